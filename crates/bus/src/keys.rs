//! Construction and parsing of all key expressions of Spandrel.

use crate::name::{Name, NameError};

/// Default root of all key expressions.
pub const DEFAULT_ROOT: &str = "spandrel";

/// Key expressions of one structure.
///
/// ```
/// use spandrel_bus::{Keys, Name};
/// let keys = Keys::new("spandrel".parse()?, "tower".parse()?);
/// assert_eq!(keys.samples(&"roof".parse()?), "spandrel/tower/sensor/roof/samples");
/// # Ok::<(), spandrel_bus::NameError>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Keys {
    root: Name,
    structure: Name,
}

impl Keys {
    /// Creates the key expressions below `{root}/{structure}`.
    #[must_use]
    pub fn new(root: Name, structure: Name) -> Self {
        Self { root, structure }
    }

    /// Creates the key expressions from unchecked texts.
    ///
    /// # Errors
    /// Returns [`NameError`] if one of the texts is not a [`Name`].
    pub fn parse(root: &str, structure: &str) -> Result<Self, NameError> {
        Ok(Self::new(Name::new(root)?, Name::new(structure)?))
    }

    /// Returns the root.
    #[must_use]
    pub fn root(&self) -> &Name {
        &self.root
    }

    /// Returns the name of the structure.
    #[must_use]
    pub fn structure(&self) -> &Name {
        &self.structure
    }

    fn below(&self, rest: &str) -> String {
        format!("{}/{}/{rest}", self.root, self.structure)
    }

    /// Returns the key of the sample blocks of one node.
    #[must_use]
    pub fn samples(&self, node: &Name) -> String {
        self.below(&format!("sensor/{node}/samples"))
    }

    /// Returns the key to query the latest sample blocks of one node. The node replies.
    #[must_use]
    pub fn buffer(&self, node: &Name) -> String {
        self.below(&format!("sensor/{node}/@buffer"))
    }

    /// Returns the key of the frame blocks.
    #[must_use]
    pub fn frames(&self) -> String {
        self.below("frames")
    }

    /// Returns the key to query frame blocks. Ingest replies.
    #[must_use]
    pub fn recording(&self) -> String {
        self.below("@recording")
    }

    /// Returns the key of the estimate blocks.
    #[must_use]
    pub fn estimates(&self) -> String {
        self.below("estimates")
    }

    /// Returns the key to query the latest estimate blocks. Identify replies.
    #[must_use]
    pub fn estimates_buffer(&self) -> String {
        self.below("@estimates")
    }

    /// Returns the key of one parameter at display rate.
    #[must_use]
    pub fn parameter(&self, parameter: &Name) -> String {
        self.below(&format!("parameter/{parameter}"))
    }

    /// Returns the key expression of all parameters at display rate.
    #[must_use]
    pub fn all_parameters(&self) -> String {
        self.below("parameter/*")
    }

    /// Returns the key of one noise parameter at display rate.
    #[must_use]
    pub fn noise(&self, name: &Name) -> String {
        self.below(&format!("noise/{name}"))
    }

    /// Returns the key expression of all noise parameters at display rate.
    #[must_use]
    pub fn all_noise(&self) -> String {
        self.below("noise/*")
    }

    /// Returns the key of the plausibility of the model classes.
    #[must_use]
    pub fn model_class(&self) -> String {
        self.below("model-class")
    }

    /// Returns the key of the verdict on the fit.
    #[must_use]
    pub fn fit(&self) -> String {
        self.below("fit")
    }

    /// Returns the key of the compressed local estimate of one node.
    #[must_use]
    pub fn local(&self, node: &Name) -> String {
        self.below(&format!("local/{node}"))
    }

    /// Returns the key of the station's feedback to one node.
    #[must_use]
    pub fn feedback(&self, node: &Name) -> String {
        self.below(&format!("feedback/{node}"))
    }

    /// Returns the key expression of the compressed local estimates of all nodes.
    #[must_use]
    pub fn all_local(&self) -> String {
        self.below("local/*")
    }

