//! Items of a lossless stream that are no longer in memory.

use crate::message::Block;
use crate::range::QueryRange;
use crate::ring::{ANSWER_BYTES, Ring};

/// Storage for items that the source of a lossless stream no longer has in memory.
///
/// The bus calls it on a thread that may block.
pub trait Archive<B>: Send + Sync {
    /// Reads the items of `epoch` from number `after` on, or from the oldest stored item if that is
    /// later.
    ///
    /// Returns at most `limit` items and roughly `bytes` bytes. Returns `None` if the archive has
    /// no such items or cannot read them.
    fn read(&self, epoch: u64, after: u64, limit: u64, bytes: usize) -> Option<B>;

    /// Returns the lowest stored epoch above `epoch`.
    fn epoch_after(&self, epoch: u64) -> Option<u64>;
}

/// Items to read from an archive before the ring may reply.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Lookup {
    epoch: u64,
    after: u64,
    limit: u64,
    /// Epoch of the ring, which is the latest epoch.
    last_epoch: u64,
}

impl Lookup {
    /// Returns the requested items that the ring does not contain, if any.
    ///
    /// A reader without an epoch receives at most the last `recent` items of the current epoch, not
    /// the whole archive.
    pub(crate) fn of<B: Block>(ring: &Ring<B>, range: &QueryRange, recent: u64) -> Option<Self> {
        let last_epoch = ring.epoch();
        let limit = range.limit.max(1);
        match range.epoch {
            Some(epoch) if epoch > last_epoch => None,
            Some(epoch) if epoch < last_epoch => Some(Self {
                epoch,
                after: range.after,
                limit,
                last_epoch,
            }),
            epoch => {
                let oldest = if epoch.is_some() {
                    0
                } else {
                    ring.next().saturating_sub(recent)
                };
                let after = range.after.max(oldest);
                (after < ring.first()).then_some(Self {
                    epoch: last_epoch,
                    after,
                    limit,
                    last_epoch,
                })
            }
        }
    }

    /// Reads the items. Returns `None` if the ring must reply with its own contents.
    pub(crate) fn read<B: Block>(self, archive: &dyn Archive<B>) -> Option<B> {
        let Self {
            mut epoch,
            mut after,
            limit,
            last_epoch,
        } = self;
        loop {
            if let Some(block) = archive.read(epoch, after, limit, ANSWER_BYTES) {
                return Some(block);
            }
            // The archive has no more items of this epoch. Continue with the next epoch.
            epoch = archive
                .epoch_after(epoch)
                .filter(|next| *next <= last_epoch)?;
            after = 0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ring::Keep;
    use crate::testing::{frames, push};
    use crate::{FrameBlock, StreamState};

    /// An archive with ten frames of epoch 1 and five frames of epoch 3.
    struct Kept;

    impl Archive<FrameBlock> for Kept {
        fn read(&self, epoch: u64, after: u64, limit: u64, _bytes: usize) -> Option<FrameBlock> {
            let end = match epoch {
                1 => 10,
                3 => 5,
                _ => 0,
            };
            (after < end).then(|| frames(epoch, after, limit.min(end - after)))
        }

        fn epoch_after(&self, epoch: u64) -> Option<u64> {
            [1, 3].into_iter().find(|kept| *kept > epoch)
        }
    }

    fn found(
        ring: &Ring<FrameBlock>,
        after: u64,
        epoch: Option<u64>,
        recent: u64,
    ) -> Option<(u64, u64, u64)> {
        let lookup = Lookup::of(
            ring,
            &QueryRange {
                after,
                limit: 100,
                epoch,
            },
            recent,
        )?;
        let block = lookup.read(&Kept)?;
        Some((block.header.epoch, block.header.sequence, block.end()))
    }

    #[test]
    fn items_in_the_ring_are_not_read_from_the_archive() {
        let mut ring =
            Ring::new("source".into(), 3, Keep::last(100)).going_on(5, StreamState::Running);
        push(&mut ring, &frames(3, 5, 5)).unwrap();
        assert_eq!(found(&ring, 5, Some(3), 100), None);
        assert_eq!(found(&ring, 10, Some(3), 100), None);
        assert_eq!(
            found(&ring, 0, Some(4), 100),
            None,
            "an epoch that this source has not reached"
        );
    }

    #[test]
    fn items_missing_in_the_ring_are_read_from_the_archive_epoch_by_epoch() {
        let ring = Ring::new("source".into(), 3, Keep::last(100)).going_on(5, StreamState::Running);
        assert_eq!(found(&ring, 2, Some(3), 100), Some((3, 2, 5)));
        assert_eq!(found(&ring, 7, Some(1), 100), Some((1, 7, 10)));
        assert_eq!(
            found(&ring, 10, Some(1), 100),
            Some((3, 0, 5)),
            "epoch 1 is over"
        );
        assert_eq!(
            found(&ring, 4, Some(2), 100),
            Some((3, 0, 5)),
            "nothing of epoch 2"
        );
        let empty = Ring::new("source".into(), 9, Keep::last(100));
        assert_eq!(
            found(&empty, 5, Some(3), 100),
            None,
            "epoch 3 is over, the ring answers"
        );
    }

    #[test]
    fn reader_without_a_position_gets_the_most_recent_items() {
        let ring = Ring::new("source".into(), 3, Keep::last(100)).going_on(5, StreamState::Running);
        assert_eq!(found(&ring, 0, None, 100), Some((3, 0, 5)));
        assert_eq!(found(&ring, 0, None, 2), Some((3, 3, 5)));
        assert_eq!(found(&ring, 0, None, 0), None);
    }
}
