//! Natural frequencies, mode shapes and modal damping of a linear structure.
//!
//! `K φ = ω² M φ` with `φᵀ M φ = 1` is solved as the symmetric problem `L⁻¹ K L⁻ᵀ q = ω² q`, with
//! `M = L Lᵀ` and `φ = L⁻ᵀ q`.

use crate::linear_system::{Damping, LinearSystem};
use nalgebra::{DMatrix, DVector, SymmetricEigen};
use nalgebra_sparse::CsrMatrix;

/// The undamped modes of a structure, lowest frequency first.
#[derive(Debug, Clone)]
pub(crate) struct Modes {
    /// `ω` (rad/s), ascending.
    pub(crate) angular_frequencies: Vec<f64>,
    /// `Φ` (N_d × N_d), one column per mode, with `Φᵀ M Φ = I`.
    pub(crate) shapes: DMatrix<f64>,
}

impl Modes {
    /// The modes of a system without degrees of freedom.
    pub(crate) fn none() -> Self {
        Self {
            angular_frequencies: Vec::new(),
            shapes: DMatrix::zeros(0, 0),
        }
    }

    /// Solves for all modes; `stiffness` is symmetric.
    ///
    /// Returns `None` if `mass` is not positive definite or numbers overflow.
    pub(crate) fn new(mass: DMatrix<f64>, mut stiffness: DMatrix<f64>) -> Option<Self> {
        let l = mass.cholesky()?.unpack();
        l.solve_lower_triangular_mut(&mut stiffness);
        stiffness.transpose_mut();
        l.solve_lower_triangular_mut(&mut stiffness);
        if stiffness.iter().any(|entry| !entry.is_finite()) {
            return None; // the iteration would not terminate
        }
        let transposed = stiffness.transpose();
        let eigen = SymmetricEigen::new((stiffness + transposed) * 0.5);
        let mut order: Vec<usize> = (0..eigen.eigenvalues.len()).collect();
        order.sort_by(|a, b| eigen.eigenvalues[*a].total_cmp(&eigen.eigenvalues[*b]));
        let mut shapes = eigen.eigenvectors.select_columns(&order);
        l.tr_solve_lower_triangular_mut(&mut shapes);
        let angular_frequencies = order
            .iter()
            .map(|mode| eigen.eigenvalues[*mode].max(0.0).sqrt())
            .collect();
        Some(Self {
            angular_frequencies,
            shapes,
        })
    }

    /// Returns `ω_max` (rad/s).
    pub(crate) fn highest(&self) -> f64 {
        self.angular_frequencies.last().copied().unwrap_or(0.0)
    }

    /// Returns `φᵀ X φ` of one mode for a symmetric `X`.
    pub(crate) fn quadratic(&self, mode: usize, x: &DMatrix<f64>) -> f64 {
        let shape: DVector<f64> = self.shapes.column(mode).into_owned();
        (x * &shape).dot(&shape)
    }

    /// Returns `φᵀ X φ` of one mode for a symmetric sparse `X`.
    pub(crate) fn sparse_quadratic(&self, mode: usize, x: &CsrMatrix<f64>) -> f64 {
        let shape = self.shapes.column(mode);
        let entries = x.triplet_iter();
        entries
            .map(|(row, column, value)| shape[row] * value * shape[column])
            .sum()
    }

    /// Returns the damping ratio `φᵀ C φ / 2ω` of each mode.
    ///
    /// The ratio is exact for Rayleigh damping. For a damping matrix that couples the modes, it is
    /// the usual first approximation.
    pub(crate) fn damping_ratios(&self, system: &LinearSystem) -> Vec<f64> {
        let matrix = system.damping.matrix(system.len());
        let ratio = |(mode, omega): (usize, &f64)| {
            let modal = match (&system.damping, &matrix) {
                (
                    Damping::Rayleigh {
                        alpha_per_s,
                        beta_s,
                    },
                    _,
                ) => {
                    // β K uses the stiffness of the springs.
                    alpha_per_s + beta_s * omega * omega / system.initial_slope()
                }
                (_, Some(matrix)) => self.quadratic(mode, matrix),
                (_, None) => 0.0,
            };
            modal / (2.0 * omega)
        };
        self.angular_frequencies
            .iter()
            .enumerate()
            .map(ratio)
            .collect()
    }
}
