//! Strong-motion figures of one channel.
//!
//! Sources: A. Arias, *A measure of earthquake intensity*, in R. J. Hansen (ed.), *Seismic Design
//! for Nuclear Power Plants* (1970), 438-483. M. D. Trifunac and A. G. Brady, *A study on the
//! duration of strong earthquake ground motion*, Bull. Seism. Soc. Am. 65 (1975), 581-626: the
//! significant duration is the time between 5 % and 95 % of the final intensity.

use serde::Serialize;
use std::f64::consts::PI;

/// Standard gravity (m/s²), exact by definition.
pub const GRAVITY: f64 = 9.806_65;

/// Shares of the Arias intensity between which the significant duration lies.
const SIGNIFICANT: (f64, f64) = (0.05, 0.95);

/// Figures of any channel. Its mean counts as an offset of the sensor.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct MotionFigures {
    /// Largest absolute value (unit of the channel).
    pub peak: f64,
    /// Time of the largest absolute value since the first sample (s).
    pub peak_at_s: f64,
    /// Root mean square over the whole record (unit of the channel).
    pub rms: f64,
    /// Number of missing samples.
    pub missing: usize,
}

/// Figures that apply to accelerations only, in addition to [`MotionFigures`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct IntensityFigures {
    /// Arias intensity I = π/(2g) ∫ a² dt (m/s).
    pub arias_m_per_s: f64,
    /// Significant duration D5-95 (s).
    pub significant_duration_s: f64,
    /// Start of the significant duration since the first sample (s).
    pub significant_from_s: f64,
}

/// Returns the mean of the samples without missing ones. `None` if all are missing.
#[must_use]
pub fn mean(samples: &[f64]) -> Option<f64> {
    let present = || samples.iter().filter(|value| value.is_finite());
    let count = present().count();
    (count > 0).then(|| present().sum::<f64>() / count as f64)
}

/// Returns the figures of a channel, whose missing samples are `NaN`. Returns `None` if all are
/// missing.
#[must_use]
pub fn motion_figures(samples: &[f64], step_s: f64) -> Option<MotionFigures> {
    let mean = mean(samples)?;
    let (mut peak, mut at, mut sum, mut count) = (0.0_f64, 0, 0.0, 0_usize);
    for (index, value) in samples.iter().enumerate() {
        if value.is_finite() {
            let deviation = value - mean;
            if deviation.abs() > peak {
                (peak, at) = (deviation.abs(), index);
            }
            sum += deviation * deviation;
            count += 1;
        }
    }
    Some(MotionFigures {
        peak,
        peak_at_s: at as f64 * step_s,
        rms: (sum / count as f64).sqrt(),
        missing: samples.len() - count,
    })
}

/// Returns the intensity of an acceleration (m/s²), whose missing samples are `NaN`. They count as
/// the mean. Returns `None` if all are missing.
#[must_use]
pub fn intensity_figures(samples: &[f64], step_s: f64) -> Option<IntensityFigures> {
    let mean = mean(samples)?;
    let square = |value: &f64| {
        let deviation = value - mean;
        if deviation.is_finite() {
            deviation * deviation
        } else {
            0.0
        }
    };
    let whole: f64 = samples.iter().map(square).sum();
    let (mut sum, mut from, mut to) = (0.0, None, None);
    for (index, value) in samples.iter().enumerate() {
        sum += square(value);
        let time_s = index as f64 * step_s;
        if from.is_none() && sum >= SIGNIFICANT.0 * whole {
            from = Some(time_s);
        }
        if to.is_none() && sum >= SIGNIFICANT.1 * whole {
            to = Some(time_s);
        }
    }
    let from = from.unwrap_or(0.0);
    Some(IntensityFigures {
        arias_m_per_s: PI / (2.0 * GRAVITY) * whole * step_s,
        significant_duration_s: to.unwrap_or(from) - from,
        significant_from_s: from,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    /// A sine of 2 m/s² and 1 Hz for 20 s between 5 s of rest, with an offset.
    fn burst() -> Vec<f64> {
        (0..3000)
            .map(|i| {
                let time_s = 0.01 * f64::from(i);
                let moves = (5.0..25.0).contains(&time_s);
                0.7 + if moves {
                    2.0 * (TAU * time_s).sin()
                } else {
                    0.0
                }
            })
            .collect()
    }

    #[test]
    fn figures_of_a_sine_are_those_of_its_closed_form() {
        let figures = motion_figures(&burst(), 0.01).unwrap();
        assert!((figures.peak - 2.0).abs() < 1e-3, "{figures:?}");
        // A quarter of a period after one of the zeros.
        let phase = (figures.peak_at_s - 5.25).rem_euclid(0.5);
        assert!(phase.min(0.5 - phase) < 0.011, "{figures:?}");
        // Mean square 2 over 20 of 30 s.
        assert!((figures.rms - f64::sqrt(4.0 / 3.0)).abs() < 1e-3);
        let intensity = intensity_figures(&burst(), 0.01).unwrap();
        // π/(2g) · ½ · 2² · 20 s.
        let exact = PI / (2.0 * GRAVITY) * 40.0;
        assert!((intensity.arias_m_per_s / exact - 1.0).abs() < 1e-3);
        // The intensity grows by 5 % a second. The sine squared is periodic in 0.5 s.
        assert!((intensity.significant_duration_s - 18.0).abs() < 0.02);
        assert!((intensity.significant_from_s - 6.0).abs() < 0.02);
    }

    #[test]
    fn missing_samples_change_neither_peak_nor_intensity_much() {
        let mut holed = burst();
        for index in (0..3000).step_by(50) {
            holed[index] = f64::NAN;
        }
        let figures = motion_figures(&holed, 0.01).unwrap();
        assert_eq!(figures.missing, 60);
        assert!((figures.peak - 2.0).abs() < 0.01);
        assert!(motion_figures(&[f64::NAN; 4], 0.01).is_none());
        assert!(intensity_figures(&[], 0.01).is_none());
    }
}
