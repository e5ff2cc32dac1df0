//! Summary at the end of a run: the last estimates and all alerts.

mod classes;
mod decided;
mod fit;
mod nodes;
mod noise;
mod ordered;
mod text;

use classes::ClassCollector;
pub use classes::ClassSummary;
pub use decided::DecidedSummary;
use fit::FitCollector;
pub use fit::FitSummary;
use nodes::NodeCollector;
pub use nodes::NodeSummary;
pub use noise::{NoiseLevelSummary, StatedLevel};
pub use ordered::Ordered;
use serde::Serialize;
use spandrel_alert::{Alert, Baseline, DecidedFrames, ParameterEstimate, Watch};
use spandrel_bus::{
    AlertMessage, AlertState, CredibleInterval, EstimateBlock, FrameBlock, ModelClassDisplay,
    NodeDisplay, OutlierDisplay, Phase, UndecidedBecause,
};
use spandrel_faults::ObservedRelation;
use spandrel_structure::Structure;
use std::collections::BTreeMap;

/// Result of a run, as `--json` prints it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// Number of identified frames.
    pub frames: u64,
    /// Last estimate of each parameter in file order, as a ratio to nominal.
    pub parameters: Ordered<ParameterSummary>,
    /// Alerts that were raised, acknowledged or cleared, in order.
    pub alerts: Vec<AlertSummary>,
    /// Last estimate of each adapted noise level in file order, with the stated level.
    pub noise: Ordered<NoiseLevelSummary>,
    /// Verdict on the fit. `None` if no service judges it.
    pub fit: Option<FitSummary>,
    /// Share of the time in which alerts of each watched parameter were decided, in file order.
    pub decided: Ordered<DecidedSummary>,
    /// Mean of the normalised innovation squared per used channel.
    ///
    /// It covers the frames after the noise training and the start-up aid. `None` if there are no
    /// such frames or no innovations. A value of about 1 means that the noise has the identified
    /// size. It says nothing about the model, unlike the fit.
    pub misfit: Option<f64>,
    /// Warnings that require attention.
    pub warnings: Vec<String>,
    /// Whether alerts of a watched parameter are undecided at the end, or were so for more than
    /// half of the time. A warning states the reason.
    #[serde(skip)]
    pub is_undecided: bool,
    /// Final state and changes of the model classes. `None` if there is a single model.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub classes: Option<ClassSummary>,
    /// Summary of each node in file order. Empty without distributed identification.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub nodes: Vec<NodeSummary>,
    /// Problems with the samples of a record. `None` if there were none, or if the status of the
    /// services counts them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub samples: Option<Samples>,
    /// Mean relative effective sample size of the particles before resampling: the effective sample
    /// size divided by the number of particles (0 to 1). `None` without a particle filter.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub effective_share: Option<f64>,
}

/// Problems with the samples of a record.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct Samples {
    /// Number of missing samples of each channel with any. Discarded samples count as missing.
    pub missing: BTreeMap<String, u64>,
    /// Number of discarded samples by reason, as in the status of ingest.
    pub discarded: BTreeMap<String, u64>,
}

impl Samples {
    /// Counts the missing samples in frames with these channels.
    pub fn take_frames(&mut self, channels: &[String], block: &FrameBlock) {
        for (_, values) in block.iter() {
            for (channel, value) in channels.iter().zip(values) {
                if value.is_nan() {
                    *self.missing.entry(channel.clone()).or_default() += 1;
                }
            }
        }
    }
}

/// Mean and standard deviation of a level.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Level {
    pub mean: f64,
    pub std: f64,
}

impl Level {
    fn new(mean: f64, variance: f64) -> Self {
        Self {
            mean,
            std: variance.max(0.0).sqrt(),
        }
    }
}

/// Final estimate of a parameter, within this record and for this structure.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ParameterSummary {
    pub mean: f64,
    pub std: f64,
    /// Credible interval of 95 % within this record.
    pub within: CredibleInterval,
    /// Credible interval of 95 % for this structure. It includes the scatter between records from
    /// the baseline.
    ///
    /// `None` without a baseline of several records.
    pub for_this_structure: Option<CredibleInterval>,
}

/// One change of an alert.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct AlertSummary {
    /// Name of the parameter.
    pub parameter: String,
    /// `raised`, `unconfirmed`, `acknowledged` or `cleared`.
    pub state: AlertState,
    /// Measurement time since the first frame (s).
    pub time_s: f64,
    /// Estimate of the loss at that time, as a share of the reference.
    pub loss_at_first: f64,
    /// Number of later revisions of the loss.
    pub revisions: u32,
    /// Last estimate of the loss, as a share of the reference.
    pub loss: f64,
    /// Last probability that the loss exceeds the threshold of the rule.
    pub credibility: f64,
    /// Sentence of the alert.
    pub why: String,
}

