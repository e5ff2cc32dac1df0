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

    /// Returns the key of one item of a family.
    fn key(&self, family: KeyFamily, of: &Name) -> String {
        family.expression(&self.root, Some(&self.structure), Some(of))
    }

    /// Returns the key expression of a family, which is its key if the family has a single key.
    fn all(&self, family: KeyFamily) -> String {
        family.expression(&self.root, Some(&self.structure), None)
    }

    /// Returns the key of the sample blocks of one node.
    #[must_use]
    pub fn samples(&self, node: &Name) -> String {
        self.key(KeyFamily::Samples, node)
    }

    /// Returns the key to query the latest sample blocks of one node. The node replies.
    #[must_use]
    pub fn buffer(&self, node: &Name) -> String {
        self.key(KeyFamily::Buffer, node)
    }

    /// Returns the key of the frame blocks.
    #[must_use]
    pub fn frames(&self) -> String {
        self.all(KeyFamily::Frames)
    }

    /// Returns the key to query frame blocks. Ingest replies.
    #[must_use]
    pub fn recording(&self) -> String {
        self.all(KeyFamily::Recording)
    }

    /// Returns the key of the estimate blocks.
    #[must_use]
    pub fn estimates(&self) -> String {
        self.all(KeyFamily::Estimates)
    }

    /// Returns the key to query the latest estimate blocks. Identify replies.
    #[must_use]
    pub fn estimates_buffer(&self) -> String {
        self.all(KeyFamily::EstimatesBuffer)
    }

    /// Returns the key of one parameter at display rate.
    #[must_use]
    pub fn parameter(&self, parameter: &Name) -> String {
        self.key(KeyFamily::Parameter, parameter)
    }

    /// Returns the key expression of all parameters at display rate.
    #[must_use]
    pub fn all_parameters(&self) -> String {
        self.all(KeyFamily::Parameter)
    }

    /// Returns the key of the loss of one parameter at display rate.
    #[must_use]
    pub fn loss(&self, parameter: &Name) -> String {
        self.key(KeyFamily::Loss, parameter)
    }

    /// Returns the key expression of the losses of all parameters at display rate.
    #[must_use]
    pub fn all_losses(&self) -> String {
        self.all(KeyFamily::Loss)
    }

    /// Returns the key of one noise parameter at display rate.
    #[must_use]
    pub fn noise(&self, name: &Name) -> String {
        self.key(KeyFamily::Noise, name)
    }

    /// Returns the key expression of all noise parameters at display rate.
    #[must_use]
    pub fn all_noise(&self) -> String {
        self.all(KeyFamily::Noise)
    }

    /// Returns the key of the plausibility of the model classes.
    #[must_use]
    pub fn model_class(&self) -> String {
        self.all(KeyFamily::ModelClass)
    }

    /// Returns the key of the state of the monitoring.
    #[must_use]
    pub fn monitoring(&self) -> String {
        self.all(KeyFamily::Monitoring)
    }

    /// Returns the key of the verdict on the fit.
    #[must_use]
    pub fn fit(&self) -> String {
        self.all(KeyFamily::Fit)
    }

    /// Returns the key of the compressed local estimate of one node.
    #[must_use]
    pub fn local(&self, node: &Name) -> String {
        self.key(KeyFamily::Local, node)
    }

    /// Returns the key of the station's feedback to one node.
    #[must_use]
    pub fn feedback(&self, node: &Name) -> String {
        self.key(KeyFamily::Feedback, node)
    }

    /// Returns the key expression of the compressed local estimates of all nodes.
    #[must_use]
    pub fn all_local(&self) -> String {
        self.all(KeyFamily::Local)
    }

    /// Returns the key of the station's assessment of one node.
    #[must_use]
    pub fn node(&self, node: &Name) -> String {
        self.key(KeyFamily::Node, node)
    }

    /// Returns the key expression of the station's assessments of all nodes.
    #[must_use]
    pub fn all_nodes(&self) -> String {
        self.all(KeyFamily::Node)
    }

    /// Returns the key of the outliers of one channel.
    #[must_use]
    pub fn outlier(&self, channel: &Name) -> String {
        self.key(KeyFamily::Outlier, channel)
    }

    /// Returns the key expression of the outliers of all channels.
    #[must_use]
    pub fn all_outliers(&self) -> String {
        self.all(KeyFamily::Outlier)
    }

    /// Returns the key of the comparison of one node's sensors with the others.
    #[must_use]
    pub fn sensor_health(&self, node: &Name) -> String {
        self.key(KeyFamily::SensorHealth, node)
    }

    /// Returns the key expression of the comparisons of all nodes' sensors.
    #[must_use]
    pub fn all_sensor_health(&self) -> String {
        self.all(KeyFamily::SensorHealth)
    }

    /// Returns the key of the reduced samples of one node.
    #[must_use]
    pub fn waveform(&self, node: &Name) -> String {
        self.key(KeyFamily::Waveform, node)
    }

    /// Returns the key of the spectra of one node.
    #[must_use]
    pub fn spectrum(&self, node: &Name) -> String {
        self.key(KeyFamily::Spectrum, node)
    }

    /// Returns the key of one condition.
    #[must_use]
    pub fn condition(&self, name: &Name) -> String {
        self.key(KeyFamily::Condition, name)
    }

    /// Returns the key expression of all conditions.
    #[must_use]
    pub fn all_conditions(&self) -> String {
        self.all(KeyFamily::Condition)
    }

    /// Returns the key of the judgement of one quantity.
    #[must_use]
    pub fn judgement(&self, quantity: &Name) -> String {
        self.key(KeyFamily::Judgement, quantity)
    }

    /// Returns the key expression of the judgements of all quantities.
    #[must_use]
    pub fn all_judgements(&self) -> String {
        self.all(KeyFamily::Judgement)
    }

    /// Returns the key to query the history of the judgement of one quantity. The service `judge`
    /// replies.
    #[must_use]
    pub fn judgement_course(&self, quantity: &Name) -> String {
        self.key(KeyFamily::JudgementCourse, quantity)
    }

    /// Returns the key expression of the judgement histories of all quantities.
    #[must_use]
    pub fn all_judgement_courses(&self) -> String {
        self.all(KeyFamily::JudgementCourse)
    }

    /// Returns the key to query one report of an earthquake, or the list `index`. The service
    /// reports replies.
    #[must_use]
    pub fn report(&self, report: &Name) -> String {
        self.key(KeyFamily::Report, report)
    }

    /// Returns the key expression of all reports.
    #[must_use]
    pub fn all_reports(&self) -> String {
        self.all(KeyFamily::Report)
    }

    /// Returns the key of one declared mode.
    #[must_use]
    pub fn mode(&self, mode: &Name) -> String {
        self.key(KeyFamily::Mode, mode)
    }

    /// Returns the key expression of all declared modes.
    #[must_use]
    pub fn all_modes(&self) -> String {
        self.all(KeyFamily::Mode)
    }

    /// Returns the key of the events, such as restarts, calibrations and exclusions.
    #[must_use]
    pub fn event(&self) -> String {
        self.all(KeyFamily::Event)
    }

    /// Returns the key of the alert of one parameter.
    #[must_use]
    pub fn alert(&self, parameter: &Name) -> String {
        self.key(KeyFamily::Alert, parameter)
    }

    /// Returns the key expression of the alerts of all parameters, without their acknowledgements.
    #[must_use]
    pub fn all_alerts(&self) -> String {
        self.all(KeyFamily::Alert)
    }

    /// Returns the key to query the latest alert changes. The alert service replies.
    #[must_use]
    pub fn alert_log(&self) -> String {
        self.all(KeyFamily::AlertLog)
    }

    /// Returns the key to acknowledge the alert of one parameter.
    #[must_use]
    pub fn acknowledge(&self, parameter: &Name) -> String {
        self.key(KeyFamily::Acknowledge, parameter)
    }

    /// Returns the key expression of the acknowledgements of all alerts.
    #[must_use]
    pub fn all_acknowledgements(&self) -> String {
        self.all(KeyFamily::Acknowledge)
    }

    /// Returns the key on which people begin and end maintenance.
    #[must_use]
    pub fn maintenance(&self) -> String {
        self.all(KeyFamily::Maintenance)
    }

    /// Returns the key on which people annotate the structure.
    #[must_use]
    pub fn annotation(&self) -> String {
        self.all(KeyFamily::Annotation)
    }

    /// Returns the key of the liveliness token that marks the samples of one node as simulated.
    #[must_use]
    pub fn simulated(&self, node: &Name) -> String {
        self.key(KeyFamily::Simulated, node)
    }

    /// Returns the key expression of the tokens of all simulated nodes.
    #[must_use]
    pub fn all_simulated(&self) -> String {
        self.all(KeyFamily::Simulated)
    }

    /// Returns the key of the progress of one service.
    #[must_use]
    pub fn progress(&self, service: Service) -> String {
        self.all(KeyFamily::Progress(service))
    }

    /// Returns the key of the status of one instance of a service.
    #[must_use]
    pub fn status(&self, service: Service, id: &Name) -> String {
        self.key(KeyFamily::Status(service), id)
    }

    /// Returns the key expression of the statuses of all instances of one service.
    #[must_use]
    pub fn statuses(&self, service: Service) -> String {
        self.all(KeyFamily::Status(service))
    }

    /// Returns the key expression of the statuses of all instances of all services.
    #[must_use]
    pub fn all_statuses(&self) -> String {
        expression_of(&self.root, Some(&self.structure), "status/*/*")
    }

    /// Returns the key of the liveliness token of one instance of a service. For a sensor, `id` is
    /// the node.
    #[must_use]
    pub fn live(&self, service: Service, id: &Name) -> String {
        self.key(KeyFamily::Live(service), id)
    }

    /// Returns the key expression of the liveliness tokens of all instances of a service.
    #[must_use]
    pub fn all_live(&self, service: Service) -> String {
        self.all(KeyFamily::Live(service))
    }

    /// Returns the key of the liveliness token that claims the lead of the identification. `claim`
    /// is the name of the claim.
    #[must_use]
    pub fn leader(&self, claim: &Name) -> String {
        self.key(KeyFamily::Leader, claim)
    }

    /// Returns the key expression of all claims to lead the identification.
    #[must_use]
    pub fn all_leaders(&self) -> String {
        self.all(KeyFamily::Leader)
    }

    /// Returns the key to query the state of the leading identification.
    #[must_use]
    pub fn state(&self) -> String {
        self.all(KeyFamily::State)
    }

    /// Returns the key to query the structure file.
    #[must_use]
    pub fn description(&self) -> String {
        self.all(KeyFamily::Description)
    }

    /// Returns the key to query the history of one parameter. The query parameter `kind` selects
    /// another quantity of this name.
    #[must_use]
    pub fn history(&self, parameter: &Name) -> String {
        self.key(KeyFamily::History, parameter)
    }

    /// Returns the key expression of all histories.
    #[must_use]
    pub fn all_history(&self) -> String {
        self.all(KeyFamily::History)
    }

    /// Returns the key to query the log of alerts, acknowledgements and events.
    #[must_use]
    pub fn history_log(&self) -> String {
        self.all(KeyFamily::HistoryLog)
    }
}

