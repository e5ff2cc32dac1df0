//! Measures the share of recent frames without a sample, per channel.

use std::collections::{BTreeMap, VecDeque};

use spandrel_bus::{FrameBlock, Name};

/// Span of measurement time over which the share is computed, s.
const SPAN_S: f64 = 5.0;
/// Number of segments of this span.
const SEGMENTS: usize = 10;

/// The missing samples of the last 5 s of frames.
#[derive(Debug)]
pub(crate) struct MissingShare {
    channels: Vec<Name>,
    segment_frames: u64,
    /// Oldest first. The last one is incomplete.
    segments: VecDeque<Segment>,
}

/// Frames of one segment, and how many of them lack each channel.
#[derive(Debug)]
struct Segment {
    frames: u64,
    missing: Vec<u64>,
}

impl MissingShare {
    /// Creates the measurement for these channels in frame order.
    pub(crate) fn new(channels: Vec<Name>, sampling_rate_hz: f64) -> Self {
        Self {
            channels,
            segment_frames: ((SPAN_S * sampling_rate_hz / SEGMENTS as f64) as u64).max(1),
            segments: VecDeque::new(),
        }
    }

    /// Counts the frames of a block.
    pub(crate) fn take(&mut self, block: &FrameBlock) {
        for (_, values) in block.iter() {
            let is_full = |segment: &Segment| segment.frames >= self.segment_frames;
            if self.segments.back().is_none_or(is_full) {
                if self.segments.len() > SEGMENTS {
                    self.segments.pop_front();
                }
                self.segments.push_back(Segment {
                    frames: 0,
                    missing: vec![0; self.channels.len()],
                });
            }
            let Some(segment) = self.segments.back_mut() else {
                continue; // one was just added
            };
            segment.frames += 1;
            for (missing, value) in segment.missing.iter_mut().zip(values) {
                *missing += u64::from(value.is_nan());
            }
        }
    }

    /// Returns the shares, 0 to 1, of the channels that miss samples.
    pub(crate) fn shares(&self) -> BTreeMap<Name, f64> {
        let frames: u64 = self.segments.iter().map(|segment| segment.frames).sum();
        let share = |(index, channel): (usize, &Name)| {
            let of_channel = { self.segments.iter() }.filter_map(|one| one.missing.get(index));
            let missing: u64 = of_channel.sum();
            (missing > 0).then(|| (channel.clone(), missing as f64 / frames as f64))
        };
        self.channels.iter().enumerate().filter_map(share).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use spandrel_bus::{Header, StreamState};

    fn name(text: &str) -> Name {
        Name::new(text).unwrap()
    }

    /// Takes seconds of frames at 100 Hz in which every fourth sample of the roof is missing.
    fn take(shares: &mut MissingShare, seconds: usize, is_missing: bool) {
        for second in 0..seconds {
            let roof = |frame: usize| match is_missing && frame.is_multiple_of(4) {
                true => f64::NAN,
                false => 1.0,
            };
            shares.take(&FrameBlock {
                header: Header {
                    source: "ingest".into(),
                    epoch: 1,
                    sequence: 100 * second as u64,
                    time_ns: 0,
                },
                t0_ns: 0,
                sampling_rate_hz: 100.0,
                channels: 2,
                values: (0..100).flat_map(|frame| [0.0, roof(frame)]).collect(),
                state: StreamState::Running,
            });
        }
    }

    #[test]
    fn share_of_missing_samples_is_that_of_the_last_seconds() {
        let mut shares = MissingShare::new(vec![name("ground"), name("roof")], 100.0);
        assert_eq!(shares.shares(), BTreeMap::new());
        take(&mut shares, 20, false);
        take(&mut shares, 6, true);
        let found = shares.shares();
        assert_eq!(found.keys().collect::<Vec<_>>(), [&name("roof")]);
        assert!((found["roof"] - 0.25).abs() < 0.01, "{found:?}");
        take(&mut shares, 6, false);
        assert_eq!(shares.shares(), BTreeMap::new());
    }
}
