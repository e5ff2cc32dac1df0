//! Ground motions of the robustness benchmark.

use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use std::f64::consts::{PI, TAU};

/// Spectrum of the ground acceleration, and how it varies between samples.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Spectrum {
    /// Independent at every sample, with linear interpolation between samples.
    WhiteStraight,
    /// Independent at every sample and constant until the next, as the filter assumes for an
    /// unmeasured motion.
    WhiteHeld,
    /// Smooth: white noise after a fourth-order low-pass filter with this cut-off frequency (Hz).
    Smooth(f64),
    /// Kanai-Tajimi: white noise through a soil layer of 2.4 Hz and a damping ratio of 0.6.
    KanaiTajimi,
}

/// Change of the level over time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Envelope {
    /// Constant level.
    Constant,
    /// Full level until this time (s), and this share of it afterwards.
    Falls { at_s: f64, share: f64 },
    /// Full level except between these times (s), when the ground is at rest.
    Pauses { from_s: f64, to_s: f64 },
    /// Level between 1/√10 and √10 of its geometric mean, with this period (s).
    Tenfold(f64),
}

/// Kanai-Tajimi soil layer: natural frequency (Hz) and damping ratio of firm soil.
const SOIL: (f64, f64) = (2.4, 0.6);

/// A ground acceleration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Ground {
    pub(super) spectrum: Spectrum,
    pub(super) envelope: Envelope,
    /// Standard deviation (m/s²).
    pub(super) std: f64,
}

impl Ground {
    /// Returns the accelerations (m/s²) at `substeps` points per sample for `samples` samples, and
    /// at the end of the last one.
    pub(super) fn draw(
        &self,
        samples: usize,
        substeps: usize,
        rate_hz: f64,
        random: &mut ChaCha8Rng,
    ) -> Vec<f64> {
        let fine_s = 1.0 / (rate_hz * substeps as f64);
        let count = samples * substeps + 1;
        let mut motion = match self.spectrum {
            Spectrum::WhiteStraight => {
                let white: Vec<f64> = (0..samples + 2)
                    .map(|_| StandardNormal.sample(random))
                    .collect();
                (0..count)
                    .map(|k| {
                        let (sample, part) =
                            (k / substeps, (k % substeps) as f64 / substeps as f64);
                        white[sample] + part * (white[sample + 1] - white[sample])
                    })
                    .collect()
            }
            Spectrum::WhiteHeld => {
                let white: Vec<f64> = (0..=samples)
                    .map(|_| StandardNormal.sample(random))
                    .collect();
                (0..count).map(|k| white[k / substeps]).collect()
            }
            Spectrum::Smooth(cut_off_hz) => {
                let white = (0..count).map(|_| StandardNormal.sample(random)).collect();
                // The two second-order sections of a fourth-order Butterworth low-pass filter.
                let once = filtered(white, cut_off_hz, (PI / 8.0).cos(), 0.0, fine_s);
                normalised(filtered(
                    once,
                    cut_off_hz,
                    (3.0 * PI / 8.0).cos(),
                    0.0,
                    fine_s,
                ))
            }
            Spectrum::KanaiTajimi => {
                let white = (0..count).map(|_| StandardNormal.sample(random)).collect();
                let (frequency_hz, ratio) = SOIL;
                normalised(filtered(white, frequency_hz, ratio, 1.0, fine_s))
            }
        };
        for (k, value) in motion.iter_mut().enumerate() {
            *value *= self.std * self.envelope.factor(k as f64 * fine_s);
        }
        motion
    }
}

impl Envelope {
    fn factor(self, time_s: f64) -> f64 {
        match self {
            Self::Constant => 1.0,
            Self::Falls { at_s, share } => {
                if time_s < at_s {
                    1.0
                } else {
                    share
                }
            }
            Self::Pauses { from_s, to_s } => {
                if (from_s..to_s).contains(&time_s) {
                    0.0
                } else {
                    1.0
                }
            }
            Self::Tenfold(period_s) => 10f64.powf(0.5 * (TAU * time_s / period_s).sin()),
        }
    }
}

/// Returns the response `ω² x + velocity · 2ζω ẋ` of `ẍ + 2ζω ẋ + ω² x = input`, by the trapezoidal
/// rule.
fn filtered(
    input: Vec<f64>,
    frequency_hz: f64,
    ratio: f64,
    velocity: f64,
    step_s: f64,
) -> Vec<f64> {
    // The bilinear transform is prewarped at the natural frequency.
    let k = 1.0 / (PI * frequency_hz * step_s).tan();
    let (a0, a1, a2) = (
        k * k + 2.0 * ratio * k + 1.0,
        2.0 - 2.0 * k * k,
        k * k - 2.0 * ratio * k + 1.0,
    );
    let (b0, b1, b2) = (
        1.0 + velocity * 2.0 * ratio * k,
        2.0,
        1.0 - velocity * 2.0 * ratio * k,
    );
    let (mut x1, mut x2, mut y1, mut y2) = (0.0, 0.0, 0.0, 0.0);
    input
        .into_iter()
        .map(|x| {
            let y = (b0 * x + b1 * x1 + b2 * x2 - a1 * y1 - a2 * y2) / a0;
            (x2, x1, y2, y1) = (x1, x, y1, y);
            y
        })
        .collect()
}

/// Scales the values to a standard deviation of 1.
fn normalised(mut values: Vec<f64>) -> Vec<f64> {
    let mean_square = values.iter().map(|value| value * value).sum::<f64>() / values.len() as f64;
    let scale = mean_square.sqrt().recip();
    values.iter_mut().for_each(|value| *value *= scale);
    values
}
