//! Continuous systems with measured input and drifting parameters, as in both examples of the
//! source.
//!
//! Source: Ching, Beck, Porter & Shaikhutdinov (2006). Mechanical states obey `ẋ = g(x, θ, u)`.
//! Parameters and noise levels obey `θ̇ = G w`, in discrete time `θ_k = θ_{k−1} + G w_{k−1}` with a
//! diagonal `G`. With large entries of `G`, the estimate follows recent data. With small entries,
//! it has a long memory.

use super::model::{
    DIFFERENCE_STEP, DifferenceWorkspace, Interval, ParticleModel, central_differences,
    difference_to, reflect,
};
use crate::error::FilterError;
use nalgebra::DMatrix;

/// A system `ẋ = g(x, θ, u)`, `y = h(x, θ, u) + diag(σ) v` with the state `[x, θ, σ]`.
pub trait ContinuousSystem: Clone + Send {
    /// Returns the number of mechanical states, at the start of the state.
    fn mechanical_len(&self) -> usize;

    /// Returns the number of parameters and noise levels, at the end of the state.
    fn drifting_len(&self) -> usize;

    /// Returns the number of inputs `p`, which are all measured.
    fn input_len(&self) -> usize;

    /// Returns the number of observed channels `q`.
    fn observation_len(&self) -> usize;

    /// Writes the time derivative of the mechanical states (units per second), computed from the
    /// whole state.
    fn derivative(&self, state: &[f64], input: &[f64], out: &mut [f64]);

    /// Writes the output without noise (q).
    fn output(&self, state: &[f64], input: &[f64], out: &mut [f64]);

    /// Writes the standard deviation of the noise of each channel (q).
    fn noise_std(&self, state: &[f64], out: &mut [f64]);
}

/// The time within a step at which the parameter increment acts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum IncrementTime {
    /// Before the integration.
    ///
    /// Required if the parameters affect the output only through the integrated states.
    Start,
    /// After the integration.
    ///
    /// Valid if the output itself contains the parameters. The Jacobian then requires only one
    /// integration.
    End,
}

/// Adapter that makes a particle model from a [`ContinuousSystem`].
///
/// It integrates with classical Runge-Kutta substeps with held input, and adds the drift.
#[derive(Debug, Clone)]
pub struct Drifting<S> {
    system: S,
    step_s: f64,
    substeps: usize,
    increment_time: IncrementTime,
    drift_std: Vec<f64>,
    lower: Vec<f64>,
    input: Vec<f64>,
    stage: Vec<f64>,
    slope: Vec<f64>,
    sum: Vec<f64>,
    noise_std: Vec<f64>,
}

impl<S: ContinuousSystem> Drifting<S> {
    /// Creates a discrete model of `system`.
    ///
    /// - `step_s`: time between frames (s), divided into `substeps`
    /// - `drift_std`: standard deviation of the increment of each parameter and noise level per
    ///   step, the diagonal of `G`
    /// - `lower`: limit at which each parameter and noise level is reflected (same units), minus
    ///   infinity for none
    ///
    /// # Errors
    /// Returns an error if a length does not fit or a number is out of range.
    pub fn new(
        system: S,
        step_s: f64,
        substeps: usize,
        increment_time: IncrementTime,
        drift_std: Vec<f64>,
        lower: Vec<f64>,
    ) -> Result<Self, FilterError> {
        let expected = system.drifting_len();
        FilterError::check_sizes([
            ("drift", drift_std.len(), expected),
            ("lower limit of the drift", lower.len(), expected),
        ])?;
        if !(step_s > 0.0 && step_s.is_finite()) {
            return Err(FilterError::Setting {
                what: "time step",
                found: step_s,
                allowed: "positive",
            });
        }
        if substeps == 0 {
            return Err(FilterError::Setting {
                what: "number of substeps",
                found: 0.0,
                allowed: "positive",
            });
        }
        check_drift(&drift_std)?;
        let (mechanical, q) = (system.mechanical_len(), system.observation_len());
        Ok(Self {
            input: vec![0.0; system.input_len()],
            stage: vec![0.0; mechanical + expected],
            slope: vec![0.0; mechanical],
            sum: vec![0.0; mechanical],
            noise_std: vec![0.0; q],
            system,
            step_s,
            substeps,
            increment_time,
            drift_std,
            lower,
        })
    }

    /// Returns the system.
    pub fn system(&self) -> &S {
        &self.system
    }

    fn drift(&self, disturbance: &[f64], state: &mut [f64]) {
        let parameters = &mut state[self.system.mechanical_len()..];
        for (j, parameter) in parameters.iter_mut().enumerate() {
            *parameter = reflect(
                *parameter + self.drift_std[j] * disturbance[j],
                self.lower[j],
                f64::INFINITY,
            );
        }
    }

