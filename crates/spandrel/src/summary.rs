//! What a run ends with: the last estimates, and the alerts on the way.

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
use spandrel_structure::Structure;
use std::collections::BTreeMap;

/// The result of a run, as `--json` prints it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// Frames identified.
    pub frames: u64,
    /// The last estimate of each parameter in file order, ratio to nominal.
    pub parameters: Ordered<ParameterSummary>,
    /// Alerts that were raised, acknowledged or cleared, in order.
    pub alerts: Vec<AlertSummary>,
    /// The last estimate of each adapted noise level in file order, beside what the file states.
    pub noise: Ordered<NoiseLevelSummary>,
    /// The verdict on the fit; none where nobody judges it.
    pub fit: Option<FitSummary>,
    /// Share of the time in which alerts of each watched parameter were decided, in file order.
    pub decided: Ordered<DecidedSummary>,
    /// Mean of the normalised innovation squared per channel used, once the noise levels are trained and the start-up aid has
    /// faded; none before, and without innovations. About 1 says that the noise has the size that was found, and nothing of the
    /// model: the fit does.
    pub misfit: Option<f64>,
    /// What people should look into.
    pub warnings: Vec<String>,
    /// Whether alerts of a watched parameter are not decided at the end; a warning says why.
    #[serde(skip)]
    pub ends_undecided: bool,
    /// How the model classes stand at the end, and what they went through; none where there is one model.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub classes: Option<ClassSummary>,
    /// What became of the nodes, in file order; none where they do not identify for themselves.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub nodes: Vec<NodeSummary>,
    /// What was wrong with the samples of a record; none where nothing was, and where the services have counted it in their
    /// status.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub samples: Option<Samples>,
    /// Of particles, the mean share that counted before they were drawn anew.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub effective_share: Option<f64>,
}

/// What was wrong with the samples of a record.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct Samples {
    /// Samples that are not there, of each channel that lacks some; those that were discarded are among them.
    pub missing: BTreeMap<String, u64>,
    /// Samples that were discarded, by reason as in the status of ingest.
    pub discarded: BTreeMap<String, u64>,
}

impl Samples {
    /// Takes the frames of a structure with these channels.
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

/// Mean and standard deviation.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Level {
    pub mean: f64,
    pub std: f64,
}

/// What is known of a parameter at the end: within this record, and for this structure.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ParameterSummary {
    pub mean: f64,
    pub std: f64,
    /// Interval of 95 % within this record.
    pub within: CredibleInterval,
    /// Interval of 95 % for this structure, with the scatter between records of the baseline; none without a baseline of
    /// several records.
    pub for_this_structure: Option<CredibleInterval>,
}

/// One change of an alert.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct AlertSummary {
    /// The parameter.
    pub parameter: String,
    /// `raised`, `unconfirmed`, `acknowledged` or `cleared`.
    pub state: AlertState,
    /// Measurement time since the first frame (s).
    pub time_s: f64,
    /// Loss found at that time, a share of the reference.
    pub loss_at_first: f64,
    /// How often the loss was revised since.
    pub revisions: u32,
    /// Loss found last, a share of the reference.
    pub loss: f64,
    /// Probability found last that the loss is more than the rule asks about.
    pub credibility: f64,
    /// The alert in words.
    pub why: String,
}

