//! The adaptive extended Kalman filter: a chain of stages around predict and update.
//!
//! Source: Huang & Yuen (2023), §2.4 (fading memory) and §3.2 (noise parameters); the order of one step is that of
//! equations (3.14) to (3.18) with the noise parameters updated before the state.

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

/// A negative variance below this, relative to the largest, is rounding: at the start of a wide prior the smallest
/// eigenvalue sits there in every form of the update.
const ROUNDING: f64 = 1e-12;

/// Above this normalised innovation squared per entry of the state, a step is no measure of the motion.
const CREDIBLE: f64 = 25.0;

/// While the start-up aid raises the noise of the sensors more than this, residuals do not have the size that screening asks for.
const LARGEST_SCREENED_ANNEALING: f64 = 2.0;

/// Standard deviations of a normal variable that hold 95 % on both sides.
const QUANTILE_95: f64 = 1.96;

/// One instant as the filter sees it.
#[derive(Debug, Clone, Copy)]
pub struct Frame<'a> {
    /// `z` (N_0, sensor units); NaN marks a missing channel.
    pub observations: &'a [f64],
    /// The known part of the excitation at this instant (N_f): 0 where it is not measured, NaN where its sample is missing.
    pub excitation: &'a [f64],
}

/// What one step found; estimates are read from the filter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Step {
    /// `νᵀ S⁻¹ ν`, χ² with [`Step::used_channels`] degrees of freedom when all is right.
    pub normalised_innovation_squared: f64,
    /// `ln p(z | D)` of this frame.
    pub log_evidence: f64,
    /// Channels that took part; 0 makes the step a prediction.
    pub used_channels: usize,
    /// Channels whose sample was there and was rejected, as an outlier or of a faulty sensor.
    pub rejected_channels: usize,
    /// Entries of the state that had to be brought back to their limits.
    pub limited_states: usize,
    /// Variances that had reached their bound.
    pub bounded_variances: usize,
    /// Phase of the noise parameters after the step.
    pub noise_phase: NoisePhase,
    /// The training of the noise parameters ended at this step.
    pub training_ended: bool,
    /// The training of the noise parameters should have ended at this step, but a level is still uncertain.
    pub training_overdue: bool,
    /// The noise parameters went back to training at this step, because the innovations kept disagreeing with them.
    pub training_restarted: bool,
}

/// A joint filter of state and parameters with fading memory and identified noise levels.
///
/// One call of [`ExtendedKalmanFilter::step`] is one time step; it allocates nothing and is deterministic to the bit. The
/// first frame updates the prior without a prediction: the prior is for its instant.
#[derive(Debug, Clone)]
pub struct ExtendedKalmanFilter<M> {
    model: M,
    settings: FilterSettings,
    state: FilterState,
    work: Workspace,
    /// noise levels and rejected channels come from another filter of the same frames
    follows: bool,
}

impl<M: ProcessModel + ObservationModel> ExtendedKalmanFilter<M> {
    /// Makes a filter at its prior.
    ///
    /// # Errors
    /// When a setting does not fit the model or lies outside its range.
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

    /// Goes back to the prior: what a diverged filter is left with.
    ///
    /// The structure need not be at rest: the motion starts as uncertain as it has been large.
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

    /// Forgets the motion and keeps the parameters and noise levels: after a gap too long to be bridged.
    ///
    /// The physical state is taken as zero, as uncertain as the motion has been large, and uncorrelated with the parameters:
    /// the structure need not have come to rest. The next frame updates it without a prediction.
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

    /// Takes one frame.
    ///
    /// # Errors
    /// When the frame does not fit the model, which leaves the filter as it was, or when the filter has diverged and must
    /// be restarted.
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

    /// Sets the noise parameters to levels that are known from elsewhere, such as a schedule.
    ///
    /// `psi` (N_ψ). The coming step takes them; under any rule but [`NoiseRule::Fixed`] it then moves them.
    ///
    /// # Errors
    /// When their number is not that of the model, or one of them is not positive.
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

    /// Returns what is known of the noise parameters.
    pub fn noise(&self) -> &NoiseState {
        &self.state.noise
    }

    /// Returns what is known of the misfit of the parameters; `None` where it is not measured.
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

    /// Returns the measures of fit of each channel (N_0); empty where they are not taken.
    pub fn channel_fits(&self) -> &[ChannelFit] {
        self.state.fit.as_ref().map_or(&[], FitState::channels)
    }

    /// Returns the covariance of two parameters (from 0) that includes the error of the model, as far as it shows.
    ///
    /// It is the filter's own where misfit is not measured.
    pub fn parameter_covariance(&self, i: usize, j: usize) -> f64 {
        let first = self.model.state_len() - self.model.parameter_len();
        let own = self.state.covariance[(first + i, first + j)];
        let scaled = self.state.misfit.as_ref().map_or(own, |misfit| {
            own * (misfit.variance_scale(i) * misfit.variance_scale(j)).sqrt()
        });
        scaled + self.settings.considered_std[first + i] * self.settings.considered_std[first + j]
    }

    /// Returns what is known of outliers in each channel; `None` where they are not screened.
    pub fn outliers(&self) -> Option<&OutlierState> {
        self.state.outliers.as_ref()
    }

    /// Returns the innovation of the last step (N_0), NaN where a channel was missing or rejected.
    pub fn innovation(&self) -> &DVector<f64> {
        &self.work.update.innovation
    }

    /// Returns `S` of the last step (N_0 × N_0); rows of missing channels are those of the identity.
    pub fn innovation_covariance(&self) -> &DMatrix<f64> {
        &self.work.update.innovation_covariance
    }

