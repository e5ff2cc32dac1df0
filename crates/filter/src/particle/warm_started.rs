//! A particle filter that starts from an extended Kalman filter of the same system.
//!
//! With accurate sensors and a wide prior, the weights of the first frames concentrate on a few
//! particles. No later step corrects their wrong initial motion. A Kalman filter over the first
//! second narrows the Gaussian from which the particles are drawn.

use super::{
    ExcitedSystem, GaussianStart, ParticleFilter, ParticleSettings, ParticleState, ParticleStep,
};
use crate::error::FilterError;
use crate::extended::{ExtendedKalmanFilter, FilterSettings, FilterState, Frame};
use crate::model::{ObservationModel, ProcessModel};
use crate::noise::NoisePhase;
use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

/// The complete state of a warm-started filter between two steps, for a checkpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WarmStartState {
    /// The Kalman filter, which is idle while the particle filter runs.
    kalman: FilterState,
    /// Number of frames left for the Kalman filter.
    left: u64,
    /// `None` while the Kalman filter runs.
    particles: Option<ParticleState>,
}

/// A particle filter of any [`ProcessModel`] and [`ObservationModel`], with a Kalman filter for its
/// first frames.
///
/// The particle filter starts from the mean and the covariance of the Kalman filter, including
/// correlations. It also takes over the noise levels, which then remain constant. The Kalman filter
/// therefore runs until their training has ended, even if this takes longer than planned.
#[derive(Debug, Clone)]
pub struct WarmStartedParticleFilter<M> {
    kalman: ExtendedKalmanFilter<M>,
    particles: ParticleFilter<ExcitedSystem<M>>,
    prior: GaussianStart,
    warm_steps: u64,
    /// Number of frames left for the Kalman filter.
    left: u64,
}

impl<M: ProcessModel + ObservationModel + Clone + Send> WarmStartedParticleFilter<M> {
    /// Creates a filter at its prior.
    ///
    /// - `drift_std`: standard deviation of the increment of each parameter per step (N_θ,
    ///   parameter units)
    /// - `warm_steps`: number of frames for the Kalman filter; 0 draws the particles from the
    ///   prior, if no noise level must be trained
    ///
    /// # Errors
    /// Returns an error if a setting does not fit the model or is out of range.
    pub fn new(
        model: M,
        settings: FilterSettings,
        drift_std: DVector<f64>,
        particle_settings: ParticleSettings,
        warm_steps: u64,
    ) -> Result<Self, FilterError> {
        let system = ExcitedSystem::new(model.clone(), &settings, drift_std)?;
        let prior = system.start_at_prior(&settings);
        let particles = ParticleFilter::new(system, particle_settings, prior.clone())?;
        let kalman = ExtendedKalmanFilter::new(model, settings)?;
        Ok(Self {
            left: first_steps(&kalman, warm_steps),
            kalman,
            particles,
            prior,
            warm_steps,
        })
    }

    /// Returns to the prior.
    ///
    /// # Errors
    /// Returns errors of both filters, which do not occur after a successful
    /// [`WarmStartedParticleFilter::new`].
    pub fn restart(&mut self) -> Result<(), FilterError> {
        self.kalman.restart();
        self.left = first_steps(&self.kalman, self.warm_steps);
        self.take_noise_levels()?;
        self.particles.restart_from(self.prior.clone())
    }

    /// Discards the motion after a gap that is too long to bridge.
    ///
    /// It keeps the mean and covariance of the parameters and the noise levels. The Kalman filter
    /// then runs again for `warm_steps` frames, at least one.
    pub fn forget_motion(&mut self) {
        if self.left == 0 {
            let n = self.kalman.mean().len();
            let len = self.particles.mean().len();
            let mut covariance = DMatrix::zeros(len, len);
            self.particles.covariance_to(&mut covariance);
            let mean = DVector::from_column_slice(&self.particles.mean().as_slice()[..n]);
            let known = self.kalman.state().clone();
            self.kalman.continue_from(
                &known,
                mean,
                covariance.view((0, 0), (n, n)).into_owned(),
                Some,
            );
        }
        self.kalman.forget_motion();
        self.left = self.warm_steps.max(1);
    }

