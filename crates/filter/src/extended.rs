//! The adaptive extended Kalman filter: predict and update, with the stages around them.
//!
//! Source: Huang & Yuen (2023), §2.4 (fading memory) and §3.2 (noise parameters). A step follows
//! the order of equations (3.14) to (3.18) and updates the noise parameters before the state.

mod marginal;
mod settings;
mod state;
mod workspace;

pub use settings::{Annealing, FilterSettings};
pub use state::FilterState;

use crate::constant::ConstantPath;
use crate::dense::{add_quadratic_form_mut, diagonal_to, symmetrise_mut};
use crate::discretise::{self, InputHold, Series};
use crate::error::FilterError;
use crate::fading::bound_variances_mut;
use crate::fit::{ChannelFit, Fit, FitState, Shown, ShownParameters};
use crate::misfit::MisfitState;
use crate::model::{ObservationModel, ProcessModel};
use crate::noise::{ExcitationPath, NoiseEvents, NoisePhase, NoiseRule, NoiseState, NoiseTarget};
use crate::outlier::OutlierState;
use crate::product::{Extent, Left, Sum};
use crate::proportional;
use crate::small;
use crate::update::{self, ExcitationPosterior, ExcitationSpread};
use nalgebra::{DMatrix, DVector};
use workspace::Workspace;

/// Largest magnitude of a negative variance, relative to the largest variance, that counts as
/// rounding.
///
/// At the start of a wide prior, every form of the update leaves the smallest eigenvalue at this
/// level.
const ROUNDING: f64 = 1e-12;

/// Largest normalised innovation squared, per entry of the state, of a step that may update the
/// mean square of the motion.
const CREDIBLE: f64 = 25.0;

/// Largest factor of the start-up aid at which residuals can set the scales of the outlier
/// screening.
///
/// A larger factor also enlarges the residuals. The scales are estimated again when the factor
/// falls to this value.
const LARGEST_SCREENED_ANNEALING: f64 = 2.0;

/// Quantile of the standard normal distribution for a two-sided interval of 95 %.
const QUANTILE_95: f64 = 1.96;

/// Samples of all channels at one time step.
#[derive(Debug, Clone, Copy)]
pub struct Frame<'a> {
    /// `z` (N_0, sensor units); NaN marks a missing channel.
    pub observations: &'a [f64],
    /// The known part of the excitation (N_f): 0 for an unmeasured component, NaN for a missing
    /// sample.
    pub excitation: &'a [f64],
}

/// Result of one step. The estimates themselves are available from the filter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Step {
    /// `νᵀ S⁻¹ ν`. If the model is right, it follows χ² with [`Step::used_channels`] degrees of
    /// freedom.
    pub normalised_innovation_squared: f64,
    /// `ln p(z | D)` of this frame.
    pub log_evidence: f64,
    /// Number of channels used in the update. With 0 channels, the step is a prediction only.
    pub used_channels: usize,
    /// Number of channels whose sample was rejected, as an outlier or because the sensor is faulty.
    pub rejected_channels: usize,
    /// Number of state entries that were clamped to their limits.
    pub limited_states: usize,
    /// Number of variances that exceeded their bound and were reduced to it.
    pub bounded_variances: usize,
    /// Phase of the noise parameters after the step.
    pub noise_phase: NoisePhase,
    /// `true` if the training of the noise parameters ended at this step.
    pub training_ended: bool,
    /// `true` if the training of the noise parameters reached its limit at this step without
    /// ending.
    pub training_overdue: bool,
    /// `true` if the noise parameters returned to training at this step, because the innovations
    /// kept disagreeing with them.
    pub training_restarted: bool,
}

/// A joint filter of state and parameters with fading memory and identified noise levels.
///
/// Each call of [`ExtendedKalmanFilter::step`] is one time step. It does not allocate, and its
/// results are bit-identical for the same frames. The first frame updates the prior without a
/// prediction, because the prior applies to the time of that frame.
#[derive(Debug, Clone)]
pub struct ExtendedKalmanFilter<M> {
    model: M,
    settings: FilterSettings,
    state: FilterState,
    work: Workspace,
    /// `true` if another filter of the same frames provides the noise levels and the rejected
    /// channels.
    follows: bool,
}

impl<M: ProcessModel + ObservationModel> ExtendedKalmanFilter<M> {
    /// Creates a filter at its prior.
    ///
    /// # Errors
    /// Returns an error if a setting does not fit the model or is outside its range.
    pub fn new(model: M, settings: FilterSettings) -> Result<Self, FilterError> {
        settings.check(&model)?;
        let work = Workspace::new(&model, &settings)?;
        let state = FilterState::start(&model, &settings);
        Ok(Self {
            model,
            settings,
            state,
            work,
            follows: false,
        })
    }

