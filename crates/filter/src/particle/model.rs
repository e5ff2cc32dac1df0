//! What a particle filter asks of a system.
//!
//! Notation: Ching, Beck, Porter & Shaikhutdinov (2006). `x_k = f(x_{k−1}, u, w)`, `y_k = h(x_k, u) + v` with `w ~ N(0, I_l)`
//! and `v ~ N(0, R)`; `R` may depend on the state, which then holds the noise levels.

use nalgebra::DMatrix;

/// Half the width of the central differences for `∂y/∂w`, in standard deviations of the disturbance.
pub(super) const DIFFERENCE_STEP: f64 = 1e-2;

/// The input over one time step, as far as it is measured; NaN marks a missing sample.
#[derive(Debug, Clone, Copy)]
pub struct Interval<'a> {
    /// The input at the frame before (p), or `None` at a first frame to whose instant the particles already belong.
    pub previous: Option<&'a [f64]>,
    /// The input at this frame (p).
    pub current: &'a [f64],
    /// The mean square of each input so far (p): how large a missing sample may have been.
    pub mean_square: &'a [f64],
}

/// A system whose steps are random by a standard Gaussian disturbance alone.
///
/// Sampling in the space of the disturbance needs no density of the state, which does not exist where only parameters are
/// disturbed. Every worker thread has its own copy of a model; `&mut self` is for scratch space only, and what a call
/// writes may depend on nothing but its arguments. None of the calls may allocate.
pub trait ParticleModel: Clone + Send {
    /// Returns `n`, the length of the state with parameters and noise levels.
    fn state_len(&self) -> usize;

    /// Returns `p`, the number of inputs.
    fn input_len(&self) -> usize;

    /// Returns `l`, the length of the disturbance.
    fn disturbance_len(&self) -> usize;

    /// Returns `q`, the number of observed channels.
    fn observation_len(&self) -> usize;

    /// Replaces `x_{k−1}` by `x_k = f(x_{k−1}, u, w)` in `state` (n).
    ///
    /// Without a previous input only what acts at the instant of the frame itself is done, often nothing. A state that is
    /// no longer finite takes the particle out of the sample.
    fn propagate(&mut self, interval: Interval<'_>, disturbance: &[f64], state: &mut [f64]);

    /// Writes `h(x_k, u_k)` (q, sensor units).
    fn observe(&mut self, interval: Interval<'_>, state: &[f64], out: &mut [f64]);

    /// Writes the covariance `R` of the measurement noise (q × q), which may depend on noise levels in the state.
    fn sensor_covariance(&mut self, state: &[f64], out: &mut DMatrix<f64>);

    /// Brings a drawn state back to where it has a meaning, by reflection: a stiffness stays positive.
    fn confine(&self, state: &mut [f64]) {
        let _ = state;
    }

    /// Writes `h(f(x, u, 0), u)` (q) and `J = ∂y/∂w` at `w = 0` (q × l) for a particle at `x_{k−1}`.
    ///
    /// By default from central differences with steps of 10⁻², which cost `2 l + 1` calls of [`ParticleModel::propagate`].
    fn linearise(
        &mut self,
        interval: Interval<'_>,
        state: &[f64],
        output: &mut [f64],
        jacobian: &mut DMatrix<f64>,
        work: &mut DifferenceWorkspace,
    ) {
        central_differences(self, interval, state, output, jacobian, work);
    }
}

/// Writes output and `J` as [`ParticleModel::linearise`] does by default.
pub(super) fn central_differences(
    model: &mut impl ParticleModel,
    interval: Interval<'_>,
    state: &[f64],
    output: &mut [f64],
    jacobian: &mut DMatrix<f64>,
    work: &mut DifferenceWorkspace,
) {
    let DifferenceWorkspace {
        moved,
        disturbance,
        lower,
    } = work;
    disturbance.fill(0.0);
    for j in 0..disturbance.len() {
        for (side, out) in [
            (-DIFFERENCE_STEP, lower.as_mut_slice()),
            (DIFFERENCE_STEP, &mut *output),
        ] {
            disturbance[j] = side;
            moved.copy_from_slice(state);
            model.propagate(interval, disturbance, moved);
            model.observe(interval, moved, out);
        }
        disturbance[j] = 0.0;
        difference_to(
            output,
            lower,
            &mut jacobian.as_mut_slice()[j * lower.len()..(j + 1) * lower.len()],
        );
    }
    moved.copy_from_slice(state);
    model.propagate(interval, disturbance, moved);
    model.observe(interval, moved, output);
}

/// Writes one column of `J` from the outputs on both sides.
pub(super) fn difference_to(upper: &[f64], lower: &[f64], column: &mut [f64]) {
    for (entry, (upper, lower)) in column.iter_mut().zip(upper.iter().zip(lower)) {
        *entry = (upper - lower) / (2.0 * DIFFERENCE_STEP);
    }
}

/// Scratch space of the central differences, made once.
#[derive(Debug, Clone)]
pub struct DifferenceWorkspace {
    /// a state (n)
    pub(super) moved: Vec<f64>,
    /// a disturbance (l)
    pub(super) disturbance: Vec<f64>,
    /// an output (q)
    pub(super) lower: Vec<f64>,
}

impl DifferenceWorkspace {
    /// Makes the scratch space for one model.
    #[must_use]
    pub fn new(model: &impl ParticleModel) -> Self {
        Self {
            moved: vec![0.0; model.state_len()],
            disturbance: vec![0.0; model.disturbance_len()],
            lower: vec![0.0; model.observation_len()],
        }
    }
}

/// Mirrors a value at the nearest limit that it has passed; a value beyond the other limit after that is put on it.
pub(super) fn reflect(value: f64, lower: f64, upper: f64) -> f64 {
    let mirrored = if value < lower {
        2.0 * lower - value
    } else if value > upper {
        2.0 * upper - value
    } else {
        return value; // NaN comes here too, and stays what it is
    };
    mirrored.max(lower).min(upper)
}
