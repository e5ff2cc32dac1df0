//! The interface between a particle filter and a system.
//!
//! Notation: Ching, Beck, Porter & Shaikhutdinov (2006). `x_k = f(x_{k−1}, u, w)`,
//! `y_k = h(x_k, u) + v` with `w ~ N(0, I_l)` and `v ~ N(0, R)`. `R` may depend on the state, which
//! then contains the noise levels.

use nalgebra::DMatrix;

/// Half-width of the central differences for `∂y/∂w`, in standard deviations of the disturbance.
pub(super) const DIFFERENCE_STEP: f64 = 1e-2;

/// The measured input over one time step; NaN marks a missing sample.
#[derive(Debug, Clone, Copy)]
pub struct Interval<'a> {
    /// The input at the previous frame (p).
    ///
    /// `None` at the first frame if the particles already belong to its time.
    pub previous: Option<&'a [f64]>,
    /// The input at this frame (p).
    pub current: &'a [f64],
    /// The mean square of each input so far (p), as the variance of a missing sample.
    pub mean_square: &'a [f64],
}

/// A system whose only randomness is a standard Gaussian disturbance in each step.
///
/// Sampling the disturbance requires no density of the state. Such a density does not exist if only
/// parameters are disturbed. Each worker thread has its own copy of the model. `&mut self` is only
/// for scratch space: the output of a call must depend only on its arguments. No call may allocate.
pub trait ParticleModel: Clone + Send {
    /// Returns `n`, the length of the state including parameters and noise levels.
    fn state_len(&self) -> usize;

    /// Returns `p`, the number of inputs.
    fn input_len(&self) -> usize;

    /// Returns `l`, the length of the disturbance.
    fn disturbance_len(&self) -> usize;

    /// Returns `q`, the number of observed channels.
    fn observation_len(&self) -> usize;

    /// Replaces `x_{k−1}` by `x_k = f(x_{k−1}, u, w)` in `state` (n).
    ///
    /// Without a previous input, it applies only the changes at the time of the frame itself, often
    /// none. A particle whose state becomes non-finite is removed from the sample.
    fn propagate(&mut self, interval: Interval<'_>, disturbance: &[f64], state: &mut [f64]);

    /// Writes `h(x_k, u_k)` (q, sensor units).
    fn observe(&mut self, interval: Interval<'_>, state: &[f64], out: &mut [f64]);

    /// Writes the covariance `R` of the measurement noise (q × q), which may depend on noise levels
    /// in the state.
    fn sensor_covariance(&mut self, state: &[f64], out: &mut DMatrix<f64>);

    /// Reflects a drawn state into its valid range, for example a negative stiffness.
    fn confine(&self, state: &mut [f64]) {
        let _ = state;
    }

    /// Writes `h(f(x, u, 0), u)` (q) and `J = ∂y/∂w` at `w = 0` (q × l) for a particle at
    /// `x_{k−1}`.
    ///
    /// The default uses central differences with steps of 10⁻² and calls
    /// [`ParticleModel::propagate`] `2 l + 1` times.
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

/// Computes the output and `J` as the default of [`ParticleModel::linearise`].
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

/// Computes one column of `J` from the outputs on both sides.
pub(super) fn difference_to(upper: &[f64], lower: &[f64], column: &mut [f64]) {
    for (entry, (upper, lower)) in column.iter_mut().zip(upper.iter().zip(lower)) {
        *entry = (upper - lower) / (2.0 * DIFFERENCE_STEP);
    }
}

/// Scratch space of the central differences, allocated once.
#[derive(Debug, Clone)]
pub struct DifferenceWorkspace {
    /// A state (n).
    pub(super) moved: Vec<f64>,
    /// A disturbance (l).
    pub(super) disturbance: Vec<f64>,
    /// An output (q).
    pub(super) lower: Vec<f64>,
}

impl DifferenceWorkspace {
    /// Allocates the scratch space for one model.
    #[must_use]
    pub fn new(model: &impl ParticleModel) -> Self {
        Self {
            moved: vec![0.0; model.state_len()],
            disturbance: vec![0.0; model.disturbance_len()],
            lower: vec![0.0; model.observation_len()],
        }
    }
}

/// Reflects a value at the limit that it exceeds; if the reflection exceeds the other limit, the
/// result is that limit.
pub(super) fn reflect(value: f64, lower: f64, upper: f64) -> f64 {
    let mirrored = if value < lower {
        2.0 * lower - value
    } else if value > upper {
        2.0 * upper - value
    } else {
        return value; // also returns NaN unchanged
    };
    mirrored.max(lower).min(upper)
}
