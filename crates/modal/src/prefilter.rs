//! The streaming filters before the covariances: high pass, anti-aliasing filter and decimation.
//!
//! The low-pass filter is an ideal one under a Kaiser window (J. F. Kaiser, 1974; Oppenheim &
//! Schafer, *Discrete-Time Signal Processing*, section 7.5.3). The high pass is a Butterworth
//! filter of order 4 by the bilinear transform, in two sections. Its own poles have damping ratios
//! of 0.38 and 0.92, so they cannot be mistaken for modes.

use crate::settings::USABLE_SHARE;
use serde::{Deserialize, Serialize};
use std::f64::consts::PI;

/// Attenuation of the stop band (dB).
const ATTENUATION_DB: f64 = 80.0;
/// Quality factors of the two sections of a Butterworth filter of order 4.
const BUTTERWORTH_4: [f64; 2] = [0.541_196_100_146_197, 1.306_562_964_876_376_5];

/// Returns the largest ratio of decimation that keeps `highest_hz` below the usable share of the
/// new rate.
pub(crate) fn decimation_factor(rate_hz: f64, highest_hz: f64) -> usize {
    let factor = USABLE_SHARE * rate_hz / highest_hz;
    // A ratio of 4.9999999 is 5 with rounding.
    ((factor * (1.0 + 1e-9)).floor() as usize).max(1)
}

/// Filters and decimates frames, one at a time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Prefilter {
    factor: usize,
    sections: Vec<Section>,
    /// Symmetric coefficients of the low-pass filter, empty without decimation.
    taps: Vec<f64>,
    /// Offset of each channel: its first value.
    offsets: Vec<f64>,
    /// Last value of each channel.
    held: Vec<f64>,
    /// The last `taps.len()` frames, the oldest at `next`.
    history: Vec<f64>,
    next: usize,
    filled: usize,
    until_output: usize,
    output: Vec<f64>,
}

impl Prefilter {
    pub(crate) fn new(channels: usize, rate_hz: f64, lowest_hz: f64, factor: usize) -> Self {
        let taps = if factor > 1 {
            low_pass(factor)
        } else {
            Vec::new()
        };
        let sections = if lowest_hz > 0.0 {
            BUTTERWORTH_4
                .iter()
                .map(|quality| Section::high_pass(lowest_hz / rate_hz, *quality, channels))
                .collect()
        } else {
            Vec::new()
        };
        Self {
            factor,
            sections,
            offsets: vec![f64::NAN; channels],
            held: vec![0.0; channels],
            history: vec![0.0; taps.len() * channels],
            taps,
            next: 0,
            filled: 0,
            until_output: 1,
            output: vec![0.0; channels],
        }
    }

    /// Forgets all previous frames, but keeps the offsets.
    pub(crate) fn reset(&mut self) {
        self.sections.iter_mut().for_each(Section::reset);
        self.held.fill(0.0);
        (self.next, self.filled, self.until_output) = (0, 0, 1);
    }

    /// Filters a frame. Returns the decimated frame if one is due.
    ///
    /// A missing value (`NaN`) repeats the last value of its channel. A frame is due once the
    /// low-pass filter is full, and then after every `factor` frames.
    pub(crate) fn push(&mut self, frame: &[f64]) -> Option<&[f64]> {
        for (channel, value) in frame.iter().enumerate() {
            if !value.is_finite() {
                continue;
            }
            if self.offsets[channel].is_nan() {
                self.offsets[channel] = *value;
            }
            self.held[channel] = value - self.offsets[channel];
        }
        self.output.copy_from_slice(&self.held);
        for section in &mut self.sections {
            section.filter_mut(&mut self.output);
        }
        if self.taps.is_empty() {
            return Some(&self.output);
        }
        let channels = self.output.len();
        self.history[self.next * channels..][..channels].copy_from_slice(&self.output);
        self.next = (self.next + 1) % self.taps.len();
        self.filled = (self.filled + 1).min(self.taps.len());
        if self.filled < self.taps.len() {
            return None;
        }
        self.until_output -= 1;
        if self.until_output > 0 {
            return None;
        }
        self.until_output = self.factor;
        self.convolve();
        Some(&self.output)
    }

    fn convolve(&mut self) {
        let channels = self.output.len();
        self.output.fill(0.0);
        let (newer, older) = self.history.split_at(self.next * channels);
        let frames = older
            .chunks_exact(channels)
            .chain(newer.chunks_exact(channels));
        for (tap, frame) in self.taps.iter().zip(frames) {
            for (output, value) in self.output.iter_mut().zip(frame) {
                *output += tap * value;
            }
        }
    }
}

