//! Forgetting: the fading factor, and a bound on the variances that it would increase without
//! limit.
//!
//! Notation: Huang & Yuen (2023), (2.66) and (2.71).

use crate::error::FilterError;
use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

/// The fading factor `λ ≥ 1`, by which the predicted covariance is multiplied at every step.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Serialize, Deserialize)]
#[serde(try_from = "f64", into = "f64")]
pub struct FadingFactor(f64);

impl FadingFactor {
    /// No forgetting.
    pub const NONE: Self = Self(1.0);

    /// Creates a factor from its value.
    ///
    /// # Errors
    /// Returns [`FilterError::Setting`] if the value is below 1 or not finite.
    pub fn new(value: f64) -> Result<Self, FilterError> {
        if value.is_finite() && value >= 1.0 {
            Ok(Self(value))
        } else {
            Err(FilterError::Setting {
                what: "fading factor",
                found: value,
                allowed: "at least 1 and finite",
            })
        }
    }

    /// Creates the factor for a half-life of `half_life_steps` (`N_λ`): `λ = 2^(2/N_λ)`, equation
    /// (2.71).
    ///
    /// After `N_λ` steps, the weight of a sample on the residual has halved. Its information halves
    /// after `N_λ/2` steps.
    ///
    /// # Errors
    /// Returns [`FilterError::Setting`] if the half-life is not positive.
    pub fn from_half_life(half_life_steps: f64) -> Result<Self, FilterError> {
        if half_life_steps > 0.0 {
            Self::new(2f64.powf(2.0 / half_life_steps))
        } else {
            Err(FilterError::Setting {
                what: "half-life in steps",
                found: half_life_steps,
                allowed: "positive",
            })
        }
    }

    /// Returns `λ`.
    #[must_use]
    pub fn value(self) -> f64 {
        self.0
    }

    /// Returns the averaging length of the information, `1/ln λ` steps; infinite without
    /// forgetting.
    #[must_use]
    pub fn memory_steps(self) -> f64 {
        1.0 / self.0.ln()
    }
}

impl TryFrom<f64> for FadingFactor {
    type Error = FilterError;

    fn try_from(value: f64) -> Result<Self, FilterError> {
        Self::new(value)
    }
}

impl From<FadingFactor> for f64 {
    fn from(factor: FadingFactor) -> Self {
        factor.0
    }
}

/// Scales rows and columns of a covariance so that no variance exceeds its bound. Returns the
/// number of variances that did.
///
/// Forgetting multiplies the variance of every direction without information from the data by `λ`
/// at each step. The scaling preserves the correlations and positive definiteness.
pub(crate) fn bound_variances_mut(covariance: &mut DMatrix<f64>, bounds: &DVector<f64>) -> usize {
    let n = covariance.nrows();
    let mut bounded = 0;
    for j in 0..n {
        let variance = covariance[(j, j)];
        if variance > bounds[j] {
            let shrink = (bounds[j] / variance).sqrt();
            for i in 0..n {
                covariance[(i, j)] *= shrink;
                covariance[(j, i)] *= shrink;
            }
            covariance[(j, j)] = bounds[j];
            bounded += 1;
        }
    }
    bounded
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_life_of_two_thousand_steps_gives_the_printed_factor() {
        // ch2 §5 check 3: λ = 2^(1/1000) = 1.000693387 and λ^2000 = 4
        let factor = FadingFactor::from_half_life(2000.0).unwrap();
        assert!((factor.value() - 1.000_693_387).abs() < 5e-10);
        assert!((factor.value().powi(2000) - 4.0).abs() < 1e-10);
        assert!((factor.memory_steps() - 1442.7).abs() < 0.05);
    }

    #[test]
    fn bounding_keeps_correlations() {
        let mut covariance = DMatrix::from_row_slice(2, 2, &[4.0, 1.0, 1.0, 9.0]);
        let count = bound_variances_mut(&mut covariance, &DVector::from_row_slice(&[1.0, 100.0]));
        assert_eq!(count, 1);
        assert_eq!(covariance[(0, 0)], 1.0);
        assert_eq!(covariance[(1, 1)], 9.0);
        let correlation = covariance[(0, 1)] / (covariance[(0, 0)] * covariance[(1, 1)]).sqrt();
        assert!((correlation - 1.0 / 6.0).abs() < 1e-15);
    }

    #[test]
    fn factor_below_one_is_refused() {
        assert!(FadingFactor::new(0.99).is_err());
        assert!(FadingFactor::from_half_life(0.0).is_err());
        assert!(FadingFactor::from_half_life(f64::NAN).is_err());
    }
}
