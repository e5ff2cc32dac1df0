//! Key expressions of one structure or of all, and the comparison of messages with their keys.

use super::heard::{Input, Instance};
use spandrel_bus::{
    AlertMessage, Event, FitDisplay, KeyFamily, Keys, LossDisplay, Message, ModelClassDisplay,
    Name, NameError, NodeDisplay, NoiseDisplay, ParameterDisplay, Progress, Service, Status, Topic,
    parse_key,
};

/// Key expressions of the data for display.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KeyExpressions {
    pub parameters: String,
    pub losses: String,
    pub noise: String,
    pub classes: String,
    pub fits: String,
    pub nodes: String,
    pub alerts: String,
    pub events: String,
    pub statuses: String,
    pub ingested: String,
    pub live: Vec<String>,
}

impl KeyExpressions {
    /// Returns the key expressions of one structure, or of all below the root.
    ///
    /// # Errors
    /// None in practice, because the placeholder for all structures is a valid name.
    pub fn new(root: &Name, structure: Option<&Name>) -> Result<Self, NameError> {
        /// Placeholder for any structure, which `*` replaces in each key expression.
        const ANY: &str = "any";
        let keys = match structure {
            Some(structure) => Keys::new(root.clone(), structure.clone()),
            None => Keys::new(root.clone(), Name::new(ANY)?),
        };
        let expression = |key: String| match structure {
            Some(_) => key,
            None => key.replacen(&format!("{root}/{ANY}/"), &format!("{root}/*/"), 1),
        };
        Ok(Self {
            parameters: expression(keys.all_parameters()),
            losses: expression(keys.all_losses()),
            noise: expression(keys.all_noise()),
            classes: expression(keys.model_class()),
            fits: expression(keys.fit()),
            nodes: expression(keys.all_nodes()),
            alerts: expression(keys.all_alerts()),
            events: expression(keys.event()),
            statuses: expression(keys.all_statuses()),
            ingested: expression(keys.progress(Service::Ingest)),
            live: Service::ALL
                .iter()
                .map(|service| expression(keys.all_live(*service)))
                .collect(),
        })
    }
}

/// A message that contains its structure and topic, like its key.
pub trait OnTopic: Message {
    fn topic(&self) -> Option<(&Name, Topic)>;
    fn into_input(self) -> Input;
}

impl OnTopic for ParameterDisplay {
    fn topic(&self) -> Option<(&Name, Topic)> {
        Some((
            &self.structure,
            Topic::new(KeyFamily::Parameter, &self.parameter),
        ))
    }

    fn into_input(self) -> Input {
        Input::Parameter(self)
    }
}

impl OnTopic for LossDisplay {
    fn topic(&self) -> Option<(&Name, Topic)> {
        Some((
            &self.structure,
            Topic::new(KeyFamily::Loss, &self.parameter),
        ))
    }

    fn into_input(self) -> Input {
        Input::Loss(self)
    }
}

impl OnTopic for NoiseDisplay {
    fn topic(&self) -> Option<(&Name, Topic)> {
        Some((&self.structure, Topic::new(KeyFamily::Noise, &self.name)))
    }

    fn into_input(self) -> Input {
        Input::Noise(self)
    }
}

impl OnTopic for ModelClassDisplay {
    fn topic(&self) -> Option<(&Name, Topic)> {
        Some((&self.structure, Topic::single(KeyFamily::ModelClass)))
    }

    fn into_input(self) -> Input {
        Input::Classes(self)
    }
}

impl OnTopic for FitDisplay {
    fn topic(&self) -> Option<(&Name, Topic)> {
        Some((&self.structure, Topic::single(KeyFamily::Fit)))
    }

    fn into_input(self) -> Input {
        Input::Fit(self)
    }
}

impl OnTopic for NodeDisplay {
    fn topic(&self) -> Option<(&Name, Topic)> {
        Some((&self.structure, Topic::new(KeyFamily::Node, &self.node)))
    }

    fn into_input(self) -> Input {
        Input::Node(self)
    }
}

impl OnTopic for AlertMessage {
    fn topic(&self) -> Option<(&Name, Topic)> {
        Some((
            &self.structure,
            Topic::new(KeyFamily::Alert, &self.parameter),
        ))
    }

    fn into_input(self) -> Input {
        Input::Alert(self)
    }
}

