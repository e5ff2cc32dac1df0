//! A step through the accelerations that displacements and parameters cause.

use crate::product::{Extent, Left, Multiplier, Right, Sum};
use nalgebra::DMatrix;

/// What a step through the accelerations needs.
#[derive(Debug, Clone)]
pub(super) struct Accelerations {
    /// `[Z, 0, h² W]ᵀ` (n × N_d)
    pub(super) transposed: DMatrix<f64>,
    pub(super) by_state: Right,
    /// `[h q̂, ŝ]ᵀ` and `[I − Gs − (α + βG) q, q̂/h]ᵀ` (2N_d × N_d)
    pub(super) by_motion: [Right; 2],
    /// `Σ [Z, 0, h² W]ᵀ` (n × N_d)
    pub(super) half_way: DMatrix<f64>,
    /// `[Φ, ΨW] Σ [Z, 0, h² W]ᵀ` (2N_d × N_d)
    pub(super) whole_way: DMatrix<f64>,
}

impl Accelerations {
    pub(super) fn new(free: usize, parameters: usize) -> Self {
        let n = 2 * free + parameters;
        let by_motion = || Right::new(2 * free, free, 2);
        Self {
            transposed: DMatrix::zeros(n, free),
            by_state: Right::new(n, free, 1 + parameters.div_ceil(2)),
            by_motion: [by_motion(), by_motion()],
            half_way: DMatrix::zeros(n, free),
            whole_way: DMatrix::zeros(2 * free, free),
        }
    }
}

/// Which entries of a covariance are wanted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Triangle {
    Both,
    Lower,
}

impl Accelerations {
    /// Writes `factor · X [Φ, ΨW]ᵀ` for `X` (m × n) into the first rows and columns of `out`.
    pub(super) fn apply_to(
        &mut self,
        x: &DMatrix<f64>,
        triangle: Triangle,
        factor: f64,
        out: &mut DMatrix<f64>,
        multiplier: Multiplier,
    ) {
        let Self { by_state, by_motion: [of_x, of_v], half_way, whole_way, .. } = self;
        let free = half_way.ncols() as isize;
        let caused = if triangle == Triangle::Both { half_way } else { whole_way };
        let extent = |from: isize| if triangle == Triangle::Both { Extent::Full } else { Extent::Lower { from } };
        multiplier.multiply_to(Left::new(x), by_state, extent(-free), Sum::PLAIN, caused);
        let free = caused.ncols();
        let left = Left::joined(x, free..2 * free, caused);
        let sum = Sum { factor, start: Some(x) };
        multiplier.multiply_to_columns(left, of_x, extent(0), sum, 0, out);
        multiplier.multiply_to_columns(left, of_v, extent(free as isize), Sum::scaled(factor), free, out);
    }
}
