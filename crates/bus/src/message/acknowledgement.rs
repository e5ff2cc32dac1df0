//! Someone has seen an alert.

use serde::{Deserialize, Serialize};

use super::text::{mend_label, mend_text};
use super::{Format, Malformed, Message, check_label, check_text};
use crate::name::Name;

/// Who acknowledges the alert of which parameter; the key says the same.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Acknowledgement {
    /// The structure.
    pub structure: Name,
    /// The parameter.
    pub parameter: Name,
    /// When, ns since the Unix epoch, UTC, on the clock of the one who acknowledges.
    pub time_ns: i64,
    /// Who; at most [`MAX_LABEL_BYTES`](super::MAX_LABEL_BYTES), without control characters.
    pub who: String,
    /// A note; may be empty, and may have several lines.
    #[serde(default)]
    pub note: String,
}

impl Acknowledgement {
    /// The same as it may be sent, of one that was kept when more was allowed.
    #[must_use]
    pub fn legible(mut self) -> Self {
        mend_label(&mut self.who);
        mend_text(&mut self.note);
        self
    }
}

impl Message for Acknowledgement {
    const TYPE: &'static str = "acknowledgement";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        check_label("who", &self.who)?;
        check_text("note", &self.note)
    }
}