    /// Resets a diverged filter to its prior.
    ///
    /// The structure need not be at rest. The prior variance of each physical state is increased by
    /// the running mean square of that state.
    pub fn restart(&mut self) {
        let motion_mean_square = self.state.motion_mean_square.clone();
        let excitation_mean_square = self.state.excitation_mean_square.clone();
        self.state = FilterState::start(&self.model, &self.settings);
        for (j, mean_square) in motion_mean_square.iter().enumerate() {
            self.state.covariance[(j, j)] += mean_square;
        }
        (
            self.state.motion_mean_square,
            self.state.excitation_mean_square,
        ) = (motion_mean_square, excitation_mean_square);
    }

    /// Resets the motion and keeps the parameters and noise levels, after a gap that is too long to
    /// bridge.
    ///
    /// The physical state returns to its prior mean and becomes uncorrelated with the parameters.
    /// The structure need not be at rest: the running mean square of the motion is added to the
    /// prior variance. The next frame updates this state without a prediction.
    pub fn forget_motion(&mut self) {
        let moving = self.model.state_len() - self.model.parameter_len();
        let FilterState {
            mean,
            covariance,
            last_excitation,
            posterior,
            fresh,
            motion_mean_square,
            ..
        } = &mut self.state;
        for j in 0..moving {
            mean[j] = self.settings.prior_mean[j];
            covariance.row_mut(j).fill(0.0);
            covariance.column_mut(j).fill(0.0);
            covariance[(j, j)] =
                self.settings.prior_std[j] * self.settings.prior_std[j] + motion_mean_square[j];
        }
        last_excitation.fill(0.0);
        if let Some(posterior) = posterior {
            posterior.clear();
        }
        *fresh = true;
        if let Some(outliers) = &mut self.state.outliers {
            outliers.retrain();
        }
    }

    /// Processes one frame.
    ///
    /// # Errors
    /// Returns an error if the frame does not fit the model; the filter is then unchanged. Any
    /// other error means that the filter has diverged and must be restarted.
    pub fn step(&mut self, frame: Frame<'_>) -> Result<Step, FilterError> {
        self.check_frame(frame)?;
        self.take_excitation(frame);
        self.predict();
        let (noise_events, rejected_channels) = self.predict_observation(frame);
        let used = update::leave_out_missing(&mut self.work.update, &mut self.work.p_ht);
        let evidence = update::factorise(&mut self.work.update, used)?;
        if !evidence.log_evidence.is_finite() {
            return Err(FilterError::NotFinite {
                what: "normalised innovation",
                index: 0,
            });
        }
        let is_fresh = self.excitation_is_fresh();
        let Self { model, work, .. } = self;
        update::correct(
            model,
            &mut work.mean,
            &mut work.covariance,
            is_fresh.then_some(ExcitationSpread {
                input: &work.input_matrix,
                scaled: &work.input_spread,
            }),
            &mut work.p_ht,
            &work.sensors,
            &mut work.update,
        );
        let per_channel = evidence.normalised_innovation_squared / used.max(1) as f64;
        self.answer_misfit(per_channel);
        let (limited_states, rests_on_bound) = self.limit_state();
        let bounded_variances = self.bound_variances();
        self.check_result()?;
        self.judge_fit(frame, per_channel, rests_on_bound);
        self.commit(frame, evidence.normalised_innovation_squared);
        Ok(Step {
            normalised_innovation_squared: evidence.normalised_innovation_squared,
            log_evidence: evidence.log_evidence,
            used_channels: used,
            rejected_channels,
            limited_states,
            bounded_variances,
            noise_phase: self.state.noise.phase,
            training_ended: noise_events.training_ended,
            training_overdue: noise_events.training_overdue,
            training_restarted: noise_events.training_restarted,
        })
    }

    /// Sets the noise parameters `psi` (N_ψ) to known levels, for example from a schedule.
    ///
    /// The next step starts from these levels. Every rule except [`NoiseRule::Fixed`] then updates
    /// them.
    ///
    /// # Errors
    /// Returns an error if the number of levels does not fit the model, or if a level is not
    /// positive and finite.
    pub fn set_noise_parameters(&mut self, psi: &[f64]) -> Result<(), FilterError> {
        let (found, expected) = (psi.len(), self.state.noise.mean.len());
        if found != expected {
            return Err(FilterError::Dimension {
                what: "noise parameters",
                found,
                expected,
            });
        }
        for &level in psi {
            if !(level > 0.0 && level.is_finite()) {
                return Err(FilterError::Setting {
                    what: "noise parameter",
                    found: level,
                    allowed: "positive",
                });
            }
        }
        self.state.noise.mean.copy_from_slice(psi);
        Ok(())
    }

    /// Returns the model.
    pub fn model(&self) -> &M {
        &self.model
    }

    /// Returns the settings.
    pub fn settings(&self) -> &FilterSettings {
        &self.settings
    }

    /// Returns the filtered state `y` (n).
    pub fn mean(&self) -> &DVector<f64> {
        &self.state.mean
    }

    /// Returns the covariance of the filtered state (n × n).
    pub fn covariance(&self) -> &DMatrix<f64> {
        &self.state.covariance
    }

    /// Returns the estimates of the noise parameters.
    pub fn noise(&self) -> &NoiseState {
        &self.state.noise
    }

