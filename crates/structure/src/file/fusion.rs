//! Reads `identification` of `[structure]`, and `[fusion]`: the settings of distributed
//! identification.

use crate::fusion_plan::{FusionPlan, MotionPlan};
use crate::node::Node;
use crate::section::{Allowed, Section};
use spandrel_filter::fusion::{
    CovarianceScheme, FeedbackRule, FusionRule, GlobalDetector, Sharing, Weighting,
};
use std::ops::Range;
use toml::Spanned;

/// Values of `identification`: `true` if identification is distributed.
pub(super) const IDENTIFICATIONS: [(&str, bool); 2] =
    [("centralized", false), ("distributed", true)];

#[derive(Clone, Copy, PartialEq)]
enum Rule {
    PriorCorrect,
    Published,
}

const RULES: [(&str, Rule); 2] = [
    ("prior-correct", Rule::PriorCorrect),
    ("published", Rule::Published),
];

const FEEDBACKS: [(&str, FeedbackRule); 5] = [
    ("marginal", FeedbackRule::Marginal),
    ("federated", FeedbackRule::Federated),
    ("mean", FeedbackRule::Mean),
    ("none", FeedbackRule::None),
    ("reset", FeedbackRule::Reset),
];

const COVARIANCES: [(&str, bool); 2] = [("full", true), ("variances", false)];

#[derive(Clone, Copy, PartialEq)]
enum Motion {
    None,
    Modes,
    Responses,
    Samples,
}

const MOTIONS: [(&str, Motion); 4] = [
    ("none", Motion::None),
    ("modes", Motion::Modes),
    ("responses", Motion::Responses),
    ("samples", Motion::Samples),
];

/// Default number of sample instants that nodes exchange in a fusion period.
const SAMPLES: usize = 10;

#[derive(Clone, Copy, PartialEq)]
enum Detector {
    None,
    AllAtOnce,
    OneAtATime,
}

const DETECTORS: [(&str, Detector); 3] = [
    ("none", Detector::None),
    ("all-at-once", Detector::AllAtOnce),
    ("one-at-a-time", Detector::OneAtATime),
];

const WEIGHTINGS: [(&str, Weighting); 2] = [
    ("all-or-nothing", Weighting::AllOrNothing),
    ("graded", Weighting::Graded),
];

/// Default rate of fusions (Hz).
const RATE_HZ: f64 = 1.0;

/// Default test of the nodes, stricter than the source.
///
/// The node beside a damage detects it first, and should not be excluded for that.
const DETECTOR: GlobalDetector = GlobalDetector {
    screening: 0.999,
    exclusion: 0.5,
    one_at_a_time: true,
    readmission: 3,
    weighting: Weighting::AllOrNothing,
};

/// Default age (fusion periods) above which a message is stale: Huang & Yuen (2023), chapter 7.
const STALE_PERIODS: f64 = 3.0;

/// The parts of the file that `[fusion]` must fit.
pub(super) struct FusionContext<'c> {
    /// Sampling rate of the structure (Hz).
    pub(super) rate_hz: Option<f64>,
    pub(super) nodes: &'c [Node],
    /// `true` if the file compares model classes.
    pub(super) has_classes: bool,
}

/// Reads `[fusion]` of a structure with distributed identification.
pub(super) fn read_fusion(
    section: Option<Section<'_>>,
    distributed: Option<&Spanned<bool>>,
    file: &Section<'_>,
    context: &FusionContext<'_>,
) -> Option<FusionPlan> {
    let Some(span) = distributed
        .filter(|distributed| *distributed.get_ref())
        .map(Spanned::span)
    else {
        if let Some(section) = section {
            refuse_fusion(section);
        }
        return None;
    };
    if context.has_classes {
        let allowed =
            "must not be distributed: model classes need the samples of all nodes in one filter";
        file.diagnostics().report(
            span,
            "structure.identification",
            "is \"distributed\" with [classes]",
            allowed,
        );
    }
    let (rate_hz, nodes) = (context.rate_hz, context.nodes);
    let mut plan = FusionPlan {
        rate_hz: RATE_HZ,
        rule: FusionRule::default(),
        feedback: FeedbackRule::default(),
        covariance: CovarianceScheme::Full,
        motion: MotionPlan::None,
        detector: Some(DETECTOR),
        stale_periods: STALE_PERIODS,
        waveforms: false,
    };
    let Some(mut section) = section else {
        check_rate(file, None, plan.rate_hz, rate_hz, nodes);
        return Some(plan);
    };
    let fusion_rate = section.number("rate-hz", Allowed::RATE);
    plan.rate_hz = fusion_rate.as_ref().map_or(RATE_HZ, |rate| *rate.get_ref());
    let divides = check_rate(&section, fusion_rate.as_ref(), plan.rate_hz, rate_hz, nodes);
    plan.rule = read_rule(&mut section);
    let feedback = section.choice("feedback", &FEEDBACKS);
    plan.feedback = feedback
        .as_ref()
        .map_or(plan.feedback, |feedback| *feedback.get_ref());
    if let Some(full) = section.choice("covariance", &COVARIANCES) {
        plan.covariance = if full.into_inner() {
            CovarianceScheme::Full
        } else {
            CovarianceScheme::Identity
        };
    }
    let motion = MotionRead::new(&mut section);
    plan.motion = motion.plan();
    if let (MotionPlan::Samples(instants), Some(rate_hz)) =
        (plan.motion, rate_hz.filter(|_| divides))
    {
        motion.check_instants(&section, instants, plan.rate_hz, rate_hz, nodes);
    }
    motion.check_keys(&section);
    motion.check_feedback(&section, feedback.as_ref());
    motion.check_nodes(&section, nodes);
    plan.detector = read_detector(&mut section);
    plan.stale_periods = section.number_or("stale-periods", Allowed::FROM_ONE, STALE_PERIODS);
    plan.waveforms = section.flag_or("waveforms", false);
    section.finish();
    Some(plan)
}