    /// Returns the key of the station's assessment of one node.
    #[must_use]
    pub fn node(&self, node: &Name) -> String {
        self.below(&format!("node/{node}"))
    }

    /// Returns the key expression of the station's assessments of all nodes.
    #[must_use]
    pub fn all_nodes(&self) -> String {
        self.below("node/*")
    }

    /// Returns the key of the outliers of one channel.
    #[must_use]
    pub fn outlier(&self, channel: &Name) -> String {
        self.below(&format!("outlier/{channel}"))
    }

    /// Returns the key expression of the outliers of all channels.
    #[must_use]
    pub fn all_outliers(&self) -> String {
        self.below("outlier/*")
    }

    /// Returns the key of the events, such as restarts, calibrations and exclusions.
    #[must_use]
    pub fn event(&self) -> String {
        self.below("event")
    }

    /// Returns the key of the alert of one parameter.
    #[must_use]
    pub fn alert(&self, parameter: &Name) -> String {
        self.below(&format!("alert/{parameter}"))
    }

    /// Returns the key expression of the alerts of all parameters, without their acknowledgements.
    #[must_use]
    pub fn all_alerts(&self) -> String {
        self.below("alert/*")
    }

    /// Returns the key to query the latest alert changes. The alert service replies.
    #[must_use]
    pub fn alert_log(&self) -> String {
        self.below("@alert-log")
    }

    /// Returns the key to acknowledge the alert of one parameter.
    #[must_use]
    pub fn acknowledge(&self, parameter: &Name) -> String {
        self.below(&format!("alert/{parameter}/acknowledge"))
    }

    /// Returns the key expression of the acknowledgements of all alerts.
    #[must_use]
    pub fn all_acknowledgements(&self) -> String {
        self.below("alert/*/acknowledge")
    }

    /// Returns the key of the progress of one service.
    #[must_use]
    pub fn progress(&self, service: Service) -> String {
        self.below(&format!("progress/{}", service.as_str()))
    }

    /// Returns the key of the status of one instance of a service.
    #[must_use]
    pub fn status(&self, service: Service, id: &Name) -> String {
        self.below(&format!("status/{}/{id}", service.as_str()))
    }

    /// Returns the key expression of the statuses of all instances of one service.
    #[must_use]
    pub fn statuses(&self, service: Service) -> String {
        self.below(&format!("status/{}/*", service.as_str()))
    }

    /// Returns the key expression of the statuses of all instances of all services.
    #[must_use]
    pub fn all_statuses(&self) -> String {
        self.below("status/*/*")
    }

    /// Returns the key of the liveliness token of one instance of a service. For a sensor, `id` is
    /// the node.
    #[must_use]
    pub fn live(&self, service: Service, id: &Name) -> String {
        self.below(&format!("live/{}/{id}", service.as_str()))
    }

    /// Returns the key expression of the liveliness tokens of all instances of a service.
    #[must_use]
    pub fn all_live(&self, service: Service) -> String {
        self.below(&format!("live/{}/*", service.as_str()))
    }

    /// Returns the key of the liveliness token that claims the lead of the identification. `claim`
    /// is the name of the claim.
    #[must_use]
    pub fn leader(&self, claim: &Name) -> String {
        self.below(&format!("leader/identify/{claim}"))
    }

    /// Returns the key expression of all claims to lead the identification.
    #[must_use]
    pub fn all_leaders(&self) -> String {
        self.below("leader/identify/*")
    }

    /// Returns the key to query the state of the leading identification.
    #[must_use]
    pub fn state(&self) -> String {
        self.below("@state")
    }

    /// Returns the key to query the structure file.
    #[must_use]
    pub fn description(&self) -> String {
        self.below("description")
    }

    /// Returns the key to query the history of one parameter. The query parameter `kind` selects
    /// another quantity of this name.
    #[must_use]
    pub fn history(&self, parameter: &Name) -> String {
        self.below(&format!("history/{parameter}"))
    }

