//! Integration of the mechanical states of a system.

use nalgebra::DVector;
use spandrel_filter::ContinuousSystem;

/// Integrates the mechanical states of a system over one step with constant input, by classical
/// Runge-Kutta substeps.
pub(crate) fn integrate(
    system: &impl ContinuousSystem,
    state: &mut [f64],
    input: &[f64],
    step_s: f64,
    substeps: usize,
) {
    let mechanical = system.mechanical_len();
    let h = step_s / substeps as f64;
    let slope_at = |start: &[f64], slope: &DVector<f64>, reach: f64| {
        let mut stage = start.to_vec();
        (0..mechanical).for_each(|i| stage[i] += reach * slope[i]);
        let mut out = DVector::zeros(mechanical);
        system.derivative(&stage, input, out.as_mut_slice());
        out
    };
    for _ in 0..substeps {
        let k1 = slope_at(state, &DVector::zeros(mechanical), 0.0);
        let k2 = slope_at(state, &k1, 0.5 * h);
        let k3 = slope_at(state, &k2, 0.5 * h);
        let k4 = slope_at(state, &k3, h);
        (0..mechanical)
            .for_each(|i| state[i] += h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]));
    }
}
