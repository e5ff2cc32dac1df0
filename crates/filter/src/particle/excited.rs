//! Adapter that makes a particle model from a system with the two traits of the Kalman filters.
//!
//! The disturbance of a step is `w = [w_f, w_θ]`. The unknown excitation is `L_f w_f` with
//! `L_f L_fᵀ = Σ_f`, held over the step. The parameter increment is `G w_θ` and acts at the start
//! of the step. The prediction is that of the extended Kalman filter around each particle: notation
//! of Huang & Yuen (2023), §2.4. The drift of the parameters follows Ching, Beck, Porter &
//! Shaikhutdinov (2006).
//!
//! If sensors respond directly to the excitation of the same frame (`D ≠ 0`), `w_f` is the
//! excitation at that frame. The observation then determines its weight. The state stores it in
//! `N_f` entries after the parameters, and it acts on the motion over the next step.

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

/// Relative pivot below which the excitation does not vary in a direction.
const ZERO_PIVOT: f64 = 1e-14;

/// Number of substeps above which a particle has diverged, as a multiple of the substeps of the
/// prior.
///
/// A diverged particle would otherwise take as long as all others together.
const DIVERGED_SUBSTEPS: usize = 20;

/// A [`ProcessModel`] and [`ObservationModel`] with random excitation and drifting parameters.
///
/// State: `[y, w]`, where `y` (n) is the state of the model with its parameters last. `w` (N_f) is
/// the excitation of the last frame, if the model has a direct term.
///
/// From the settings of the Kalman filter, it uses the time step, the limits, the initial noise
/// levels and the hold of the known excitation. It does not use the fading factor, the variance
/// bounds or the start-up aid, because the drift determines the memory.
#[derive(Debug, Clone)]
pub struct ExcitedSystem<M> {
    model: M,
    step_s: f64,
    input_hold: InputHold,
    drift_std: DVector<f64>,
    lower: DVector<f64>,
    upper: DVector<f64>,
    noise: NoiseModel,
    /// Σ_n (N_0 × N_0).
    sensors: DMatrix<f64>,
    /// Σ_f, its factor, and a factor for frames with missing samples (N_f × N_f).
    excitation: DMatrix<f64>,
    excitation_factor: DMatrix<f64>,
    missing_factor: DMatrix<f64>,
    work: Workspace,
    /// Maximum number of substeps; a particle that needs more has diverged.
    most_substeps: usize,
}

#[derive(Debug, Clone)]
struct Workspace {
    /// Known excitation at both ends of the step, and the total acting excitation (N_f).
    older: DVector<f64>,
    newer: DVector<f64>,
    acting: DVector<f64>,
    /// B_y ḟ (n).
    ramp: DVector<f64>,
    /// B_y (n × N_f).
    input_matrix: DMatrix<f64>,
    /// Γ g (n × 1).
    increment: DMatrix<f64>,
    /// [Γ g, Γ B_y] (n × (1 + N_f)).
    inputs: DMatrix<f64>,
    /// Effects of excitation and parameter drift on the predicted state (n × N_f, n × N_θ).
    by_excitation: DMatrix<f64>,
    by_parameter: DMatrix<f64>,
    /// Effects of excitation and parameter drift on the output (N_0 × N_f, N_0 × N_θ).
    seen_excitation: DMatrix<f64>,
    seen_parameter: DMatrix<f64>,
    motion: discretise::Workspace,
    excitations: discretise::Workspace,
    parameters: discretise::Workspace,
}

impl<M: ProcessModel + ObservationModel + Clone + Send> ExcitedSystem<M> {
    /// Creates a system from a model and the settings of its Kalman filter.
    ///
    /// `drift_std`: standard deviation of the increment of each parameter per step (N_θ, parameter
    /// units).
    ///
    /// # Errors
    /// Returns an error if a size does not fit the model or a setting is out of range.
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

    /// Sets the identified noise levels `ψ` (N_ψ), for example to the result of a Kalman filter.
    ///
    /// # Errors
    /// Returns an error if the number of levels differs from the settings, or if the covariance of
    /// the excitation is not positive semidefinite.
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

    /// Returns the prior of the settings as a start density at the time of the first frame.
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

    /// Returns the estimate of a Kalman filter after its last frame as a start density, with all
    /// correlations.
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

    /// Stores the known excitation of the interval; a missing sample counts as zero and is
    /// uncertain.
    fn take_known(&mut self, interval: Interval<'_>) {
        let Workspace { older, newer, .. } = &mut self.work;
        let known = |value: f64| if value.is_nan() { 0.0 } else { value };
        for j in 0..newer.len() {
            newer[j] = known(interval.current[j]);
            older[j] = interval.previous.map_or(0.0, |previous| known(previous[j]));
        }
    }

    /// Returns `L_f` for a frame; a missing sample adds the mean square of the known excitation.
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
            // A larger diagonal keeps a semidefinite matrix semidefinite.
            Err(_) => &self.excitation_factor,
        }
    }

    /// Computes the slope of the motion that results from the known excitation during the step.
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

    /// Returns `true` if the linearised motion needs far more substeps than the motion of the
    /// prior.
    fn has_diverged(&self) -> bool {
        Series::choose(self.model.rate_bound(), self.step_s).substeps > self.most_substeps
    }

    /// Linearises the process at a state, with the excitation that acts over the step.
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
                state.fill(f64::NAN); // removes the particle
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
    /// Adds the predicted motion without disturbance to `state`, and computes the effects of the
    /// disturbances.
    ///
    /// The effects are `Γ B_y L_f` and `A [0; G]` of the linearised process.
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

/// Replaces a symmetric positive semidefinite matrix by a lower triangular `L` with `L Lᵀ`; known
/// inputs have zero rows.
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
    fn factor_reproduces_a_covariance_with_known_inputs() {
        // The second input is known.
        let half = DMatrix::from_row_slice(3, 2, &[2.0, 0.0, 0.0, 0.0, -1.0, 0.5]);
        let covariance = &half * half.transpose();
        let mut factor = covariance.clone();
        semidefinite_cholesky_mut(&mut factor).unwrap();
        assert!((&factor * factor.transpose() - covariance).amax() < 1e-15);
        assert!(semidefinite_cholesky_mut(&mut DMatrix::from_element(1, 1, -1.0)).is_err());
    }
}
