//! Data from the structure file that the page needs. It does not change while the dashboard runs.

use serde::Serialize;
use spandrel_structure::{Coordinates, Drawing, Reference, Structure};

/// Description of a structure, without measurements.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct About {
    pub(crate) name: String,
    pub(crate) description: String,
    /// Location of the structure, in words; may be empty.
    pub(crate) place: String,
    /// Whom to call about an alarm; may be empty.
    pub(crate) contact: String,
    /// Address of the instructions for an alarm.
    pub(crate) runbook: Option<String>,
    pub(crate) coordinates: Option<Coordinates>,
    pub(crate) sampling_rate_hz: f64,
    pub(crate) display_rate_hz: f64,
    /// Half-life of the filter's memory (s).
    pub(crate) half_life_s: f64,
    /// Whether there is a model. Without one, only natural frequencies are followed.
    pub(crate) has_model: bool,
    /// Whether a filter estimates the parts of the model from every frame, so that alerts judge
    /// them within seconds. Otherwise there is no model, or natural frequencies update it.
    pub(crate) is_filtered: bool,
    /// Whether nodes identify the structure from their own samples and a station fuses the results.
    pub(crate) distributed: bool,
    /// Whether waveforms and spectra of the sensors are published.
    pub(crate) has_waveforms: bool,
    pub(crate) parameters: Vec<AboutParameter>,
    pub(crate) noise: Vec<AboutNoise>,
    pub(crate) conditions: Vec<AboutCondition>,
    /// Names of the quantities that are judged for lasting change.
    pub(crate) judged: Vec<String>,
    /// How they are judged. `None` without a table `[judge]`.
    pub(crate) judge: Option<AboutJudge>,
    /// Whether earthquakes are reported.
    pub(crate) earthquakes: bool,
    /// Modes that are followed.
    pub(crate) modes: Vec<AboutMode>,
    pub(crate) rules: Vec<AboutRule>,
    pub(crate) drawing: Drawing,
    /// Index of each observed channel in the drawing's list of sensors. Without a filter, those
    /// from which modes are identified.
    #[serde(skip)]
    pub(crate) observed: Vec<usize>,
}

/// An identified parameter, as a ratio to its nominal value.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct AboutParameter {
    pub(crate) name: String,
    /// Whether 1 − θ is a loss of stiffness.
    pub(crate) stiffness: bool,
    /// Mean and standard deviation of the prior, as ratios to the nominal value.
    pub(crate) prior: (f64, f64),
    /// Loss threshold of the first rule on this parameter, as a share of the reference.
    pub(crate) loss: f64,
}

/// A noise level, shown as a variance.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct AboutNoise {
    pub(crate) name: String,
    /// Unit of the standard deviation.
    pub(crate) unit: &'static str,
    /// Standard deviation in the structure file, in the unit.
    pub(crate) std: f64,
}

/// A declared mode.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct AboutMode {
    pub(crate) name: String,
    /// Frequency in the structure file (Hz).
    pub(crate) frequency_hz: f64,
}

/// A condition, such as a temperature.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct AboutCondition {
    pub(crate) name: String,
    pub(crate) unit: &'static str,
    /// Lowest and highest plausible value, in the unit.
    pub(crate) range: Option<(f64, f64)>,
}

/// The settings of the judgement of lasting change.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct AboutJudge {
    /// Expected number of false alarms per year, for all quantities together.
    pub(crate) false_alarms_per_year: f64,
    /// Loss of stiffness that matters, as a share.
    pub(crate) loss: f64,
    pub(crate) commissioning_days: u32,
    /// Names of the conditions whose effect is removed.
    pub(crate) conditions: Vec<String>,
}

/// An alert rule.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct AboutRule {
    pub(crate) parameters: Vec<String>,
    pub(crate) loss: f64,
    pub(crate) credibility: f64,
    pub(crate) sustain_s: f64,
    /// Time for which the reference is learnt (s). `None` if the structure file states it.
    pub(crate) learn_s: Option<f64>,
}