    /// Returns the number of terms by which the last prediction moved a row of the covariance, for models that have a
    /// [`ProportionalForm`](crate::ProportionalForm): what a step costs follows from it.
    pub fn transition_term_count(&self) -> Option<usize> {
        self.work
            .proportional
            .as_ref()
            .map(proportional::Transition::term_count)
    }

    /// Returns the number of frames taken.
    pub fn steps(&self) -> u64 {
        self.state.steps
    }

    /// Returns the state for a checkpoint.
    pub fn state(&self) -> &FilterState {
        &self.state
    }

    /// Returns the known excitation of the last frame (N_f), NaN where it was missing; zero before the first.
    pub(crate) fn last_excitation(&self) -> &DVector<f64> {
        &self.state.last_excitation
    }

    /// Returns what the last frame says of its unknown excitation, for models with a direct term.
    pub(crate) fn excitation_posterior(&self) -> Option<&ExcitationPosterior> {
        self.state.posterior.as_ref()
    }

    /// Takes the state of a checkpoint; the next step gives the same bits as if the filter had never stopped.
    ///
    /// # Errors
    /// When the state does not fit the model.
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

    /// At its prior, takes the motion to be as large as another filter has seen it.
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

    /// From now on the noise levels are `psi` (N_ψ), and no outliers are screened: another filter of the same frames does
    /// both.
    pub(crate) fn follow(&mut self, psi: &[f64]) {
        self.follows = true;
        self.state.noise.mean.copy_from_slice(psi);
    }

    /// From now on identifies the noise levels and screens outliers, continuing from what another filter knew of them.
    pub(crate) fn lead(&mut self, noise: NoiseState, outliers: Option<OutlierState>) {
        self.follows = false;
        (self.state.noise, self.state.outliers) = (noise, outliers);
    }

    /// Takes over mean and covariance, and what filter `source` of the same motion knows besides them.
    ///
    /// `origin` says which entry of the state of `source` an entry of this one's is, if any.
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

    /// Sorts out what is known of the excitation at both ends of the step, and writes its covariances.
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

    /// Writes `Σ_f` of the coming step and of the frame, and `Σ_n`, for the noise parameters as they now are.
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
            // a missing sample of a measured excitation is as uncertain as the excitation itself is large
            work.step_excitation[(j, j)] += work.missing[j];
            if frame.excitation[j].is_nan() {
                work.frame_excitation[(j, j)] += state.excitation_mean_square[j];
            }
        }
    }

    /// Writes mean, `λ A Σ Aᵀ` and `B` of the coming instant; the first frame finds the prior.
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
            work.older.axpy(1.0, &work.newer, -1.0); // the slope, per step
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
            *mean += increment; // y ← y + Γ g                                      (2.67)
        }
        work.input_matrix
            .as_mut_slice()
            .copy_from_slice(&work.inputs.as_slice()[n..]); // B = Γ B_y
        self.finish_prediction();
    }

    /// Adds what the frame before has told of the excitation, given `A C` in the scratch space.
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
        // A Σ Aᵀ + A C Bᵀ + B Cᵀ Aᵀ + B W Bᵀ: the sensors have already felt the excitation of this step. Half of the last
        // goes to each of the two before, so that many forces cost no more than the state is long
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

    /// Writes innovation, `S`, `P Hᵀ` and `P`; screens outliers and moves the noise parameters in between.
    fn predict_observation(&mut self, frame: Frame<'_>) -> (NoiseEvents, usize) {
        let Self { model, work, .. } = self;
        model.linearise_observation(work.mean.as_slice(), work.newer.as_slice());
        model.observe(work.update.innovation.as_mut_slice());
        for (innovation, datum) in work.update.innovation.iter_mut().zip(frame.observations) {
            *innovation = datum - *innovation; // NaN where the channel is missing
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

    /// Rejects outliers, by the noise levels as they were before this step; returns how many there are.
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

    /// Returns the factor by which the start-up aid raises the noise of the sensors at this step.
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

    /// Moves the noise parameters by what this frame says of them.
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
            return NoiseEvents::default(); // the prior is for this very instant: nothing has aged
        }
        let lambda = settings.fading.value();
        // What the excitation of this step adds is already in S₀ when the frame before has told of it.
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
            // a missing sample of a measured excitation is as uncertain as the excitation itself is large
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

    /// Tells whether the unknown excitation of the coming step adds to the predicted covariance by its matrix `B`.
    ///
    /// It does not where the frame before has told of it, or where the model is constant and has other means.
    fn excitation_is_fresh(&self) -> bool {
        let felt = self.state.posterior.is_some() && !self.state.fresh;
        self.work.constant.is_none() && !felt
    }

    /// Adds the noises to `P Hᵀ` and `S`, and to `P` where the model is constant.
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

    /// Measures what the misfit does to the parameters, tempers what this step taught of them, and follows jumps.
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

    /// Brings entries of the state back to their limits; the covariance stays.
    ///
    /// Returns how many were beyond them, and whether the data put one of them there: its interval excludes the prior mean.
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
            // NaN is no reason to count here: the check of the result finds it
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

    /// Scales the covariance so that no variance exceeds its bound; returns how many did.
    fn bound_variances(&mut self) -> usize {
        let Self { settings, work, .. } = self;
        let (variances, bounds) = (&mut work.update.variances, &settings.variance_bound);
        if variances
            .iter()
            .zip(bounds)
            .all(|(variance, bound)| variance <= bound)
        {
            return 0; // without a look at the covariance: its diagonal is as far apart as its columns are long
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

    /// Makes the result of the step the state.
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
        // a filter that diverges tells nothing of how large the motion is
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
