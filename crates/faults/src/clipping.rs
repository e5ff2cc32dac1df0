//! Peaks that are cut off at the end of the range of a sensor.
//!
//! Peaks of a motion differ in height and are round. Peaks of a clipped channel have one height,
//! are flat, and have steep flanks.

use crate::channel::Fault;
use crate::finding::Evidence;
use serde::{Deserialize, Serialize};

/// Least number of equal samples of a flat peak.
const FLAT: u32 = 3;

/// Least number of flat peaks at one value.
const PEAKS: u32 = 2;

/// Difference of equal samples, as a share of the span. Interpolation rounds.
const EQUAL: f64 = 1e-6;

/// Least span of the values, in steps of the recorder. The peaks of a smaller motion are flat as
/// well.
const SPAN: f64 = 64.0;

/// Least height of the flank of a flat peak, in steps of the recorder. A slow motion arrives at its
/// flat peaks by one step.
const FLANK: f64 = 8.0;

/// The extremes of a channel since the last window.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Extremes {
    last: Option<f64>,
    /// Number of equal samples at the end.
    equal: u32,
    /// Change before the first of them.
    flank: f64,
    low: Extreme,
    high: Extreme,
    /// Smallest change, the step of the recorder.
    step: Option<f64>,
    /// Smallest and largest sample.
    span: Option<(f64, f64)>,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
struct Extreme {
    value: f64,
    peaks: u32,
}

impl Extremes {
    /// Takes a sample. NaN ends a flat peak.
    pub(crate) fn take(&mut self, value: f64) {
        if !value.is_finite() {
            (self.last, self.equal) = (None, 0);
            return;
        }
        let (low, high) = self.span.unwrap_or((value, value));
        self.span = Some((low.min(value), high.max(value)));
        let Some(last) = self.last.replace(value) else {
            (self.equal, self.flank) = (1, 0.0);
            return;
        };
        let change = (value - last).abs();
        let tolerance = EQUAL * (high - low);
        if change <= tolerance {
            self.equal += 1;
            return;
        }
        self.step = Some(self.step.map_or(change, |step| step.min(change)));
        if self.equal >= FLAT {
            let flank = self.flank.max(change);
            self.low
                .take(last, last < self.low.value, flank, tolerance, self.step);
            self.high
                .take(last, last > self.high.value, flank, tolerance, self.step);
        }
        (self.equal, self.flank) = (1, change);
    }

    /// Closes the window, and returns what it shows.
    pub(crate) fn close(&mut self) -> Evidence {
        let (span, step) = (self.span.take(), self.step.take());
        let extremes = [
            std::mem::take(&mut self.low),
            std::mem::take(&mut self.high),
        ];
        let (Some((low, high)), Some(step)) = (span, step) else {
            return Evidence::Open;
        };
        if high - low < SPAN * step {
            return Evidence::Open;
        }
        let tolerance = EQUAL * (high - low);
        let is_cut = |(extreme, end): &(Extreme, f64)| {
            extreme.peaks >= PEAKS && (extreme.value - end).abs() <= tolerance
        };
        let cut = extremes.into_iter().zip([low, high]).find(is_cut);
        cut.map_or(Evidence::Sound, |(extreme, _)| {
            Evidence::Fault(Fault::Clipped(extreme.value))
        })
    }
}

impl Extreme {
    /// Counts a flat peak. A peak that `exceeds` the former ones starts the count again.
    fn take(&mut self, value: f64, exceeds: bool, flank: f64, tolerance: f64, step: Option<f64>) {
        if flank < FLANK * step.unwrap_or(0.0) {
            return;
        }
        if self.peaks > 0 && (value - self.value).abs() <= tolerance {
            self.peaks += 1;
        } else if self.peaks == 0 || exceeds {
            *self = Self { value, peaks: 1 };
        }
    }
}
