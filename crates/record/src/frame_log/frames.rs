//! Frames as stored in the log, and the layout of a log.

use crate::RecordError;

/// The layout of a log. Every segment states it, and all segments in a folder have the same layout.
#[derive(Debug, Clone, PartialEq)]
pub struct LogLayout {
    /// Name of the structure.
    pub structure: String,
    /// Names of the channels, in frame order.
    pub channels: Vec<String>,
    /// Names of the sensor nodes, in the order of the node positions.
    pub nodes: Vec<String>,
    /// Sampling rate of the frames, in Hz.
    pub sampling_rate_hz: f64,
}

/// The position in the stream of a sensor node.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NodePosition {
    /// Epoch of the node.
    pub epoch: u64,
    /// Sequence number of the next sample.
    pub sequence: u64,
    /// Whether the node has ended its stream.
    pub ended: bool,
}

/// Consecutive frames of one epoch.
///
/// Frame j of the block has sequence number `sequence + j`. Frame k of the epoch was measured at
/// `t0_ns + round(k·10⁹/rate)`. A block without frames only marks the end of the epoch.
#[derive(Debug, Clone, PartialEq)]
pub struct LoggedFrames {
    /// Id of the source of the frames, at most 65535 bytes.
    pub source: String,
    /// Epoch of the frames.
    pub epoch: u64,
    /// Sequence number of the first frame, or of the next frame if the block is empty.
    pub sequence: u64,
    /// Time of frame 0 of the epoch, in ns since 1970, UTC. It may be negative.
    pub t0_ns: i64,
    /// Sampling rate of the frames, in Hz.
    pub sampling_rate_hz: f64,
    /// Number of values per frame.
    pub channels: u16,
    /// Values frame by frame, `NaN` if missing. Values read back are bit-identical, including
    /// `NaN`.
    pub values: Vec<f64>,
    /// Whether the epoch ends with these frames.
    pub ended: bool,
    /// Position in the stream of each node after these frames, in layout order; may be empty.
    pub nodes: Vec<NodePosition>,
}

/// The frames of one epoch in a log.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LogSpan {
    /// The epoch.
    pub epoch: u64,
    /// Sequence number of the first frame in the log.
    pub from: u64,
    /// Sequence number after the last frame in the log.
    pub to: u64,
    /// Number of missing frames in between.
    pub missing: u64,
}

impl LoggedFrames {
    /// Returns the number of frames.
    pub fn count(&self) -> u64 {
        (self.values.len() / usize::from(self.channels).max(1)) as u64
    }

    /// Returns the sequence number after the last frame.
    pub fn end(&self) -> u64 {
        self.sequence.saturating_add(self.count())
    }

    /// Returns the time of the first frame, in ns since 1970, UTC.
    pub fn time_ns(&self) -> i64 {
        self.time_of(self.sequence)
    }

    /// Returns the time of the last frame, or of the next frame if the block is empty, in ns since
    /// 1970, UTC.
    pub(crate) fn last_time_ns(&self) -> i64 {
        self.time_of(self.sequence.saturating_add(self.count().saturating_sub(1)))
    }

    fn time_of(&self, number: u64) -> i64 {
        frame_time_ns(self.t0_ns, self.sampling_rate_hz, number)
    }

    /// Drops the frames before `number`. The node positions remain, because they refer to the end
    /// of the block.
    pub(super) fn skip_to(&mut self, number: u64) {
        let skipped = number.saturating_sub(self.sequence).min(self.count());
        self.values
            .drain(..skipped as usize * usize::from(self.channels));
        self.sequence += skipped;
    }

    /// Keeps only the first `frames` frames. Drops the end mark and the node positions, which
    /// belong to the last frame.
    pub(super) fn truncate(&mut self, frames: u64) {
        if frames < self.count() {
            self.values
                .truncate(frames as usize * usize::from(self.channels));
            self.ended = false;
            self.nodes.clear();
        }
    }

    /// Appends the frames of `next`, or returns `next` as an error if it does not continue these
    /// frames.
    pub(super) fn join(&mut self, next: Self) -> Result<(), Self> {
        let follows = !self.ended
            && self.source == next.source
            && (self.epoch, self.end()) == (next.epoch, next.sequence)
            && (self.t0_ns, self.channels) == (next.t0_ns, next.channels)
            && self.sampling_rate_hz == next.sampling_rate_hz;
        if !follows {
            return Err(next);
        }
        self.values.extend_from_slice(&next.values);
        self.ended = next.ended;
        self.nodes = next.nodes;
        Ok(())
    }

    /// Checks that the log can store and return these frames unchanged.
    pub(super) fn check(&self, layout: &LogLayout) -> Result<(), RecordError> {
        let refused = |what: &'static str, found: String, allowed: String| {
            Err(RecordError::NotLoggable {
                structure: layout.structure.clone(),
                what,
                found,
                allowed,
            })
        };
        let channels = usize::from(self.channels);
        if channels != layout.channels.len() {
            return refused(
                "number of channels",
                channels.to_string(),
                layout.channels.len().to_string(),
            );
        }
        if !self.values.len().is_multiple_of(channels.max(1)) {
            return refused(
                "number of values",
                self.values.len().to_string(),
                format!("a multiple of {channels}"),
            );
        }
        if !self.nodes.is_empty() && self.nodes.len() != layout.nodes.len() {
            return refused(
                "number of nodes",
                self.nodes.len().to_string(),
                format!("0 or {}", layout.nodes.len()),
            );
        }
        if self.source.len() > usize::from(u16::MAX) {
            return refused(
                "length of the source",
                self.source.len().to_string(),
                format!("at most {}", u16::MAX),
            );
        }
        if u32::try_from(self.count()).is_err() {
            return refused(
                "number of frames",
                self.count().to_string(),
                format!("at most {}", u32::MAX),
            );
        }
        if !(self.sampling_rate_hz.is_finite() && self.sampling_rate_hz > 0.0) {
            let found = format!("{} Hz", self.sampling_rate_hz);
            return refused("sampling rate", found, "positive and finite".to_owned());
        }
        match self.sequence.checked_add(self.count()) {
            Some(_) => Ok(()),
            None => refused(
                "number of the first frame",
                self.sequence.to_string(),
                "below 2^64".to_owned(),
            ),
        }
    }
}

/// Returns the time of frame `number`, in ns: t0 + round(number·10⁹/rate), saturating.
///
/// The calculation uses integers if the rate is a whole number of microhertz, as all rates in use
/// are. In floating point, the product of a large frame number would be inexact.
pub(crate) fn frame_time_ns(t0_ns: i64, rate_hz: f64, number: u64) -> i64 {
    /// 10⁹ ns/s times 10⁶ µHz/Hz.
    const NANOSECONDS_MICROHERTZ: i128 = 1_000_000_000_000_000;
    let microhertz = (rate_hz * 1e6).round();
    let is_whole = (1.0..=1e18).contains(&microhertz) && microhertz / 1e6 == rate_hz;
    let offset_ns = match is_whole {
        true => {
            let rate = microhertz as i128;
            let steps = i128::from(number) * NANOSECONDS_MICROHERTZ;
            i64::try_from((steps + rate / 2) / rate).unwrap_or(i64::MAX)
        }
        false => (number as f64 * 1e9 / rate_hz).round() as i64,
    };
    t0_ns.saturating_add(offset_ns)
}
