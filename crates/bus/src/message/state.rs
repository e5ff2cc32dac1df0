//! State of an identification, sent by the leader to its standby.

use serde::{Deserialize, Serialize};

use super::{Format, Header, MAX_MESSAGE_BYTES, Malformed, Message, bounded};

/// Complete state of an identification between two blocks.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct StateMessage {
    /// Source: id of identify; epoch and sequence: of the first frame that is not in the state;
    /// time: of the last frame in the state.
    pub header: Header,
    /// Term of the leader.
    pub term: u64,
    /// State in the format of a checkpoint, with a description of its origin and a checksum. Only
    /// identify reads it.
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