    /// Returns the misfit of the parameters, or `None` if it is not measured.
    pub fn misfit(&self) -> Option<&MisfitState> {
        self.state.misfit.as_ref()
    }

    /// Returns the verdict on the fit after the last step.
    pub fn fit(&self) -> Fit {
        self.state
            .fit
            .as_ref()
            .map(FitState::fit)
            .unwrap_or_default()
    }

    /// Returns the measures of fit of each channel (N_0), or an empty slice if the fit is not
    /// measured.
    pub fn channel_fits(&self) -> &[ChannelFit] {
        self.state.fit.as_ref().map_or(&[], FitState::channels)
    }

    /// Returns the covariance of parameters `i` and `j` (from 0), including the detectable model
    /// error.
    ///
    /// If the misfit is not measured, it is the filter's own covariance. In both cases, it includes
    /// [`FilterSettings::considered_std`].
    pub fn parameter_covariance(&self, i: usize, j: usize) -> f64 {
        let first = self.model.state_len() - self.model.parameter_len();
        let own = self.state.covariance[(first + i, first + j)];
        let scaled = self.state.misfit.as_ref().map_or(own, |misfit| {
            own * (misfit.variance_scale(i) * misfit.variance_scale(j)).sqrt()
        });
        scaled + self.settings.considered_std[first + i] * self.settings.considered_std[first + j]
    }

    /// Returns the state of the outlier screening, or `None` if outliers are not screened.
    pub fn outliers(&self) -> Option<&OutlierState> {
        self.state.outliers.as_ref()
    }

    /// Returns the innovation of the last step (N_0), NaN for a missing or rejected channel.
    pub fn innovation(&self) -> &DVector<f64> {
        &self.work.update.innovation
    }

    /// Returns `S` of the last step (N_0 × N_0). The rows of missing channels are those of the
    /// identity.
    pub fn innovation_covariance(&self) -> &DMatrix<f64> {
        &self.work.update.innovation_covariance
    }

    /// Returns the number of terms with which the last prediction moved one row of the covariance.
    ///
    /// The cost of a step follows from this number. It is `None` for models without a
    /// [`ProportionalForm`](crate::ProportionalForm).
    pub fn transition_term_count(&self) -> Option<usize> {
        self.work
            .proportional
            .as_ref()
            .map(proportional::Transition::term_count)
    }

    /// Returns the number of processed frames.
    pub fn steps(&self) -> u64 {
        self.state.steps
    }

    /// Returns the state for a checkpoint.
    pub fn state(&self) -> &FilterState {
        &self.state
    }

    /// Returns the known excitation of the last frame (N_f): NaN for a missing sample, zero before
    /// the first frame.
    pub(crate) fn last_excitation(&self) -> &DVector<f64> {
        &self.state.last_excitation
    }

    /// Returns the posterior of the unknown excitation of the last frame, or `None` for a model
    /// without a direct term.
    pub(crate) fn excitation_posterior(&self) -> Option<&ExcitationPosterior> {
        self.state.posterior.as_ref()
    }

    /// Restores the state from a checkpoint. Subsequent steps are bit-identical to those of an
    /// uninterrupted filter.
    ///
    /// # Errors
    /// Returns [`FilterError::Dimension`] if the state does not fit the model or the settings.
    pub fn restore(&mut self, state: FilterState) -> Result<(), FilterError> {
        let n = self.model.state_len();
        let [(states, inputs), (own_states, own_inputs)] =
            [&state, &self.state].map(FilterState::course_shape);
        let sizes = [
            ("mean of a checkpoint", state.mean.len(), n),
            ("covariance of a checkpoint", state.covariance.len(), n * n),
            (
                "excitation of a checkpoint",
                state.last_excitation.len(),
                self.model.excitation_len(),
            ),
            (
                "screened channels of a checkpoint",
                state.screened(),
                self.state.screened(),
            ),
            (
                "noise parameters of a checkpoint",
                state.noise.mean.len(),
                self.settings.noise.parameters.len(),
            ),
            (
                "misfit of a checkpoint",
                state.misfit_len(),
                self.state.misfit_len(),
            ),
            ("fit of a checkpoint", state.fit_len(), self.state.fit_len()),
            (
                "states that the excitation of a checkpoint drives",
                states,
                own_states,
            ),
            (
                "course of the excitation of a checkpoint",
                inputs,
                own_inputs,
            ),
        ];
        for (what, found, expected) in sizes {
            if found != expected {
                return Err(FilterError::Dimension {
                    what,
                    found,
                    expected,
                });
            }
        }
        self.state = state;
        Ok(())
    }

    /// Widens the prior of the motion by the mean square of the motion that another filter has
    /// observed.
    pub(crate) fn expect_motion_of<N>(
        &mut self,
        other: &ExtendedKalmanFilter<N>,
        motion_len: usize,
    ) {
        for j in 0..motion_len {
            self.state.covariance[(j, j)] += other.state.motion_mean_square[j];
        }
        self.state
            .motion_mean_square
            .copy_from(&other.state.motion_mean_square);
        self.state
            .excitation_mean_square
            .copy_from(&other.state.excitation_mean_square);
    }