/// Reason for an undecided alert at the end.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
enum Undecided {
    /// The data contradict the model and there is no active alert. Parameters share one sentence.
    Contradicted,
    /// Another reason, or an active alert, with its sentence.
    Other(String),
}

impl Undecided {
    fn new(state: AlertState, because: UndecidedBecause, why: &str) -> Self {
        match (state, because) {
            (AlertState::Undecided, UndecidedBecause::FitContradicted) => Self::Contradicted,
            _ => Self::Other(why.to_owned()),
        }
    }
}

/// Collects a summary from the messages of the services.
#[derive(Debug, Clone)]
pub struct Collector {
    parameters: Vec<String>,
    noise: Vec<StatedLevel>,
    t0_ns: Option<i64>,
    frames: u64,
    /// Number of frames of the start-up aid, and of frames since the last start of the filter.
    annealing: (u64, u64),
    classes: ClassCollector,
    nodes: NodeCollector,
    last: Option<spandrel_bus::Estimate>,
    alerts: Vec<(i64, AlertSummary)>,
    fit: FitCollector,
    decided: Vec<(usize, DecidedFrames)>,
    /// Parameters without a decision at the end.
    undecided: BTreeMap<String, Undecided>,
    /// Sum of the normalised innovations squared, and sum of the used channels.
    misfit: (f64, f64),
    samples: Option<Samples>,
    effective_share: Option<f64>,
    /// Relation of each channel to the others.
    observed: Vec<Option<ObservedRelation>>,
    /// Channels that are in doubt or faulty at the end, as indices in a frame.
    suspected: Vec<usize>,
    /// Number of frames in which each channel was in doubt or faulty.
    suspected_frames: Vec<u64>,
    baseline: Option<Baseline>,
}

impl Collector {
    /// Creates an empty collector for the estimates of a structure.
    pub fn new(structure: &Structure) -> Self {
        let annealed = (structure.annealing_end_s() * structure.sampling_rate_hz()).ceil() as u64;
        Self {
            parameters: structure
                .parameters()
                .iter()
                .map(|parameter| parameter.name().to_owned())
                .collect(),
            noise: StatedLevel::adapted_of(structure),
            t0_ns: None,
            frames: 0,
            annealing: (annealed, 0),
            classes: ClassCollector::default(),
            nodes: NodeCollector::new(structure),
            last: None,
            alerts: Vec::new(),
            fit: FitCollector::default(),
            decided: Vec::new(),
            undecided: BTreeMap::new(),
            misfit: (0.0, 0.0),
            samples: None,
            effective_share: None,
            observed: Vec::new(),
            suspected: Vec::new(),
            suspected_frames: vec![0; structure.channel_count()],
            baseline: None,
        }
    }

    /// Adds a baseline, whose scatter between records determines the intervals for the structure.
    pub fn with_baseline(self, baseline: Option<&Baseline>) -> Self {
        Self {
            baseline: baseline.cloned(),
            ..self
        }
    }

    /// Records the mean relative effective sample size of the particles (0 to 1), or `None` without
    /// a particle filter.
    pub fn take_effective_share(&mut self, share: Option<f64>) {
        self.effective_share = share;
    }

    /// Records the mean relation of each channel to the others, and the channels that are in doubt
    /// or faulty at the end (indices in a frame).
    pub fn take_sensors(&mut self, observed: Vec<Option<ObservedRelation>>, suspected: Vec<usize>) {
        self.observed = observed;
        self.suspected = suspected;
    }

    /// Counts frames in which these channels (indices in a frame) were in doubt or faulty.
    pub fn take_suspected(&mut self, suspected: impl Iterator<Item = usize>, frames: usize) {
        for channel in suspected {
            if let Some(count) = self.suspected_frames.get_mut(channel) {
                *count += frames as u64;
            }
        }
    }

    /// Returns the number of frames in which a channel was in doubt or faulty.
    pub fn suspected_frames(&self, channel: usize) -> u64 {
        self.suspected_frames.get(channel).copied().unwrap_or(0)
    }

    /// Returns the channels that are in doubt or faulty at the end, as indices in a frame.
    pub fn suspected(&self) -> &[usize] {
        &self.suspected
    }

    /// Returns the mean relation of each channel to the others. `None` for a channel that could not
    /// be compared.
    pub fn observed(&self) -> &[Option<ObservedRelation>] {
        &self.observed
    }

    /// Records the problems with the samples.
    pub fn take_samples(&mut self, samples: Samples) {
        self.samples = Some(samples);
    }

