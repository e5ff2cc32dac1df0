//! A particle filter that starts from an extended Kalman filter of the same system.
//!
//! With accurate sensors and a wide prior the weights of the first frames fall on a handful of particles, whose wrong initial
//! motion nothing mends. A Kalman filter over the first second narrows the Gaussian from which the particles are drawn.

use super::{
    ExcitedSystem, GaussianStart, ParticleFilter, ParticleSettings, ParticleState, ParticleStep,
};
use crate::error::FilterError;
use crate::extended::{ExtendedKalmanFilter, FilterSettings, FilterState, Frame};
use crate::model::{ObservationModel, ProcessModel};
use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

/// The whole state of a warm-started filter between two steps: what a checkpoint holds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[expect(
    clippy::large_enum_variant,
    reason = "one of them exists per filter, and it lives in a checkpoint only"
)]
pub enum WarmStartState {
    /// The Kalman filter runs.
    Warming {
        /// The Kalman filter.
        kalman: FilterState,
        /// Frames that it still takes.
        left: u64,
    },
    /// The particles run, with the noise levels (N_ψ) that the Kalman filter had found.
    Running {
        /// The particles.
        particles: ParticleState,
        /// The noise levels.
        noise_levels: DVector<f64>,
    },
}

/// A particle filter of any [`ProcessModel`] and [`ObservationModel`], with a Kalman filter for its first frames.
///
/// At the change it takes mean and covariance over, the correlations included, and the noise levels, which stay as they are
/// from then on.
#[derive(Debug, Clone)]
pub struct WarmStartedParticleFilter<M> {
    kalman: ExtendedKalmanFilter<M>,
    particles: ParticleFilter<ExcitedSystem<M>>,
    prior: GaussianStart,
    noise_levels: DVector<f64>,
    warm_steps: u64,
    /// frames that the Kalman filter still takes
    left: u64,
}

impl<M: ProcessModel + ObservationModel + Clone + Send> WarmStartedParticleFilter<M> {
    /// Makes a filter at its prior.
    ///
    /// `drift_std`: standard deviation of the increment of each parameter per step (N_θ, parameter units). `warm_steps`:
    /// frames that the Kalman filter takes, 0 to draw the particles from the prior.
    ///
    /// # Errors
    /// When a setting does not fit the model or lies outside its range.
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

    /// Goes back to the prior.
    ///
    /// # Errors
    /// None for a filter that could be made: those of its parts are passed on.
    pub fn restart(&mut self) -> Result<(), FilterError> {
        self.kalman.restart();
        self.left = self.warm_steps;
        self.take_noise_levels(self.kalman.noise().mean.clone())?;
        self.particles.restart_from(self.prior.clone())
    }

    /// Forgets the motion and keeps mean and covariance of the parameters, and the noise levels: after a gap too long to be
    /// bridged. The Kalman filter runs again for as long as at the start, one frame at least.
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

    /// Takes one frame.
    ///
    /// The step at which the particles take over allocates, no other one does.
    ///
    /// # Errors
    /// When the frame does not fit the model, which leaves the filter as it was, or when the filter has diverged and must
    /// be restarted.
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

    /// Returns the Kalman filter; it stands still once the particles run.
    pub fn kalman(&self) -> &ExtendedKalmanFilter<M> {
        &self.kalman
    }

    /// Returns the mean of the state (n), from whichever filter runs.
    pub fn mean(&self) -> &[f64] {
        let n = self.kalman.mean().len();
        if self.left > 0 {
            self.kalman.mean().as_slice()
        } else {
            &self.particles.mean().as_slice()[..n]
        }
    }

    /// Returns the standard deviation of one entry of the state, from whichever filter runs; `None` beyond its end.
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

    /// Returns the innovation of the last step (N_0, sensor units), from whichever filter runs; NaN where a channel was missing.
    pub fn innovation(&self) -> &[f64] {
        if self.left > 0 {
            self.kalman.innovation().as_slice()
        } else {
            self.particles.innovation()
        }
    }

    /// Returns the length of the state of the particles: that of the model, and the excitation of one with a direct term.
    pub fn state_len(&self) -> usize {
        self.particles.mean().len()
    }

    /// Writes the covariance of the filter that runs.
    ///
    /// `out`: as long and wide as the state of the particles, which holds the excitation behind the state of a model with
    /// a direct term; those entries are zero while the Kalman filter runs.
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

    /// Takes the state of a checkpoint; the next step gives the same bits as if the filter had never stopped.
    ///
    /// # Errors
    /// When the state does not fit the model or the settings.
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