    /// Fixes the noise levels at `psi` (N_ψ) and stops the outlier screening, because another
    /// filter of the same frames does both.
    pub(crate) fn follow(&mut self, psi: &[f64]) {
        self.follows = true;
        self.state.noise.mean.copy_from_slice(psi);
    }

    /// Starts to identify noise levels and to screen outliers, from the estimates of another
    /// filter.
    pub(crate) fn lead(&mut self, noise: NoiseState, outliers: Option<OutlierState>) {
        self.follows = false;
        (self.state.noise, self.state.outliers) = (noise, outliers);
    }

    /// Continues from the state of another filter of the same motion, with the given mean and
    /// covariance.
    ///
    /// `origin` returns the index in the state of `source` for an index in the state of this
    /// filter, or `None` for a new entry.
    pub(crate) fn continue_from(
        &mut self,
        source: &FilterState,
        mean: DVector<f64>,
        covariance: DMatrix<f64>,
        origin: impl Fn(usize) -> Option<usize>,
    ) {
        let mut state = source.clone();
        if let (Some(posterior), Some(known)) = (&mut state.posterior, &source.posterior) {
            posterior.cross = DMatrix::from_fn(mean.len(), known.cross.ncols(), |row, input| {
                origin(row).map_or(0.0, |row| known.cross[(row, input)])
            });
        }
        state.excitation_course = state
            .excitation_course
            .map(|course| course.of_states(mean.len()));
        (state.mean, state.covariance) = (mean, covariance);
        self.state = state;
    }

    /// Returns the number of observations in a frame.
    #[must_use]
    pub fn observation_len(&self) -> usize {
        self.model.observation_len()
    }

    pub(crate) fn check_frame(&self, frame: Frame<'_>) -> Result<(), FilterError> {
        let sizes = [
            (
                "observations of a frame",
                frame.observations.len(),
                self.model.observation_len(),
            ),
            (
                "excitation of a frame",
                frame.excitation.len(),
                self.model.excitation_len(),
            ),
        ];
        for (what, found, expected) in sizes {
            if found != expected {
                return Err(FilterError::Dimension {
                    what,
                    found,
                    expected,
                });
            }
        }
        Ok(())
    }

    /// Writes the known excitation at both ends of the step and the variances of missing samples.
    ///
    /// It also adds the part of the excitation that the last step omitted to the filtered state.
    fn take_excitation(&mut self, frame: Frame<'_>) {
        let Self { state, work, .. } = self;
        for j in 0..work.older.len() {
            let (older, newer) = (state.last_excitation[j], frame.excitation[j]);
            work.older[j] = if older.is_nan() { 0.0 } else { older };
            work.newer[j] = if newer.is_nan() { 0.0 } else { newer };
            let course = state.excitation_course.as_ref();
            work.above_the_line[j] =
                course.map_or(0.0, |course| course.above_the_line(j, older, newer));
            if let Some(course) = course {
                course.make_up(j, older, newer, &mut state.mean);
            }
            work.missing[j] = if older.is_nan() {
                state.excitation_mean_square[j]
            } else {
                0.0
            };
        }
    }

    /// Writes `Σ_f` of the coming step, `Σ_f` of the frame and `Σ_n` for the current noise
    /// parameters.
    fn write_noise_covariances(&mut self, frame: Frame<'_>) {
        let Self {
            settings,
            state,
            work,
            ..
        } = self;
        let psi = &state.noise.mean;
        settings
            .noise
            .covariance_to(NoiseTarget::Sensors, psi, &mut work.sensors);
        settings
            .noise
            .covariance_to(NoiseTarget::Excitation, psi, &mut work.step_excitation);
        work.frame_excitation.copy_from(&work.step_excitation);
        for j in 0..work.older.len() {
            // A missing sample of a measured excitation has the mean square of that excitation as
            // its variance.
            work.step_excitation[(j, j)] += work.missing[j];
            if frame.excitation[j].is_nan() {
                work.frame_excitation[(j, j)] += state.excitation_mean_square[j];
            }
        }
    }

