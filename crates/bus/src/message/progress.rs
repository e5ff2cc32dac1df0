//! Progress of a service.

use serde::{Deserialize, Serialize};

use super::{Format, Header, Malformed, Message};

/// Progress of a service that has processed all frames below number `done`.
///
/// Services publish it for each block and repeat it while idle, because progress messages may be
/// dropped.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Progress {
    /// Source: id of the service; epoch: of the counted frames; sequence: same as `done`.
    ///
    /// Time: of the last processed frame, ns since the Unix epoch, UTC (`i64::MIN` if there is
    /// none).
    pub header: Header,
    /// Number of the first unprocessed frame.
    pub done: u64,
    /// Number of the first frame, of the same epoch, that the service would need again after a
    /// crash. Equals `done` for a service without checkpoints.
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