/// Reports that a structure without distributed identification has `[fusion]`.
fn refuse_fusion(mut section: Section<'_>) {
    let allowed = "must not be given unless identification = \"distributed\" in [structure]";
    section
        .diagnostics()
        .report(section.span(), "fusion", "is given", allowed);
    section.leave_unread(&[
        "rate-hz",
        "rule",
        "sharing-factor",
        "feedback",
        "covariance",
        "motion",
        "modes",
        "samples-per-period",
        "detector",
        "screening",
        "exclusion",
        "readmission",
        "weighting",
        "stale-periods",
        "waveforms",
    ]);
    section.finish();
}

fn read_rule(section: &mut Section<'_>) -> FusionRule {
    let rule = section
        .choice("rule", &RULES)
        .map_or(Rule::PriorCorrect, Spanned::into_inner);
    let sharing = section.number("sharing-factor", Allowed::FROM_ONE);
    if let (Rule::Published, Some(sharing)) = (rule, &sharing) {
        let allowed =
            "must not be given together with rule = \"published\", which assumes independent nodes";
        section.diagnostics().report(
            sharing.span(),
            section.key("sharing-factor"),
            "is given",
            allowed,
        );
    }
    match rule {
        Rule::Published => FusionRule::Published,
        Rule::PriorCorrect => FusionRule::PriorCorrect(
            sharing
                .as_ref()
                .map_or(Sharing::All, |factor| Sharing::Factor(*factor.get_ref())),
        ),
    }
}

/// What `[fusion]` states about the motion that nodes and station exchange.
struct MotionRead {
    motion: Motion,
    /// Position of the motion, or of the table.
    span: Range<usize>,
    modes: Option<Spanned<usize>>,
    samples: Option<Spanned<usize>>,
}

impl MotionRead {
    fn new(section: &mut Section<'_>) -> Self {
        let motion = section.choice("motion", &MOTIONS);
        let span = motion.as_ref().map_or(section.span(), Spanned::span);
        Self {
            motion: motion.map_or(Motion::None, Spanned::into_inner),
            span,
            modes: section.whole("modes", 1, 10_000),
            samples: section.whole("samples-per-period", 1, 10_000),
        }
    }

    fn plan(&self) -> MotionPlan {
        match self.motion {
            Motion::None => MotionPlan::None,
            Motion::Modes => MotionPlan::Modes(self.modes.as_ref().map(|modes| *modes.get_ref())),
            Motion::Responses => MotionPlan::Responses,
            Motion::Samples => MotionPlan::Samples(
                self.samples
                    .as_ref()
                    .map_or(SAMPLES, |samples| *samples.get_ref()),
            ),
        }
    }

    /// Checks that the sample instants divide the samples of each node in a fusion period.
    fn check_instants(
        &self,
        section: &Section<'_>,
        instants: usize,
        fusion_hz: f64,
        rate_hz: f64,
        nodes: &[Node],
    ) {
        let rates = nodes
            .iter()
            .map(|node| node.sampling_rate_hz().unwrap_or(rate_hz));
        let uneven =
            |rate_hz: &f64| !((rate_hz / fusion_hz).round() as u64).is_multiple_of(instants as u64);
        if let Some(rate_hz) = rates.chain([rate_hz]).find(uneven) {
            let samples = self.samples.as_ref();
            let span = samples.map_or(section.span(), Spanned::span);
            let allowed = format!(
                "must divide {}, the samples of a node in a fusion period, without remainder",
                (rate_hz / fusion_hz).round()
            );
            let found = if samples.is_some() {
                format!("is {instants}")
            } else {
                format!("is left at {instants}")
            };
            section
                .diagnostics()
                .report(span, section.key("samples-per-period"), found, allowed);
        }
    }