    /// Returns the key expression of all histories.
    #[must_use]
    pub fn all_history(&self) -> String {
        self.below("history/*")
    }

    /// Returns the key to query the log of alerts, acknowledgements and events.
    #[must_use]
    pub fn history_log(&self) -> String {
        self.below("@history-log")
    }
}

/// The services that occur in key expressions.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Service {
    /// A sensor node, real, simulated or replayed.
    Sensor,
    /// The sensor-ingest service.
    Ingest,
    /// The identification worker.
    Identify,
    /// The central station.
    Fuse,
    /// The alert service.
    Alert,
    /// The history service.
    History,
    /// The service that notifies people of alerts.
    Notify,
    /// The dashboard.
    Dashboard,
}

impl Service {
    /// All services.
    pub const ALL: [Self; 8] = [
        Self::Sensor,
        Self::Ingest,
        Self::Identify,
        Self::Fuse,
        Self::Alert,
        Self::History,
        Self::Notify,
        Self::Dashboard,
    ];

    /// Returns the name of the service in a key expression.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Sensor => "sensor",
            Self::Ingest => "ingest",
            Self::Identify => "identify",
            Self::Fuse => "fuse",
            Self::Alert => "alert",
            Self::History => "history",
            Self::Notify => "notify",
            Self::Dashboard => "dashboard",
        }
    }

    fn from_chunk(chunk: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|s| s.as_str() == chunk)
    }
}

/// All keys of one kind, for access rules.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum KeyFamily {
    /// [`Keys::samples`], one per node
    Samples,
    /// [`Keys::buffer`], one per node
    Buffer,
    /// [`Keys::frames`]
    Frames,
    /// [`Keys::recording`]
    Recording,
    /// [`Keys::estimates`]
    Estimates,
    /// [`Keys::estimates_buffer`]
    EstimatesBuffer,
    /// [`Keys::parameter`], one per parameter
    Parameter,
    /// [`Keys::noise`], one per noise parameter
    Noise,
    /// [`Keys::model_class`]
    ModelClass,
    /// [`Keys::fit`]
    Fit,
    /// [`Keys::local`], one per node
    Local,
    /// [`Keys::feedback`], one per node
    Feedback,
    /// [`Keys::node`], one per node
    Node,
    /// [`Keys::outlier`], one per channel
    Outlier,
    /// [`Keys::event`]
    Event,
    /// [`Keys::alert`], one per parameter
    Alert,
    /// [`Keys::acknowledge`], one per parameter
    Acknowledge,
    /// [`Keys::progress`] of this service
    Progress(Service),
    /// [`Keys::status`] of the instances of this service
    Status(Service),
    /// [`Keys::live`] of the instances of this service
    Live(Service),
    /// [`Keys::leader`], one per claim
    Leader,
    /// [`Keys::state`]
    State,
    /// [`Keys::description`]
    Description,
    /// [`Keys::history`], one per parameter
    History,
    /// [`Keys::history_log`]
    HistoryLog,
    /// [`Keys::alert_log`]
    AlertLog,
}

