//! Conjugate Bayesian regression with priors in physical units.
//!
//! Notation of the normal and inverse gamma model: prior N(m0, σ² Λ0⁻¹), σ² ~ InvGamma(a0, b0), here
//! with m0 = 0. Source: Gelman et al., Bayesian Data Analysis (3rd ed., 2013), section 14.8;
//! Särkkä (2013), chapter 3, for the sequential form.
//!
//! - Λn = Λ0 + Σ w x xᵀ (1)
//! - mn = Λn⁻¹ (Λ0 m0 + Σ w x y) (2)
//! - an = a0 + n/2 (3)
//! - bn = b0 + ½ (Σ w y² + m0ᵀ Λ0 m0 − mnᵀ Λn mn) (4), evaluated as b0 + ½ (Σ w r² + mnᵀ Λ0 mn) with
//!   the residuals r, which cannot become negative by rounding
//!
//! The prior standard deviations s of the coefficients are physical, so Λ0 = σ²/s² depends on σ². It
//! is iterated with σ² = bn/an. The weights are those of errors with a Student t distribution
//! (Lange, Little & Taylor 1989): w = (ν + 1)/(ν + r²/σ²).

use crate::whitening::Row;
use nalgebra::{Cholesky, DMatrix, DVector};
use serde::{Deserialize, Serialize};

/// Degrees of freedom ν of the errors of a day. Four is the usual choice of robust regression.
pub(crate) const FREEDOM: f64 = 4.0;
/// Shape a0 of the prior of σ²: as much as two days.
const SHAPE: f64 = 1.0;
/// Root of b0/a0: scatter of ln(frequency) between days.
const SCATTER: f64 = 0.005;
/// Number of iterations of σ² and the weights. Both converge within a few.
const ITERATIONS: usize = 12;

/// How errors are weighted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Errors {
    /// All weights are 1.
    Normal,
    /// Student t with [`FREEDOM`] degrees of freedom.
    StudentT,
}

/// Coefficients with their uncertainty.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Posterior {
    /// mn, one entry per regressor.
    pub(crate) mean: DVector<f64>,
    /// Λn⁻¹: covariance of the coefficients relative to σ².
    pub(crate) covariance: DMatrix<f64>,
    /// σ: standard deviation of the core of the errors.
    pub(crate) sigma: f64,
}

/// A fitted regression.
pub(crate) struct Fit {
    pub(crate) posterior: Posterior,
    /// Logarithm of the evidence of the rows, up to a constant of their number.
    pub(crate) ln_evidence: f64,
}

impl Posterior {
    /// Returns xᵀ mn.
    pub(crate) fn expected(&self, x: &DVector<f64>) -> f64 {
        x.dot(&self.mean)
    }

    /// Returns xᵀ Λn⁻¹ x: the variance of the expected value relative to σ².
    pub(crate) fn leverage(&self, x: &DVector<f64>) -> f64 {
        x.dot(&(&self.covariance * x)).max(0.0)
    }

    /// Learns one row, given the residual to learn and the weight w of the row.
    ///
    /// Returns the gain K = Λ⁻¹x / (1/w + xᵀΛ⁻¹x). Source: the rank-one form of (1) and (2).
    pub(crate) fn learn(&mut self, x: &DVector<f64>, residual: f64, weight: f64) -> DVector<f64> {
        let c = &self.covariance * x;
        let gain = &c / (1.0 / weight + x.dot(&c));
        self.mean.axpy(residual, &gain, 1.0);
        self.covariance.ger(-1.0, &gain, &c, 1.0);
        gain
    }
}

/// Returns the weight of an error z (in units of σ).
pub(crate) fn weight(z: f64) -> f64 {
    (FREEDOM + 1.0) / (FREEDOM + z * z)
}

/// Fits whitened rows. `prior` is the standard deviation of each coefficient.
///
/// Returns `None` if there are no rows or a matrix is not positive definite.
pub(crate) fn fit(rows: &[Row], prior: &DVector<f64>, errors: Errors) -> Option<Fit> {
    let n = rows.len();
    let mean_square = rows.iter().map(|row| row.y * row.y).sum::<f64>() / n as f64;
    let mut variance = mean_square.max(SCATTER * SCATTER * 1e-4);
    let mut weights = vec![1.0; n];
    let b0 = SHAPE * SCATTER * SCATTER;
    let a = SHAPE + 0.5 * n as f64; // (3)
    let mut found = None;
    for _ in 0..ITERATIONS {
        let prior_precision = prior.map(|std| variance / (std * std));
        let mut precision = DMatrix::from_diagonal(&prior_precision);
        let mut moment = DVector::zeros(prior.len());
        for (row, weight) in rows.iter().zip(&weights) {
            precision.ger(*weight, &row.x, &row.x, 1.0); // (1)
            moment.axpy(weight * row.y, &row.x, 1.0);
        }
        let factor = Cholesky::new(precision)?;
        let mean = factor.solve(&moment); // (2)
        let residuals: Vec<f64> = rows.iter().map(|row| row.y - row.x.dot(&mean)).collect();
        let prior_part = prior_precision.dot(&mean.map(|m| m * m));
        let square: f64 = residuals.iter().zip(&weights).map(|(r, w)| w * r * r).sum();
        let b = b0 + 0.5 * (square + prior_part); // (4)
        variance = b / a;
        if errors == Errors::StudentT {
            let sigma = variance.sqrt();
            for (weight_of, residual) in weights.iter_mut().zip(&residuals) {
                *weight_of = weight(residual / sigma);
            }
        }
        let ln_evidence =
            0.5 * prior_precision.map(f64::ln).sum() - 0.5 * factor.ln_determinant() - a * b.ln();
        found = Some((mean, factor, ln_evidence));
    }
    let (mean, factor, ln_evidence) = found?;
    let identity = DMatrix::identity(prior.len(), prior.len());
    (n > 0 && variance.is_finite()).then(|| Fit {
        posterior: Posterior {
            mean,
            covariance: factor.solve(&identity),
            sigma: variance.sqrt(),
        },
        ln_evidence,
    })
}