impl OnTopic for Event {
    fn topic(&self) -> Option<(&Name, Topic)> {
        Some((&self.structure, Topic::single(KeyFamily::Event)))
    }

    fn into_input(self) -> Input {
        Input::Event(self)
    }
}

impl OnTopic for Status {
    fn topic(&self) -> Option<(&Name, Topic)> {
        let service = Service::from_name(self.service.as_str())?;
        Some((
            &self.structure,
            Topic::new(KeyFamily::Status(service), &self.id),
        ))
    }

    fn into_input(self) -> Input {
        Input::Status(self)
    }
}

/// Converts a received message to an input, or to [`Input::Misplaced`] if its content contradicts
/// its key.
pub fn input<M: OnTopic>(root: &Name, key: &str, message: M) -> Input {
    let of_key = parse_key(root, key);
    let is_in_place = message.topic().is_some_and(|(structure, topic)| {
        of_key.is_some_and(|(key_structure, key_topic)| {
            (structure, topic) == (&key_structure, key_topic)
        })
    });
    if is_in_place {
        message.into_input()
    } else {
        Input::Misplaced
    }
}

/// Converts a progress message of ingest to an input. Only its key names the structure.
pub fn ingested(root: &Name, key: &str, progress: Progress) -> Input {
    match parse_key(root, key) {
        Some((
            structure,
            Topic {
                family: KeyFamily::Progress(Service::Ingest),
                ..
            },
        )) => Input::Ingested(structure, progress),
        _ => Input::Misplaced,
    }
}

/// Returns the instance that a liveliness token represents.
pub fn instance(root: &Name, key: &str) -> Option<Instance> {
    match parse_key(root, key)? {
        (
            structure,
            Topic {
                family: KeyFamily::Live(service),
                of: Some(id),
            },
        ) => Some(Instance {
            structure,
            service,
            id,
        }),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{alert, name, status};
    use super::*;
    use spandrel_bus::AlertState;

    #[test]
    fn expressions_of_one_structure_are_those_of_its_keys() {
        let expressions = KeyExpressions::new(&name("spandrel"), Some(&name("tower"))).unwrap();
        assert_eq!(expressions.parameters, "spandrel/tower/parameter/*");
        assert_eq!(expressions.events, "spandrel/tower/event");
    }

    #[test]
    fn expressions_of_all_structures_leave_the_structure_open() {
        let expressions = KeyExpressions::new(&name("any"), None).unwrap();
        assert_eq!(expressions.parameters, "any/*/parameter/*");
        assert_eq!(expressions.noise, "any/*/noise/*");
        assert_eq!(expressions.classes, "any/*/model-class");
        assert_eq!(expressions.nodes, "any/*/node/*");
        assert_eq!(expressions.alerts, "any/*/alert/*");
        assert_eq!(expressions.events, "any/*/event");
        assert_eq!(expressions.statuses, "any/*/status/*/*");
        assert_eq!(expressions.ingested, "any/*/progress/ingest");
        assert!(expressions.live.contains(&"any/*/live/sensor/*".to_owned()));
    }

    #[test]
    fn a_message_on_the_key_of_another_is_misplaced() {
        let root = name("spandrel");
        let raised = alert("storey-2", 0, AlertState::Raised);
        assert_eq!(
            input(&root, "spandrel/tower/alert/storey-2", raised.clone()),
            Input::Alert(raised.clone())
        );
        assert_eq!(
            input(&root, "spandrel/tower/alert/storey-1", raised.clone()),
            Input::Misplaced
        );
        assert_eq!(
            input(&root, "spandrel/bridge/alert/storey-2", raised),
            Input::Misplaced
        );
        let mut unknown = status(Service::Ingest, 0.0, &[]);
        unknown.service = name("nobody");
        assert_eq!(
            input(&root, "spandrel/tower/status/nobody/a", unknown),
            Input::Misplaced
        );
    }

    #[test]
    fn a_token_names_its_instance() {
        let expected = Instance {
            structure: name("tower"),
            service: Service::Sensor,
            id: name("floor-1"),
        };
        assert_eq!(
            instance(&name("spandrel"), "spandrel/tower/live/sensor/floor-1"),
            Some(expected)
        );
        assert_eq!(instance(&name("spandrel"), "spandrel/tower/frames"), None);
    }
}
