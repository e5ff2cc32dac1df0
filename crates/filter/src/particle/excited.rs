//! Any system with the two traits of the Kalman filters as a particle filter sees it.
//!
//! The disturbance of a step is `w = [w_f, w_θ]`: the unknown excitation `L_f w_f` with `L_f L_fᵀ = Σ_f`, held over the
//! step, and the increment `G w_θ` of the parameters, which acts at its beginning. Notation: Huang & Yuen (2023), §2.4, for
//! the prediction, which is that of the extended Kalman filter around each particle; Ching, Beck, Porter & Shaikhutdinov
//! (2006) for the drift of the parameters.
//!
//! Where sensors feel the excitation of their own instant (`D ≠ 0`), `w_f` is that of the frame: the observation weighs it,
//! the state keeps it in `N_f` entries behind the parameters, and it acts on the motion over the coming step.

use super::GaussianStart;
use super::drifting::check_drift;
use super::model::{DifferenceWorkspace, Interval, ParticleModel, reflect};
use crate::discretise::{self, InputHold, Series};
use crate::error::FilterError;
use crate::extended::{ExtendedKalmanFilter, FilterSettings};
use crate::model::{ObservationModel, ProcessModel};
use crate::noise::{NoiseModel, NoiseTarget};
use crate::update::ExcitationPosterior;
use nalgebra::{DMatrix, DVector};

/// A pivot below this share of its diagonal entry is a direction in which the excitation does not vary.
const ZERO_PIVOT: f64 = 1e-14;

/// A particle that needs so many times the substeps of the prior has diverged. It would take as long as all others together.
const DIVERGED_SUBSTEPS: usize = 20;

/// A [`ProcessModel`] and [`ObservationModel`] whose particles differ by unknown excitation and drifting parameters.
///
/// State: `[y, w]`, the state `y` (n) of the model with its parameters last, and the excitation `w` (N_f) of the last frame
/// if the model has a direct term. Of the settings of the Kalman filter it uses the time step, the limits, the noises at
/// their start and the hold of the known excitation. It uses neither the fading factor nor the bounds of the variances
/// (the drift sets the memory), nor the start-up aid.
#[derive(Debug, Clone)]
pub struct ExcitedSystem<M> {
    model: M,
    step_s: f64,
    input_hold: InputHold,
    drift_std: DVector<f64>,
    lower: DVector<f64>,
    upper: DVector<f64>,
    noise: NoiseModel,
    /// Σ_n (N_0 × N_0)
    sensors: DMatrix<f64>,
    /// Σ_f and its factor, and a factor for frames with missing samples (N_f × N_f)
    excitation: DMatrix<f64>,
    excitation_factor: DMatrix<f64>,
    missing_factor: DMatrix<f64>,
    work: Workspace,
    /// substeps from which on a particle counts as diverged
    most_substeps: usize,
}

#[derive(Debug, Clone)]
struct Workspace {
    /// known excitation at both ends of the step, and the whole one that acts (N_f)
    older: DVector<f64>,
    newer: DVector<f64>,
    acting: DVector<f64>,
    /// B_y ḟ (n)
    ramp: DVector<f64>,
    /// B_y (n × N_f)
    input_matrix: DMatrix<f64>,
    /// Γ g (n × 1)
    increment: DMatrix<f64>,
    /// [Γ g, Γ B_y] (n × (1 + N_f))
    inputs: DMatrix<f64>,
    /// what an excitation and the drift of the parameters do to the predicted state (n × N_f, n × N_θ)
    by_excitation: DMatrix<f64>,
    by_parameter: DMatrix<f64>,
    /// and to the output (N_0 × N_f, N_0 × N_θ)
    seen_excitation: DMatrix<f64>,
    seen_parameter: DMatrix<f64>,
    motion: discretise::Workspace,
    excitations: discretise::Workspace,
    parameters: discretise::Workspace,
}

