//! Sources and their channels, checked.

use std::fmt;
use std::path::{Path, PathBuf};

use spandrel_record::ReadOptions;

use crate::calibration::Calibration;
use crate::lines::{LineFormat, RawFormat};

/// A connection to an instrument, or to a server of many instruments.
#[derive(Clone, Debug, PartialEq)]
pub struct SourcePlan {
    /// Name of the source, unique in the configuration.
    pub name: String,
    /// Kind of the connection, with its address.
    pub kind: SourceKind,
    /// Origin of the times of the samples.
    pub stamps: Stamps,
    /// Time that a row waits for the other channels of its node, s.
    pub wait_s: f64,
    /// Channels of the source.
    pub channels: Vec<ChannelPlan>,
    /// Conditions of the source.
    pub conditions: Vec<ConditionPlan>,
}

impl SourcePlan {
    /// Returns the names of all channels and conditions in the source.
    pub(crate) fn labels(&self) -> Vec<String> {
        let channels = self.channels.iter().map(|channel| &channel.label);
        let conditions = self.conditions.iter().map(|condition| &condition.label);
        channels.chain(conditions).cloned().collect()
    }

    /// Returns the time without a value after which the source is silent, s, unless its channels
    /// determine it. `None` if no value is expected within a known time.
    pub(crate) fn silent_after_s(&self) -> Option<f64> {
        let intervals = self.conditions.iter().map(|condition| condition.interval_s);
        let longest = intervals.collect::<Option<Vec<f64>>>()?.into_iter();
        Some(SILENT_AFTER_INTERVALS * longest.fold(0.0, f64::max))
    }
}

/// Number of intervals without a value after which a source of conditions is silent.
const SILENT_AFTER_INTERVALS: f64 = 2.0;

/// Kind and address of a source.
#[derive(Clone, Debug, PartialEq)]
pub enum SourceKind {
    /// Receives datagrams. Each contains one or more lines.
    Udp {
        /// Address to listen on.
        listen: String,
        /// Format of the lines.
        format: LineFormat,
    },
    /// Connects to a server that sends lines.
    Tcp {
        /// Address of the server.
        address: String,
        /// Format of the lines.
        format: LineFormat,
    },
    /// Accepts connections of instruments that send lines.
    TcpServer {
        /// Address to listen on.
        listen: String,
        /// Format of the lines.
        format: LineFormat,
    },
    /// Reads lines from standard input.
    Stdin {
        /// Format of the lines.
        format: LineFormat,
    },
    /// Follows a file that grows.
    File(GrowingFile),
    /// Reads the files that are dropped into a folder.
    Folder(DropFolder),
    /// Receives miniSEED records from a SeedLink server.
    SeedLink(SeedLinkServer),
    /// Subscribes to a topic of an MQTT broker.
    Mqtt(MqttTopic),
}

/// A topic of an MQTT broker.
#[derive(Clone, Debug, PartialEq)]
pub struct MqttTopic {
    /// Host of the broker.
    pub host: String,
    /// Port of the broker.
    pub port: u16,
    /// Topic filter.
    pub topic: String,
    /// Identifier of the client, unique at the broker.
    pub client_id: String,
    /// Whether the broker keeps messages while the feed is disconnected.
    pub session: MqttSession,
    /// User and password, if the broker requires a login.
    pub login: Option<Login>,
    /// Content of a message.
    pub payload: Payload,
}

/// Whether a broker keeps messages for a client.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MqttSession {
    /// The broker keeps messages while the client is disconnected.
    Kept,
    /// The broker forgets the client when it disconnects.
    Clean,
}

/// A user and a password.
#[derive(Clone, PartialEq, Eq)]
pub struct Login {
    /// User.
    pub user: String,
    /// Password.
    pub password: String,
}

impl fmt::Debug for Login {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // A log must not contain the password.
        write!(f, "Login({})", self.user)
    }
}

/// Content of a message.
#[derive(Clone, Debug, PartialEq)]
pub enum Payload {
    /// One or more lines.
    Lines(LineFormat),
    /// An array of numbers.
    Raw(RawFormat),
}

/// A SeedLink server. The names of the channels are `NET.STA.LOC.CHA`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SeedLinkServer {
    /// Address, HOST:PORT.
    pub address: String,
    /// Highest version of the protocol that the client uses.
    pub newest: SeedLinkVersion,
}

/// A version of the SeedLink protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SeedLinkVersion {
    /// SeedLink 3.
    Three,
    /// SeedLink 4.
    Four,
}

/// A file that grows, and its rotation.
#[derive(Clone, Debug, PartialEq)]
pub struct GrowingFile {
    /// Path. A `*` in the file name stands for any text, such as a date. The files are then read
    /// in the order of their names.
    pub path: PathBuf,
    /// Format of the lines.
    pub format: LineFormat,
    /// Start position if ingest has no frames yet.
    pub start: StartAt,
}

/// Start position in a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StartAt {
    /// The first line.
    Start,
    /// The present end of the file.
    End,
}

/// A folder into which recordings are dropped.
#[derive(Clone, Debug, PartialEq)]
pub struct DropFolder {
    /// Path of the folder.
    pub path: PathBuf,
    /// File with the names of the recordings that were read.
    pub memory: PathBuf,
    /// Properties that the recordings may not state themselves.
    pub options: ReadOptions,
}

