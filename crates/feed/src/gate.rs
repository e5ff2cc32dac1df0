//! Keeps a source that can wait from running ahead of ingest.
//!
//! A file or a server delivers a backlog at any speed. The ring of a node keeps a limited number of
//! samples, so a block that ingest has not processed must not leave the ring.

use std::collections::VecDeque;

/// Maximum number of published samples that ingest has not processed. It is a quarter of the ring:
/// packets in transit and readers that are behind ingest need the rest.
const WINDOW: u64 = 4096;

/// The published blocks of one node that ingest has not processed.
#[derive(Clone, Debug, Default)]
pub(crate) struct Ahead {
    /// Time of the last sample (ns) and number of samples of each block.
    blocks: VecDeque<(i64, u64)>,
    samples: u64,
}

impl Ahead {
    /// Records a published block. Without room, it extends the last block, so that a source that
    /// cannot wait needs no more memory.
    pub(crate) fn published(&mut self, last_ns: i64, samples: u64) {
        let has_room = self.has_room();
        self.samples += samples;
        match self.blocks.back_mut() {
            Some(last) if !has_room => *last = (last_ns.max(last.0), last.1 + samples),
            _ => self.blocks.push_back((last_ns, samples)),
        }
    }

    /// Forgets the published blocks, because the clock of their source was wrong.
    pub(crate) fn forget(&mut self) {
        *self = Self::default();
    }

    /// Records that ingest has processed everything up to `time_ns`.
    pub(crate) fn processed(&mut self, time_ns: i64) {
        while let Some((_, samples)) = self.blocks.pop_front_if(|(last_ns, _)| *last_ns <= time_ns)
        {
            self.samples -= samples;
        }
    }

    /// Returns `true` if more samples may be published.
    pub(crate) fn has_room(&self) -> bool {
        self.samples < WINDOW
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn room_returns_when_ingest_has_processed_a_block() {
        let mut ahead = Ahead::default();
        ahead.published(10, 4000);
        assert!(ahead.has_room());
        ahead.published(20, 4000);
        assert!(!ahead.has_room());
        ahead.processed(9);
        assert!(!ahead.has_room());
        ahead.processed(10);
        assert!(ahead.has_room());
    }

    #[test]
    fn blocks_without_room_need_no_memory_and_are_processed_together() {
        let mut ahead = Ahead::default();
        for last_ns in 0..100_000 {
            ahead.published(last_ns, 1);
        }
        assert_eq!(ahead.blocks.len() as u64, WINDOW);
        ahead.processed(99_998);
        assert!(!ahead.has_room());
        ahead.processed(99_999);
        assert_eq!((ahead.samples, ahead.blocks.len()), (0, 0));
    }
}