    /// Processes estimates in order.
    pub fn take_estimates(&mut self, block: &EstimateBlock) {
        self.t0_ns.get_or_insert(block.t0_ns);
        self.frames += block.estimates.len() as u64;
        for estimate in &block.estimates {
            self.fit.take(&estimate.flags);
            let (annealed, since_start) = &mut self.annealing;
            *since_start = if estimate.flags.restarted {
                0
            } else {
                *since_start + 1
            };
            // The start-up aid distrusts the sensors, and the training distrusts their noise. A
            // frame without channels has no innovation.
            if estimate.flags.phase == Phase::Working
                && *since_start > *annealed
                && estimate
                    .innovations
                    .iter()
                    .any(|innovation| innovation.is_finite())
            {
                self.misfit.0 += estimate.normalised_innovation_squared;
                self.misfit.1 += f64::from(estimate.used_channels);
            }
        }
        if let Some(last) = block.estimates.last() {
            self.last = Some(last.clone());
        }
    }

    /// Processes the state of the model classes, in order.
    pub fn take_classes(&mut self, display: &ModelClassDisplay) {
        self.classes.take(display);
    }

    /// Processes the state of a distributed node after a fusion, in order.
    pub fn take_node(&mut self, display: &NodeDisplay) {
        self.nodes.take_node(display);
    }

    /// Processes the screening of a channel of a distributed node, in order.
    pub fn take_outliers(&mut self, display: &OutlierDisplay) {
        self.nodes.take_outliers(display);
    }

    /// Records the share of decided frames.
    pub fn take_decided(&mut self, watch: &Watch) {
        self.decided = watch.decided_shares().into_iter().collect();
    }

    /// Processes a change of an alert from the bus.
    pub fn take_message(&mut self, message: &AlertMessage) {
        let parameter = message.parameter.to_string();
        let undecided = message
            .undecided_because
            .map(|because| Undecided::new(message.state, because, &message.why));
        self.note_undecided(&parameter, undecided);
        let told = |loss| AlertSummary {
            parameter,
            state: message.state,
            time_s: 0.0,
            loss_at_first: loss,
            revisions: message.revision,
            loss,
            credibility: message.credibility,
            why: message.why.clone(),
        };
        self.take(message.time_ns, message.loss.map(told));
    }

    /// Processes a change of an alert from the core.
    pub fn take_alert(&mut self, alert: &Alert) {
        let Some(parameter) = self.parameters.get(alert.parameter).cloned() else {
            return; // the core has the same parameters
        };
        let undecided = alert
            .undecided_because
            .map(|because| Undecided::new(alert.state, because, &alert.why));
        self.note_undecided(&parameter, undecided);
        let told = |loss| AlertSummary {
            parameter,
            state: alert.state,
            time_s: 0.0,
            loss_at_first: loss,
            revisions: alert.revision,
            loss,
            credibility: alert.probability_of_loss,
            why: alert.why.clone(),
        };
        self.take(
            alert.estimate.time_ns,
            alert.loss.map(|estimate| told(estimate.loss)),
        );
    }

    fn note_undecided(&mut self, parameter: &str, undecided: Option<Undecided>) {
        match undecided {
            Some(undecided) => drop(self.undecided.insert(parameter.to_owned(), undecided)),
            None => drop(self.undecided.remove(parameter)),
        }
    }

    /// Returns one sentence for each reason why alerts are undecided at the end.
    fn undecided_warnings(&self) -> Vec<String> {
        let none_of = |names: &[&str], why: &str| {
            (!names.is_empty()).then(|| format!("no decision on {}: {why}", names.join(", ")))
        };
        let contradicted = self.parameters.iter().map(String::as_str);
        let contradicted: Vec<&str> = contradicted
            .filter(|name| self.undecided.get(*name) == Some(&Undecided::Contradicted))
            .collect();
        let learning = self
            .decided
            .iter()
            .filter(|(_, frames)| frames.frames() == 0);
        let learning = learning.filter_map(|(parameter, _)| self.parameters.get(*parameter));
        let learning: Vec<&str> = learning
            .filter(|name| !self.undecided.contains_key(*name))
            .map(String::as_str)
            .collect();
        let others = self
            .undecided
            .values()
            .filter_map(|undecided| match undecided {
                Undecided::Other(why) => Some(why.clone()),
                Undecided::Contradicted => None,
            });
        let shared = none_of(&contradicted, UndecidedBecause::FitContradicted.words());
        let shared = shared.into_iter().chain(none_of(
            &learning,
            "the reference was still being learnt at the end",
        ));
        shared.chain(others).collect()
    }

