//! Samples that caused a node's worker to panic, which later runs skip.

use spandrel_bus::{Block, SampleBlock, StreamState};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Successive items of an epoch.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Span {
    pub(crate) epoch: u64,
    /// Number of the first item.
    pub(crate) from: u64,
    /// Number of the item after the last.
    pub(crate) to: u64,
}

/// Samples that caused a worker to panic, shared between the runs of the worker in one process.
///
/// After a panic, every sample of the block that the worker was processing counts as missing. The
/// block is short, and the filter bridges it by predictions.
#[derive(Debug, Clone, Default)]
pub struct SetAside {
    spans: Arc<Mutex<Vec<Span>>>,
}

impl SetAside {
    fn spans(&self) -> MutexGuard<'_, Vec<Span>> {
        // No code that can panic runs under this lock.
        self.spans.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Excludes these samples from now on.
    pub(crate) fn add(&self, span: Span) {
        self.spans().push(span);
    }

    /// Returns the number of panics so far.
    pub(crate) fn deaths(&self) -> u64 {
        self.spans().len() as u64
    }

    /// Returns the number of excluded samples.
    pub(crate) fn samples(&self) -> u64 {
        self.spans()
            .iter()
            .map(|span| span.to.saturating_sub(span.from))
            .sum()
    }

    /// Returns the parts of a block without the excluded samples.
    pub(crate) fn cut(&self, block: SampleBlock) -> Vec<SampleBlock> {
        let mut parts = vec![block];
        for span in self.spans().iter().copied() {
            parts = parts
                .into_iter()
                .flat_map(|part| without(part, span))
                .collect();
        }
        parts
    }
}

/// Returns the parts of a block before and after a span.
fn without(block: SampleBlock, span: Span) -> Vec<SampleBlock> {
    let Span { epoch, from, to } = span;
    let (first, end) = (block.header.sequence, block.end());
    if block.header.epoch != epoch || end <= from || first >= to {
        return vec![block];
    }
    let (mut before, mut after) = (block.clone(), block);
    before.truncate(from.saturating_sub(first));
    after.skip(to - first);
    // An end mark belongs to the last part, even if that part has no samples.
    let has_after = after.count() > 0 || after.state == StreamState::Ended;
    [
        Some(before).filter(|before| before.count() > 0),
        Some(after).filter(|_| has_after),
    ]
    .into_iter()
    .flatten()
    .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use spandrel_bus::{Header, Pace};

    fn block(first: u64, count: u64, state: StreamState) -> SampleBlock {
        SampleBlock {
            header: Header {
                source: "roof".into(),
                epoch: 7,
                sequence: first,
                time_ns: 10_000_000 * first as i64,
            },
            sampling_rate_hz: 100.0,
            pace: Pace::Live,
            channels: 1,
            samples: (first..first + count).map(|number| number as f64).collect(),
            state,
            clock_quality: None,
        }
    }

    /// Returns first and end of each remaining part of a block.
    fn left(set_aside: &SetAside, block: SampleBlock) -> Vec<(u64, u64)> {
        set_aside
            .cut(block)
            .into_iter()
            .map(|part| (part.header.sequence, part.end()))
            .collect()
    }

    #[test]
    fn samples_set_aside_are_omitted_for_any_block_size() {
        let set_aside = SetAside::default();
        let span = |from, to| Span { epoch: 7, from, to };
        set_aside.add(span(10, 14));
        set_aside.add(span(20, 22));
        assert_eq!((set_aside.deaths(), set_aside.samples()), (2, 6));
        let running = |first, count| block(first, count, StreamState::Running);
        assert_eq!(left(&set_aside, running(0, 10)), [(0, 10)]);
        assert_eq!(
            left(&set_aside, running(5, 30)),
            [(5, 10), (14, 20), (22, 35)]
        );
        assert_eq!(left(&set_aside, running(8, 4)), [(8, 10)]);
        assert_eq!(left(&set_aside, running(12, 4)), [(14, 16)]);
        assert_eq!(left(&set_aside, running(11, 2)), []);
        let other = SampleBlock {
            header: Header {
                epoch: 8,
                ..running(8, 4).header
            },
            ..running(8, 4)
        };
        assert_eq!(left(&set_aside, other), [(8, 12)]);
        let ended = set_aside.cut(block(8, 6, StreamState::Ended));
        let [before, end] = &ended[..] else {
            panic!("{ended:?}")
        };
        assert_eq!((before.end(), before.state), (10, StreamState::Running));
        assert_eq!(
            (end.header.sequence, end.end(), end.state),
            (14, 14, StreamState::Ended)
        );
    }
}
