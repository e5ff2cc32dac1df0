//! Text of the structure file.

use serde::{Deserialize, Serialize};

use super::{Format, MAX_MESSAGE_BYTES, Malformed, Message};
use crate::name::Name;

/// Reply to a query for the description of a structure.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Description {
    /// Name of the structure.
    pub structure: Name,
    /// The structure file (TOML).
    pub text: String,
}

impl Message for Description {
    const TYPE: &'static str = "description";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        if self.text.len() <= MAX_MESSAGE_BYTES {
            return Ok(());
        }
        Err(Malformed::Text {
            what: "text",
            found: self.text.len(),
            most: MAX_MESSAGE_BYTES,
        })
    }
}