    /// Writes mean, `λ A Σ Aᵀ` and `B` for the time of the new frame. The first frame uses the
    /// prior instead.
    fn predict(&mut self) {
        let Self {
            model,
            settings,
            state,
            work,
            ..
        } = self;
        work.mean.copy_from(&state.mean);
        if state.fresh {
            work.covariance.copy_from(&state.covariance);
            if work.constant.is_none() {
                work.input_matrix.fill(0.0);
            }
            return;
        }
        if let Some(posterior) = &state.posterior {
            work.older += &posterior.mean;
        }
        work.older += &work.above_the_line;
        if let Some(constant) = &mut work.constant {
            constant.propagate_covariance_to(
                &state.covariance,
                settings.fading.value(),
                &mut work.covariance,
            );
            let held = &work.older;
            let ramp = (settings.input_hold == InputHold::First).then(|| {
                work.newer_less_older.copy_from(&work.newer);
                work.newer_less_older -= held;
                work.newer_less_older += &work.above_the_line;
                &work.newer_less_older
            });
            constant.predict_mean_mut(&mut work.mean, held, ramp);
            let ConstantPath {
                transition, column, ..
            } = constant;
            if let Some(ExcitationPosterior { cross, .. }) = &state.posterior {
                work.cross.copy_from(cross);
                transition.mul_mut(&mut work.cross, column);
            }
            self.finish_prediction();
            return;
        }
        model.linearise_process(state.mean.as_slice(), work.older.as_slice());
        model.excitation_matrix(&mut work.input_matrix);
        let n = work.mean.len();
        model.derivative(&mut work.inputs.as_mut_slice()[..n]);
        work.inputs.as_mut_slice()[n..].copy_from_slice(work.input_matrix.as_slice());
        let ramp = (settings.input_hold == InputHold::First).then(|| {
            work.older.axpy(1.0, &work.newer, -1.0); // slope, per step
            work.older += &work.above_the_line;
            work.ramp
                .gemv(1.0 / settings.step_s, &work.input_matrix, &work.older, 0.0);
            work.ramp.as_slice()
        });
        let cross = state.posterior.as_ref().map(|posterior| {
            work.cross.copy_from(&posterior.cross);
            &mut work.cross
        });
        let (step_s, rate_bound) = (settings.step_s, model.rate_bound());
        if let Some((transition, form)) = work.proportional.as_mut().zip(model.proportional_form())
        {
            transition.discretise(&form, step_s, rate_bound, &mut work.inputs, ramp);
            transition.propagate_covariance_to(
                &state.covariance,
                settings.fading.value(),
                &mut work.covariance,
            );
            if let Some(cross) = cross {
                transition.mul_mut(cross);
            }
        } else {
            let (series, scratch) = (Series::choose(rate_bound, step_s), &mut work.discretise);
            discretise::integrate_inputs(model, step_s, series, &mut work.inputs, ramp, scratch);
            discretise::propagate_covariance(
                model,
                step_s,
                series,
                &state.covariance,
                &mut work.covariance,
                scratch,
            );
            work.covariance *= settings.fading.value();
            symmetrise_mut(&mut work.covariance);
            if let Some(cross) = cross {
                discretise::transition_mul_narrow(model, step_s, series, cross, scratch);
            }
        }
        for (mean, increment) in work.mean.iter_mut().zip(&work.inputs.as_slice()[..n]) {
            *mean += increment; // y ← y + Γ g (2.67)
        }
        work.input_matrix
            .as_mut_slice()
            .copy_from_slice(&work.inputs.as_slice()[n..]); // B = Γ B_y
        self.finish_prediction();
    }

    /// Adds the excitation posterior of the previous frame to the prediction. `work.cross` must
    /// contain `A C`.
    fn finish_prediction(&mut self) {
        let Self {
            settings,
            state,
            work,
            ..
        } = self;
        let Some(ExcitationPosterior { covariance, .. }) = &state.posterior else {
            return;
        };
        // A Σ Aᵀ + A C Bᵀ + B Cᵀ Aᵀ + B W Bᵀ: the last frame has already measured the excitation of
        // this step. Half of the last term is added to each of the two terms before it. This leaves
        // one product of rank 2N_f, which is cheap even with many forces.
        let inputs = work.cross.ncols();
        for b in 0..inputs {
            work.cross
                .column_mut(b)
                .gemv(0.5, &work.input_matrix, &covariance.column(b), 1.0);
        }
        work.pair.columns_mut(0, inputs).copy_from(&work.cross);
        work.pair
            .columns_mut(inputs, inputs)
            .copy_from(&work.input_matrix);
        work.swapped_pair
            .rows_mut(0, inputs)
            .tr_copy_from(&work.input_matrix);
        work.swapped_pair
            .rows_mut(inputs, inputs)
            .tr_copy_from(&work.cross);
        work.by_pair.pack(&work.swapped_pair);
        work.pair *= settings.fading.value();
        let (left, variances) = (Left::new(&work.pair), work.update.variances.as_mut_slice());
        work.multiplier
            .add_symmetric_mut(left, &work.by_pair, &mut work.covariance, variances);
    }