/// The services that occur in key expressions.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Service {
    /// A sensor node, real, simulated or replayed.
    Sensor,
    /// The service that connects instruments to the bus.
    Feed,
    /// The sensor-ingest service.
    Ingest,
    /// The identification worker.
    Identify,
    /// The central station.
    Fuse,
    /// The alert service.
    Alert,
    /// The service that follows natural frequencies.
    Modes,
    /// The service that judges lasting changes.
    Judge,
    /// The service that reports earthquakes.
    Reports,
    /// The history service.
    History,
    /// The service that notifies people of alerts.
    Notify,
    /// The dashboard.
    Dashboard,
}

impl Service {
    /// All services.
    pub const ALL: [Self; 12] = [
        Self::Sensor,
        Self::Feed,
        Self::Ingest,
        Self::Identify,
        Self::Fuse,
        Self::Alert,
        Self::Modes,
        Self::Judge,
        Self::Reports,
        Self::History,
        Self::Notify,
        Self::Dashboard,
    ];

    /// Returns the name of the service in a key expression.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Sensor => "sensor",
            Self::Feed => "feed",
            Self::Ingest => "ingest",
            Self::Identify => "identify",
            Self::Fuse => "fuse",
            Self::Alert => "alert",
            Self::Modes => "modes",
            Self::Judge => "judge",
            Self::Reports => "reports",
            Self::History => "history",
            Self::Notify => "notify",
            Self::Dashboard => "dashboard",
        }
    }

    /// Returns the name of the service, as a chunk of a key.
    #[must_use]
    pub fn name(self) -> Name {
        Name::of_service(self)
    }

    /// Returns the service of this name. `None` if there is none.
    #[must_use]
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL
            .into_iter()
            .find(|service| service.as_str() == name)
    }
}

