//! The inputs of the present state, and their comparison with the keys of their messages.

use spandrel_bus::{
    Acknowledgement, AlertMessage, ConditionDisplay, EstimateBlock, Event, FitDisplay, HistoryLog,
    JudgementDisplay, JudgementLog, KeyFamily as K, LossDisplay, ModeDisplay, ModelClassDisplay,
    MonitoringDisplay, Name, NodeDisplay, NoiseDisplay, OutlierDisplay, ParameterDisplay, Progress,
    SensorHealthDisplay, Service, SpectrumDisplay, Status, Topic, WaveformDisplay, parse_key,
};
use std::collections::BTreeSet;
use std::time::Duration;

/// An input of the present state.
#[derive(Clone, Debug, PartialEq)]
pub enum Input {
    /// Time since a fixed moment. Later inputs are received at this time.
    Now(Duration),
    /// The estimate of a parameter.
    Parameter(ParameterDisplay),
    /// The loss of a parameter.
    Loss(LossDisplay),
    /// The estimate of a noise level.
    Noise(NoiseDisplay),
    /// The outliers of a channel.
    Outlier(OutlierDisplay),
    /// Comparison of the sensors of a node with the others.
    SensorHealth(SensorHealthDisplay),
    /// The reduced samples of a node.
    Waveform(WaveformDisplay),
    /// The spectra of a node.
    Spectrum(SpectrumDisplay),
    /// A value of a condition.
    Condition(ConditionDisplay),
    /// The latest value of a condition, and its age when the query was answered.
    StandingCondition(ConditionDisplay, Duration),
    /// The judgement of a quantity.
    Judgement(JudgementDisplay),
    /// A declared mode.
    Mode(Box<ModeDisplay>),
    /// The plausibility of the model classes.
    Classes(ModelClassDisplay),
    /// The station's assessment of a node.
    Node(NodeDisplay),
    /// The verdict on the fit.
    Fit(FitDisplay),
    /// Whether the present data reveal damage.
    Monitoring(MonitoringDisplay),
    /// Estimates of a structure at the sampling rate.
    Estimates(Name, EstimateBlock),
    /// The alert of a parameter has changed.
    Alert(AlertMessage),
    /// The state of an alert in reply to a query.
    StandingAlert(AlertMessage),
    /// A past change of an alert, from the log of the alert service.
    LoggedAlert(AlertMessage),
    /// A person has acknowledged an alert.
    Acknowledgement(Acknowledgement),
    /// An event, such as a restart.
    Event(Event),
    /// The status of a service.
    Status(Status),
    /// Progress of ingest of a structure.
    Ingested(Name, Progress),
    /// All instances that are present.
    Present(BTreeSet<Instance>),
    /// Past changes and events from the history service.
    Past(HistoryLog),
    /// Past changes of lasting losses from the service `judge`.
    LastingLosses(JudgementLog),
    /// A message whose content contradicts its key.
    Misplaced,
}

/// One instance of a service, or one sensor node, of a structure.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Instance {
    /// Name of the structure.
    pub structure: Name,
    /// The service.
    pub service: Service,
    /// The name of the instance or of the node.
    pub id: Name,
}

impl Instance {
    /// Returns the instance that a liveliness token represents.
    pub(crate) fn of_token(root: &Name, key: &str) -> Option<Self> {
        let (structure, topic) = parse_key(root, key)?;
        match (topic.family, topic.of) {
            (K::Live(service), Some(id)) => Some(Self {
                structure,
                service,
                id,
            }),
            _ => None,
        }
    }
}

impl Input {
    /// Converts a received message, or returns [`Input::Misplaced`] if it contradicts its key.
    /// `input` receives the structure in the key.
    pub(crate) fn placed(root: &Name, key: &str, input: impl FnOnce(Name) -> Self) -> Self {
        let Some((structure, topic)) = parse_key(root, key) else {
            return Self::Misplaced;
        };
        let input = input(structure.clone());
        if input.place() == Some((&structure, Some(topic))) {
            input
        } else {
            Self::Misplaced
        }
    }