    /// Processes one frame.
    ///
    /// Only the step in which the particle filter takes over allocates.
    ///
    /// # Errors
    /// Returns an error in these cases:
    ///
    /// - The frame does not fit the model. The filter is then unchanged.
    /// - The filter has diverged. The caller must then restart it.
    pub fn step(&mut self, frame: Frame<'_>) -> Result<ParticleStep, FilterError> {
        if self.left == 0 {
            return self.particles.step(frame);
        }
        let step = self.kalman.step(frame)?;
        let is_training = self.kalman.noise().phase == NoisePhase::Training;
        self.left = (self.left - 1).max(u64::from(is_training));
        if self.left == 0 {
            self.take_noise_levels()?;
            self.particles
                .restart_from(self.particles.model().start_after(&self.kalman))?;
        }
        Ok(ParticleStep {
            log_evidence: step.log_evidence,
            used_channels: step.used_channels,
            normalised_innovation_squared: step.normalised_innovation_squared,
            effective_size: self.particles.settings().particles as f64,
            coefficient_of_variation: 0.0,
            resampled: false,
        })
    }

    /// Returns the particle filter, or `None` while the Kalman filter runs.
    pub fn particles(&mut self) -> Option<&mut ParticleFilter<ExcitedSystem<M>>> {
        (self.left == 0).then_some(&mut self.particles)
    }

    /// Returns the number of particles.
    pub fn particle_count(&self) -> usize {
        self.particles.settings().particles
    }

    /// Returns the Kalman filter, which is idle while the particle filter runs.
    pub fn kalman(&self) -> &ExtendedKalmanFilter<M> {
        &self.kalman
    }

    /// Returns the mean of the state (n) from the active filter.
    pub fn mean(&self) -> &[f64] {
        let n = self.kalman.mean().len();
        if self.left > 0 {
            self.kalman.mean().as_slice()
        } else {
            &self.particles.mean().as_slice()[..n]
        }
    }

    /// Returns the standard deviation of one state entry from the active filter; `None` if the
    /// entry does not exist.
    pub fn std(&self, component: usize) -> Option<f64> {
        if component >= self.kalman.mean().len() {
            None
        } else if self.left > 0 {
            Some(
                self.kalman.covariance()[(component, component)]
                    .max(0.0)
                    .sqrt(),
            )
        } else {
            Some(self.particles.std()[component])
        }
    }

    /// Returns the innovation of the last step (N_0, sensor units) from the active filter, NaN for
    /// missing channels.
    pub fn innovation(&self) -> &[f64] {
        if self.left > 0 {
            self.kalman.innovation().as_slice()
        } else {
            self.particles.innovation()
        }
    }

    /// Returns the length of the particle state: the state of the model, and its excitation if it
    /// has a direct term.
    pub fn state_len(&self) -> usize {
        self.particles.mean().len()
    }

    /// Computes the covariance of the active filter.
    ///
    /// `out` is square with the length of the particle state. With a direct term, this state
    /// contains the excitation after the state of the model. These entries are zero while the
    /// Kalman filter is active.
    pub fn covariance_to(&self, out: &mut DMatrix<f64>) {
        if self.left > 0 {
            let n = self.kalman.mean().len();
            out.fill(0.0);
            out.view_mut((0, 0), (n, n))
                .copy_from(self.kalman.covariance());
        } else {
            self.particles.covariance_to(out);
        }
    }

    /// Returns the state for a checkpoint.
    pub fn state(&self) -> WarmStartState {
        let particles = || self.particles.state().clone();
        WarmStartState {
            kalman: self.kalman.state().clone(),
            left: self.left,
            particles: (self.left == 0).then(particles),
        }
    }

    /// Restores the state of a checkpoint; subsequent steps are bit-identical to an uninterrupted
    /// run.
    ///
    /// # Errors
    /// Returns an error if the state does not fit the model or the settings.
    pub fn restore(&mut self, state: WarmStartState) -> Result<(), FilterError> {
        self.kalman.restore(state.kalman)?;
        let Some(particles) = state.particles else {
            self.left = state.left.max(1);
            return Ok(());
        };
        self.particles.restore(particles)?;
        self.left = 0;
        self.take_noise_levels()
    }

    /// Gives the particles the noise levels of the Kalman filter.
    fn take_noise_levels(&mut self) -> Result<(), FilterError> {
        let levels = &self.kalman.noise().mean;
        let mut taken = Ok(());
        self.particles.update_model(|model| {
            if let Err(error) = model.take_noise_levels(levels) {
                taken = Err(error);
            }
        });
        taken
    }
}

/// Returns the number of frames for the Kalman filter, at least one if it trains noise levels.
fn first_steps<M: ProcessModel + ObservationModel>(
    kalman: &ExtendedKalmanFilter<M>,
    warm_steps: u64,
) -> u64 {
    let is_training = kalman.noise().phase == NoisePhase::Training;
    warm_steps.max(u64::from(is_training))
}
