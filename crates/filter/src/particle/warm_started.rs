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
use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

/// The complete state of a warm-started filter between two steps, for a checkpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[expect(
    clippy::large_enum_variant,
    reason = "one of them exists per filter, and it lives in a checkpoint only"
)]
pub enum WarmStartState {
    /// The Kalman filter is running.
    Warming {
        /// The Kalman filter.
        kalman: FilterState,
        /// Number of frames left for the Kalman filter.
        left: u64,
    },
    /// The particle filter is running, with the noise levels (N_ψ) identified by the Kalman filter.
    Running {
        /// The particles.
        particles: ParticleState,
        /// The noise levels.
        noise_levels: DVector<f64>,
    },
}

/// A particle filter of any [`ProcessModel`] and [`ObservationModel`], with a Kalman filter for its
/// first frames.
///
/// The particle filter starts from the mean and the covariance of the Kalman filter, including
/// correlations. It also takes over the noise levels, which then remain constant.
#[derive(Debug, Clone)]
pub struct WarmStartedParticleFilter<M> {
    kalman: ExtendedKalmanFilter<M>,
    particles: ParticleFilter<ExcitedSystem<M>>,
    prior: GaussianStart,
    noise_levels: DVector<f64>,
    warm_steps: u64,
    /// Number of frames left for the Kalman filter.
    left: u64,
}

impl<M: ProcessModel + ObservationModel + Clone + Send> WarmStartedParticleFilter<M> {
    /// Creates a filter at its prior.
    ///
    /// - `drift_std`: standard deviation of the increment of each parameter per step (N_θ,
    ///   parameter units)
    /// - `warm_steps`: number of frames for the Kalman filter; 0 draws the particles from the prior
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
        let noise_levels = kalman.noise().mean.clone();
        Ok(Self {
            kalman,
            particles,
            prior,
            noise_levels,
            warm_steps,
            left: warm_steps,
        })
    }

    /// Returns to the prior.
    ///
    /// # Errors
    /// Passes on errors of both filters, which do not occur after a successful
    /// [`WarmStartedParticleFilter::new`].
    pub fn restart(&mut self) -> Result<(), FilterError> {
        self.kalman.restart();
        self.left = self.warm_steps;
        self.take_noise_levels(self.kalman.noise().mean.clone())?;
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
        self.left -= 1;
        if self.left == 0 {
            self.take_noise_levels(self.kalman.noise().mean.clone())?;
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
        if self.left > 0 {
            WarmStartState::Warming {
                kalman: self.kalman.state().clone(),
                left: self.left,
            }
        } else {
            WarmStartState::Running {
                particles: self.particles.state().clone(),
                noise_levels: self.noise_levels.clone(),
            }
        }
    }

    /// Restores the state of a checkpoint; subsequent steps are bit-identical to an uninterrupted
    /// run.
    ///
    /// # Errors
    /// Returns an error if the state does not fit the model or the settings.
    pub fn restore(&mut self, state: WarmStartState) -> Result<(), FilterError> {
        match state {
            WarmStartState::Warming { kalman, left } => {
                self.kalman.restore(kalman)?;
                self.left = left.max(1);
            }
            WarmStartState::Running {
                particles,
                noise_levels,
            } => {
                self.particles.restore(particles)?;
                self.take_noise_levels(noise_levels)?;
                self.left = 0;
            }
        }
        Ok(())
    }

    fn take_noise_levels(&mut self, levels: DVector<f64>) -> Result<(), FilterError> {
        let mut taken = Ok(());
        self.particles.update_model(|model| {
            if let Err(error) = model.take_noise_levels(&levels) {
                taken = Err(error);
            }
        });
        taken?;
        self.noise_levels = levels;
        Ok(())
    }
}