/// Returns the coefficients of a low-pass filter for decimation by `factor`.
///
/// The pass band ends at 0.4 of the new rate. The stop band starts at 0.6, so that nothing aliases
/// into the pass band.
fn low_pass(factor: usize) -> Vec<f64> {
    let half = half_length(factor);
    let beta = 0.1102 * (ATTENUATION_DB - 8.7);
    let cutoff = PI / factor as f64; // rad per sample, the middle of the transition
    let tap = |offset: f64| {
        let ideal = if offset == 0.0 {
            cutoff / PI
        } else {
            (cutoff * offset).sin() / (PI * offset)
        };
        let position = offset / half as f64;
        ideal * bessel_i0(beta * (1.0 - position * position).max(0.0).sqrt())
    };
    let taps: Vec<f64> = (0..=2 * half)
        .map(|index| tap(index as f64 - half as f64))
        .collect();
    let gain: f64 = taps.iter().sum();
    taps.iter().map(|tap| tap / gain).collect()
}

/// Returns the number of coefficients on each side of the middle one.
fn half_length(factor: usize) -> usize {
    let transition = 2.0 * PI * 0.2 / factor as f64; // rad per sample
    ((ATTENUATION_DB - 8.0) / (2.285 * transition) / 2.0).ceil() as usize
}

/// Returns the number of frames that fill the low-pass filter.
pub(crate) fn filling_frames(factor: usize) -> usize {
    if factor > 1 {
        2 * half_length(factor) + 1
    } else {
        0
    }
}

/// Modified Bessel function of the first kind and order 0, by its power series.
fn bessel_i0(x: f64) -> f64 {
    let mut term = 1.0;
    let mut sum = 1.0;
    let mut k = 1.0;
    while term > 1e-17 * sum {
        term *= (x / (2.0 * k)) * (x / (2.0 * k));
        sum += term;
        k += 1.0;
    }
    sum
}

/// One second-order section of a filter, in transposed direct form II.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Section {
    numerator: [f64; 3],
    denominator: [f64; 2],
    /// Two states per channel.
    states: Vec<[f64; 2]>,
}

impl Section {
    /// Creates a high-pass section. `cutoff` is the share of the sampling rate.
    fn high_pass(cutoff: f64, quality: f64, channels: usize) -> Self {
        let k = (PI * cutoff).tan();
        let norm = 1.0 + k / quality + k * k;
        Self {
            numerator: [1.0 / norm, -2.0 / norm, 1.0 / norm],
            denominator: [
                2.0 * (k * k - 1.0) / norm,
                (1.0 - k / quality + k * k) / norm,
            ],
            states: vec![[0.0; 2]; channels],
        }
    }

    fn reset(&mut self) {
        self.states.fill([0.0; 2]);
    }

    fn filter_mut(&mut self, frame: &mut [f64]) {
        let ([b0, b1, b2], [a1, a2]) = (self.numerator, self.denominator);
        for (value, state) in frame.iter_mut().zip(&mut self.states) {
            let input = *value;
            let output = b0 * input + state[0];
            *state = [
                b1 * input - a1 * output + state[1],
                b2 * input - a2 * output,
            ];
            *value = output;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the largest output of a unit sine, after the filters have settled.
    fn gain(frequency_hz: f64, lowest_hz: f64, factor: usize) -> f64 {
        let mut filter = Prefilter::new(1, 100.0, lowest_hz, factor);
        filter.offsets[0] = 0.0;
        (0..20_000)
            .map(|n| (2.0 * PI * frequency_hz * f64::from(n) / 100.0).sin())
            .filter_map(|value| filter.push(&[value]).map(|output| output[0]))
            .skip(10_000 / factor)
            .fold(0.0, |largest, value| value.abs().max(largest))
    }

    #[test]
    fn low_pass_passes_to_0_4_and_stops_from_0_6_of_the_new_rate() {
        // New rate 20 Hz. 80 dB is a factor of 1e-4.
        for (frequency_hz, least, most) in [(1.03, 0.999, 1.001), (7.97, 0.998, 1.001)] {
            let found = gain(frequency_hz, 0.0, 5);
            assert!(found > least && found < most, "{frequency_hz} Hz: {found}");
        }
        for frequency_hz in [12.03, 17.9, 33.3] {
            let found = gain(frequency_hz, 0.0, 5);
            assert!(found < 2e-4, "{frequency_hz} Hz: {found}");
        }
    }

    #[test]
    fn high_pass_is_the_butterworth_filter_of_order_4() {
        // |H|² = 1/(1 + (f0/f)⁸), with the frequency axis of the bilinear transform.
        let warped = |f: f64| (PI * f / 100.0).tan();
        for frequency_hz in [0.51, 1.03, 2.2, 20.7] {
            let ratio = warped(1.0) / warped(frequency_hz);
            let expected = (1.0 + ratio.powi(8)).powf(-0.5);
            let found = gain(frequency_hz, 1.0, 1);
            assert!(
                (found - expected).abs() < 2e-2,
                "{frequency_hz}: {found} {expected}"
            );
        }
    }

    #[test]
    fn factor_keeps_the_band_below_0_4_of_the_new_rate() {
        for (rate_hz, highest_hz, factor) in [
            (100.0, 40.0, 1),
            (100.0, 8.0, 5),
            (100.0, 7.9, 5),
            (200.0, 16.0, 5),
        ] {
            assert_eq!(
                decimation_factor(rate_hz, highest_hz),
                factor,
                "{highest_hz}"
            );
        }
    }
}