impl KeyFamily {
    /// Returns the key expression of the family.
    ///
    /// `None` for `structure` or `of` selects all structures or all names.
    ///
    /// ```
    /// use spandrel_bus::{KeyFamily, Name};
    /// let root: Name = "spandrel".parse()?;
    /// assert_eq!(KeyFamily::Alert.expression(&root, None, None), "spandrel/*/alert/*");
    /// # Ok::<(), spandrel_bus::NameError>(())
    /// ```
    #[must_use]
    pub fn expression(self, root: &Name, structure: Option<&Name>, of: Option<&Name>) -> String {
        let of = of.map_or("*", Name::as_str);
        let rest = match self {
            Self::Samples => format!("sensor/{of}/samples"),
            Self::Buffer => format!("sensor/{of}/@buffer"),
            Self::Frames => "frames".to_owned(),
            Self::Recording => "@recording".to_owned(),
            Self::Estimates => "estimates".to_owned(),
            Self::EstimatesBuffer => "@estimates".to_owned(),
            Self::Parameter => format!("parameter/{of}"),
            Self::Noise => format!("noise/{of}"),
            Self::ModelClass => "model-class".to_owned(),
            Self::Fit => "fit".to_owned(),
            Self::Local => format!("local/{of}"),
            Self::Feedback => format!("feedback/{of}"),
            Self::Node => format!("node/{of}"),
            Self::Outlier => format!("outlier/{of}"),
            Self::Event => "event".to_owned(),
            Self::Alert => format!("alert/{of}"),
            Self::Acknowledge => format!("alert/{of}/acknowledge"),
            Self::Progress(service) => format!("progress/{}", service.as_str()),
            Self::Status(service) => format!("status/{}/{of}", service.as_str()),
            Self::Live(service) => format!("live/{}/{of}", service.as_str()),
            Self::Leader => format!("leader/identify/{of}"),
            Self::State => "@state".to_owned(),
            Self::Description => "description".to_owned(),
            Self::History => format!("history/{of}"),
            Self::HistoryLog => "@history-log".to_owned(),
            Self::AlertLog => "@alert-log".to_owned(),
        };
        format!("{root}/{}/{rest}", structure.map_or("*", Name::as_str))
    }

    /// Returns one key expression for the keys of all services.
    ///
    /// Returns `None` if the family does not contain one key per service.
    #[must_use]
    pub fn expression_of_all_services(
        self,
        root: &Name,
        structure: Option<&Name>,
    ) -> Option<String> {
        let rest = match self {
            Self::Progress(_) => "progress/*",
            Self::Status(_) => "status/*/*",
            Self::Live(_) => "live/*/*",
            _ => return None,
        };
        Some(format!(
            "{root}/{}/{rest}",
            structure.map_or("*", Name::as_str)
        ))
    }

    /// Returns all families.
    #[must_use]
    pub fn all() -> Vec<Self> {
        use KeyFamily as K;
        let mut all = vec![
            K::Samples,
            K::Buffer,
            K::Frames,
            K::Recording,
            K::Estimates,
            K::EstimatesBuffer,
        ];
        all.extend([
            K::Parameter,
            K::Noise,
            K::ModelClass,
            K::Fit,
            K::Local,
            K::Feedback,
            K::Node,
            K::Outlier,
            K::Event,
        ]);
        all.extend([K::Alert, K::Acknowledge]);
        for of_service in [K::Progress, K::Status, K::Live] {
            all.extend(Service::ALL.map(of_service));
        }
        all.extend([
            K::Leader,
            K::State,
            K::Description,
            K::History,
            K::HistoryLog,
            K::AlertLog,
        ]);
        all
    }
}

/// The content of a concrete key, the inverse of the methods of [`Keys`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Topic {
    /// [`Keys::samples`]
    Samples(Name),
    /// [`Keys::frames`]
    Frames,
    /// [`Keys::estimates`]
    Estimates,
    /// [`Keys::parameter`]
    Parameter(Name),
    /// [`Keys::noise`]
    Noise(Name),
    /// [`Keys::model_class`]
    ModelClass,
    /// [`Keys::fit`]
    Fit,
    /// [`Keys::local`]
    Local(Name),
    /// [`Keys::feedback`]
    Feedback(Name),
    /// [`Keys::node`]
    Node(Name),
    /// [`Keys::outlier`]
    Outlier(Name),
    /// [`Keys::event`]
    Event,
    /// [`Keys::alert`]
    Alert(Name),
    /// [`Keys::acknowledge`]
    Acknowledge(Name),
    /// [`Keys::progress`]
    Progress(Service),
    /// [`Keys::status`]
    Status(Service, Name),
    /// [`Keys::live`]
    Live(Service, Name),
    /// [`Keys::description`]
    Description,
    /// [`Keys::history`]
    History(Name),
}