    /// Writes innovation, `S`, `P Hᵀ` and `P`. Screens outliers and updates the noise parameters in
    /// between.
    ///
    /// Returns the noise events and the number of rejected channels.
    fn predict_observation(&mut self, frame: Frame<'_>) -> (NoiseEvents, usize) {
        let Self { model, work, .. } = self;
        model.linearise_observation(work.mean.as_slice(), work.newer.as_slice());
        model.observe(work.update.innovation.as_mut_slice());
        for (innovation, datum) in work.update.innovation.iter_mut().zip(frame.observations) {
            *innovation = datum - *innovation; // NaN for a missing channel
        }
        let is_known = work.constant.is_some() && work.by_h_t.is_packed(); // H never changes
        if is_known || model.observation_matrix(&mut work.h_t) {
            if !is_known {
                work.by_h_t.repack_sparse(&work.h_t);
            }
            if work.mean.len() <= small::MOST_ROWS {
                small::multiply_to(
                    work.multiplier.arch(),
                    &work.covariance,
                    &work.h_t,
                    &mut work.p_ht,
                );
            } else {
                let left = Left::new(&work.covariance);
                work.multiplier.multiply_to(
                    left,
                    &work.by_h_t,
                    Extent::Full,
                    Sum::PLAIN,
                    &mut work.p_ht,
                );
            }
        } else {
            model.observation_jacobian_mul(&work.covariance, &mut work.h_p);
            work.p_ht.tr_copy_from(&work.h_p); // because P is symmetric
        }
        model.observation_jacobian_mul(&work.p_ht, &mut work.update.innovation_covariance); // S₀
        symmetrise_mut(&mut work.update.innovation_covariance);
        if work.constant.is_none() {
            model.observation_jacobian_mul(&work.input_matrix, &mut work.h_b);
        }

        let rejected = self.screen_outliers(frame);
        let events = self.update_noise(frame);
        self.write_noise_covariances(frame);
        self.add_noises();
        (events, rejected)
    }

    /// Rejects outliers, using the noise levels from before this step. Returns the number of
    /// rejected channels.
    fn screen_outliers(&mut self, frame: Frame<'_>) -> usize {
        if self.follows || self.settings.outliers.is_none() {
            return 0;
        }
        self.write_noise_covariances(frame);
        let annealing = self.annealing();
        let was_annealed =
            self.annealing_at(self.state.steps.saturating_sub(1)) > LARGEST_SCREENED_ANNEALING;
        let Self {
            model,
            settings,
            state,
            work,
            ..
        } = self;
        let (Some(outlier_settings), Some(outliers)) = (&settings.outliers, &mut state.outliers)
        else {
            return 0;
        };
        let felt = state.posterior.is_some() && !state.fresh;
        for channel in 0..work.variances.len() {
            let of_row = |row: &DMatrix<f64>, covariance: &DMatrix<f64>| {
                let mut sum = 0.0;
                for b in 0..covariance.ncols() {
                    for a in 0..covariance.nrows() {
                        sum += row[(channel, a)] * covariance[(a, b)] * row[(channel, b)];
                    }
                }
                sum
            };
            let mut variance = work.update.innovation_covariance[(channel, channel)];
            variance += annealing * work.sensors[(channel, channel)];
            if !felt && !state.fresh {
                variance += settings.fading.value() * of_row(&work.h_b, &work.step_excitation);
            }
            if let Some(direct) = model.feedthrough() {
                variance += of_row(direct, &work.frame_excitation);
            }
            work.variances[channel] = variance;
        }
        if was_annealed && annealing <= LARGEST_SCREENED_ANNEALING {
            outliers.rescale(&mut work.sorted);
        }
        let residuals = work.update.innovation.as_mut_slice();
        outliers.screen(
            outlier_settings,
            residuals,
            work.variances.as_slice(),
            &mut work.sorted,
        )
    }

    /// Returns the factor by which the start-up aid increases the sensor noise at this step.
    fn annealing(&self) -> f64 {
        self.annealing_at(self.state.steps)
    }

    fn annealing_at(&self, step: u64) -> f64 {
        self.settings.annealing.map_or(
            1.0,
            |Annealing {
                 amount,
                 time_constant_s,
             }| {
                let elapsed_s =
                    step.saturating_sub(self.state.annealed_from) as f64 * self.settings.step_s;
                1.0 + amount * (-elapsed_s / time_constant_s).exp()
            },
        )
    }

    /// Updates the noise parameters with this frame.
    fn update_noise(&mut self, frame: Frame<'_>) -> NoiseEvents {
        let fixed = self.settings.noise.parameters.is_empty()
            || self.settings.noise_settings.rule == NoiseRule::Fixed;
        if self.follows || fixed {
            return NoiseEvents::default();
        }
        let Self {
            model,
            settings,
            state,
            work,
            ..
        } = self;
        if state.fresh && frame.observations.iter().all(|datum| datum.is_nan()) {
            // The prior applies to the time of this frame, so no information has faded.
            return NoiseEvents::default();
        }
        let lambda = settings.fading.value();
        // After a posterior from the previous frame, S₀ already contains the excitation of this
        // step.
        let felt = state.posterior.is_some() && !state.fresh;
        let path = match &work.constant {
            _ if felt => ExcitationPath::Felt,
            Some(_) if state.fresh => ExcitationPath::Felt, // no step, no excitation
            Some(constant) => ExcitationPath::Constant(&constant.levels),
            None => ExcitationPath::Input(&work.h_b),
        };
        let objective = &mut work.objective;
        let known = &mut work.frame_known;
        known.copy_from(&work.update.innovation_covariance);
        *known += &settings.noise.sensors;
        work.step_excitation.copy_from(&settings.noise.excitation);
        work.frame_excitation.copy_from(&settings.noise.excitation);
        for j in 0..work.older.len() {
            // A missing sample of a measured excitation has the mean square of that excitation as
            // its variance.
            work.step_excitation[(j, j)] += work.missing[j];
            if frame.excitation[j].is_nan() {
                work.frame_excitation[(j, j)] += state.excitation_mean_square[j];
            }
        }
        match (path, &work.constant) {
            (ExcitationPath::Input(h_b), _) => {
                add_quadratic_form_mut(known, h_b, &work.step_excitation, lambda)
            }
            (ExcitationPath::Constant(_), Some(constant)) => {
                constant.add_known_datum_mut(lambda, &work.missing, known);
            }
            (ExcitationPath::Felt | ExcitationPath::Constant(_), _) => {}
        }
        if let Some(direct) = model.feedthrough() {
            add_quadratic_form_mut(known, direct, &work.frame_excitation, 1.0);
        }
        objective.set_frame(
            &settings.noise,
            known,
            path,
            model.feedthrough(),
            lambda,
            &work.update.innovation,
        );
        state
            .noise
            .update(&settings.noise, &settings.noise_settings, objective)
    }