impl GrowingFile {
    /// Returns the folder of the file.
    pub(crate) fn folder(&self) -> &Path {
        match self.path.parent() {
            Some(folder) if folder.as_os_str().is_empty() => Path::new("."),
            Some(folder) => folder,
            None => Path::new("/"),
        }
    }

    /// Returns `true` if the path stands for several files.
    pub(crate) fn is_pattern(&self) -> bool {
        self.name().contains('*')
    }

    /// Returns `true` if a file name fits the pattern.
    pub(crate) fn matches(&self, name: &str) -> bool {
        let pattern = self.name();
        let Some((before, after)) = pattern.split_once('*') else {
            return pattern == name;
        };
        name.len() >= before.len() + after.len()
            && name.starts_with(before)
            && name.ends_with(after)
    }

    /// Returns the error of a feed that finds no file.
    pub(crate) fn missing(&self) -> String {
        let path = self.path.display();
        match self.is_pattern() {
            true => format!("no file matches {path}"),
            false if self.path.exists() => format!(
                "{path} is not a file; kind = \"stdin\" reads a serial port, and kind \
                 = \"folder\" a folder"
            ),
            false => format!("{path} does not exist"),
        }
    }

    fn name(&self) -> String {
        let name = self.path.file_name().unwrap_or_default();
        name.to_string_lossy().into_owned()
    }
}

impl SourceKind {
    /// Returns `true` if the source delivers earlier samples again after a restart.
    #[must_use]
    pub fn can_repeat(&self) -> bool {
        match self {
            Self::Udp { .. }
            | Self::Tcp { .. }
            | Self::TcpServer { .. }
            | Self::Stdin { .. }
            | Self::Mqtt(_) => false,
            Self::File(_) | Self::Folder(_) | Self::SeedLink(_) => true,
        }
    }

    /// Returns `true` if samples with earlier times mean that the clock of the source was set back.
    ///
    /// The files of a folder may be dropped in any order, and each has its own times.
    pub(crate) fn can_go_back(&self) -> bool {
        !matches!(self, Self::Folder(_))
    }

    /// Returns the kind and address for people.
    #[must_use]
    pub fn description(&self) -> String {
        match self {
            Self::Udp { listen, .. } => format!("udp {listen}"),
            Self::Tcp { address, .. } => format!("tcp {address}"),
            Self::TcpServer { listen, .. } => format!("tcp-server {listen}"),
            Self::Stdin { .. } => "stdin".to_owned(),
            Self::File(file) => format!("file {}", file.path.display()),
            Self::Mqtt(broker) => format!("mqtt {}:{} {}", broker.host, broker.port, broker.topic),
            Self::SeedLink(server) => format!("seedlink {}", server.address),
            Self::Folder(folder) => format!("folder {}", folder.path.display()),
        }
    }
}

/// Origin of the times of the samples.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Stamps {
    /// The source states the time of each packet. It may deviate by `jitter_s` (s) from the time
    /// that follows from the previous packet. The minimum is half a time step.
    Source {
        /// Allowed deviation, s.
        jitter_s: f64,
    },
    /// Samples are counted from the arrival of the first packet. A packet that arrives more than
    /// `jitter_s` (s) too early or too late sets the time again.
    Arrival {
        /// Allowed deviation, s.
        jitter_s: f64,
    },
}

/// A channel of a source, and the channel of a structure that it feeds.
#[derive(Clone, Debug, PartialEq)]
pub struct ChannelPlan {
    /// Name of the channel in the source.
    pub label: String,
    /// Index into the nodes of the configuration.
    pub node: usize,
    /// Position of the channel in its node.
    pub position: usize,
    /// Name of the channel in the structure file.
    pub channel: String,
    /// Conversion to SI units.
    pub calibration: Calibration,
    /// SI unit of the channel.
    pub unit: &'static str,
}

/// A channel of a source, and the condition of a structure that it measures.
#[derive(Clone, Debug, PartialEq)]
pub struct ConditionPlan {
    /// Name of the channel in the source.
    pub label: String,
    /// Index into the structures of the configuration.
    pub structure: usize,
    /// Name of the condition in the structure file.
    pub name: String,
    /// Unit of the condition.
    pub unit: &'static str,
    /// Lowest and highest plausible value, in the unit.
    pub range: Option<(f64, f64)>,
    /// Expected time between two values, s.
    pub interval_s: Option<f64>,
    /// Conversion to the unit of the condition.
    pub calibration: Calibration,
}

/// A node with at least one channel that a source feeds.
#[derive(Clone, Debug, PartialEq)]
pub struct NodePlan {
    /// Index into the structures of the configuration.
    pub structure: usize,
    /// Name of the node.
    pub name: String,
    /// Number of channels.
    pub channels: usize,
    /// Sampling rate, Hz.
    pub rate_hz: f64,
}

/// A structure of the configuration.
#[derive(Clone, Debug, PartialEq)]
pub struct StructurePlan {
    /// Name.
    pub name: String,
    /// File of the structure.
    pub file: PathBuf,
}
