//! A stream in pieces that limit the work per step.
//!
//! Fetched blocks contain thousands of items. For a heavy model, such a block is more than a minute
//! of filter work. During this time the service would not process other inputs of the structure,
//! and the thread would not reply to the watchdog.

use spandrel_bus::{Block, Delivery, Stream, StreamCounts};
use tokio::time::{Duration, Instant};

/// Maximum number of items per piece. Sources publish at most this number at once.
pub(crate) const MOST_ITEMS: u64 = 128;
/// Maximum number of items in the first piece, whose cost per item is unknown. The heaviest models
/// take 25 ms per item, and three times as long on a machine with much other load.
const FIRST_ITEMS: u64 = 16;
/// Number of items that a piece may always have.
const LEAST_ITEMS: u64 = 8;
/// Time that the work on a piece may take. The watchdog requires a reply from a thread within 10 s.
const WORK: Duration = Duration::from_millis(500);

/// The blocks of a stream, with long ones cut into pieces. The positions of the cuts do not affect
/// the estimates.
#[derive(Debug)]
pub(crate) struct Pieces<B> {
    stream: Stream<B>,
    /// The rest of a block.
    rest: Option<B>,
    /// Maximum number of items of the next piece.
    most: u64,
    /// The last piece, until the next one is requested.
    given: Option<Given>,
}

/// A piece on which the caller works.
#[derive(Debug)]
struct Given {
    since: Instant,
    items: u64,
}

impl<B: Block> Pieces<B> {
    pub(crate) fn of(stream: Stream<B>) -> Self {
        Self {
            stream,
            rest: None,
            most: FIRST_ITEMS,
            given: None,
        }
    }

    /// Waits for the next piece or gap. The future is safe to drop. Never returns `None` while this
    /// value exists.
    ///
    /// The time from one return to the next call counts as the work on the piece.
    pub(crate) async fn next(&mut self) -> Option<Delivery<B>> {
        if let Some(Given { since, items }) = self.given.take() {
            self.most = most_after(self.most, items, since.elapsed());
        }
        let block = match self.rest.take() {
            Some(rest) => rest,
            None => match self.stream.deliveries().recv_async().await.ok()? {
                Delivery::Block(block) => block,
                gap @ Delivery::Gap(_) => return Some(gap),
            },
        };
        let (piece, rest) = cut(block, self.most);
        self.rest = rest;
        self.given = Some(Given {
            since: Instant::now(),
            items: piece.count(),
        });
        Some(Delivery::Block(piece))
    }

    /// Returns the counters of the stream.
    pub(crate) fn counts(&self) -> StreamCounts {
        self.stream.counts()
    }
}

/// Returns the maximum number of items of the next piece, after `took` for a piece of `items` items
/// when `most` were allowed. It at most doubles.
fn most_after(most: u64, items: u64, took: Duration) -> u64 {
    let fitting = items as f64 * WORK.as_secs_f64() / took.as_secs_f64().max(1e-6);
    (fitting as u64)
        .min(2 * most)
        .clamp(LEAST_ITEMS, MOST_ITEMS)
}

/// Returns the first piece of a block, with at most `most` items, and the rest, if any. The end of
/// the epoch belongs to the rest.
fn cut<B: Block>(block: B, most: u64) -> (B, Option<B>) {
    if block.count() <= most {
        return (block, None);
    }
    let mut piece = block.clone();
    piece.truncate(most);
    let mut rest = block;
    rest.skip(most);
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
            let (piece, rest) = cut(block, MOST_ITEMS);
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
    fn heavy_work_shortens_the_pieces_and_light_work_lengthens_them() {
        let heavy = |items: u64| Duration::from_millis(75 * items);
        let mut most = FIRST_ITEMS;
        for _ in 0..4 {
            most = most_after(most, most, heavy(most));
        }
        assert_eq!(most, LEAST_ITEMS);
        for _ in 0..4 {
            most = most_after(most, most, Duration::ZERO);
        }
        assert_eq!(most, MOST_ITEMS);
        let usual = Duration::from_millis(25 * MOST_ITEMS);
        assert_eq!(most_after(most, MOST_ITEMS, usual), 20);
    }

    #[test]
    fn short_blocks_and_empty_ends_stay_whole() {
        for count in [0, 1, MOST_ITEMS] {
            assert_eq!(pieces(block(5, count)), [block(5, count)]);
        }
        assert_eq!(pieces(block(5, MOST_ITEMS + 1)).len(), 2);
    }
}
