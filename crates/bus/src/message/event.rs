//! Rare events with their reasons, for people.

use serde::{Deserialize, Serialize};

use super::text::{mend_label, mend_text};
use super::{Format, Malformed, Message, check_label, check_text};
use crate::name::Name;

/// Kind of an event.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum EventKind {
    /// A filter or a service was restarted.
    Restart,
    /// A standby took over.
    Takeover,
    /// A reference or a noise parameter was calibrated.
    Calibration,
    /// A noise level or parameter remains unknown, because the data do not inform it.
    Unidentified,
    /// Another model class is the most plausible one.
    LeadingClass,
    /// A node disagrees with the others and is excluded.
    NodeExcluded,
    /// A node is offline or sends nothing that the station can fuse.
    NodeSilent,
    /// A node is included again or sends usable messages again.
    NodeBack,
    /// A channel is excluded.
    ChannelExcluded,
    /// A channel is probably faulty.
    ChannelInDoubt,
    /// A channel is included again.
    ChannelBack,
    /// A large share of the samples of a node does not reach the frames.
    SamplesDropped,
    /// The node's samples reach the frames again.
    SamplesBack,
    /// The clock of a node differs from that of most nodes, or no majority of the nodes agrees.
    ClockWrong,
    /// The clock of such a node agrees again.
    ClockRight,
    /// The monitoring became blind, degraded or complete.
    Monitoring,
    /// Maintenance began or ended, so that notices are muted or sent again.
    Maintenance,
    /// Items are permanently lost.
    Gap,
    /// Identification is overloaded and publishes display values less often.
    Overloaded,
    /// Identification has caught up.
    CaughtUp,
    /// The history cannot use its database, or had to begin a new file.
    HistoryUnavailable,
    /// The history can use its database again.
    HistoryBack,
    /// A service cannot save its state, because its folder is gone.
    StateLost,
    /// A service can save its state again.
    StateBack,
    /// A lasting change of a quantity was found.
    LastingChange,
    /// A person has annotated the structure.
    Annotation,
    /// A mode persists that the structure file does not declare.
    ModeProposed,
    /// A declared mode is found too rarely, so its values are not published.
    ModeLost,
    /// A declared mode was found, for the first time or again.
    ModeFound,
    /// Two declared modes can no longer be told apart.
    ModePaired,
    /// Two such modes can be told apart again.
    ModeParted,
    /// The natural frequencies of the model contradict the measured ones.
    ModelContradicted,
    /// They agree again.
    ModelAgrees,
    /// The clock of a node has moved against those of the other nodes, but its samples are used.
    ClockMoved,
    /// Strong motion has begun. A report follows.
    Earthquake,
    /// A report of an earthquake is ready. The subject names it.
    EarthquakeReport,
    /// A report of an earthquake is not made, or waits.
    EarthquakeUnreported,
    /// A connection to the bus was closed, because its other end stopped reading.
    ReaderDisconnected,
    /// The source of a node states a low quality of its clock. Its samples are used.
    ClockDoubtful,
    /// A receiver has got a notice.
    NoticeSent,
    /// A receiver could not be notified.
    NoticeFailed,
}

/// One event with its reason.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Event {
    /// Name of the structure.
    pub structure: Name,
    /// Measurement time of the event, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// Kind of the event.
    pub kind: EventKind,
    /// Affected node, channel, parameter or service; at most
    /// [`MAX_LABEL_BYTES`](super::MAX_LABEL_BYTES), without control characters.
    pub subject: String,
    /// What happened, in words.
    pub what: String,
    /// The reason, in words.
    pub why: String,
}

impl Event {
    /// Start of the text of an event about a notice that was sent. The receiver follows it.
    pub const NOTICE_SENT: &'static str = "notice sent to ";
    /// Start of the text of an event about a notice that was not sent. The receiver follows it.
    pub const NOTICE_FAILED: &'static str = "notice not sent to ";

    /// Makes a stored event valid if it was stored under less strict limits.
    #[must_use]
    pub fn legible(mut self) -> Self {
        mend_label(&mut self.subject);
        mend_text(&mut self.what);
        mend_text(&mut self.why);
        self
    }
}

impl Message for Event {
    const TYPE: &'static str = "event";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        check_label("subject", &self.subject)?;
        check_text("what", &self.what)?;
        check_text("why", &self.why)
    }
}
