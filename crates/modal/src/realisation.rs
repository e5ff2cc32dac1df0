//! Poles of state-space models of all orders, from one singular value decomposition.
//!
//! Notation of Döhler & Mevel (2013), Mech. Syst. Signal Process. 38, 346–366: H block Hankel
//! matrix of output covariances, O observability matrix, A state matrix, C output matrix, n order,
//! λ eigenvalue of A. Equation numbers here refer to docs/theory/modal.md.
//!
//! The observability matrix is O = U_n instead of U_n S_n^½. The two differ by a change of the
//! state basis, which leaves poles and shapes unchanged. As the columns of U are orthonormal, O_upᵀ
//! O_up = I − U_lastᵀ U_last, where U_last is the last block row. The models of all orders
//! therefore share their products.

use crate::ModalError;
use crate::dense::{Svd, eigen, svd};
use nalgebra::{Cholesky, Complex, DMatrix, DVector};
use std::f64::consts::PI;

/// Smallest ratio of a singular value to the largest one up to which models are built. Below it,
/// singular vectors are rounding errors.
const SMALLEST_SINGULAR_VALUE: f64 = 1e-12;

/// The decomposition of an epoch and its products for all orders.
#[derive(Debug, Clone)]
pub(crate) struct Realisation {
    pub(crate) svd: Svd,
    /// Number of channels *l*.
    pub(crate) outputs: usize,
    /// O_upᵀ O_up at the highest order.
    gram: DMatrix<f64>,
    /// O_upᵀ O_down at the highest order.
    shifted: DMatrix<f64>,
    /// Sampling rate (Hz).
    pub(crate) rate_hz: f64,
}

/// A pole of a model.
#[derive(Debug, Clone, PartialEq)]
pub struct Pole {
    /// Order of the model.
    pub order: usize,
    /// Natural frequency (Hz).
    pub frequency_hz: f64,
    /// Damping ratio.
    pub damping: f64,
    /// Shape at the usable channels, each scaled to unit variance of its motion.
    pub(crate) shape: DVector<Complex<f64>>,
    /// Position of the eigenvalue in the model.
    pub(crate) position: usize,
}

/// The state matrix of one order and its eigenvectors.
#[derive(Debug, Clone)]
pub(crate) struct Model {
    pub(crate) order: usize,
    /// Eigenvalues of A.
    pub(crate) values: Vec<Complex<f64>>,
    /// Right eigenvectors of A, one per column.
    pub(crate) vectors: DMatrix<Complex<f64>>,
}

impl Realisation {
    /// Decomposes the block Hankel matrix of the `outputs` channels up to the `highest` order.
    pub(crate) fn new(
        hankel: DMatrix<f64>,
        outputs: usize,
        rate_hz: f64,
        highest: usize,
    ) -> Result<Self, ModalError> {
        let rows = hankel.nrows();
        let svd = svd(hankel)?;
        let limit = SMALLEST_SINGULAR_VALUE * svd.s.first().copied().unwrap_or(0.0);
        let rank = svd.s.iter().take_while(|s| **s > limit).count();
        let up_rows = rows - outputs;
        let highest = highest.min(rank).min(up_rows);
        let u = svd.u.columns(0, highest);
        let up = u.rows(0, up_rows);
        let down = u.rows(outputs, up_rows);
        let last = u.rows(up_rows, outputs);
        Ok(Self {
            gram: DMatrix::identity(highest, highest) - last.tr_mul(&last), // O_upᵀ O_up (4)
            shifted: up.tr_mul(&down),                                      // O_upᵀ O_down (4)
            svd,
            outputs,
            rate_hz,
        })
    }

    /// Returns the highest order that the matrix supports.
    pub(crate) fn highest_order(&self) -> usize {
        self.gram.nrows()
    }

    /// Returns the factor of O_upᵀ O_up at an order. Returns `None` if it is singular.
    pub(crate) fn gram_factor(&self, order: usize) -> Option<Cholesky<f64, nalgebra::Dyn>> {
        Cholesky::new(self.gram.view((0, 0), (order, order)).into_owned())
    }

    /// Returns the model of one order, or `None` if the equations are singular.
    pub(crate) fn model(&self, order: usize) -> Result<Option<Model>, ModalError> {
        let Some(factor) = self.gram_factor(order) else {
            return Ok(None);
        };
        // A = O_up⁺ O_down (4)
        let a = factor.solve(&self.shifted.view((0, 0), (order, order)).into_owned());
        let eigen = eigen(&a)?;
        Ok(Some(Model {
            order,
            values: eigen.values,
            vectors: eigen.vectors,
        }))
    }

    /// Returns the oscillating poles of a model, in order of frequency.
    pub(crate) fn poles(&self, model: &Model) -> Vec<Pole> {
        let c = self.svd.u.view((0, 0), (self.outputs, model.order));
        let c = c.map(|value| Complex::new(value, 0.0));
        let mut poles: Vec<Pole> = model
            .values
            .iter()
            .enumerate()
            .filter(|(_, value)| value.im > 0.0)
            .map(|(position, value)| {
                let lambda = value.ln() * self.rate_hz; // λ = ln μ / Δt (5)
                Pole {
                    order: model.order,
                    frequency_hz: lambda.norm() / (2.0 * PI), // f = |λ| / 2π (5)
                    damping: -lambda.re / lambda.norm(),      // ζ = −Re λ / |λ| (5)
                    shape: &c * model.vectors.column(position), // φ = C ψ (5)
                    position,
                }
            })
            .collect();
        poles.sort_by(|a, b| a.frequency_hz.total_cmp(&b.frequency_hz));
        poles
    }
}