    /// Returns the structure that the input concerns. `None` if it concerns all.
    #[must_use]
    pub fn structure(&self) -> Option<&Name> {
        self.place().map(|(structure, _)| structure)
    }

    /// Returns the structure and the topic of a message. A message without a topic of its own has
    /// `None`.
    fn place(&self) -> Option<(&Name, Option<Topic>)> {
        let (structure, topic) = match self {
            Self::Parameter(m) => (&m.structure, Topic::new(K::Parameter, &m.parameter)),
            Self::Loss(m) => (&m.structure, Topic::new(K::Loss, &m.parameter)),
            Self::Noise(m) => (&m.structure, Topic::new(K::Noise, &m.name)),
            Self::Outlier(m) => (&m.structure, Topic::new(K::Outlier, &m.channel)),
            Self::SensorHealth(m) => (&m.structure, Topic::new(K::SensorHealth, &m.node)),
            Self::Waveform(m) => (&m.structure, Topic::new(K::Waveform, &m.node)),
            Self::Spectrum(m) => (&m.structure, Topic::new(K::Spectrum, &m.node)),
            Self::Condition(m) | Self::StandingCondition(m, _) => {
                (&m.structure, Topic::new(K::Condition, &m.name))
            }
            Self::Judgement(m) => (&m.structure, Topic::new(K::Judgement, &m.quantity)),
            Self::LastingLosses(m) => (&m.structure, Topic::single(K::JudgementLog)),
            Self::Mode(m) => (&m.structure, Topic::new(K::Mode, &m.mode)),
            Self::Classes(m) => (&m.structure, Topic::single(K::ModelClass)),
            Self::Node(m) => (&m.structure, Topic::new(K::Node, &m.node)),
            Self::Fit(m) => (&m.structure, Topic::single(K::Fit)),
            Self::Monitoring(m) => (&m.structure, Topic::single(K::Monitoring)),
            Self::Estimates(structure, _) => (structure, Topic::single(K::Estimates)),
            Self::Alert(m) | Self::StandingAlert(m) => {
                (&m.structure, Topic::new(K::Alert, &m.parameter))
            }
            Self::Acknowledgement(m) => (&m.structure, Topic::new(K::Acknowledge, &m.parameter)),
            Self::Event(m) => (&m.structure, Topic::single(K::Event)),
            Self::Status(m) => match Service::from_name(m.service.as_str()) {
                Some(service) => (&m.structure, Topic::new(K::Status(service), &m.id)),
                None => return Some((&m.structure, None)),
            },
            Self::Ingested(structure, _) => {
                (structure, Topic::single(K::Progress(Service::Ingest)))
            }
            Self::LoggedAlert(m) => return Some((&m.structure, None)),
            Self::Past(m) => return Some((&m.structure, None)),
            Self::Now(_) | Self::Present(_) | Self::Misplaced => return None,
        };
        Some((structure, Some(topic)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{alert, name, status};
    use spandrel_bus::AlertState;

    #[test]
    fn message_on_a_key_of_another_sender_is_misplaced() {
        let placed = |key: &str, input: &Input| {
            Input::placed(&name("spandrel"), key, |_| input.clone()) == *input
        };
        let raised = Input::Alert(alert("storey-2", 0, AlertState::Raised));
        assert!(placed("spandrel/tower/alert/storey-2", &raised));
        assert!(!placed("spandrel/tower/alert/storey-1", &raised));
        assert!(!placed("spandrel/bridge/alert/storey-2", &raised));
        let mut unknown = status(Service::Ingest);
        unknown.service = name("nobody");
        let unknown = Input::Status(unknown);
        assert!(!placed("spandrel/tower/status/nobody/a", &unknown));
    }

    #[test]
    fn a_token_names_its_instance() {
        let expected = Instance {
            structure: name("tower"),
            service: Service::Sensor,
            id: name("floor-1"),
        };
        let instance = |key| Instance::of_token(&name("spandrel"), key);
        assert_eq!(
            instance("spandrel/tower/live/sensor/floor-1"),
            Some(expected)
        );
        assert_eq!(instance("spandrel/tower/frames"), None);
    }
}
