//! The sampling instants of a node, and the values of its samples at the times of the frames.
//!
//! Nodes sample at the same rate, but rarely at the same instants. The phase of a sample is its
//! time minus the time that its number alone would give. The mean phase over the latest
//! [`WINDOW`] samples determines when the node samples, even if the time stamps of its blocks
//! jitter. Phases far from the median do not count.
//! The value at the time of a frame is interpolated from the neighbouring samples (Lagrange), so
//! that all values of a frame belong to one instant.
//!
//! The mean extends over a fixed number of samples instead of decaying, so that a restart that
//! reads the latest samples again computes the same bits.

use std::collections::VecDeque;

use spandrel_bus::{NodeClock, TimeGrid};
use spandrel_checkpoint::Position;

/// Number of earlier samples that determine the mean phase. A restart reads as many samples again.
pub(crate) const WINDOW: u64 = 128;

/// Number of samples on each side of a frame that determine its value. With 4, the error is 0.01 %
/// at an eighth of the sampling rate and 2 % at a quarter, half a step between two samples.
pub(crate) const HALF_STENCIL: usize = 4;

/// Largest distance between sample and frame that is ignored, in steps of the node. The phase
/// error is 4° at the Nyquist frequency.
const NEGLIGIBLE_STEPS: f64 = 0.01;

/// Largest distance between sample and frame that is interpolated, in steps of the node. A sample
/// is nearer unless the time stamps jitter.
const LARGEST_STEPS: f64 = 1.0;

/// A sample: its position in the stream of its node, and its time stamp.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Stamp {
    pub(crate) position: Position,
    pub(crate) time_ns: i64,
}

/// The latest samples of a node.
#[derive(Debug)]
pub(crate) struct SamplingInstants {
    channels: usize,
    rate_hz: f64,
    /// Times of the sample numbers, counted from 0.
    grid: Option<TimeGrid>,
    /// Position and phase of the latest samples that are evenly spaced, oldest first.
    past: VecDeque<(Position, i64)>,
    /// Largest deviation from the usual phase of a sample that counts for the mean.
    tolerance_ns: i64,
    /// Values of the latest [`HALF_STENCIL`] samples of `past`, oldest first.
    values: VecDeque<f64>,
    offset_ns: i64,
}

impl SamplingInstants {
    /// Samples that deviate by more than `tolerance_ns` from the median phase do not count.
    pub(crate) fn new(channels: usize, tolerance_ns: i64) -> Self {
        Self {
            channels,
            rate_hz: 0.0,
            grid: None,
            past: VecDeque::new(),
            tolerance_ns,
            values: VecDeque::new(),
            offset_ns: 0,
        }
    }

    /// Sets the sampling rate of the node.
    pub(crate) fn set_rate(&mut self, rate_hz: f64) {
        if self.rate_hz != rate_hz {
            self.rate_hz = rate_hz;
            self.grid = TimeGrid::new(0, rate_hz);
            self.forget();
        }
    }

    /// Adds a sample that has been used or dropped. Samples come in order.
    pub(crate) fn pass(&mut self, stamp: Stamp, values: impl Iterator<Item = f64>) {
        self.reach(stamp);
        let phase_ns = self.phase_ns(stamp);
        self.past.push_back((stamp.position, phase_ns));
        self.values.extend(values);
        let excess = self
            .values
            .len()
            .saturating_sub(HALF_STENCIL * self.channels);
        self.values.drain(..excess);
    }

    /// Returns the distance from a frame to the next sample, in steps of the node: positive if the
    /// sample is later. Returns `None` if the sample may stand for the value at the frame.
    pub(crate) fn steps_from(&mut self, frame_ns: i64, stamp: Stamp) -> Option<f64> {
        self.reach(stamp);
        let phase_ns = self.phase_ns(stamp);
        let mean_ns = self.mean_phase_ns(phase_ns);
        // Equal to the mean phase plus the time of the number.
        let instant_ns = stamp
            .time_ns
            .saturating_add(mean_ns.saturating_sub(phase_ns));
        self.offset_ns = instant_ns.saturating_sub(frame_ns);
        let steps = self.offset_ns as f64 * self.rate_hz / 1e9;
        let is_off = steps.abs() > NEGLIGIBLE_STEPS && steps.abs() <= LARGEST_STEPS;
        is_off.then_some(steps)
    }

    /// Replaces the values of the sample `first` by those at the frame `steps` earlier.
    ///
    /// `next` yields the samples after it. `waiting` contains the values of `first` and of these
    /// samples, sample by sample. A value stays as it is if a neighbour is missing.
    pub(crate) fn interpolate(
        &self,
        steps: f64,
        first: Stamp,
        next: impl Iterator<Item = Stamp>,
        waiting: &VecDeque<f64>,
        values: &mut [f64],
    ) {
        let before = self.contiguous_before(first);
        let mut last = first;
        let contiguous = |stamp: &Stamp| {
            let follows = self.follows(last, *stamp);
            last = *stamp;
            follows
        };
        let after = next.take(HALF_STENCIL).take_while(contiguous).count();
        let at = -steps;
        let kept = self.values.len() / self.channels;
        for (channel, value) in values.iter_mut().enumerate() {
            let sample = |offset: isize| match usize::try_from(offset) {
                Ok(offset) => waiting[offset * self.channels + channel],
                Err(_) => self.values[(kept - offset.unsigned_abs()) * self.channels + channel],
            };
            let complete =
                (1..=HALF_STENCIL)
                    .rev()
                    .map(|half| stencil(half, at))
                    .find(|(low, high)| {
                        before >= low.unsigned_abs()
                            && after >= high.unsigned_abs()
                            && (*low..=*high).all(|offset| sample(offset).is_finite())
                    });
            if let Some((low, high)) = complete {
                *value = lagrange(low, high, at, sample);
            }
        }
    }