impl<M: ProcessModel + ObservationModel + Clone + Send> ExcitedSystem<M> {
    /// Makes a system from a model and the settings of its Kalman filter.
    ///
    /// `drift_std`: standard deviation of the increment of each parameter per step (N_θ, parameter units).
    ///
    /// # Errors
    /// When a size does not fit the model, or a setting lies outside its range.
    pub fn new(
        model: M,
        settings: &FilterSettings,
        drift_std: DVector<f64>,
    ) -> Result<Self, FilterError> {
        settings.check(&model)?;
        let (n, parameters) = (model.state_len(), model.parameter_len());
        let (inputs, channels) = (model.excitation_len(), model.observation_len());
        if drift_std.len() != parameters {
            let (what, found) = ("drift of the parameters", drift_std.len());
            return Err(FilterError::Dimension {
                what,
                found,
                expected: parameters,
            });
        }
        check_drift(drift_std.as_slice())?;
        let square = || DMatrix::zeros(inputs, inputs);
        let mut model = model;
        model.linearise_process(settings.prior_mean.as_slice(), &vec![0.0; inputs]);
        let most_substeps =
            DIVERGED_SUBSTEPS * Series::choose(model.rate_bound(), settings.step_s).substeps;
        let mut system = Self {
            most_substeps,
            step_s: settings.step_s,
            input_hold: settings.input_hold,
            drift_std,
            lower: settings.lower.clone(),
            upper: settings.upper.clone(),
            noise: settings.noise.clone(),
            sensors: DMatrix::zeros(channels, channels),
            excitation: square(),
            excitation_factor: square(),
            missing_factor: square(),
            work: Workspace {
                older: DVector::zeros(inputs),
                newer: DVector::zeros(inputs),
                acting: DVector::zeros(inputs),
                ramp: DVector::zeros(n),
                input_matrix: DMatrix::zeros(n, inputs),
                increment: DMatrix::zeros(n, 1),
                inputs: DMatrix::zeros(n, 1 + inputs),
                by_excitation: DMatrix::zeros(n, inputs),
                by_parameter: DMatrix::zeros(n, parameters),
                seen_excitation: DMatrix::zeros(channels, inputs),
                seen_parameter: DMatrix::zeros(channels, parameters),
                motion: discretise::Workspace::new(n, 0),
                excitations: discretise::Workspace::new(n, inputs),
                parameters: discretise::Workspace::new(n, parameters),
            },
            model,
        };
        let levels = DVector::from_iterator(
            settings.noise.parameters.len(),
            settings.noise.parameters.iter().map(|p| p.start),
        );
        system.take_noise_levels(&levels)?;
        Ok(system)
    }

    /// Returns the model.
    pub fn model(&self) -> &M {
        &self.model
    }

    /// Sets the identified noise levels `ψ` (N_ψ), for instance to what a Kalman filter has found.
    ///
    /// # Errors
    /// When there are more or fewer levels than the settings name, or the covariance of the excitation is not positive
    /// semidefinite.
    pub fn take_noise_levels(&mut self, levels: &DVector<f64>) -> Result<(), FilterError> {
        let expected = self.noise.parameters.len();
        if levels.len() != expected {
            return Err(FilterError::Dimension {
                what: "noise levels",
                found: levels.len(),
                expected,
            });
        }
        self.noise
            .covariance_to(NoiseTarget::Sensors, levels, &mut self.sensors);
        self.noise
            .covariance_to(NoiseTarget::Excitation, levels, &mut self.excitation);
        self.excitation_factor.copy_from(&self.excitation);
        semidefinite_cholesky_mut(&mut self.excitation_factor)
    }

    /// Returns the prior of the settings as a start: it is for the instant of the first frame.
    #[must_use]
    pub fn start_at_prior(&self, settings: &FilterSettings) -> GaussianStart {
        let (n, len) = (self.model.state_len(), self.state_len());
        let mut start = GaussianStart {
            mean: DVector::zeros(len),
            covariance: DMatrix::zeros(len, len),
            previous_input: None,
        };
        start.mean.rows_mut(0, n).copy_from(&settings.prior_mean);
        for j in 0..n {
            start.covariance[(j, j)] = settings.prior_std[j] * settings.prior_std[j];
        }
        start
    }