    /// Returns `true` if the unknown excitation of the coming step adds to the predicted covariance
    /// through its matrix `B`.
    ///
    /// It returns `false` if the previous frame already provided a posterior of this excitation. A
    /// constant model adds the excitation noise in `add_noises`.
    fn excitation_is_fresh(&self) -> bool {
        let felt = self.state.posterior.is_some() && !self.state.fresh;
        self.work.constant.is_none() && !felt
    }

    /// Adds the noise covariances to `P Hᵀ` and `S`, and also to `P` for a constant model.
    fn add_noises(&mut self) {
        let annealing = self.annealing();
        let Self {
            model,
            settings,
            state,
            work,
            ..
        } = self;
        let lambda = settings.fading.value();
        let felt = state.posterior.is_some() && !state.fresh;
        let innovation_covariance = &mut work.update.innovation_covariance;
        if let Some(constant) = &work.constant {
            if !felt && !state.fresh {
                let (psi, missing) = (&state.noise.mean, &work.missing);
                constant.add_noise_mut(
                    psi,
                    lambda,
                    missing,
                    &mut work.covariance,
                    &mut work.p_ht,
                    innovation_covariance,
                );
            }
        } else if !felt {
            add_quadratic_form_mut(
                innovation_covariance,
                &work.h_b,
                &work.step_excitation,
                lambda,
            );
            for (b, mut spread) in work.input_spread.column_iter_mut().enumerate() {
                spread.gemv(
                    lambda,
                    &work.input_matrix,
                    &work.step_excitation.column(b),
                    0.0,
                ); // λ B Σ_f
                for (channel, mut p_ht) in work.p_ht.column_iter_mut().enumerate() {
                    p_ht.axpy(work.h_b[(channel, b)], &spread, 1.0); // + B Σ_f Bᵀ Hᵀ
                }
            }
        }
        if let Some(direct) = model.feedthrough() {
            add_quadratic_form_mut(innovation_covariance, direct, &work.frame_excitation, 1.0);
        }
        diagonal_to(innovation_covariance, &mut work.predicted_variances);
        if annealing != 1.0 {
            work.sensors *= annealing;
        }
        *innovation_covariance += &work.sensors;
    }

    /// Measures the effect of misfit on the parameters, reduces the corrections of this step
    /// accordingly and follows jumps.
    fn answer_misfit(&mut self, normalised_innovation_squared: f64) {
        let Self {
            model,
            settings,
            state,
            work,
            ..
        } = self;
        let (Some(misfit_settings), Some(misfit)) = (&settings.misfit, &mut state.misfit) else {
            return;
        };
        let Workspace {
            misfit: scratch,
            mean,
            covariance,
            p_ht,
            update,
            ..
        } = work;
        scratch.read(&update.variances, p_ht, update.whitened());
        let is_excitation_known = !state.last_excitation.iter().any(|sample| sample.is_nan());
        let jumped = misfit.take(
            misfit_settings,
            scratch,
            normalised_innovation_squared,
            is_excitation_known,
        );
        scratch.temper(
            misfit,
            misfit_settings,
            settings.fading.value(),
            &settings.prior_std,
            mean,
            covariance,
        );
        if jumped {
            let first = mean.len() - model.parameter_len();
            for j in first..mean.len() {
                covariance[(j, j)] += settings.prior_std[j] * settings.prior_std[j];
            }
            misfit.start_jump((first..mean.len()).map(|j| covariance[(j, j)]));
            state.annealed_from = state.steps;
        }
        diagonal_to(covariance, &mut update.variances);
    }