    /// Returns the number of samples that must follow the first one before its frame can close.
    pub(crate) fn required_after(steps: f64) -> usize {
        stencil(HALF_STENCIL, -steps).1.unsigned_abs()
    }

    /// Returns when the node samples, or `None` if it samples at the times of the frames.
    pub(crate) fn clock(&self) -> Option<NodeClock> {
        let phases = || self.past.iter().map(|(_, phase_ns)| *phase_ns);
        let spread = phases().max().zip(phases().min());
        let jitter_ns = spread.map_or(0, |(max, min)| max - min);
        let is_off = |ns: i64| (ns as f64 * self.rate_hz / 1e9).abs() > NEGLIGIBLE_STEPS;
        (is_off(self.offset_ns) || is_off(jitter_ns)).then_some(NodeClock {
            offset_s: self.offset_ns as f64 / 1e9,
            jitter_s: jitter_ns as f64 / 1e9,
            difference_s: None,
            quality_percent: None,
        })
    }

    /// Removes the samples that do not count for the mean at this sample.
    fn reach(&mut self, stamp: Stamp) {
        let Some((last, phase_ns)) = self.past.back().copied() else {
            return;
        };
        let Position { epoch, sequence } = stamp.position;
        let jump_ns = self.phase_ns(stamp).abs_diff(phase_ns);
        if last.epoch != epoch || last.sequence >= sequence || jump_ns as f64 * self.rate_hz > 0.5e9
        {
            self.forget();
        }
        let is_old = |(old, _): &(Position, i64)| old.sequence.saturating_add(WINDOW) < sequence;
        while self.past.pop_front_if(|past| is_old(past)).is_some() {}
        let kept = self.past.len() * self.channels;
        let excess = self.values.len().saturating_sub(kept);
        self.values.drain(..excess);
    }

    fn forget(&mut self) {
        self.past.clear();
        self.values.clear();
    }

    /// Returns the mean of the past phases and the present one, ns. A few wrong time stamps, such
    /// as those of dropped samples, have no effect: they are far from the median.
    fn mean_phase_ns(&self, present_ns: i64) -> i64 {
        let phases = || self.past.iter().map(|(_, ns)| *ns).chain([present_ns]);
        let (low, high) = phases().fold((present_ns, present_ns), |(low, high), ns| {
            (low.min(ns), high.max(ns))
        });
        let mut usual = low..=high;
        if high.saturating_sub(low) > self.tolerance_ns {
            let mut sorted: Vec<i64> = phases().collect();
            let middle = sorted.len() / 2;
            let (_, median, _) = sorted.select_nth_unstable(middle);
            usual =
                median.saturating_sub(self.tolerance_ns)..=median.saturating_add(self.tolerance_ns);
        }
        let counted = phases().filter(|ns| usual.contains(ns));
        let (sum, count) =
            counted.fold((0, 0), |(sum, count), ns| (sum + i128::from(ns), count + 1));
        // The median always counts.
        i64::try_from(sum.div_euclid(count)).unwrap_or(present_ns)
    }

    fn phase_ns(&self, stamp: Stamp) -> i64 {
        let counted_ns = self
            .grid
            .map_or(0, |grid| grid.time_ns(stamp.position.sequence));
        stamp.time_ns.saturating_sub(counted_ns)
    }

    /// Returns `true` if `next` is the sample after `last`, and no time is missing between them.
    fn follows(&self, last: Stamp, next: Stamp) -> bool {
        let jump_ns = self.phase_ns(last).abs_diff(self.phase_ns(next));
        let after = Position {
            sequence: last.position.sequence + 1,
            ..last.position
        };
        next.position == after && jump_ns as f64 * self.rate_hz <= 0.5e9
    }

    /// Returns how many of the kept samples directly precede a sample.
    fn contiguous_before(&self, first: Stamp) -> usize {
        let Position { epoch, sequence } = first.position;
        let kept = self.values.len() / self.channels;
        let newest_first = self.past.iter().rev().take(kept);
        let expected = (1..).map(|back| Position {
            epoch,
            sequence: sequence.wrapping_sub(back),
        });
        newest_first
            .zip(expected)
            .take_while(|((position, _), expected)| position == expected)
            .count()
    }
}

/// Returns the first and last sample of a stencil around a place, relative to the sample at 0.
fn stencil(half: usize, at: f64) -> (isize, isize) {
    let half = half as isize;
    match at < 0.0 {
        true => (-half, half - 1),
        false => (1 - half, half),
    }
}

/// Returns the value at `at` of the polynomial through the samples `low` to `high`.
fn lagrange(low: isize, high: isize, at: f64, sample: impl Fn(isize) -> f64) -> f64 {
    let weight = |place: isize| -> f64 {
        let others = (low..=high).filter(|other| *other != place);
        others
            .map(|other| (at - other as f64) / (place - other) as f64)
            .product()
    };
    (low..=high)
        .map(|place| weight(place) * sample(place))
        .sum()
}