    /// Returns the estimate of a Kalman filter after its last frame as a start, with all correlations.
    #[must_use]
    pub fn start_after(&self, filter: &ExtendedKalmanFilter<M>) -> GaussianStart {
        let (n, len) = (self.model.state_len(), self.state_len());
        let mut mean = DVector::zeros(len);
        let mut covariance = DMatrix::zeros(len, len);
        mean.rows_mut(0, n).copy_from(filter.mean());
        covariance
            .view_mut((0, 0), (n, n))
            .copy_from(filter.covariance());
        if let Some(ExcitationPosterior {
            mean: w,
            covariance: of_w,
            cross,
            ..
        }) = filter.excitation_posterior()
        {
            mean.rows_mut(n, w.len()).copy_from(w);
            covariance.view_mut((n, n), of_w.shape()).copy_from(of_w);
            covariance.view_mut((0, n), cross.shape()).copy_from(cross);
            covariance
                .view_mut((n, 0), (w.len(), n))
                .copy_from(&cross.transpose());
        }
        GaussianStart {
            mean,
            covariance,
            previous_input: Some(filter.last_excitation().clone()),
        }
    }

    /// Sorts out what is known of the excitation; a missing sample is taken as zero, and is uncertain.
    fn take_known(&mut self, interval: Interval<'_>) {
        let Workspace { older, newer, .. } = &mut self.work;
        let known = |value: f64| if value.is_nan() { 0.0 } else { value };
        for j in 0..newer.len() {
            newer[j] = known(interval.current[j]);
            older[j] = interval.previous.map_or(0.0, |previous| known(previous[j]));
        }
    }

    /// Returns `L_f` for a frame: a missing sample adds as much as the known excitation has been large.
    fn factor(&mut self, samples: &[f64], mean_square: &[f64]) -> &DMatrix<f64> {
        if !samples.iter().any(|value| value.is_nan()) {
            return &self.excitation_factor;
        }
        self.missing_factor.copy_from(&self.excitation);
        for (j, value) in samples.iter().enumerate() {
            if value.is_nan() {
                self.missing_factor[(j, j)] += mean_square[j];
            }
        }
        match semidefinite_cholesky_mut(&mut self.missing_factor) {
            Ok(()) => &self.missing_factor,
            // a larger diagonal cannot spoil a matrix that had a factor
            Err(_) => &self.excitation_factor,
        }
    }

    /// Writes the slope of the motion from the known excitation through the step, if it is not held.
    fn take_ramp(&mut self) {
        let Self { step_s, work, .. } = self;
        let Workspace {
            older,
            newer,
            ramp,
            input_matrix,
            ..
        } = work;
        ramp.gemv(1.0 / *step_s, input_matrix, newer, 0.0);
        ramp.gemv(-1.0 / *step_s, input_matrix, older, 1.0);
    }

    /// Returns `true` if the motion at which the model is linearised needs far more substeps than that of the prior.
    fn has_diverged(&self) -> bool {
        Series::choose(self.model.rate_bound(), self.step_s).substeps > self.most_substeps
    }

    /// Linearises the process at a state with the excitation that acts on it over the step.
    fn linearise_motion(&mut self, state: &[f64], noise: &[f64], interval: Interval<'_>) {
        let n = self.model.state_len();
        self.work.acting.copy_from(&self.work.older);
        if state.len() > n {
            for (acting, w) in self.work.acting.iter_mut().zip(&state[n..]) {
                *acting += w;
            }
        } else if let Some(previous) = interval.previous {
            let count = noise.len();
            for j in 0..count {
                let factor = self.factor(previous, interval.mean_square);
                let w: f64 = (0..=j).map(|k| factor[(j, k)] * noise[k]).sum();
                self.work.acting[j] += w;
            }
        }
        self.model
            .linearise_process(&state[..n], self.work.acting.as_slice());
    }
}

impl<M: ProcessModel + ObservationModel + Clone + Send> ParticleModel for ExcitedSystem<M> {
    fn state_len(&self) -> usize {
        self.model.state_len()
            + self
                .model
                .feedthrough()
                .map_or(0, |_| self.model.excitation_len())
    }

    fn input_len(&self) -> usize {
        self.model.excitation_len()
    }

    fn disturbance_len(&self) -> usize {
        self.model.excitation_len() + self.model.parameter_len()
    }

    fn observation_len(&self) -> usize {
        self.model.observation_len()
    }