/// Why nothing is decided at the end.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
enum Undecided {
    /// The data contradict the model, and no alert stands: parameters share this sentence.
    Contradicted,
    /// Another reason, or an alert that stands: the sentence.
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

/// Collects a summary from what the services say.
#[derive(Debug, Clone)]
pub struct Collector {
    parameters: Vec<String>,
    noise: Vec<StatedLevel>,
    t0_ns: Option<i64>,
    frames: u64,
    /// frames that the start-up aid lasts, and those since the last start of the filter
    annealing: (u64, u64),
    classes: ClassCollector,
    nodes: NodeCollector,
    last: Option<spandrel_bus::Estimate>,
    alerts: Vec<(i64, AlertSummary)>,
    fit: FitCollector,
    decided: Vec<(usize, DecidedFrames)>,
    /// Parameters on which nothing is decided at the end.
    undecided: BTreeMap<String, Undecided>,
    /// sum of the normalised innovations squared, and of the channels used
    misfit: (f64, f64),
    samples: Option<Samples>,
    effective_share: Option<f64>,
    baseline: Option<Baseline>,
}

impl Collector {
    /// Starts empty, for the estimates of a structure.
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
            baseline: None,
        }
    }

    /// States the intervals for the structure by the scatter between the records of a baseline.
    pub fn with_baseline(self, baseline: Option<&Baseline>) -> Self {
        Self {
            baseline: baseline.cloned(),
            ..self
        }
    }

    /// Takes the mean share of particles that counted.
    pub fn take_effective_share(&mut self, share: Option<f64>) {
        self.effective_share = share;
    }

    /// Takes what was wrong with the samples.
    pub fn take_samples(&mut self, samples: Samples) {
        self.samples = Some(samples);
    }

    /// Takes estimates in order.
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
            // the start-up aid distrusts the sensors, and the training their noise; a frame without a channel has no innovation
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

    /// Takes how the model classes stand, in order.
    pub fn take_classes(&mut self, display: &ModelClassDisplay) {
        self.classes.take(display);
    }

    /// Takes how a node that identifies for itself stands after a fusion, in order.
    pub fn take_node(&mut self, display: &NodeDisplay) {
        self.nodes.take_node(display);
    }

    /// Takes how the screening of a channel of such a node stands, in order.
    pub fn take_outliers(&mut self, display: &OutlierDisplay) {
        self.nodes.take_outliers(display);
    }

    /// Takes how many frames were decided on.
    pub fn take_decided(&mut self, watch: &Watch) {
        self.decided = watch.decided_shares().into_iter().collect();
    }

    /// Takes a change of an alert from the bus.
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

    /// Takes a change of an alert from the core.
    pub fn take_alert(&mut self, alert: &Alert) {
        let Some(parameter) = self.parameters.get(alert.parameter).cloned() else {
            return; // the core knows no other parameters
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

    /// What is not decided at the end, a sentence for each reason.
    fn undecided_warnings(&self) -> Vec<String> {
        let none_of = |names: &[&str], why: &str| {
            (!names.is_empty())
                .then(|| format!("no alert of {} is decided: {why}", names.join(", ")))
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
        // what is pending, normal or undecided wakes nobody
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

    /// Number of frames taken.
    pub fn frames(&self) -> u64 {
        self.frames
    }

    /// Returns the summary.
    pub fn finish(self) -> Summary {
        let t0_ns = self.t0_ns.unwrap_or(0);
        let level = |mean: f64, variance: f64| Level {
            mean,
            std: variance.max(0.0).sqrt(),
        };
        let (mut parameters, mut noise) = (Ordered::default(), Ordered::default());
        if let Some(last) = &self.last {
            for (index, (name, mean)) in self.parameters.iter().zip(&last.mean).enumerate() {
                let Level { mean, std } = level(*mean, last.variance(index).unwrap_or(0.0));
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
            for (stated, (mean, variance)) in self
                .noise
                .iter()
                .zip(last.noise_mean.iter().zip(&last.noise_covariance))
            {
                noise.push(stated.name.clone(), stated.found(level(*mean, *variance)));
            }
        }
        let warnings = self
            .noise
            .iter()
            .zip(noise.values())
            .filter_map(|(stated, found)| stated.warning(found));
        let fit = self.fit.finish();
        let warnings = warnings.chain(fit.as_ref().and_then(FitSummary::warning));
        let undecided = self.undecided_warnings();
        let ends_undecided = !undecided.is_empty();
        let warnings = warnings.chain(undecided).collect();
        let mut decided = Ordered::default();
        for (parameter, frames) in &self.decided {
            if let (Some(name), Some(summary)) =
                (self.parameters.get(*parameter), DecidedSummary::of(frames))
            {
                decided.push(name.clone(), summary);
            }
        }
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
            ends_undecided,
            classes: self.classes.finish(t0_ns),
            nodes: self.nodes.finish(),
            samples: self.samples,
            effective_share: self.effective_share,
        }
    }
}

impl Summary {
    /// Writes the summary as one line of JSON.
    pub fn json(&self) -> String {
        // names and finite numbers only: this cannot fail
        serde_json::to_string(self).map_or_else(|error| error.to_string(), |line| line + "\n")
    }
}
