//! Low-pass filter that limits all channels of a structure to the same band.
//!
//! If the input and all outputs of a linear structure pass the same filter, they still obey the
//! same equation of motion. The identification can therefore work on the band in which its model is
//! valid.
//!
//! The filter is causal: Butterworth sections from the bilinear transform with prewarping, in
//! direct form II transposed.

use crate::error::FilterError;
use serde::{Deserialize, Serialize};

/// Coefficients of one second-order section, `b0 b1 b2 a1 a2` with `a0 = 1`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Section {
    b: [f64; 3],
    a: [f64; 2],
}

/// A low-pass for all channels, with its filter state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BandLimit {
    sections: Vec<Section>,
    /// Two state variables per section and channel.
    memory: Vec<[f64; 2]>,
    /// Last value of each channel, NaN before the first sample. It replaces a missing sample.
    last: Vec<f64>,
}

impl BandLimit {
    /// Creates a Butterworth low-pass of even `order` with its −3 dB point at `frequency_hz`.
    ///
    /// # Errors
    /// Returns [`FilterError::Setting`] if the order is odd or zero, or if the frequency is not
    /// between 0 and half the sampling rate.
    pub fn low_pass(
        order: usize,
        frequency_hz: f64,
        sampling_rate_hz: f64,
        channels: usize,
    ) -> Result<Self, FilterError> {
        if order == 0 || order % 2 == 1 {
            let what = "order of the band limit";
            return Err(FilterError::Setting {
                what,
                found: order as f64,
                allowed: "even and positive",
            });
        }
        if !(frequency_hz > 0.0 && frequency_hz < 0.5 * sampling_rate_hz) {
            let allowed = "between 0 and half the sampling rate";
            return Err(FilterError::Setting {
                what: "frequency of the band limit",
                found: frequency_hz,
                allowed,
            });
        }
        let warped = (std::f64::consts::PI * frequency_hz / sampling_rate_hz).tan();
        let sections: Vec<Section> = (0..order / 2)
            .map(|k| {
                // Damping of the k-th pole pair on the Butterworth circle.
                let angle = std::f64::consts::PI * (2 * k + 1) as f64 / (2 * order) as f64;
                let twice_damping = 2.0 * angle.sin();
                let scale = 1.0 / (1.0 + twice_damping * warped + warped * warped);
                let gain = warped * warped * scale;
                Section {
                    b: [gain, 2.0 * gain, gain],
                    a: [
                        2.0 * (warped * warped - 1.0) * scale,
                        (1.0 - twice_damping * warped + warped * warped) * scale,
                    ],
                }
            })
            .collect();
        let memory = vec![[0.0; 2]; sections.len() * channels];
        Ok(Self {
            sections,
            memory,
            last: vec![f64::NAN; channels],
        })
    }

    /// Clears the filter state, so that the next sample of each channel counts as its first.
    pub fn reset(&mut self) {
        self.memory.fill([0.0; 2]);
        self.last.fill(f64::NAN);
    }

    /// Filters one frame in place. A missing channel (NaN) stays missing.
    ///
    /// The first value of a channel sets the filter to its steady state, so that an offset causes
    /// no transient. For a missing sample, the filter state advances with the last value of the
    /// channel.
    pub fn apply(&mut self, frame: &mut [f64]) {
        let count = self.sections.len();
        for (channel, value) in frame.iter_mut().enumerate() {
            let missing = value.is_nan();
            let mut x = if missing { self.last[channel] } else { *value };
            if x.is_nan() {
                continue; // no sample yet
            }
            let memory = &mut self.memory[channel * count..(channel + 1) * count];
            if self.last[channel].is_nan() {
                for (section, state) in self.sections.iter().zip(memory.iter_mut()) {
                    // Steady state for an input of constant `x`; the gain at 0 Hz is 1.
                    state[1] = (section.b[2] - section.a[1]) * x;
                    state[0] = (section.b[1] - section.a[0]) * x + state[1];
                }
            }
            self.last[channel] = x;
            for (section, state) in self.sections.iter().zip(memory.iter_mut()) {
                let y = section.b[0] * x + state[0];
                state[0] = section.b[1] * x - section.a[0] * y + state[1];
                state[1] = section.b[2] * x - section.a[1] * y;
                x = y;
            }
            if !missing {
                *value = x;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gain(order: usize, corner_hz: f64, frequency_hz: f64) -> f64 {
        let rate = 120.0;
        let mut filter = BandLimit::low_pass(order, corner_hz, rate, 1).unwrap();
        let mut sum = 0.0;
        let count = 12_000;
        for k in 0..2 * count {
            let mut frame = [(std::f64::consts::TAU * frequency_hz * k as f64 / rate).sin()];
            filter.apply(&mut frame);
            if k >= count {
                sum += frame[0] * frame[0];
            }
        }
        (2.0 * sum / count as f64).sqrt()
    }

    #[test]
    fn gain_is_that_of_a_butterworth_filter() {
        // |H|² = 1/(1 + (tan(πf/fs)/tan(πfc/fs))^(2·order)): the analytic response of the bilinear
        // Butterworth filter.
        for (order, corner, frequency) in [
            (4, 12.0, 12.0),
            (4, 12.0, 6.0),
            (4, 6.0, 12.0),
            (2, 10.0, 30.0),
        ] {
            let warp = |f: f64| (std::f64::consts::PI * f / 120.0).tan();
            let expected = (1.0 + (warp(frequency) / warp(corner)).powi(2 * order))
                .sqrt()
                .recip();
            let found = gain(order as usize, corner, frequency);
            assert!(
                (found - expected).abs() < 1e-6,
                "order {order} at {frequency} Hz: {found} for {expected}"
            );
        }
    }

    #[test]
    fn offset_causes_no_transient_and_gaps_remain_gaps() {
        let mut filter = BandLimit::low_pass(4, 6.0, 120.0, 2).unwrap();
        for k in 0..50 {
            let mut frame = [9.81, if k == 7 { f64::NAN } else { -2.0 }];
            filter.apply(&mut frame);
            assert!((frame[0] - 9.81).abs() < 1e-12);
            assert_eq!(frame[1].is_nan(), k == 7);
            assert!(k == 7 || (frame[1] + 2.0).abs() < 1e-12);
        }
    }

    #[test]
    fn odd_order_and_frequency_above_nyquist_are_refused() {
        assert!(BandLimit::low_pass(3, 6.0, 120.0, 1).is_err());
        assert!(BandLimit::low_pass(4, 60.0, 120.0, 1).is_err());
    }
}
