//! Gaussian densities, their information form, and their products.
//!
//! Source: Huang & Yuen (2023), §6.3.2, (6.22) to (6.43).

use crate::dense::{
    cholesky_mut, ln_determinant, solve_lower_mut, solve_lower_transposed_mut, symmetrise_mut,
};
use crate::error::FilterError;
use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

/// A Gaussian density by its mean `μ` (n) and covariance `Σ` (n × n).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Gaussian {
    /// `μ` (n).
    pub mean: DVector<f64>,
    /// `Σ` (n × n), symmetric positive definite.
    pub covariance: DMatrix<f64>,
}

/// A Gaussian density by its information matrix `Δ = Σ⁻¹` (n × n) and vector `δ = Σ⁻¹ μ` (n).
///
/// In this form, the product of densities is a sum.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Information {
    /// `Δ` (n × n).
    pub matrix: DMatrix<f64>,
    /// `δ` (n).
    pub vector: DVector<f64>,
}

impl Gaussian {
    /// Creates a density from its mean (n) and the upper triangle of its covariance by columns
    /// (n(n+1)/2).
    ///
    /// A slice of n entries instead contains only the variances. Returns `None` if the lengths do
    /// not fit.
    #[must_use]
    pub fn from_triangle(mean: &[f64], covariance: &[f64]) -> Option<Self> {
        let n = mean.len();
        let covariance = if covariance.len() == n * (n + 1) / 2 {
            DMatrix::from_fn(n, n, |i, j| {
                let (low, high) = (i.min(j), i.max(j));
                covariance[high * (high + 1) / 2 + low]
            })
        } else if covariance.len() == n {
            DMatrix::from_diagonal(&DVector::from_column_slice(covariance))
        } else {
            return None;
        };
        Some(Self {
            mean: DVector::from_column_slice(mean),
            covariance,
        })
    }

    /// Returns the upper triangle of the covariance by columns (n(n+1)/2).
    #[must_use]
    pub fn triangle(&self) -> Vec<f64> {
        let n = self.mean.len();
        (0..n)
            .flat_map(|j| (0..=j).map(move |i| (i, j)))
            .map(|at| self.covariance[at])
            .collect()
    }

    /// Returns the variances (n), which define a diagonal covariance completely.
    #[must_use]
    pub fn variances(&self) -> Vec<f64> {
        self.covariance.diagonal().as_slice().to_vec()
    }

    /// Returns the information form, `Δ = Σ⁻¹` and `δ = Σ⁻¹ μ`.
    ///
    /// # Errors
    /// Returns an error if the covariance is not positive definite or a number is not finite.
    pub fn information(&self) -> Result<Information, FilterError> {
        let mut matrix = inverse(&self.covariance)?;
        symmetrise_mut(&mut matrix);
        let vector = &matrix * &self.mean;
        if let Some(index) = vector.iter().position(|entry| !entry.is_finite()) {
            return Err(FilterError::NotFinite {
                what: "entry of a Gaussian density",
                index,
            });
        }
        Ok(Information { matrix, vector })
    }
}

impl Information {
    /// Returns zero information about `n` quantities.
    #[must_use]
    pub fn none(n: usize) -> Self {
        Self {
            matrix: DMatrix::zeros(n, n),
            vector: DVector::zeros(n),
        }
    }

    /// Adds `weight` times other information; a negative weight subtracts it.
    pub fn add(&mut self, weight: f64, other: &Self) {
        self.matrix
            .zip_apply(&other.matrix, |entry, addend| *entry += weight * addend);
        self.vector.axpy(weight, &other.vector, 1.0);
    }

    /// Fades the information: multiplies the covariance by `growth ≥ 1` and keeps the mean.
    pub fn fade(&mut self, growth: f64) {
        self.matrix /= growth;
        self.vector /= growth;
    }

    /// Returns the mean `μ = Δ⁻¹ δ` and the covariance `Σ = Δ⁻¹`.
    ///
    /// # Errors
    /// Returns an error if the matrix is not positive definite or a number is not finite.
    pub fn gaussian(&self) -> Result<Gaussian, FilterError> {
        let mut covariance = inverse(&self.matrix)?;
        symmetrise_mut(&mut covariance);
        let mean = &covariance * &self.vector;
        if let Some(index) = mean.iter().position(|entry| !entry.is_finite()) {
            return Err(FilterError::NotFinite {
                what: "entry of a Gaussian density",
                index,
            });
        }
        Ok(Gaussian { mean, covariance })
    }

    /// Returns `ζ = ½ (δᵀ Δ⁻¹ δ − ln|Δ| + n ln 2π)`, (6.38).
    ///
    /// The density is `exp(−½ xᵀ Δ x + δᵀ x − ζ)`.
    fn log_normaliser(&self) -> Result<f64, FilterError> {
        let n = self.vector.len();
        let mut factor = self.matrix.clone();
        cholesky_mut(&mut factor).map_err(not_definite)?;
        let mut whitened = self.vector.clone();
        solve_lower_mut(&factor, whitened.as_mut_slice());
        let ln_two_pi = (2.0 * std::f64::consts::PI).ln();
        Ok(0.5 * (whitened.norm_squared() - ln_determinant(&factor) + n as f64 * ln_two_pi))
    }
}

