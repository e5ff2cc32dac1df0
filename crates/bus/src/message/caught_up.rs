//! Reply of a buffer that has no newer items.

use serde::{Deserialize, Serialize};

use super::{Format, Header, Malformed, Message, StreamState};

/// Reply that the buffer has no item at or after the requested number.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct CaughtUp {
    /// Source and epoch of the stream. `sequence` is the number of its next item, which is not yet
    /// published; time is 0.
    pub header: Header,
    /// Whether the stream continues.
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