    fn propagate(&mut self, interval: Interval<'_>, disturbance: &[f64], state: &mut [f64]) {
        self.take_known(interval);
        let (n, inputs) = (self.model.state_len(), self.model.excitation_len());
        let (noise, increments) = disturbance.split_at(inputs);
        if interval.previous.is_some() {
            let first = n - increments.len();
            for (j, increment) in increments.iter().enumerate() {
                let moved = state[first + j] + self.drift_std[j] * increment; // θ ← θ + G w_θ
                state[first + j] = reflect(moved, self.lower[first + j], self.upper[first + j]);
            }
            self.linearise_motion(state, noise, interval);
            if self.has_diverged() {
                state.fill(f64::NAN); // which takes the particle out
                return;
            }
            self.model.derivative(self.work.increment.as_mut_slice());
            if self.input_hold == InputHold::First {
                self.model.excitation_matrix(&mut self.work.input_matrix);
                self.take_ramp();
            }
            let Self {
                model,
                step_s,
                input_hold,
                work,
                ..
            } = self;
            let Workspace {
                increment,
                ramp,
                motion,
                ..
            } = work;
            let ramp = (*input_hold == InputHold::First).then_some(ramp.as_slice());
            let series = Series::choose(model.rate_bound(), *step_s);
            discretise::integrate_inputs(model, *step_s, series, increment, ramp, motion);
            for (value, increment) in state.iter_mut().zip(increment.iter()) {
                *value += increment; // y ← y + Γ g                                     (2.67)
            }
        }
        if state.len() > n {
            let factor = self.factor(interval.current, interval.mean_square);
            for (j, w) in state[n..].iter_mut().enumerate() {
                *w = (0..=j).map(|k| factor[(j, k)] * noise[k]).sum();
            }
        }
    }

    fn observe(&mut self, interval: Interval<'_>, state: &[f64], out: &mut [f64]) {
        self.take_known(interval);
        let n = self.model.state_len();
        self.model
            .linearise_observation(&state[..n], self.work.newer.as_slice());
        self.model.observe(out);
        if let Some(direct) = self.model.feedthrough() {
            for (b, w) in state[n..].iter().enumerate() {
                for (a, value) in out.iter_mut().enumerate() {
                    *value += direct[(a, b)] * w; // h(y, f) + D w                         (2.57)
                }
            }
        }
    }

    fn sensor_covariance(&mut self, _: &[f64], out: &mut DMatrix<f64>) {
        out.copy_from(&self.sensors);
    }

