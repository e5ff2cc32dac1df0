//! The scatter of frequencies and shapes between epochs beyond their stated deviations.
//!
//! Temperature, the strength of the motion and unmodelled effects change the modes of a sound
//! structure from epoch to epoch. The scatter τ² has a scaled inverse χ² prior. It is integrated
//! over levels, so that few epochs of commissioning give intervals as wide as those of Student.

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

/// Scale τ₀ of the prior for ln f. Natural frequencies vary by some 0.2 to 1 % between epochs.
const FREQUENCY_SCALE: f64 = 0.004;
/// Scale τ₀ of the prior for the values of a shape of unit norm.
const SHAPE_SCALE: f64 = 0.03;
/// Degrees of freedom of the prior. Its weight is that of four values of a commissioning.
const PRIOR_FREEDOM: f64 = 4.0;
/// Factors of τ₀² of the levels. They cover τ₀/4 to 8 τ₀.
const LEVELS: [f64; 6] = [1.0 / 16.0, 1.0 / 4.0, 1.0, 4.0, 16.0, 64.0];
/// κ: variance of the change of ln f that all modes have in common, per τ². Temperature and
/// amplitude act on the whole structure.
const COMMON: f64 = 4.0;

/// A level of scatter with its probability.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct Level {
    /// τ².
    pub(crate) variance: f64,
    pub(crate) weight: f64,
}

/// What scatters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Of {
    Frequencies,
    Shapes,
}

impl Of {
    fn scale(self) -> f64 {
        match self {
            Self::Frequencies => FREQUENCY_SCALE,
            Self::Shapes => SHAPE_SCALE,
        }
    }

    /// Returns the covariance of the scatter per τ².
    pub(crate) fn pattern(self, len: usize) -> DMatrix<f64> {
        match self {
            Self::Frequencies => {
                DMatrix::identity(len, len) + DMatrix::from_element(len, len, COMMON)
            }
            Self::Shapes => DMatrix::identity(len, len),
        }
    }
}

/// Deviations of one epoch from the mean of the commissioning, with their stated covariance.
pub(crate) struct Deviation {
    pub(crate) values: DVector<f64>,
    pub(crate) stated: DMatrix<f64>,
}

/// Returns the levels with their probabilities after the deviations of `epochs` epochs from their
/// mean.
pub(crate) fn levels(of: Of, deviations: &[Deviation], epochs: usize) -> Vec<Level> {
    let variances = LEVELS.map(|factor| factor * of.scale().powi(2));
    // Deviations from a mean have (n − 1)/n of the variance, and of the degrees of freedom.
    let share = 1.0 - 1.0 / epochs.max(1) as f64;
    let logs = variances.map(|variance| {
        let prior = -0.5 * PRIOR_FREEDOM * (variance.ln() + of.scale().powi(2) / variance);
        let of_epoch = |deviation: &Deviation| {
            let pattern = of.pattern(deviation.values.len());
            let covariance = &deviation.stated + pattern * variance;
            log_density(&deviation.values, covariance, share).unwrap_or(f64::NEG_INFINITY)
        };
        let likelihood: f64 = match share > 0.0 {
            true => deviations.iter().map(of_epoch).sum(),
            false => 0.0,
        };
        prior + share * likelihood
    });
    let highest = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let weights = logs.map(|log| (log - highest).exp());
    let sum: f64 = weights.iter().sum();
    let pairs = variances.into_iter().zip(weights);
    pairs
        .map(|(variance, weight)| Level {
            variance,
            weight: weight / sum,
        })
        .collect()
}

/// Returns the root mean square of τ.
pub(crate) fn rms(levels: &[Level]) -> f64 {
    let square: f64 = levels
        .iter()
        .map(|level| level.weight * level.variance)
        .sum();
    square.sqrt()
}

/// Returns the logarithm of the normal density of `values`/√share, without its constant.
fn log_density(values: &DVector<f64>, covariance: DMatrix<f64>, share: f64) -> Option<f64> {
    let lower = covariance.cholesky()?.unpack();
    let whitened = lower.solve_lower_triangular(values)?;
    let determinant: f64 = lower.diagonal().iter().map(|entry| entry.ln()).sum();
    Some(-determinant - 0.5 * whitened.norm_squared() / share)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn deviation(values: &[f64]) -> Deviation {
        let len = values.len();
        Deviation {
            values: DVector::from_column_slice(values),
            stated: DMatrix::identity(len, len) * 1e-8,
        }
    }

    #[test]
    fn many_deviations_determine_the_scatter_and_one_epoch_leaves_the_prior() {
        // ±3.2 % in each of two values: the level of 16 τ₀² is 1.6 %, that of 64 τ₀² is 3.2 %.
        let wide: Vec<Deviation> = (0..40)
            .map(|epoch| deviation(&[0.032, -0.032].map(|d| if epoch % 2 == 0 { d } else { -d })))
            .collect();
        let found = levels(Of::Frequencies, &wide, 40);
        assert!((rms(&found) - 0.032).abs() < 0.001, "{}", rms(&found));
        let alone = levels(Of::Frequencies, &[deviation(&[0.0, 0.0])], 1);
        assert_eq!(alone, levels(Of::Frequencies, &[], 1));
        let sum: f64 = alone.iter().map(|level| level.weight).sum();
        assert!((sum - 1.0).abs() < 1e-14);
    }
}