    /// Checks that only the keys of the chosen motion are given.
    fn check_keys(&self, section: &Section<'_>) {
        let samples = self.samples.as_ref();
        if let Some(samples) = samples.filter(|_| self.motion != Motion::Samples) {
            let allowed = "must not be given unless motion = \"samples\"";
            section.diagnostics().report(
                samples.span(),
                section.key("samples-per-period"),
                "is given",
                allowed,
            );
        }
        let modes = self.modes.as_ref();
        if let Some(modes) = modes.filter(|_| self.motion != Motion::Modes) {
            let allowed = "must not be given unless motion = \"modes\"";
            section
                .diagnostics()
                .report(modes.span(), section.key("modes"), "is given", allowed);
        }
    }

    /// Checks that the motion contains what the stated feedback needs.
    fn check_feedback(&self, section: &Section<'_>, feedback: Option<&Spanned<FeedbackRule>>) {
        let Some(feedback) = feedback else {
            return;
        };
        let (found, allowed) = match (feedback.get_ref(), self.motion) {
            (FeedbackRule::Reset, motion) if motion != Motion::Modes => (
                "is \"reset\"",
                "must be given together with motion = \"modes\", from which the motion is reset",
            ),
            (FeedbackRule::None, Motion::Samples) => (
                "is \"none\"",
                "must not be \"none\" with motion = \"samples\", which come with the answers",
            ),
            _ => return,
        };
        section
            .diagnostics()
            .report(feedback.span(), section.key("feedback"), found, allowed);
    }

    /// Checks that a node measures what the nodes send.
    fn check_nodes(&self, section: &Section<'_>, nodes: &[Node]) {
        let tells = |node: &Node| {
            node.channels()
                .iter()
                .any(|channel| channel.quantity().is_told_as_response())
        };
        if self.motion == Motion::Responses && !nodes.is_empty() && !nodes.iter().any(tells) {
            let allowed = "must not be given unless a node measures a displacement, a velocity or \
                a strain, because nodes send only these";
            section.diagnostics().report(
                self.span.clone(),
                section.key("motion"),
                "is \"responses\"",
                allowed,
            );
        }
    }
}

/// Reads the station's test of the nodes. Keys that the chosen test does not use are mistakes.
fn read_detector(section: &mut Section<'_>) -> Option<GlobalDetector> {
    let detector = section
        .choice("detector", &DETECTORS)
        .map_or(Detector::OneAtATime, Spanned::into_inner);
    let screening = section.number("screening", Allowed::INSIDE_UNIT);
    let exclusion = section.number("exclusion", Allowed::INSIDE_UNIT);
    let readmission = section.whole("readmission", 1, 10_000);
    let weighting = section.choice("weighting", &WEIGHTINGS);
    let unread = [
        (
            "screening",
            screening.as_ref().map(Spanned::span),
            detector == Detector::None,
        ),
        (
            "exclusion",
            exclusion.as_ref().map(Spanned::span),
            detector != Detector::AllAtOnce,
        ),
        (
            "readmission",
            readmission.as_ref().map(Spanned::span),
            detector == Detector::None,
        ),
        (
            "weighting",
            weighting.as_ref().map(Spanned::span),
            detector == Detector::None,
        ),
    ];
    for (key, span, is_unread) in unread {
        if let Some(span) = span.filter(|_| is_unread) {
            let (name, _) = DETECTORS
                .iter()
                .find(|(_, choice)| *choice == detector)
                .unwrap_or(&DETECTORS[0]);
            let allowed =
                format!("must not be given together with detector = \"{name}\", which ignores it");
            section
                .diagnostics()
                .report(span, section.key(key), "is given", allowed);
        }
    }
    (detector != Detector::None).then_some(GlobalDetector {
        screening: screening.map_or(DETECTOR.screening, Spanned::into_inner),
        exclusion: exclusion.map_or(DETECTOR.exclusion, Spanned::into_inner),
        one_at_a_time: detector == Detector::OneAtATime,
        readmission: readmission.map_or(DETECTOR.readmission, |fusions| *fusions.get_ref() as u32),
        weighting: weighting.map_or(DETECTOR.weighting, Spanned::into_inner),
    })
}

/// Checks that each node sends after a whole number of its samples; returns `true` if all do.
fn check_rate(
    section: &Section<'_>,
    given: Option<&Spanned<f64>>,
    fusion_rate_hz: f64,
    rate_hz: Option<f64>,
    nodes: &[Node],
) -> bool {
    let Some(rate_hz) = rate_hz else { return true };
    for rate_hz in nodes
        .iter()
        .map(|node| node.sampling_rate_hz().unwrap_or(rate_hz))
        .chain([rate_hz])
    {
        let samples = rate_hz / fusion_rate_hz;
        if samples.round() < 1.0 || (samples - samples.round()).abs() > 1e-9 * samples {
            let (span, key) = match given {
                Some(given) => (given.span(), section.key("rate-hz")),
                None => (section.span(), "fusion.rate-hz".to_owned()),
            };
            let allowed = format!(
                "must be the sampling rate of each node, such as {rate_hz}, divided by a whole \
                 number"
            );
            section
                .diagnostics()
                .report(span, key, format!("is {fusion_rate_hz}"), allowed);
            return false;
        }
    }
    true
}

#[cfg(test)]
mod tests;
