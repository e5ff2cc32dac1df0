//! The answer of a buffer that has nothing newer.

use serde::{Deserialize, Serialize};

use super::{Format, Header, Malformed, Message, StreamState};

/// Says that the buffer has no item at or after the number asked for.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct CaughtUp {
    /// Source and epoch of the stream; sequence: number of its next item, not yet put; time: 0.
    pub header: Header,
    /// Whether the stream goes on.
    pub state: StreamState,
}

impl Message for CaughtUp {
    const TYPE: &'static str = "caught-up";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Postcard;

    fn check(&self) -> Result<(), Malformed> {
        self.header.check(0)
    }
}
