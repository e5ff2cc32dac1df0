//! The adaptive extended Kalman filter: predict and update, with the stages around them.
//!
//! Source: Huang & Yuen (2023), §2.4 (fading memory) and §3.2 (noise parameters). A step follows
//! the order of equations (3.14) to (3.18) and updates the noise parameters before the state.

mod correction;
mod estimates;
mod handover;
mod marginal;
mod observation;
mod prediction;
mod propagator;
mod settings;
mod state;
mod workspace;

pub use settings::{Annealing, FilterSettings};
pub use state::FilterState;

use crate::error::FilterError;
use crate::model::{ObservationModel, ProcessModel};
use crate::noise::NoisePhase;
use crate::update;
use workspace::Workspace;

/// Samples of all channels at one time step.
#[derive(Debug, Clone, Copy)]
pub struct Frame<'a> {
    /// Measured values `z`, one per observation channel (N_0, sensor units). NaN marks a missing
    /// value.
    pub observations: &'a [f64],
    /// The known part of the excitation, one value per component (N_f). An unmeasured component has
    /// 0, a missing sample NaN.
    pub excitation: &'a [f64],
}

/// Result of one step. The estimates themselves are available from the filter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Step {
    /// Normalised innovation squared: `νᵀ S⁻¹ ν`, with the innovation `ν` and its covariance `S`.
    /// If the model is right, it follows χ² with [`Step::used_channels`] degrees of freedom.
    pub normalised_innovation_squared: f64,
    /// Log evidence of the frame: `ln p(z | D)`, where `z` is the measurement of this frame and `D`
    /// are the data before it.
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
/// Each call of [`ExtendedKalmanFilter::step`] is one time step. A step does not allocate, and its
/// results are bit-identical for the same frames. The first frame updates the prior without a
/// prediction, because the prior applies to the time of the first frame.
///
/// A diverged filter returns an error from `step`, and the caller must call
/// [`ExtendedKalmanFilter::restart`]. [`ExtendedKalmanFilter::state`] and
/// [`ExtendedKalmanFilter::restore`] write and read a checkpoint at any frame.
///
/// The filter represents the state by a mean and a covariance. For distributions without a Gaussian
/// shape, [`ParticleFilter`](crate::ParticleFilter) is available at a much higher cost.
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
        let rejected_channels = self.predict_observation(frame);
        let noise_events = self.update_noise(frame);
        self.add_noises(frame);
        let used = update::leave_out_missing(&mut self.work.update, &mut self.work.p_ht);
        let evidence = update::factorise(&mut self.work.update, used)?;
        if !evidence.log_evidence.is_finite() {
            return Err(FilterError::NotFinite {
                what: "normalised innovation",
                index: 0,
            });
        }
        self.update_state();
        let per_channel = evidence.normalised_innovation_squared / used.max(1) as f64;
        self.answer_misfit(per_channel);
        self.reopen_motion();
        let limited = self.limit_state();
        let bounded_variances = self.bound_variances();
        self.check_result()?;
        self.judge_fit(frame, per_channel, limited.is_on_bound);
        self.commit(frame, evidence.normalised_innovation_squared);
        Ok(Step {
            normalised_innovation_squared: evidence.normalised_innovation_squared,
            log_evidence: evidence.log_evidence,
            used_channels: used,
            rejected_channels,
            limited_states: limited.states,
            bounded_variances,
            noise_phase: self.state.noise.phase,
            training_ended: noise_events.training_ended,
            training_overdue: noise_events.training_overdue,
            training_restarted: noise_events.training_restarted,
        })
    }

    /// Sets the noise parameters `psi` (N_ψ) to known levels, for example from a schedule.
    ///
    /// The next step starts from these levels. Every rule except [`Fixed`](crate::NoiseRule::Fixed)
    /// then updates them.
    ///
    /// # Errors
    /// Returns an error if the number of levels does not fit the model, or if a level is not
    /// positive and finite.
    pub fn set_noise_parameters(&mut self, psi: &[f64]) -> Result<(), FilterError> {
        FilterError::check_sizes([("noise parameters", psi.len(), self.state.noise.mean.len())])?;
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

    /// Sets whether the coming frames contain information about the parameters.
    ///
    /// Without it, the frames update the motion only. The means of the parameters and the published
    /// covariance do not change.
    pub fn set_teaching(&mut self, teaches: bool) {
        self.work.teaches = teaches;
    }

    /// Sets the reliability `κ` (N_f, 0 to 1) of the known excitation of the coming frames.
    ///
    /// `κ` is the variance of the true excitation divided by that of its samples, which contain the
    /// noise of the sensor: Fuller (1987), §1.1. Given the samples `f`, the excitation then has the
    /// mean `κ f` and the variance `κ Σ_f`. The filter uses both. With `κ = 1`, which is the
    /// initial value, any excitation is equally probable before it is measured.
    ///
    /// A model without parameters learns nothing from the excitation and always uses `κ = 1`.
    ///
    /// # Errors
    /// Returns an error if the length does not fit the model, or if a value is outside 0 to 1.
    pub fn set_reliability(&mut self, reliability: &[f64]) -> Result<(), FilterError> {
        let (found, expected) = (reliability.len(), self.work.reliability.len());
        if found != expected {
            return Err(FilterError::Dimension {
                what: "reliabilities of the excitation",
                found,
                expected,
            });
        }
        if let Some(&found) = reliability
            .iter()
            .find(|share| !(0.0..=1.0).contains(*share))
        {
            return Err(FilterError::Setting {
                what: "reliability of the excitation",
                found,
                allowed: "0 to 1",
            });
        }
        if self.work.propagator.time_invariant().is_none() {
            self.work.reliability.copy_from_slice(reliability);
        }
        Ok(())
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
        FilterError::check_sizes(sizes)
    }
}

#[cfg(test)]
mod tests;
