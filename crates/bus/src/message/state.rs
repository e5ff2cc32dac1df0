//! The state of an identification, from the one that leads to one that stands by.

use serde::{Deserialize, Serialize};

use super::{Format, Header, MAX_MESSAGE_BYTES, Malformed, Message, bounded};

/// All that an identification knows between two blocks.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct StateMessage {
    /// Source: the id of identify; epoch and sequence: of the first frame that is not in the state; time: of the last one that is.
    pub header: Header,
    /// Term in which it leads.
    pub term: u64,
    /// The state as a checkpoint has it, with what it is of and a checksum. Only identify reads it.
    #[serde(deserialize_with = "bounded::list::<_, _, MAX_MESSAGE_BYTES>")]
    pub checkpoint: Vec<u8>,
}

impl Message for StateMessage {
    const TYPE: &'static str = "state";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Postcard;

    fn check(&self) -> Result<(), Malformed> {
        self.header.check(0)
    }
}
