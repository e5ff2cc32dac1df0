//! Offsets that grow or are too large: a drifting channel.
//!
//! The mean of a channel over some periods of the fundamental follows the common motion. What
//! differs from the median of all channels is the offset of the channel, which is constant for a
//! sound one. Its changes from one mean to the next are scatter. An offset that moves much further
//! than this scatter drifts. So does one that is many times the stated noise.

use crate::channel::Fault;
use crate::finding::Evidence;
use serde::{Deserialize, Serialize};

/// Half-life with which the reference follows the offset (s), longer than the strong part of an
/// earthquake.
///
/// A sensor that warms by 40 mm/s² per hour stays within 2 mm/s² of its reference.
const REFERENCE_HALF_LIFE_S: f64 = 120.0;

/// Offset from which a channel is faulty, in standard deviations of the stated noise.
///
/// The filter attributes an offset to noise. Example: a building of five storeys that loses 15 %,
/// with an offset in one of six channels. With an offset of 10 standard deviations, the loss is
/// raised within 11 s. With 20, it is not raised at all.
const LARGE: f64 = 10.0;

/// Number of means in a row that must change little, before a large offset is a fault. Strong
/// motion changes the means, and a step scatters them once.
const STEADY: u32 = 4;

/// Half-life of the scatter in means, six windows as for the long memory.
const SCATTER_HALF_LIFE: f64 = 24.0;

/// Distance from the reference, in standard deviations of the scatter, from which a channel
/// drifts.
///
/// 24 sound records of two structures reach 11.4, at the start of the strongest earthquake. A
/// steady drift causes its own scatter, and reaches 18 after 13 means.
const DRIFTS: f64 = 18.0;

/// Distance below which a drifting channel counts as sound again.
const RETURNED: f64 = 9.0;

/// Number of changes before the first statement.
const FIRST: u32 = 8;

/// Minimum number of channels. With two channels, it is not known which of them drifts.
const LEAST_CHANNELS: usize = 3;

/// The offset of each channel of a group.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Offsets {
    of_channels: Vec<Offset>,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
struct Offset {
    /// Sums of the weighted samples and of their weights.
    sum: (f64, f64),
    reference: Option<f64>,
    last: f64,
    /// Decayed sums of the squared changes and of their weights.
    scatter: (f64, f64),
    changes: u32,
    /// Number of means in a row that changed by less than their own 18th part.
    steady: u32,
}

impl Offsets {
    pub(crate) fn new(channels: usize) -> Self {
        Self {
            of_channels: vec![Offset::default(); channels],
        }
    }

    /// Takes the values of one frame (m/s²), NaN for missing ones, with its weight in the mean.
    ///
    /// A Hann window keeps the resonance out of the mean.
    pub(crate) fn take(&mut self, values: impl Iterator<Item = f64>, weight: f64) {
        for (offset, value) in self.of_channels.iter_mut().zip(values) {
            if value.is_finite() {
                offset.sum.0 += weight * value;
                offset.sum.1 += weight;
            }
        }
    }

    /// Completes the present means, `step_s` after the former ones. Returns their evidence for each
    /// channel.
    ///
    /// - `rigid`: acceleration of each channel for a slow ground acceleration of 1
    /// - `noise_std`: stated noise of each channel (m/s²); a smaller offset has no effect
    pub(crate) fn close(&mut self, step_s: f64, rigid: &[f64], noise_std: &[f64]) -> Vec<Evidence> {
        let mean = |offset: &Offset| (offset.sum.1 > 0.0).then(|| offset.sum.0 / offset.sum.1);
        let means: Vec<Option<f64>> = self.of_channels.iter().map(mean).collect();
        let scaled = means.iter().zip(rigid);
        let mut motions: Vec<f64> = scaled
            .filter_map(|(mean, rigid)| Some((*mean)? / rigid))
            .collect();
        motions.sort_by(f64::total_cmp);
        let count = motions.len();
        let of_channel = |(channel, offset): (usize, &mut Offset)| {
            offset.sum = (0.0, 0.0);
            match means[channel] {
                Some(mean) if count >= LEAST_CHANNELS => {
                    let median = 0.5 * (motions[(count - 1) / 2] + motions[count / 2]);
                    offset.add(mean - rigid[channel] * median, step_s, noise_std[channel])
                }
                _ => Evidence::Open,
            }
        };
        self.of_channels
            .iter_mut()
            .enumerate()
            .map(of_channel)
            .collect()
    }

    pub(crate) fn fits(&self, channels: usize) -> bool {
        self.of_channels.len() == channels
    }
}

impl Offset {
    fn add(&mut self, value: f64, step_s: f64, noise_std: f64) -> Evidence {
        let is_large = value.abs() > LARGE * noise_std;
        let Some(reference) = self.reference else {
            self.reference = Some(if is_large { 0.0 } else { value });
            self.last = value;
            return Evidence::Open;
        };
        let kept = libm::exp2(-1.0 / SCATTER_HALF_LIFE);
        let change = value - self.last;
        self.scatter.0 = kept * self.scatter.0 + change * change;
        self.scatter.1 = kept * self.scatter.1 + 1.0;
        self.last = value;
        self.changes += 1;
        // The change of two independent values has twice their variance.
        let scatter = (0.5 * self.scatter.0 / self.scatter.1).sqrt();
        let is_steady = DRIFTS * change.abs() < value.abs();
        self.steady = if is_steady {
            self.steady.saturating_add(1)
        } else {
            0
        };
        let moved = value - reference;
        if !is_large {
            let follows = 1.0 - libm::exp2(-step_s / REFERENCE_HALF_LIFE_S);
            self.reference = Some(reference + follows * moved);
        }
        let distance = moved.abs();
        let drifts = distance > DRIFTS * scatter && distance > noise_std;
        if self.changes < FIRST {
            Evidence::Open
        } else if drifts || (is_large && self.steady >= STEADY) {
            Evidence::Fault(Fault::Drift(value))
        } else if is_large {
            Evidence::Open
        } else if distance < RETURNED * scatter || distance < 0.5 * noise_std {
            Evidence::Sound
        } else {
            Evidence::Open
        }
    }
}