    /// Stores an input; a missing sample counts as zero, the mean of an excitation.
    fn take_input(&mut self, input: &[f64]) {
        for (entry, value) in self.input.iter_mut().zip(input) {
            *entry = if value.is_nan() { 0.0 } else { *value };
        }
    }

    /// Integrates the mechanical states over one step with held input.
    fn integrate(&mut self, state: &mut [f64]) {
        let Self {
            system,
            step_s,
            substeps,
            input,
            stage,
            slope,
            sum,
            ..
        } = self;
        let h = *step_s / *substeps as f64;
        stage.copy_from_slice(state);
        let mechanical = slope.len();
        for _ in 0..*substeps {
            sum.fill(0.0);
            for (weight, reach) in [(1.0, 0.5), (2.0, 0.5), (2.0, 1.0), (1.0, 0.0)] {
                system.derivative(stage, input, slope);
                for i in 0..mechanical {
                    sum[i] += weight * slope[i];
                    stage[i] = state[i] + reach * h * slope[i];
                }
            }
            for i in 0..mechanical {
                state[i] += h / 6.0 * sum[i];
            }
            stage[..mechanical].copy_from_slice(&state[..mechanical]);
        }
    }
}

impl<S: ContinuousSystem> ParticleModel for Drifting<S> {
    fn state_len(&self) -> usize {
        self.stage.len()
    }

    fn input_len(&self) -> usize {
        self.input.len()
    }

    fn disturbance_len(&self) -> usize {
        self.drift_std.len()
    }

    fn observation_len(&self) -> usize {
        self.noise_std.len()
    }

    fn propagate(&mut self, interval: Interval<'_>, disturbance: &[f64], state: &mut [f64]) {
        let Some(previous) = interval.previous else {
            return;
        };
        self.take_input(previous);
        match self.increment_time {
            IncrementTime::Start => {
                self.drift(disturbance, state);
                self.integrate(state);
            }
            IncrementTime::End => {
                self.integrate(state);
                self.drift(disturbance, state);
            }
        }
    }

    fn observe(&mut self, interval: Interval<'_>, state: &[f64], out: &mut [f64]) {
        self.take_input(interval.current);
        self.system.output(state, &self.input, out);
    }

    fn sensor_covariance(&mut self, state: &[f64], out: &mut DMatrix<f64>) {
        self.system.noise_std(state, &mut self.noise_std);
        out.fill(0.0);
        for (j, std) in self.noise_std.iter().enumerate() {
            out[(j, j)] = std * std;
        }
    }

    fn confine(&self, state: &mut [f64]) {
        let parameters = &mut state[self.system.mechanical_len()..];
        for (parameter, lower) in parameters.iter_mut().zip(&self.lower) {
            *parameter = reflect(*parameter, *lower, f64::INFINITY);
        }
    }

    fn linearise(
        &mut self,
        interval: Interval<'_>,
        state: &[f64],
        output: &mut [f64],
        jacobian: &mut DMatrix<f64>,
        work: &mut DifferenceWorkspace,
    ) {
        if interval.previous.is_none() {
            jacobian.fill(0.0); // nothing moves before the first frame
            self.observe(interval, state, output);
            return;
        }
        if self.increment_time == IncrementTime::Start {
            central_differences(self, interval, state, output, jacobian, work);
            return;
        }
        let DifferenceWorkspace {
            moved,
            disturbance,
            lower,
        } = work;
        disturbance.fill(0.0);
        moved.copy_from_slice(state);
        self.propagate(interval, disturbance, moved);
        let (mechanical, q) = (self.system.mechanical_len(), lower.len());
        for j in 0..disturbance.len() {
            let parameter = moved[mechanical + j];
            for (side, out) in [
                (-DIFFERENCE_STEP, lower.as_mut_slice()),
                (DIFFERENCE_STEP, &mut *output),
            ] {
                moved[mechanical + j] = parameter + self.drift_std[j] * side;
                self.observe(interval, moved, out);
            }
            moved[mechanical + j] = parameter;
            difference_to(
                output,
                lower,
                &mut jacobian.as_mut_slice()[j * q..(j + 1) * q],
            );
        }
        self.observe(interval, moved, output);
    }
}

/// Checks that no drift is negative or not finite.
pub(super) fn check_drift(drift_std: &[f64]) -> Result<(), FilterError> {
    match drift_std
        .iter()
        .find(|std| !(**std >= 0.0 && std.is_finite()))
    {
        None => Ok(()),
        Some(found) => Err(FilterError::Setting {
            what: "drift per step",
            found: *found,
            allowed: "finite and not negative",
        }),
    }
}
