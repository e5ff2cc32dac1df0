//! Acknowledgement of an alert.

use serde::{Deserialize, Serialize};

use super::text::{mend_label, mend_text};
use super::{Format, Malformed, Message, check_label, check_text};
use crate::name::Name;

/// Acknowledgement of the alert of one parameter. The key contains the same parameter.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Acknowledgement {
    /// Name of the structure.
    pub structure: Name,
    /// Name of the parameter.
    pub parameter: Name,
    /// Time of the acknowledgement, ns since the Unix epoch, UTC, on the clock of the person's
    /// device.
    pub time_ns: i64,
    /// Name of the person; at most [`MAX_LABEL_BYTES`](super::MAX_LABEL_BYTES), without control
    /// characters.
    pub who: String,
    /// A note; may be empty or have several lines.
    #[serde(default)]
    pub note: String,
}

impl Acknowledgement {
    /// Makes a stored acknowledgement valid if it was stored under less strict limits.
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
