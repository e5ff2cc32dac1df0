//! Frames as they are in the log, and what a log is of.

use crate::RecordError;

/// What a log is of: it is stated in every segment, and a folder holds segments of one layout.
#[derive(Debug, Clone, PartialEq)]
pub struct LogLayout {
    /// Name of the structure.
    pub structure: String,
    /// Names of the channels of a frame, in order.
    pub channels: Vec<String>,
    /// Names of the sensor nodes, in the order of the positions.
    pub nodes: Vec<String>,
    /// Frames per second, in Hz.
    pub sampling_rate_hz: f64,
}

/// How far the stream of a sensor node was used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NodePosition {
    /// Epoch of the node.
    pub epoch: u64,
    /// Number of the next sample.
    pub sequence: u64,
    /// Whether the node has said that there is none.
    pub ended: bool,
}

/// Consecutive frames of one epoch.
///
/// Frame j has number `sequence + j`; frame k was measured at `t0_ns + round(k·10⁹/rate)`. Without frames it says only that the
/// epoch has ended.
#[derive(Debug, Clone, PartialEq)]
pub struct LoggedFrames {
    /// Id of who made the frames, at most 65535 bytes.
    pub source: String,
    /// Epoch of the frames.
    pub epoch: u64,
    /// Number of the first frame here, or of the frame that would follow.
    pub sequence: u64,
    /// Time of frame 0 of the epoch, in ns since 1970, UTC; may be negative.
    pub t0_ns: i64,
    /// Frames per second, in Hz.
    pub sampling_rate_hz: f64,
    /// Values of a frame.
    pub channels: u16,
    /// Frame after frame, `NaN` where a sample is missing; the bits are kept, those of a `NaN` too.
    pub values: Vec<f64>,
    /// Whether the epoch ends with these frames.
    pub ended: bool,
    /// Where the stream of each node stands after these frames, in the order of the layout; may be empty.
    pub nodes: Vec<NodePosition>,
}

/// Frames of one epoch that a log holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LogSpan {
    /// The epoch.
    pub epoch: u64,
    /// Number of the first frame kept.
    pub from: u64,
    /// One past the number of the last frame kept.
    pub to: u64,
    /// How many frames between are not there.
    pub missing: u64,
}

impl LoggedFrames {
    /// Number of frames.
    pub fn count(&self) -> u64 {
        (self.values.len() / usize::from(self.channels).max(1)) as u64
    }

    /// Number of the frame after the last one.
    pub fn end(&self) -> u64 {
        self.sequence.saturating_add(self.count())
    }

    /// Time of the first frame, in ns since 1970, UTC.
    pub fn time_ns(&self) -> i64 {
        self.time_of(self.sequence)
    }

    /// Time of the last frame, or of the first one that would follow, in ns since 1970, UTC.
    pub(crate) fn last_time_ns(&self) -> i64 {
        self.time_of(self.sequence.saturating_add(self.count().saturating_sub(1)))
    }

    fn time_of(&self, number: u64) -> i64 {
        frame_time_ns(self.t0_ns, self.sampling_rate_hz, number)
    }

    /// Drops the frames before this number; node positions stay, as they are those after the last frame.
    pub(super) fn skip_to(&mut self, number: u64) {
        let skipped = number.saturating_sub(self.sequence).min(self.count());
        self.values
            .drain(..skipped as usize * usize::from(self.channels));
        self.sequence += skipped;
    }

    /// Drops all but the first frames; the end of the epoch and the positions of the nodes go with those after.
    pub(super) fn truncate(&mut self, frames: u64) {
        if frames < self.count() {
            self.values
                .truncate(frames as usize * usize::from(self.channels));
            self.ended = false;
            self.nodes.clear();
        }
    }

    /// Appends the frames that follow; gives them back if they do not continue these.
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

    /// Checks what the log could not give back as it was.
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

/// Time of frame `number`, in ns: t0 + round(number·10⁹/rate), saturating.
///
/// In integers where the rate has whole microhertz, as all rates in use have: the product of a large number is not exact
/// otherwise.
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
