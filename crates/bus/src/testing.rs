//! Helpers for the tests of this crate.

use crate::message::{FrameBlock, Header, StreamState};

/// Returns the frames `sequence..sequence + count` of one channel. The value of a frame is its
/// number.
pub(crate) fn frames(epoch: u64, sequence: u64, count: u64) -> FrameBlock {
    FrameBlock {
        header: Header {
            source: "source".into(),
            epoch,
            sequence,
            time_ns: (sequence * 5_000_000) as i64,
        },
        t0_ns: 0,
        sampling_rate_hz: 200.0,
        channels: 1,
        values: (sequence..sequence + count).map(|v| v as f64).collect(),
        state: StreamState::Running,
    }
}

/// Adds a block to a ring, as a publisher does.
#[expect(clippy::disallowed_methods, reason = "a publisher goes by the clock")]
pub(crate) fn push(
    ring: &mut crate::Ring<FrameBlock>,
    block: &FrameBlock,
) -> Result<(), crate::NotConsecutive> {
    let payload = crate::message::Message::encode(block).unwrap();
    ring.push(block, &payload, std::time::Instant::now())
}