    fn take(&mut self, time_ns: i64, told: Option<AlertSummary>) {
        // Pending, normal and undecided states require no attention.
        let tells = |told: &AlertSummary| {
            let states = [
                AlertState::Raised,
                AlertState::Unconfirmed,
                AlertState::Acknowledged,
                AlertState::Cleared,
            ];
            states.contains(&told.state)
        };
        let Some(told) = told.filter(tells) else {
            return;
        };
        let is_same =
            |other: &AlertSummary| other.parameter == told.parameter && other.state == told.state;
        if told.revisions > 0
            && let Some((_, last)) = self
                .alerts
                .iter_mut()
                .rev()
                .find(|(_, other)| is_same(other))
        {
            if told.revisions > last.revisions {
                *last = AlertSummary {
                    loss_at_first: last.loss_at_first,
                    ..told
                };
            }
            return;
        }
        if !self
            .alerts
            .iter()
            .any(|(at, other)| *at == time_ns && is_same(other))
        {
            self.alerts.push((time_ns, told));
        }
    }

    /// Returns the number of processed frames.
    pub fn frames(&self) -> u64 {
        self.frames
    }

    /// Returns the last estimate of each parameter.
    fn last_parameters(&self) -> Ordered<ParameterSummary> {
        let mut parameters = Ordered::default();
        let Some(last) = &self.last else {
            return parameters;
        };
        for (index, (name, mean)) in self.parameters.iter().zip(&last.mean).enumerate() {
            let Level { mean, std } = Level::new(*mean, last.variance(index).unwrap_or(0.0));
            let estimate = ParameterEstimate {
                time_ns: 0,
                mean,
                std,
            };
            let baseline = self.baseline.as_ref();
            let for_this_structure =
                baseline.and_then(|baseline| baseline.for_structure(name, &estimate));
            let within = estimate.interval();
            parameters.push(
                name.clone(),
                ParameterSummary {
                    mean,
                    std,
                    within,
                    for_this_structure,
                },
            );
        }
        parameters
    }

    /// Returns the last estimate of each adapted noise level.
    fn last_noise(&self) -> Ordered<NoiseLevelSummary> {
        let mut noise = Ordered::default();
        let Some(last) = &self.last else {
            return noise;
        };
        let levels = last.noise_mean.iter().zip(&last.noise_covariance);
        for (stated, (mean, variance)) in self.noise.iter().zip(levels) {
            noise.push(
                stated.name.clone(),
                stated.found(Level::new(*mean, *variance)),
            );
        }
        noise
    }

    /// Returns the summary.
    pub fn finish(self) -> Summary {
        let t0_ns = self.t0_ns.unwrap_or(0);
        let (parameters, noise) = (self.last_parameters(), self.last_noise());
        let warnings = self
            .noise
            .iter()
            .zip(noise.values())
            .filter_map(|(stated, found)| stated.warning(found));
        let fit = self.fit.finish();
        let unmeasured = || "the fit was not measured: alerts are decided without a verdict on it";
        let unmeasured = (fit.is_none() && !self.decided.is_empty()).then(unmeasured);
        let warnings = warnings
            .chain(fit.as_ref().and_then(FitSummary::warning))
            .chain(unmeasured.map(str::to_owned));
        let mut decided = Ordered::default();
        for (parameter, frames) in &self.decided {
            if let (Some(name), Some(summary)) =
                (self.parameters.get(*parameter), DecidedSummary::of(frames))
            {
                decided.push(name.clone(), summary);
            }
        }
        let mut undecided = self.undecided_warnings();
        undecided.extend(DecidedSummary::warning(decided.iter()));
        let is_undecided = !undecided.is_empty();
        let warnings = warnings.chain(undecided).collect();
        let alerts = self
            .alerts
            .into_iter()
            .map(|(time_ns, alert)| AlertSummary {
                time_s: time_ns.saturating_sub(t0_ns) as f64 / 1e9,
                ..alert
            });
        let (sum, channels) = self.misfit;
        let misfit = (channels > 0.0).then(|| sum / channels);
        Summary {
            frames: self.frames,
            parameters,
            alerts: alerts.collect(),
            noise,
            fit,
            decided,
            misfit,
            warnings,
            is_undecided,
            classes: self.classes.finish(t0_ns),
            nodes: self.nodes.finish(),
            samples: self.samples,
            effective_share: self.effective_share,
        }
    }
}

impl Summary {
    /// Returns the summary as one line of JSON.
    pub fn json(&self) -> String {
        // Cannot fail, because the summary contains only names and finite numbers.
        serde_json::to_string(self).map_or_else(|error| error.to_string(), |line| line + "\n")
    }
}