    fn confine(&self, state: &mut [f64]) {
        for (j, value) in state.iter_mut().enumerate().take(self.lower.len()) {
            *value = reflect(*value, self.lower[j], self.upper[j]);
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
        let DifferenceWorkspace {
            moved, disturbance, ..
        } = work;
        disturbance.fill(0.0);
        let (n, inputs) = (self.model.state_len(), self.model.excitation_len());
        let direct = state.len() > n;
        moved.copy_from_slice(state);
        jacobian.fill(0.0);
        if interval.previous.is_some() {
            self.take_known(interval);
            self.linearise_motion(state, &disturbance[..inputs], interval);
            if self.has_diverged() {
                output.fill(f64::NAN); // no density from here, and no weight after the step
                return;
            }
            self.predict_columns(interval, moved, direct);
        }
        if direct {
            moved[n..].fill(0.0);
        }
        self.observe(interval, moved, output);
        if interval.previous.is_some() {
            let Self { model, work, .. } = self;
            let Workspace {
                by_excitation,
                by_parameter,
                seen_excitation,
                seen_parameter,
                ..
            } = work;
            model.observation_jacobian_mul(by_parameter, seen_parameter);
            jacobian
                .columns_mut(inputs, seen_parameter.ncols())
                .copy_from(seen_parameter); // H A G
            if !direct {
                model.observation_jacobian_mul(by_excitation, seen_excitation);
                jacobian.columns_mut(0, inputs).copy_from(seen_excitation); // H Γ B_y L_f
            }
        }
        if direct {
            self.factor(interval.current, interval.mean_square);
            let missing = interval.current.iter().any(|value| value.is_nan());
            let factor = if missing {
                &self.missing_factor
            } else {
                &self.excitation_factor
            };
            if let Some(direct) = self.model.feedthrough() {
                for k in 0..inputs {
                    for b in k..inputs {
                        for a in 0..direct.nrows() {
                            jacobian[(a, k)] += direct[(a, b)] * factor[(b, k)]; // D L_f
                        }
                    }
                }
            }
        }
    }
}

impl<M: ProcessModel + ObservationModel + Clone + Send> ExcitedSystem<M> {
    /// Writes the state predicted without disturbance into `state`, and what the disturbances add to it, `Γ B_y L_f` and
    /// `A [0; G]`, for the process as it is linearised.
    fn predict_columns(&mut self, interval: Interval<'_>, state: &mut [f64], direct: bool) {
        self.model.excitation_matrix(&mut self.work.input_matrix);
        if self.input_hold == InputHold::First {
            self.take_ramp();
        }
        let n = self.model.state_len();
        let Self {
            model,
            step_s,
            input_hold,
            work,
            drift_std,
            ..
        } = self;
        model.derivative(&mut work.inputs.as_mut_slice()[..n]);
        work.inputs.as_mut_slice()[n..].copy_from_slice(work.input_matrix.as_slice());
        let ramp = (*input_hold == InputHold::First).then_some(work.ramp.as_slice());
        let series = Series::choose(model.rate_bound(), *step_s);
        discretise::integrate_inputs(
            model,
            *step_s,
            series,
            &mut work.inputs,
            ramp,
            &mut work.excitations,
        );
        for (value, increment) in state.iter_mut().zip(&work.inputs.as_slice()[..n]) {
            *value += increment;
        }
        if !drift_std.is_empty() {
            let first = n - drift_std.len();
            work.by_parameter.fill(0.0);
            for (j, std) in drift_std.iter().enumerate() {
                work.by_parameter[(first + j, j)] = *std;
            }
            discretise::transition_mul_narrow(
                model,
                *step_s,
                series,
                &mut work.by_parameter,
                &mut work.parameters,
            );
        }
        if let (false, Some(previous)) = (direct, interval.previous) {
            self.factor(previous, interval.mean_square);
            let missing = previous.iter().any(|value| value.is_nan());
            let factor = if missing {
                &self.missing_factor
            } else {
                &self.excitation_factor
            };
            let Workspace {
                inputs,
                by_excitation,
                ..
            } = &mut self.work;
            by_excitation.fill(0.0);
            for k in 0..factor.ncols() {
                for b in k..factor.nrows() {
                    by_excitation
                        .column_mut(k)
                        .axpy(factor[(b, k)], &inputs.column(1 + b), 1.0);
                }
            }
        }
    }
}

/// Replaces a symmetric positive semidefinite matrix by a lower triangular `L` with `L Lᵀ`; known inputs are zero rows.
fn semidefinite_cholesky_mut(matrix: &mut DMatrix<f64>) -> Result<(), FilterError> {
    let n = matrix.nrows();
    for j in 0..n {
        let diagonal = matrix[(j, j)];
        let pivot = diagonal - (0..j).map(|k| matrix[(j, k)] * matrix[(j, k)]).sum::<f64>();
        let zero = pivot.abs() <= ZERO_PIVOT * diagonal;
        if !(zero || pivot > 0.0 && pivot.is_finite()) {
            let (what, allowed) = ("pivot of the covariance of the excitation", "not negative");
            return Err(FilterError::Setting {
                what,
                found: pivot,
                allowed,
            });
        }
        let root = if zero { 0.0 } else { pivot.sqrt() };
        matrix[(j, j)] = root;
        for i in j + 1..n {
            let rest =
                matrix[(i, j)] - (0..j).map(|k| matrix[(i, k)] * matrix[(j, k)]).sum::<f64>();
            matrix[(i, j)] = if zero { 0.0 } else { rest / root };
            matrix[(j, i)] = 0.0;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn factor_of_a_covariance_with_known_inputs_gives_it_back() {
        let half = DMatrix::from_row_slice(3, 2, &[2.0, 0.0, 0.0, 0.0, -1.0, 0.5]); // the second input is known
        let covariance = &half * half.transpose();
        let mut factor = covariance.clone();
        semidefinite_cholesky_mut(&mut factor).unwrap();
        assert!((&factor * factor.transpose() - covariance).amax() < 1e-15);
        assert!(semidefinite_cholesky_mut(&mut DMatrix::from_element(1, 1, -1.0)).is_err());
    }
}