/// Parses a concrete key into its structure and topic.
///
/// Returns `None` if the key has another root or is not a Spandrel topic.
///
/// ```
/// use spandrel_bus::{Topic, parse_key};
/// let (structure, topic) = parse_key(&"spandrel".parse()?, "spandrel/tower/frames").unwrap();
/// assert_eq!((structure.as_str(), topic), ("tower", Topic::Frames));
/// # Ok::<(), spandrel_bus::NameError>(())
/// ```
#[must_use]
pub fn parse_key(root: &Name, key: &str) -> Option<(Name, Topic)> {
    let rest = key.strip_prefix(root.as_str())?.strip_prefix('/')?;
    let (structure, rest) = rest.split_once('/')?;
    let structure = Name::new(structure).ok()?;
    let name = |chunk: &str| Name::new(chunk).ok();
    let chunks: Vec<&str> = rest.split('/').collect();
    let topic = match chunks.as_slice() {
        ["sensor", node, "samples"] => Topic::Samples(name(node)?),
        ["frames"] => Topic::Frames,
        ["estimates"] => Topic::Estimates,
        ["parameter", parameter] => Topic::Parameter(name(parameter)?),
        ["noise", noise] => Topic::Noise(name(noise)?),
        ["model-class"] => Topic::ModelClass,
        ["fit"] => Topic::Fit,
        ["local", node] => Topic::Local(name(node)?),
        ["feedback", node] => Topic::Feedback(name(node)?),
        ["node", node] => Topic::Node(name(node)?),
        ["outlier", channel] => Topic::Outlier(name(channel)?),
        ["event"] => Topic::Event,
        ["alert", parameter] => Topic::Alert(name(parameter)?),
        ["alert", parameter, "acknowledge"] => Topic::Acknowledge(name(parameter)?),
        ["progress", service] => Topic::Progress(Service::from_chunk(service)?),
        ["status", service, id] => Topic::Status(Service::from_chunk(service)?, name(id)?),
        ["live", service, id] => Topic::Live(Service::from_chunk(service)?, name(id)?),
        ["description"] => Topic::Description,
        ["history", parameter] => Topic::History(name(parameter)?),
        _ => return None,
    };
    Some((structure, topic))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn keys() -> Keys {
        Keys::parse("spandrel", "tower").unwrap()
    }

    #[test]
    fn keys_are_those_of_the_design_table() {
        let (keys, n) = (keys(), Name::new("storey-1").unwrap());
        let expected = [
            (keys.samples(&n), "spandrel/tower/sensor/storey-1/samples"),
            (keys.frames(), "spandrel/tower/frames"),
            (keys.estimates(), "spandrel/tower/estimates"),
            (keys.parameter(&n), "spandrel/tower/parameter/storey-1"),
            (keys.alert(&n), "spandrel/tower/alert/storey-1"),
            (
                keys.acknowledge(&n),
                "spandrel/tower/alert/storey-1/acknowledge",
            ),
            (
                keys.progress(Service::Identify),
                "spandrel/tower/progress/identify",
            ),
            (
                keys.live(Service::Ingest, &n),
                "spandrel/tower/live/ingest/storey-1",
            ),
            (keys.recording(), "spandrel/tower/@recording"),
            (keys.buffer(&n), "spandrel/tower/sensor/storey-1/@buffer"),
            (keys.estimates_buffer(), "spandrel/tower/@estimates"),
            (keys.history(&n), "spandrel/tower/history/storey-1"),
            (keys.history_log(), "spandrel/tower/@history-log"),
            (keys.alert_log(), "spandrel/tower/@alert-log"),
            (keys.leader(&n), "spandrel/tower/leader/identify/storey-1"),
            (keys.state(), "spandrel/tower/@state"),
        ];
        for (found, expected) in expected {
            assert_eq!(found, expected);
        }
    }

    #[test]
    fn families_are_the_keys_that_services_use() {
        let (keys, n) = (keys(), Name::new("storey-1").unwrap());
        let one =
            |family: KeyFamily| family.expression(keys.root(), Some(keys.structure()), Some(&n));
        let mut used = vec![
            keys.samples(&n),
            keys.buffer(&n),
            keys.frames(),
            keys.recording(),
            keys.estimates(),
            keys.estimates_buffer(),
            keys.parameter(&n),
            keys.noise(&n),
            keys.model_class(),
            keys.fit(),
            keys.local(&n),
            keys.feedback(&n),
            keys.node(&n),
            keys.outlier(&n),
            keys.event(),
            keys.alert(&n),
            keys.acknowledge(&n),
            keys.description(),
            keys.history(&n),
            keys.history_log(),
            keys.alert_log(),
            keys.leader(&n),
            keys.state(),
        ];
        used.extend(Service::ALL.map(|service| keys.progress(service)));
        used.extend(Service::ALL.map(|service| keys.status(service, &n)));
        used.extend(Service::ALL.map(|service| keys.live(service, &n)));
        used.sort();
        let mut families: Vec<String> = KeyFamily::all().into_iter().map(one).collect();
        families.sort();
        assert_eq!(families, used);
        let all = |family: KeyFamily| family.expression(keys.root(), Some(keys.structure()), None);
        assert_eq!(all(KeyFamily::Alert), keys.all_alerts());
        assert_eq!(all(KeyFamily::Acknowledge), keys.all_acknowledgements());
        assert_eq!(
            all(KeyFamily::Live(Service::Sensor)),
            keys.all_live(Service::Sensor)
        );
        assert_eq!(all(KeyFamily::Leader), keys.all_leaders());
        let statuses = KeyFamily::Status(Service::Fuse)
            .expression_of_all_services(keys.root(), Some(keys.structure()));
        assert_eq!(statuses, Some(keys.all_statuses()));
    }

    #[test]
    fn what_is_built_is_parsed_back() {
        let (keys, n) = (keys(), Name::new("n-1").unwrap());
        let cases = [
            (keys.samples(&n), Topic::Samples(n.clone())),
            (keys.frames(), Topic::Frames),
            (keys.estimates(), Topic::Estimates),
            (keys.parameter(&n), Topic::Parameter(n.clone())),
            (keys.noise(&n), Topic::Noise(n.clone())),
            (keys.model_class(), Topic::ModelClass),
            (keys.fit(), Topic::Fit),
            (keys.local(&n), Topic::Local(n.clone())),
            (keys.feedback(&n), Topic::Feedback(n.clone())),
            (keys.node(&n), Topic::Node(n.clone())),
            (keys.outlier(&n), Topic::Outlier(n.clone())),
            (keys.event(), Topic::Event),
            (keys.alert(&n), Topic::Alert(n.clone())),
            (keys.acknowledge(&n), Topic::Acknowledge(n.clone())),
            (
                keys.progress(Service::Alert),
                Topic::Progress(Service::Alert),
            ),
            (
                keys.status(Service::Fuse, &n),
                Topic::Status(Service::Fuse, n.clone()),
            ),
            (
                keys.live(Service::Sensor, &n),
                Topic::Live(Service::Sensor, n.clone()),
            ),
            (keys.description(), Topic::Description),
            (keys.history(&n), Topic::History(n.clone())),
        ];
        for (key, topic) in cases {
            let parsed = parse_key(keys.root(), &key);
            assert_eq!(parsed, Some((keys.structure().clone(), topic)), "{key}");
        }
    }

    #[test]
    fn foreign_keys_are_not_ours() {
        let root = Name::new("spandrel").unwrap();
        for key in ["spandrel", "spandrel/tower", "other/tower/frames", ""] {
            assert_eq!(parse_key(&root, key), None, "{key}");
        }
        assert_eq!(parse_key(&root, "spandrelx/tower/frames"), None);
        assert_eq!(parse_key(&root, "spandrel/tower/progress/nobody"), None);
    }
}