    /// Judges how well the model explains the data so far.
    fn judge_fit(&mut self, frame: Frame<'_>, normalised_innovation_squared: f64, at_bound: bool) {
        let Self {
            model,
            settings,
            state,
            work,
            ..
        } = self;
        let first = work.mean.len() - model.parameter_len();
        let (Some(misfit_settings), Some(misfit), Some(fit)) =
            (&settings.misfit, &state.misfit, &mut state.fit)
        else {
            return;
        };
        fit.take(
            misfit_settings,
            misfit,
            Shown {
                observations: frame.observations,
                innovations: work.update.innovation.as_slice(),
                excitation: frame.excitation,
                noise: &work.sensors,
                normalised_innovation_squared,
                predicted_variances: work.predicted_variances.as_slice(),
                at_bound,
                parameters: ShownParameters {
                    means: &work.mean.as_slice()[first..],
                    variances: &work.update.variances.as_slice()[first..],
                    prior_means: &settings.prior_mean.as_slice()[first..],
                    prior_stds: &settings.prior_std.as_slice()[first..],
                    considered_stds: &settings.considered_std.as_slice()[first..],
                },
            },
        );
    }

    /// Clamps the entries of the state to their limits. The covariance remains unchanged.
    ///
    /// Returns the number of clamped entries. Also returns `true` if the data moved a parameter to
    /// its limit, so that its interval excludes the prior mean.
    fn limit_state(&mut self) -> (usize, bool) {
        let Self {
            model,
            settings,
            state,
            work,
            ..
        } = self;
        let first = work.mean.len() - model.parameter_len();
        let widening = |j: usize| {
            state
                .misfit
                .as_ref()
                .map_or(1.0, |misfit| misfit.variance_scale(j - first))
        };
        let (mut limited, mut rests_on_bound) = (0, false);
        for j in 0..work.mean.len() {
            let inside = work.mean[j].clamp(settings.lower[j], settings.upper[j]);
            // NaN does not count here, because `check_result` reports it.
            if inside != work.mean[j] && !work.mean[j].is_nan() {
                work.mean[j] = inside;
                limited += 1;
                if j >= first {
                    let off = inside - settings.prior_mean[j];
                    let variance = work.update.variances[j] * widening(j);
                    rests_on_bound |= off * off > QUANTILE_95 * QUANTILE_95 * variance;
                }
            }
        }
        (limited, rests_on_bound)
    }

    /// Scales the covariance so that no variance exceeds its bound. Returns the number of variances
    /// that did.
    fn bound_variances(&mut self) -> usize {
        let Self { settings, work, .. } = self;
        let (variances, bounds) = (&mut work.update.variances, &settings.variance_bound);
        if variances
            .iter()
            .zip(bounds)
            .all(|(variance, bound)| variance <= bound)
        {
            // `variances` already contains the diagonal. Reading it from the covariance is slow,
            // because its entries are a column length apart.
            return 0;
        }
        let bounded = bound_variances_mut(&mut work.covariance, bounds);
        diagonal_to(&work.covariance, variances);
        bounded
    }

    fn check_result(&mut self) -> Result<(), FilterError> {
        if let Some(index) = self
            .state
            .noise
            .mean
            .iter()
            .position(|level| !level.is_finite())
        {
            return Err(FilterError::NotFinite {
                what: "noise level",
                index,
            });
        }
        let work = &mut self.work;
        for index in 0..work.mean.len() {
            if !work.mean[index].is_finite() {
                return Err(FilterError::NotFinite {
                    what: "mean of state",
                    index,
                });
            }
            let variance = work.update.variances[index];
            if !variance.is_finite() {
                return Err(FilterError::NotFinite {
                    what: "variance of state",
                    index,
                });
            }
            if variance < 0.0 {
                let largest = work.update.variances.max();
                if variance < -ROUNDING * largest {
                    return Err(FilterError::NegativeVariance { index, variance });
                }
                work.covariance[(index, index)] = 0.0;
            }
        }
        Ok(())
    }

    /// Commits the result of the step to the state.
    fn commit(&mut self, frame: Frame<'_>, normalised_innovation_squared: f64) {
        let Self {
            model,
            settings,
            state,
            work,
            ..
        } = self;
        if let (Some(direct), Some(posterior)) = (model.feedthrough(), &mut state.posterior) {
            update::infer_excitation(
                direct,
                &work.frame_excitation,
                &work.p_ht,
                &work.update,
                posterior,
            );
        }
        std::mem::swap(&mut state.mean, &mut work.mean);
        std::mem::swap(&mut state.covariance, &mut work.covariance);
        let weight = 1.0 / (state.steps as f64 + 1.0).min(settings.fading.memory_steps());
        match &mut state.excitation_course {
            Some(course) if state.fresh => course.interrupt(),
            Some(course) => {
                course.take(&state.last_excitation, frame.excitation, &work.input_matrix)
            }
            None => {}
        }
        for j in 0..state.last_excitation.len() {
            let known = frame.excitation[j];
            state.last_excitation[j] = known;
            if !known.is_nan() {
                state.excitation_mean_square[j] +=
                    weight * (known * known - state.excitation_mean_square[j]);
            }
        }
        // A diverging filter gives no information about the size of the motion.
        if normalised_innovation_squared <= CREDIBLE * work.mean.len().max(1) as f64 {
            for (mean_square, value) in state.motion_mean_square.iter_mut().zip(&state.mean) {
                *mean_square += weight * (value * value - *mean_square);
            }
        }
        state.steps += 1;
        state.fresh = false;
    }
}

#[cfg(test)]
mod tests;