/// Multiplies densities of the same quantities; returns the normalised product and the logarithm of
/// its factor `s₀`.
///
/// `∏ 𝒩(x; μ_ι, Σ_ι) = s₀ 𝒩(x; μ_p, Σ_p)` with `Σ_p = (Σ Σ_ι⁻¹)⁻¹`, `μ_p = Σ_p Σ Σ_ι⁻¹ μ_ι`, (6.41)
/// to (6.43).
///
/// # Errors
/// Returns an error if the list is empty, the sizes differ, or a covariance is not positive
/// definite.
pub fn product(densities: &[Gaussian]) -> Result<(Gaussian, f64), FilterError> {
    let Some(first) = densities.first() else {
        return Err(FilterError::Dimension {
            what: "list of densities",
            found: 0,
            expected: 1,
        });
    };
    let n = first.mean.len();
    let mut sum = Information::none(n);
    let mut log_factor = 0.0;
    for density in densities {
        let found = density.mean.len();
        if found != n {
            return Err(FilterError::Dimension {
                what: "mean of a density",
                found,
                expected: n,
            });
        }
        let information = density.information()?;
        log_factor -= information.log_normaliser()?;
        sum.add(1.0, &information);
    }
    log_factor += sum.log_normaliser()?;
    Ok((sum.gaussian()?, log_factor))
}

/// Inverts a symmetric positive definite matrix by its Cholesky factor.
pub(super) fn inverse(matrix: &DMatrix<f64>) -> Result<DMatrix<f64>, FilterError> {
    let n = matrix.nrows();
    if matrix.ncols() != n {
        return Err(FilterError::Dimension {
            what: "row of a covariance",
            found: matrix.ncols(),
            expected: n,
        });
    }
    let mut factor = matrix.clone();
    cholesky_mut(&mut factor).map_err(not_definite)?;
    let mut inverse = DMatrix::identity(n, n);
    solve_lower_mut(&factor, inverse.as_mut_slice());
    solve_lower_transposed_mut(&factor, inverse.as_mut_slice());
    Ok(inverse)
}

fn not_definite(pivot: usize) -> FilterError {
    FilterError::NotPositiveDefinite {
        what: "covariance of a density",
        pivot,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scalar(mean: f64, std: f64) -> Gaussian {
        Gaussian {
            mean: DVector::from_element(1, mean),
            covariance: DMatrix::from_element(1, 1, std * std),
        }
    }

    #[test]
    fn product_of_three_scalars_has_the_recomputed_moments() {
        // ch6 §3.4 (a); the source prints the variance as a standard deviation
        let densities = [scalar(0.2, 2.0), scalar(0.5, 1.6), scalar(-0.6, 1.1)];
        let (product, log_factor) = product(&densities).unwrap();
        assert!(
            (product.mean[0] + 0.1708).abs() < 1e-4,
            "{}",
            product.mean[0]
        );
        assert!((product.covariance[(0, 0)] - 0.6816).abs() < 1e-4);
        assert!((product.covariance[(0, 0)].sqrt() - 0.8256).abs() < 1e-4);
        // The factor, from the densities themselves at some points.
        let density = |x: f64, g: &Gaussian| {
            let variance = g.covariance[(0, 0)];
            (-(x - g.mean[0]).powi(2) / (2.0 * variance)).exp()
                / (2.0 * std::f64::consts::PI * variance).sqrt()
        };
        for x in [-1.0, 0.3, 2.0] {
            let direct: f64 = densities.iter().map(|g| density(x, g)).product();
            assert!((log_factor.exp() * density(x, &product) / direct - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn product_of_two_bivariate_densities_has_the_recomputed_moments() {
        // ch6 §3.4 (b)
        let density = |mean: [f64; 2], covariance: [f64; 4]| Gaussian {
            mean: DVector::from_row_slice(&mean),
            covariance: DMatrix::from_row_slice(2, 2, &covariance),
        };
        let (product, _) = product(&[
            density([-0.6, -0.5], [8.3, -3.5, -3.5, 2.7]),
            density([2.6, 2.0], [4.3, 4.3, 4.3, 6.7]),
        ])
        .unwrap();
        let expected = [0.5186, -0.6710, 1.0980, 0.0642, 0.0642, 0.8144];
        let measured = product.mean.iter().chain(product.covariance.iter());
        for (measured, expected) in measured.zip(expected) {
            assert!((measured - expected).abs() < 1e-4, "{measured} {expected}");
        }
    }

    #[test]
    fn invalid_covariances_are_rejected() {
        let flat = Gaussian {
            mean: DVector::zeros(2),
            covariance: DMatrix::zeros(2, 2),
        };
        assert!(matches!(
            flat.information(),
            Err(FilterError::NotPositiveDefinite { pivot: 0, .. })
        ));
        let infinite = Gaussian {
            mean: DVector::from_element(1, f64::NAN),
            covariance: DMatrix::identity(1, 1),
        };
        assert!(matches!(
            infinite.information(),
            Err(FilterError::NotFinite { .. })
        ));
        assert!(product(&[]).is_err());
        assert!(product(&[scalar(0.0, 1.0), flat]).is_err());
    }
}
