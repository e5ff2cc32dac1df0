//! Finds single frames that cause the identification to panic, and excludes them.

use crate::identification::IdentificationInput;
use crate::set_aside::Span;
use spandrel_bus::Block;
use spandrel_checkpoint::Position;
use std::collections::{BTreeSet, VecDeque};
use std::time::Duration;
use tokio::time::Instant;

/// Maximum number of panics within [`DEATHS_WITHIN`]. Beyond it, single frames are not the cause.
const MOST_DEATHS: usize = 100;
/// Time span in which panics are counted.
const DEATHS_WITHIN: Duration = Duration::from_secs(3600);

/// The known frames that cause panics.
///
/// The first panic identifies the block that contains the frame. In the second pass, each frame of
/// the block is processed alone, so a second panic identifies the frame. From then on the frame
/// counts as missing.
#[derive(Debug, Default)]
pub(crate) struct Trouble {
    /// A block that caused a panic.
    suspect: Option<Span>,
    /// Position of each excluded frame.
    set_aside: BTreeSet<Position>,
    deaths: u64,
    /// Panics within [`DEATHS_WITHIN`], oldest first.
    recent: VecDeque<Instant>,
}

impl Trouble {
    /// Cuts an input into successive parts: suspect frames alone, and excluded frames as gaps.
    pub(crate) fn cut(&self, input: IdentificationInput) -> Vec<IdentificationInput> {
        let IdentificationInput::Frames(mut rest) = input else {
            return vec![input];
        };
        let (epoch, first, end) = (rest.header.epoch, rest.header.sequence, rest.end());
        let position = |sequence| Position { epoch, sequence };
        let mut alone: BTreeSet<u64> = self
            .set_aside
            .range(position(first)..position(end))
            .map(|excluded| excluded.sequence)
            .collect();
        if let Some(suspect) = self.suspect.filter(|suspect| suspect.epoch == epoch) {
            alone.extend(suspect.from.max(first)..suspect.to.min(end));
        }
        let mut parts = Vec::with_capacity(2 * alone.len() + 1);
        for frame in alone {
            let before = frame - rest.header.sequence;
            let mut part = rest.clone();
            part.truncate(before);
            if before > 0 {
                parts.push(IdentificationInput::Frames(part));
            }
            rest.skip(before);
            let mut single = rest.clone();
            single.truncate(1);
            rest.skip(1);
            parts.push(match self.set_aside.contains(&position(frame)) {
                true => IdentificationInput::gap(frame, frame + 1),
                false => IdentificationInput::Frames(single),
            });
        }
        // An end mark belongs to the last part, even if that part has no frames.
        if rest.count() > 0 || parts.is_empty() || rest.state == spandrel_bus::StreamState::Ended {
            parts.push(IdentificationInput::Frames(rest));
        }
        parts
    }

    /// Records a panic in these frames. Returns the frame to exclude from now on, if it is known.
    pub(crate) fn died(&mut self, now: Instant, frames: Span) -> Option<u64> {
        let Span { epoch, from, to } = frames;
        self.deaths += 1;
        self.recent.push_back(now);
        while self
            .recent
            .front()
            .is_some_and(|earlier| now.duration_since(*earlier) > DEATHS_WITHIN)
        {
            self.recent.pop_front();
        }
        if to.saturating_sub(from) > 1 {
            self.suspect = Some(frames);
            return None;
        }
        self.set_aside.insert(Position {
            epoch,
            sequence: from,
        });
        Some(from)
    }

    /// Returns the number of panics.
    pub(crate) fn deaths(&self) -> u64 {
        self.deaths
    }

    /// Returns `true` if there were too many recent panics to continue.
    pub(crate) fn is_hopeless(&self) -> bool {
        self.recent.len() > MOST_DEATHS
    }

    /// Returns the number of excluded frames.
    pub(crate) fn set_aside(&self) -> u64 {
        self.set_aside.len() as u64
    }
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
            channels: 1,
            values: (first..first + count).map(|frame| frame as f64).collect(),
            state: StreamState::Running,
        }
    }

    fn span(from: u64, to: u64) -> Span {
        Span { epoch: 7, from, to }
    }

    /// Returns first and end of each part. Gaps are negative.
    fn parts(trouble: &Trouble, input: FrameBlock) -> Vec<(i64, i64)> {
        let span = |part: IdentificationInput| match part {
            IdentificationInput::Frames(block) => {
                (block.header.sequence as i64, block.end() as i64)
            }
            IdentificationInput::Gap { from, to, .. } => (-(from as i64), -(to as i64)),
        };
        trouble
            .cut(IdentificationInput::Frames(input))
            .into_iter()
            .map(span)
            .collect()
    }

    #[test]
    fn frame_that_causes_two_panics_is_found_and_set_aside() {
        let mut trouble = Trouble::default();
        assert_eq!(parts(&trouble, block(0, 9)), [(0, 9)]);
        assert_eq!(trouble.died(Instant::now(), span(3, 6)), None);
        assert_eq!(
            parts(&trouble, block(0, 9)),
            [(0, 3), (3, 4), (4, 5), (5, 6), (6, 9)]
        );
        assert_eq!(trouble.died(Instant::now(), span(4, 5)), Some(4));
        assert_eq!(
            parts(&trouble, block(0, 9)),
            [(0, 3), (3, 4), (-4, -5), (5, 6), (6, 9)]
        );
        assert_eq!((trouble.deaths(), trouble.set_aside()), (2, 1));
        assert_eq!(parts(&trouble, block(9, 3)), [(9, 12)]);
        let other_epoch = FrameBlock {
            header: Header {
                epoch: 8,
                ..block(0, 9).header
            },
            ..block(0, 9)
        };
        assert_eq!(parts(&trouble, other_epoch), [(0, 9)]);
    }

    #[test]
    fn panics_longer_ago_than_the_limit_do_not_count() {
        let (mut trouble, mut now) = (Trouble::default(), Instant::now());
        for frame in 0..3 * MOST_DEATHS as u64 {
            now += DEATHS_WITHIN / (MOST_DEATHS as u32 - 1);
            trouble.died(now, span(frame, frame + 1));
            assert!(!trouble.is_hopeless(), "death {frame}");
        }
        trouble.died(now, span(1000, 1001));
        assert!(trouble.is_hopeless(), "one more than may be within an hour");
        assert_eq!(trouble.deaths(), 3 * MOST_DEATHS as u64 + 1);
    }

    #[test]
    fn block_of_one_frame_is_set_aside_at_once_and_its_end_is_kept() {
        let mut trouble = Trouble::default();
        assert_eq!(trouble.died(Instant::now(), span(8, 9)), Some(8));
        let last = FrameBlock {
            state: StreamState::Ended,
            ..block(8, 1)
        };
        assert_eq!(parts(&trouble, last), [(-8, -9), (9, 9)]);
    }
}
