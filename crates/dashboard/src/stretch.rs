//! Selects the frames of a time range from the recording of ingest.
//!
//! [`Stretch`] is a pure state machine: it states the next query, and takes the reply. The
//! recording may have several epochs, each with its own numbers and times of frames. The first
//! query of an epoch is therefore for one frame. Its number and time give the numbers of the wanted
//! frames. Every query is for later frames than the one before, whatever the reply contains, so
//! that the queries end.

use spandrel_bus::{Answer, Block, FrameBlock, QueryRange};

/// Maximum number of samples of all channels in one stretch. An MCAP file of them takes seconds of
/// a core, and about 80 MB of memory while it is written.
pub(crate) const MOST_SAMPLES: usize = 1_000_000;
/// Number of frames per query. A reply contains fewer if they exceed its maximum size.
const FRAMES: u64 = 16_384;

/// The frames of a time range, as far as they have been read.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Stretch {
    from_ns: i64,
    to_ns: i64,
    channels: usize,
    next: Option<QueryRange>,
    /// Times of the frames (ns since the Unix epoch, UTC), in order.
    pub(crate) times_ns: Vec<i64>,
    /// Values by channel, in the order of the structure file. `NaN` if missing.
    pub(crate) columns: Vec<Vec<f64>>,
}

/// Reason why a stretch cannot be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Unreadable {
    /// Number of channels in the recording, which differs from that of the structure file.
    Channels(usize),
    /// More samples than the maximum.
    TooLong,
}

impl Stretch {
    /// Creates a stretch from one time to another (ns since the Unix epoch, UTC), both inclusive.
    pub(crate) fn new(from_ns: i64, to_ns: i64, channels: usize) -> Self {
        Self {
            from_ns,
            to_ns,
            channels,
            next: Some(first_frame(0)),
            times_ns: Vec::new(),
            columns: vec![Vec::new(); channels],
        }
    }

    /// Returns the next query, or `None` if all frames have been read.
    pub(crate) fn next(&self) -> Option<QueryRange> {
        self.next
    }

    /// Takes the reply to the last query.
    pub(crate) fn take(&mut self, answer: &Answer<FrameBlock>) -> Result<(), Unreadable> {
        let (Some(asked), Answer::Block(block)) = (self.next.take(), answer) else {
            return Ok(());
        };
        let epoch = block.header.epoch;
        let Some(grid) = block.grid().filter(|_| Some(epoch) >= asked.epoch) else {
            return Ok(()); // an earlier epoch than asked for: there are no further ones
        };
        if usize::from(block.channels) != self.channels {
            return Err(Unreadable::Channels(usize::from(block.channels)));
        }
        let first_ns = grid.time_ns(block.header.sequence);
        let wanted = u64::try_from(grid.nearest(self.from_ns)).unwrap_or(0);
        let is_repeated = Some(epoch) == asked.epoch && block.end() <= asked.after;
        let is_over = block.count() == 0 || is_repeated || first_ns > self.to_ns;
        self.next = match is_over {
            true => epoch.checked_add(1).map(first_frame),
            false => Some(QueryRange {
                after: block.end().max(wanted),
                limit: FRAMES,
                epoch: Some(epoch),
            }),
        };
        for (number, frame) in block.iter() {
            let time_ns = grid.time_ns(number);
            if (self.from_ns..=self.to_ns).contains(&time_ns) {
                self.push(time_ns, frame);
            }
        }
        match self.times_ns.len().saturating_mul(self.channels) > MOST_SAMPLES {
            true => Err(Unreadable::TooLong),
            false => Ok(()),
        }
    }

    /// Appends a frame. A later epoch that covers the same time again replaces the earlier frames,
    /// as on the page.
    fn push(&mut self, time_ns: i64, frame: &[f64]) {
        let kept = self.times_ns.partition_point(|earlier| *earlier < time_ns);
        self.times_ns.truncate(kept);
        self.times_ns.push(time_ns);
        for (column, value) in self.columns.iter_mut().zip(frame) {
            column.truncate(kept);
            column.push(*value);
        }
    }
}

