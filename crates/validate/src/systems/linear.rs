//! Linear second-order systems in state space: `M ẍ + C ẋ + K x = T f`, with `C = α M + β K`.

use nalgebra::DMatrix;

/// Returns `M⁻¹ K` (1/s²) of a mass-normalised chain of equal masses and springs, fixed at one end.
pub(crate) fn chain(masses: usize, stiffness_per_mass: f64) -> DMatrix<f64> {
    DMatrix::from_fn(masses, masses, |i, j| match i.abs_diff(j) {
        0 if i + 1 == masses => stiffness_per_mass,
        0 => 2.0 * stiffness_per_mass,
        1 => -stiffness_per_mass,
        _ => 0.0,
    })
}

/// Returns the system matrix (2.4) and input matrix (2.5) under ground motion, for a
/// mass-normalised stiffness.
pub(crate) fn under_ground_motion(
    stiffness: &DMatrix<f64>,
    alpha: f64,
    beta: f64,
) -> (DMatrix<f64>, DMatrix<f64>) {
    let n = stiffness.nrows();
    let mut system = DMatrix::zeros(2 * n, 2 * n);
    system.view_mut((0, n), (n, n)).fill_with_identity();
    system.view_mut((n, 0), (n, n)).copy_from(&-stiffness);
    system
        .view_mut((n, n), (n, n))
        .copy_from(&-(DMatrix::identity(n, n) * alpha + stiffness * beta));
    let input = DMatrix::from_fn(2 * n, 1, |i, _| if i < n { 0.0 } else { -1.0 });
    (system, input)
}
