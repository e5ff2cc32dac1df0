//! Construction and parsing of all key expressions of Spandrel.

mod of_structure;
mod service;

pub use of_structure::Keys;
pub use service::Service;

use crate::name::Name;

/// Default root of all key expressions.
pub const DEFAULT_ROOT: &str = "spandrel";

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
    /// [`Keys::epoch`], one per quantity
    Epoch = "epoch/{of}",
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
    /// [`Keys::judgement_log`]
    JudgementLog = "@judgement-log",
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
mod tests;
