//! The two traits that describe a system to a filter: how its state moves, and which quantities are
//! observed.
//!
//! Notation: Huang & Yuen (2023), chapter 2. The state `y` contains the physical state first and
//! the identified parameters `θ` last. `f` is the excitation, held over a step.
//!
//! Jacobians are operators: a model multiplies them with given columns. It need not provide a
//! matrix, because the Jacobian of a structure is sparse.

use crate::constant::ConstantTransition;
use crate::proportional::ProportionalForm;
use nalgebra::DMatrix;

/// The motion of the state: `ẏ = g(y, f)`, equation (2.47).
///
/// The model is first linearised at a point. All other calls then refer to this point until the
/// next linearisation. No call may allocate, because the calls run at every time step.
pub trait ProcessModel {
    /// Returns `n`, the length of the state with its parameters.
    fn state_len(&self) -> usize;

    /// Returns `N_θ`, the number of parameters. They are the last entries of the state, and the
    /// prediction leaves them unchanged.
    fn parameter_len(&self) -> usize;

    /// Returns `N_f`, the number of components of the excitation.
    fn excitation_len(&self) -> usize;

    /// Sets the point for the other calls: `state` (n) and the known part of the excitation (N_f, 0
    /// if unknown).
    fn linearise_process(&mut self, state: &[f64], excitation: &[f64]);

    /// Writes `g(y, f)` (n, state units per second).
    fn derivative(&self, out: &mut [f64]);

    /// Writes `A_y X` (n × c, 1/s) for given columns `X` (n × c), equation (2.50), and overwrites
    /// all of `out`.
    ///
    /// The last `N_θ` rows are zero. `c` may differ between calls.
    fn jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>);

    /// Writes `B_y = ∂g/∂f` (n × N_f), equation (2.51) with the sign of (2.45).
    fn excitation_matrix(&self, out: &mut DMatrix<f64>);

    /// Returns an upper bound of the spectral radius of `A_y` (1/s).
    ///
    /// It determines the length of the series for `exp(A_y Δt)`.
    fn rate_bound(&self) -> f64;

    /// Returns the exact transition over `step_s` (s) of a model whose `A_y`, `B_y` and `H` never
    /// change.
    ///
    /// The filter calls this method once, when it is created. With the default `None`, the filter
    /// discretises the model at every frame.
    fn constant_transition(&self, step_s: f64) -> Option<ConstantTransition> {
        let _ = step_s;
        None
    }

    /// Returns the parts of `A_y` if it is that of a linear structure with proportional damping.
    ///
    /// A model must return them at every point or at none. The derivative is then `[ẋ, ẍ, 0]`, and
    /// the excitation acts on accelerations only. These parts make a step several times faster than
    /// [`Self::jacobian_mul`], which the filter uses for `None`.
    fn proportional_form(&self) -> Option<ProportionalForm<'_>> {
        None
    }
}

/// The observation of the state: `z = h(y, f) + D w + n`, equation (2.57) with a direct term.
///
/// `f` is the known part of the excitation and `w` its unknown part. The direct term `D` is zero
/// for displacements, velocities and absolute accelerations under ground motion. It is nonzero for
/// forces on sensed masses and for relative accelerations.
pub trait ObservationModel {
    /// Returns `N_0`, the number of observed channels.
    fn observation_len(&self) -> usize;

    /// Sets the point for the other calls, as in [`ProcessModel::linearise_process`].
    fn linearise_observation(&mut self, state: &[f64], excitation: &[f64]);

    /// Writes `h(y, f)` (N_0, sensor units), including the direct effect of the known excitation.
    fn observe(&self, out: &mut [f64]);

    /// Writes `H X` (N_0 × c) for given columns `X` (n × c), equation (2.64), and overwrites all of
    /// `out`.
    fn observation_jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>);

    /// Writes `Hᵀ` (n × N_0) and returns `true`, if that is cheap. Its zeros then cost nothing in
    /// `H P`.
    ///
    /// With the default `false`, the filter uses [`Self::observation_jacobian_mul`].
    fn observation_matrix(&self, transposed: &mut DMatrix<f64>) -> bool {
        let _ = transposed;
        false
    }

    /// Returns `D` (N_0 × N_f), or `None` if it is zero.
    fn feedthrough(&self) -> Option<&DMatrix<f64>>;
}