/// Returns the query for the first frame of an epoch, or of the next one.
fn first_frame(epoch: u64) -> QueryRange {
    QueryRange {
        after: 0,
        limit: 1,
        epoch: Some(epoch),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use spandrel_bus::{CaughtUp, Header, Name, StreamState};

    const RATE_HZ: f64 = 100.0;
    const STEP_NS: i64 = 10_000_000;

    /// An epoch of a recording: its number, the time of its frame 0, and its number of frames.
    struct Epoch(u64, i64, u64);

    fn block(epoch: &Epoch, from: u64, to: u64) -> FrameBlock {
        let Epoch(number, t0_ns, _) = *epoch;
        let values = (from..to).flat_map(|frame| [frame as f64, number as f64]);
        FrameBlock {
            header: Header {
                source: Name::new("ingest").unwrap().to_string(),
                epoch: number,
                sequence: from,
                time_ns: t0_ns + from as i64 * STEP_NS,
            },
            t0_ns,
            sampling_rate_hz: RATE_HZ,
            channels: 2,
            values: values.collect(),
            state: StreamState::Running,
        }
    }

    /// Replies like ingest: with the items of an epoch, or else with the first ones of a later
    /// epoch, or with the oldest ones of the newest epoch.
    fn reply(recording: &[Epoch], asked: QueryRange) -> Answer<FrameBlock> {
        let at = |epoch: &Epoch, after: u64| {
            let to = epoch.2.min(after + asked.limit);
            (after < epoch.2).then(|| Answer::Block(block(epoch, after, to)))
        };
        let own = recording.iter().find(|one| Some(one.0) == asked.epoch);
        let later = recording.iter().find(|one| Some(one.0) > asked.epoch);
        let last = recording.last().unwrap();
        let newest = (asked.epoch > Some(last.0)).then_some(last);
        let found = own.and_then(|one| at(one, asked.after));
        let found = found.or_else(|| later.and_then(|one| at(one, 0)));
        let found = found.or_else(|| newest.and_then(|one| at(one, 0)));
        found.unwrap_or_else(|| {
            let header = block(last, last.2, last.2).header;
            let state = StreamState::Running;
            Answer::CaughtUp(CaughtUp { header, state })
        })
    }

    fn read(recording: &[Epoch], from_ns: i64, to_ns: i64) -> (Stretch, usize) {
        let mut stretch = Stretch::new(from_ns, to_ns, 2);
        let mut queries = 0;
        while let Some(asked) = stretch.next() {
            queries += 1;
            assert!(queries < 100, "the queries do not end");
            stretch.take(&reply(recording, asked)).unwrap();
        }
        (stretch, queries)
    }

    #[test]
    fn only_the_frames_of_the_range_are_read() {
        let recording = [Epoch(3, 1_000, 1_000_000_000)];
        let from_ns = 1_000 + 500_000_000 * STEP_NS;
        let (stretch, queries) = read(&recording, from_ns, from_ns + 2 * STEP_NS);
        let expected: Vec<f64> = (500_000_000..=500_000_002).map(f64::from).collect();
        assert_eq!(stretch.columns[0], expected);
        assert_eq!(stretch.times_ns[0], from_ns);
        assert!(queries <= 5, "{queries} queries");
    }

    #[test]
    fn later_epochs_follow_and_replace_frames_of_the_same_time() {
        // The second epoch begins before the end of the first one, and the third one later.
        let recording = [
            Epoch(1, 0, 100),
            Epoch(4, 50 * STEP_NS, 100),
            Epoch(6, 400 * STEP_NS, 20),
        ];
        let (stretch, _) = read(&recording, 0, i64::MAX);
        assert_eq!(stretch.times_ns.len(), 50 + 100 + 20);
        assert!(stretch.times_ns.is_sorted_by(|a, b| a < b));
        let epochs = &stretch.columns[1];
        assert_eq!((epochs[49], epochs[50], epochs[150]), (1.0, 4.0, 6.0));
    }

    // One faulty reply kept the only place for an export busy as long as the browser waited.
    #[test]
    fn repeated_reply_ends_the_queries() {
        for epoch in [7, u64::MAX] {
            let same = Answer::Block(block(&Epoch(epoch, 0, 10), 0, 1));
            let mut stretch = Stretch::new(0, i64::MAX, 2);
            let mut queries = 0;
            while stretch.next().is_some() {
                queries += 1;
                assert!(queries < 100, "the queries do not end");
                stretch.take(&same).unwrap();
            }
        }
    }

    #[test]
    fn range_outside_the_recording_is_empty() {
        let recording = [Epoch(1, 100 * STEP_NS, 100)];
        for (from, to) in [(0, 99), (200, 300)] {
            let (stretch, _) = read(&recording, from * STEP_NS, to * STEP_NS);
            assert_eq!(stretch.times_ns, Vec::<i64>::new());
        }
    }

    #[test]
    fn recording_with_other_channels_is_not_read() {
        let mut stretch = Stretch::new(0, i64::MAX, 3);
        let asked = stretch.next().unwrap();
        let taken = stretch.take(&reply(&[Epoch(1, 0, 10)], asked));
        assert_eq!(taken, Err(Unreadable::Channels(2)));
    }
}
