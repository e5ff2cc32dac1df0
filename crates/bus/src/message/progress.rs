//! How far a service has come.

use serde::{Deserialize, Serialize};

use super::{Format, Header, Malformed, Message};

/// All frames below number `done` are done.
///
/// Put per block, and repeated while nothing happens, because a progress message may be dropped.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Progress {
    /// Source: the id of the service; epoch: that of the frames it counts; sequence: same as `done`;
    /// time: that of the last frame done, ns since the Unix epoch (`i64::MIN` while there is none).
    pub header: Header,
    /// Number of the first frame not yet done.
    pub done: u64,
    /// Number of the first frame that the service would need again if it were killed now; of the same epoch. That of `done`
    /// for a service that remembers nothing.
    pub kept: u64,
}

impl Message for Progress {
    const TYPE: &'static str = "progress";
    const VERSION: u16 = 2;
    const FORMAT: Format = Format::Postcard;

    fn check(&self) -> Result<(), Malformed> {
        self.header.check(0)
    }
}