impl About {
    pub(crate) fn new(structure: &Structure) -> Self {
        let names: Vec<String> = structure
            .parameters()
            .iter()
            .map(|parameter| parameter.name().to_owned())
            .collect();
        let parameters = structure
            .parameters()
            .iter()
            .enumerate()
            .map(|(index, parameter)| AboutParameter {
                name: parameter.name().to_owned(),
                stiffness: parameter.is_stiffness(),
                prior: (parameter.mean(), parameter.std()),
                loss: structure.loss_of_interest(index),
            });
        let noise = structure.noise_levels().iter();
        let noise = noise.map(|level| AboutNoise {
            name: level.name().to_owned(),
            unit: structure.noise_unit(level),
            std: level.std(),
        });
        let conditions = structure.conditions().iter();
        let conditions = conditions.map(|condition| AboutCondition {
            name: condition.name().to_owned(),
            unit: condition.unit(),
            range: condition.range(),
        });
        let judged = structure.judge().into_iter();
        let judged = judged.flat_map(|plan| &plan.settings.quantities);
        let modes = structure.modal().into_iter().flat_map(|plan| &plan.modes);
        let modes = modes.map(|mode| AboutMode {
            name: mode.name.clone(),
            frequency_hz: mode.frequency_hz,
        });
        let rules = structure.alert_rules().iter().map(|rule| AboutRule {
            parameters: rule
                .parameters
                .iter()
                .filter_map(|index| names.get(*index).cloned())
                .collect(),
            loss: rule.loss,
            credibility: rule.credibility,
            sustain_s: rule.sustain_s,
            learn_s: match rule.reference {
                Reference::Baseline { learn_s } => Some(learn_s),
                Reference::Given { .. } => None,
            },
        });
        let judge = structure.judge().map(|plan| &plan.settings);
        let judge = judge.map(|settings| AboutJudge {
            false_alarms_per_year: settings.false_alarms_per_year,
            loss: settings.loss,
            commissioning_days: settings.commissioning_days,
            conditions: settings
                .conditions
                .iter()
                .map(|condition| condition.name.clone())
                .collect(),
        });
        Self {
            name: structure.name().to_owned(),
            description: structure.description().to_owned(),
            place: structure.location().to_owned(),
            contact: structure.contact().to_owned(),
            runbook: structure.runbook().map(str::to_owned),
            coordinates: structure.coordinates(),
            sampling_rate_hz: structure.sampling_rate_hz(),
            display_rate_hz: structure.display_rate_hz(),
            half_life_s: structure.half_life_s(),
            has_model: structure.has_model(),
            is_filtered: structure.is_filtered(),
            distributed: structure.fusion().is_some(),
            has_waveforms: structure
                .fusion()
                .is_none_or(|plan| plan.publishes_waveforms()),
            parameters: parameters.collect(),
            noise: noise.collect(),
            conditions: conditions.collect(),
            judged: judged.map(|quantity| quantity.name.clone()).collect(),
            judge,
            earthquakes: structure.earthquakes().is_some(),
            modes: modes.collect(),
            rules: rules.collect(),
            drawing: structure.drawing(),
            observed: match structure.modal() {
                Some(plan) if !structure.is_filtered() => plan.channels.clone(),
                _ => structure.observation_channels().to_vec(),
            },
        }
    }

    /// Returns `true` if a channel is observed.
    pub(crate) fn observes(&self, channel: &str) -> bool {
        (0..self.observed.len()).any(|row| self.observed_channel(row) == Some(channel))
    }

    /// Returns the name of an observed channel from its index in the innovations.
    pub(crate) fn observed_channel(&self, row: usize) -> Option<&str> {
        self.drawing
            .sensors
            .get(*self.observed.get(row)?)
            .map(|sensor| sensor.channel.as_str())
    }
}
