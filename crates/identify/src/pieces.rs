//! A stream in pieces that limit the work per step.
//!
//! Fetched blocks contain thousands of items. For a heavy model, such a block is more than a minute
//! of filter work. During this time the service would not process other inputs of the structure,
//! and the thread would not reply to the watchdog.

use spandrel_bus::{Block, Delivery, Stream, StreamCounts};

/// Maximum number of items per piece. Sources publish at most this number at once, so only fetched
/// blocks are cut.
///
/// The heaviest models take 25 ms per item, so a piece takes about three seconds. On a machine with
/// much other load it takes three times as long. The watchdog requires a reply from a thread within
/// 10 s.
pub(crate) const MOST_ITEMS: u64 = 128;

/// The blocks of a stream, with long ones cut into pieces. The positions of the cuts do not affect
/// the estimates.
#[derive(Debug)]
pub(crate) struct Pieces<B> {
    stream: Stream<B>,
    /// The rest of a block.
    rest: Option<B>,
}

impl<B: Block> Pieces<B> {
    pub(crate) fn of(stream: Stream<B>) -> Self {
        Self { stream, rest: None }
    }

    /// Waits for the next piece or gap. The future is safe to drop. Never returns `None` while this
    /// value exists.
    pub(crate) async fn next(&mut self) -> Option<Delivery<B>> {
        let block = match self.rest.take() {
            Some(rest) => rest,
            None => match self.stream.deliveries().recv_async().await.ok()? {
                Delivery::Block(block) => block,
                gap @ Delivery::Gap(_) => return Some(gap),
            },
        };
        let (piece, rest) = cut(block);
        self.rest = rest;
        Some(Delivery::Block(piece))
    }

    /// Returns the counters of the stream.
    pub(crate) fn counts(&self) -> StreamCounts {
        self.stream.counts()
    }
}

/// Returns the first piece of a block and the rest, if any. The end of the epoch belongs to the
/// rest.
fn cut<B: Block>(block: B) -> (B, Option<B>) {
    if block.count() <= MOST_ITEMS {
        return (block, None);
    }
    let mut piece = block.clone();
    piece.truncate(MOST_ITEMS);
    let mut rest = block;
    rest.skip(MOST_ITEMS);
    (piece, Some(rest))
}

#[cfg(test)]
mod tests {
    use super::*;
    use spandrel_bus::{FrameBlock, Header, StreamState};

    fn block(first: u64, count: u64) -> FrameBlock {
        FrameBlock {
            header: Header {
                source: "ingest".into(),
                epoch: 7,
                sequence: first,
                time_ns: 10_000_000 * first as i64,
            },
            t0_ns: 0,
            sampling_rate_hz: 100.0,
            channels: 2,
            values: (2 * first..2 * (first + count))
                .map(|value| value as f64)
                .collect(),
            state: StreamState::Ended,
        }
    }

    fn pieces(block: FrameBlock) -> Vec<FrameBlock> {
        let mut pieces = Vec::new();
        let mut next = Some(block);
        while let Some(block) = next.take() {
            let (piece, rest) = cut(block);
            pieces.push(piece);
            next = rest;
        }
        pieces
    }

    #[test]
    fn pieces_of_a_long_block_are_short_and_complete() {
        let whole = block(1000, 4096);
        let pieces = pieces(whole.clone());
        assert!(pieces.iter().all(|piece| piece.count() <= MOST_ITEMS));
        let ended = pieces
            .iter()
            .filter(|piece| piece.state == StreamState::Ended)
            .count();
        assert_eq!(ended, 1, "only the last piece ends the epoch");
        let mut pieces = pieces.into_iter();
        let mut together = pieces.next().unwrap();
        assert!(pieces.all(|piece| together.append(&piece)));
        assert_eq!(together, whole);
    }

    #[test]
    fn short_blocks_and_empty_ends_stay_whole() {
        for count in [0, 1, MOST_ITEMS] {
            assert_eq!(pieces(block(5, count)), [block(5, count)]);
        }
        assert_eq!(pieces(block(5, MOST_ITEMS + 1)).len(), 2);
    }
}
