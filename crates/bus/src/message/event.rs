//! Rare things that people want to know: what, when, why.

use serde::{Deserialize, Serialize};

use super::text::{mend_label, mend_text};
use super::{Format, Malformed, Message, check_label, check_text};
use crate::name::Name;

/// The kinds of events.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum EventKind {
    /// A filter or a service was restarted.
    Restart,
    /// One that stood by has taken over.
    Takeover,
    /// A reference or a noise parameter was calibrated.
    Calibration,
    /// A noise level or parameter stays unknown: the data do not inform it.
    Unidentified,
    /// Another model class leads.
    LeadingClass,
    /// A node disagrees with the others and is left out.
    NodeExcluded,
    /// Nothing comes of a node that could be fused, or no node is there any more.
    NodeSilent,
    /// A node is taken back, or is heard again.
    NodeBack,
    /// A channel is no longer used.
    ChannelExcluded,
    /// A channel is taken back.
    ChannelBack,
    /// Items are lost for good.
    Gap,
    /// Identification does not keep up: values for people are put less often.
    Overloaded,
    /// It has caught up again.
    CaughtUp,
}

/// One event.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Event {
    /// The structure.
    pub structure: Name,
    /// When, ns since the Unix epoch, UTC, in measurement time.
    pub time_ns: i64,
    /// The kind.
    pub kind: EventKind,
    /// Whom it concerns: a node, channel, parameter or service; at most [`MAX_LABEL_BYTES`](super::MAX_LABEL_BYTES), without
    /// control characters.
    pub subject: String,
    /// What happened, in words.
    pub what: String,
    /// Why, in words.
    pub why: String,
}

impl Event {
    /// The same as it may be sent, of one that was kept when more was allowed.
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