/// Declares the families of keys with the part of the keys below the structure: the only list of
/// both.
///
/// `{of}` stands for the name of an item, `{service}` for the name of the service. The second of
/// the three parts lists the families whose keys name a service.
macro_rules! key_families {
    (
        $($(#[$first_doc:meta])* $first:ident = $first_pattern:literal,)*;
        $($(#[$doc:meta])* $of_service:ident = $pattern:literal,)*;
        $($(#[$last_doc:meta])* $last:ident = $last_pattern:literal,)*
    ) => {
        /// All keys of one kind, for access rules.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
        pub enum KeyFamily {
            $($(#[$first_doc])* $first,)*
            $($(#[$doc])* $of_service(Service),)*
            $($(#[$last_doc])* $last,)*
        }

        impl KeyFamily {
            /// Returns all families.
            pub fn all() -> impl Iterator<Item = Self> {
                let of_services = [$(Self::$of_service),*]
                    .into_iter()
                    .flat_map(|of_service| Service::ALL.map(of_service));
                [$(Self::$first,)* $(Self::$last),*].into_iter().chain(of_services)
            }

            /// Returns the part of the keys below the structure.
            fn pattern(self) -> &'static str {
                match self {
                    $(Self::$first => $first_pattern,)*
                    $(Self::$of_service(_) => $pattern,)*
                    $(Self::$last => $last_pattern,)*
                }
            }

            /// Returns the service whose keys these are. `None` if the keys do not name a service.
            fn service(self) -> Option<Service> {
                match self {
                    $(Self::$of_service(service))|* => Some(service),
                    _ => None,
                }
            }
        }
    };
}

key_families! {
    /// [`Keys::samples`], one per node
    Samples = "sensor/{of}/samples",
    /// [`Keys::buffer`], one per node
    Buffer = "sensor/{of}/@buffer",
    /// [`Keys::frames`]
    Frames = "frames",
    /// [`Keys::recording`]
    Recording = "@recording",
    /// [`Keys::estimates`]
    Estimates = "estimates",
    /// [`Keys::estimates_buffer`]
    EstimatesBuffer = "@estimates",
    /// [`Keys::parameter`], one per parameter
    Parameter = "parameter/{of}",
    /// [`Keys::loss`], one per parameter
    Loss = "loss/{of}",
    /// [`Keys::noise`], one per noise parameter
    Noise = "noise/{of}",
    /// [`Keys::model_class`]
    ModelClass = "model-class",
    /// [`Keys::fit`]
    Fit = "fit",
    /// [`Keys::monitoring`]
    Monitoring = "monitoring",
    /// [`Keys::local`], one per node
    Local = "local/{of}",
    /// [`Keys::feedback`], one per node
    Feedback = "feedback/{of}",
    /// [`Keys::node`], one per node
    Node = "node/{of}",
    /// [`Keys::outlier`], one per channel
    Outlier = "outlier/{of}",
    /// [`Keys::sensor_health`], one per node
    SensorHealth = "sensor/{of}/health",
    /// [`Keys::waveform`], one per node
    Waveform = "sensor/{of}/waveform",
    /// [`Keys::spectrum`], one per node
    Spectrum = "sensor/{of}/spectrum",
    /// [`Keys::condition`], one per condition
    Condition = "condition/{of}",
    /// [`Keys::judgement`], one per quantity
    Judgement = "judgement/{of}",
    /// [`Keys::judgement_course`], one per quantity
    JudgementCourse = "judgement/{of}/@course",
    /// [`Keys::report`], one per report
    Report = "@report/{of}",
    /// [`Keys::mode`], one per declared mode
    Mode = "mode/{of}",
    /// [`Keys::event`]
    Event = "event",
    /// [`Keys::alert`], one per parameter
    Alert = "alert/{of}",
    /// [`Keys::acknowledge`], one per parameter
    Acknowledge = "alert/{of}/acknowledge",
    /// [`Keys::maintenance`]
    Maintenance = "maintenance",
    /// [`Keys::annotation`]
    Annotation = "annotation",
    /// [`Keys::simulated`], one per node
    Simulated = "simulated/{of}",
    ;
    /// [`Keys::progress`] of this service
    Progress = "progress/{service}",
    /// [`Keys::status`] of the instances of this service
    Status = "status/{service}/{of}",
    /// [`Keys::live`] of the instances of this service
    Live = "live/{service}/{of}",
    ;
    /// [`Keys::leader`], one per claim
    Leader = "leader/identify/{of}",
    /// [`Keys::state`]
    State = "@state",
    /// [`Keys::description`]
    Description = "description",
    /// [`Keys::history`], one per parameter
    History = "history/{of}",
    /// [`Keys::history_log`]
    HistoryLog = "@history-log",
    /// [`Keys::alert_log`]
    AlertLog = "@alert-log",
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
        let below = self.below_structure(of, self.service());
        expression_of(root, structure, &below)
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
        self.service()?;
        Some(expression_of(
            root,
            structure,
            &self.below_structure(None, None),
        ))
    }

    /// Returns the part of a key expression below the structure. `None` selects all.
    fn below_structure(self, of: Option<&Name>, service: Option<Service>) -> String {
        self.pattern()
            .replace("{of}", of.map_or("*", Name::as_str))
            .replace("{service}", service.map_or("*", Service::as_str))
    }

    /// Returns the topic of the part of a key below the structure. `None` if it belongs to another
    /// family.
    fn topic(self, below: &str) -> Option<Topic> {
        let mut of = None;
        let mut chunks = below.split('/');
        for pattern in self.pattern().split('/') {
            let chunk = chunks.next()?;
            match pattern {
                "{of}" => of = Some(Name::new(chunk).ok()?),
                "{service}" if self.service()?.as_str() == chunk => {}
                word if word == chunk => {}
                _ => return None,
            }
        }
        chunks
            .next()
            .is_none()
            .then_some(Topic { family: self, of })
    }
}

fn expression_of(root: &Name, structure: Option<&Name>, below: &str) -> String {
    format!("{root}/{}/{below}", structure.map_or("*", Name::as_str))
}

/// The content of a concrete key below its structure, the inverse of the methods of [`Keys`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Topic {
    /// The family of the key.
    pub family: KeyFamily,
    /// The item, such as a parameter or a node. `None` if the family has a single key.
    pub of: Option<Name>,
}

impl Topic {
    /// Creates the topic of one item of a family.
    #[must_use]
    pub fn new(family: KeyFamily, of: &Name) -> Self {
        Self {
            family,
            of: Some(of.clone()),
        }
    }

    /// Creates the topic of a family that has a single key.
    #[must_use]
    pub fn single(family: KeyFamily) -> Self {
        Self { family, of: None }
    }
}

/// Parses a concrete key into its structure and topic.
///
/// Returns `None` if the key has another root or is not a Spandrel topic.
///
/// ```
/// use spandrel_bus::{KeyFamily, Topic, parse_key};
/// let (structure, topic) = parse_key(&"spandrel".parse()?, "spandrel/tower/frames").unwrap();
/// assert_eq!((structure.as_str(), topic), ("tower", Topic::single(KeyFamily::Frames)));
/// # Ok::<(), spandrel_bus::NameError>(())
/// ```
#[must_use]
pub fn parse_key(root: &Name, key: &str) -> Option<(Name, Topic)> {
    let rest = key.strip_prefix(root.as_str())?.strip_prefix('/')?;
    let (structure, below) = rest.split_once('/')?;
    let structure = Name::new(structure).ok()?;
    let topic = KeyFamily::all().find_map(|family| family.topic(below))?;
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
            (keys.buffer(&n), "spandrel/tower/sensor/storey-1/@buffer"),
            (keys.recording(), "spandrel/tower/@recording"),
            (keys.estimates_buffer(), "spandrel/tower/@estimates"),
            (keys.parameter(&n), "spandrel/tower/parameter/storey-1"),
            (keys.all_parameters(), "spandrel/tower/parameter/*"),
            (keys.loss(&n), "spandrel/tower/loss/storey-1"),
            (keys.all_losses(), "spandrel/tower/loss/*"),
            (keys.noise(&n), "spandrel/tower/noise/storey-1"),
            (keys.all_noise(), "spandrel/tower/noise/*"),
            (keys.model_class(), "spandrel/tower/model-class"),
            (keys.fit(), "spandrel/tower/fit"),
            (keys.local(&n), "spandrel/tower/local/storey-1"),
            (keys.all_local(), "spandrel/tower/local/*"),
            (keys.feedback(&n), "spandrel/tower/feedback/storey-1"),
            (keys.node(&n), "spandrel/tower/node/storey-1"),
            (keys.all_nodes(), "spandrel/tower/node/*"),
            (keys.outlier(&n), "spandrel/tower/outlier/storey-1"),
            (keys.all_outliers(), "spandrel/tower/outlier/*"),
            (
                keys.sensor_health(&n),
                "spandrel/tower/sensor/storey-1/health",
            ),
            (keys.all_sensor_health(), "spandrel/tower/sensor/*/health"),
            (keys.waveform(&n), "spandrel/tower/sensor/storey-1/waveform"),
            (keys.spectrum(&n), "spandrel/tower/sensor/storey-1/spectrum"),
            (keys.condition(&n), "spandrel/tower/condition/storey-1"),
            (keys.all_conditions(), "spandrel/tower/condition/*"),
            (keys.judgement(&n), "spandrel/tower/judgement/storey-1"),
            (keys.all_judgements(), "spandrel/tower/judgement/*"),
            (
                keys.judgement_course(&n),
                "spandrel/tower/judgement/storey-1/@course",
            ),
            (
                keys.all_judgement_courses(),
                "spandrel/tower/judgement/*/@course",
            ),
            (keys.report(&n), "spandrel/tower/@report/storey-1"),
            (keys.all_reports(), "spandrel/tower/@report/*"),
            (keys.mode(&n), "spandrel/tower/mode/storey-1"),
            (keys.all_modes(), "spandrel/tower/mode/*"),
            (keys.event(), "spandrel/tower/event"),
            (keys.all_alerts(), "spandrel/tower/alert/*"),
            (
                keys.all_acknowledgements(),
                "spandrel/tower/alert/*/acknowledge",
            ),
            (
                keys.status(Service::Fuse, &n),
                "spandrel/tower/status/fuse/storey-1",
            ),
            (keys.statuses(Service::Fuse), "spandrel/tower/status/fuse/*"),
            (keys.all_statuses(), "spandrel/tower/status/*/*"),
            (
                keys.all_live(Service::Sensor),
                "spandrel/tower/live/sensor/*",
            ),
            (keys.all_leaders(), "spandrel/tower/leader/identify/*"),
            (keys.description(), "spandrel/tower/description"),
            (keys.all_history(), "spandrel/tower/history/*"),
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
            (keys.history(&n), "spandrel/tower/history/storey-1"),
            (keys.history_log(), "spandrel/tower/@history-log"),
            (keys.alert_log(), "spandrel/tower/@alert-log"),
            (keys.leader(&n), "spandrel/tower/leader/identify/storey-1"),
            (keys.state(), "spandrel/tower/@state"),
            (keys.maintenance(), "spandrel/tower/maintenance"),
            (keys.annotation(), "spandrel/tower/annotation"),
            (keys.simulated(&n), "spandrel/tower/simulated/storey-1"),
            (keys.all_simulated(), "spandrel/tower/simulated/*"),
        ];
        for (found, expected) in expected {
            assert_eq!(found, expected);
            let is_known = parse_key(keys.root(), &found).is_some();
            assert_eq!(is_known, !found.contains('*'), "{found}");
        }
    }

    #[test]
    fn each_key_is_parsed_back_to_its_family_and_item() {
        let (keys, n) = (keys(), Name::new("n-1").unwrap());
        for family in KeyFamily::all() {
            let has_items = family.pattern().contains("{of}");
            let key = keys.key(family, &n);
            let topic = Topic {
                family,
                of: has_items.then(|| n.clone()),
            };
            let parsed = parse_key(keys.root(), &key);
            assert_eq!(parsed, Some((keys.structure().clone(), topic)), "{key}");
        }
    }

    #[test]
    fn no_two_families_share_a_key() {
        let (keys, n) = (keys(), Name::new("n-1").unwrap());
        let all: std::collections::BTreeSet<String> = KeyFamily::all()
            .map(|family| keys.key(family, &n))
            .collect();
        assert_eq!(all.len(), KeyFamily::all().count());
        let statuses = KeyFamily::Status(Service::Fuse)
            .expression_of_all_services(keys.root(), Some(keys.structure()));
        assert_eq!(statuses, Some(keys.all_statuses()));
    }

    #[test]
    fn foreign_keys_are_not_parsed() {
        let root = Name::new("spandrel").unwrap();
        for key in ["spandrel", "spandrel/tower", "other/tower/frames", ""] {
            assert_eq!(parse_key(&root, key), None, "{key}");
        }
        assert_eq!(parse_key(&root, "spandrelx/tower/frames"), None);
        assert_eq!(parse_key(&root, "spandrel/tower/progress/nobody"), None);
    }
}
