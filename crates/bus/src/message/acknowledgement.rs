//! Someone has seen an alert.

use serde::{Deserialize, Serialize};

use super::{Format, Malformed, Message, check_text};
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
    /// Who.
    pub who: String,
    /// A note; may be empty.
    #[serde(default)]
    pub note: String,
}

impl Message for Acknowledgement {
    const TYPE: &'static str = "acknowledgement";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        check_text("who", &self.who)?;
        check_text("note", &self.note)
    }
}
