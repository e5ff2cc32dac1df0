//! A particle filter that starts from an extended Kalman filter of the same system.
//!
//! With accurate sensors and a wide prior the weights of the first frames fall on a handful of particles, whose wrong initial
//! motion nothing mends. A Kalman filter over the first second narrows the Gaussian from which the particles are drawn.

use super::{ExcitedSystem, GaussianStart, ParticleFilter, ParticleSettings, ParticleState, ParticleStep};
use crate::error::FilterError;
use crate::extended::{ExtendedKalmanFilter, FilterSettings, FilterState, Frame};
use crate::model::{ObservationModel, ProcessModel};
use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

/// The whole state of a warm-started filter between two steps: what a checkpoint holds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[expect(clippy::large_enum_variant, reason = "one of them exists per filter, and it lives in a checkpoint only")]
pub enum WarmStartState {
    /// The Kalman filter runs.
    Warming(FilterState),
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
    warming: bool,
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
        Ok(Self { kalman, particles, prior, noise_levels, warm_steps, warming: warm_steps > 0 })
    }

    /// Goes back to the prior.
    ///
    /// # Errors
    /// None for a filter that could be made: those of its parts are passed on.
    pub fn restart(&mut self) -> Result<(), FilterError> {
        self.kalman.restart();
        self.warming = self.warm_steps > 0;
        self.take_noise_levels(self.kalman.noise().mean.clone())?;
        self.particles.restart_from(self.prior.clone())
    }

    /// Takes one frame.
    ///
    /// The step at which the particles take over allocates, no other one does.
    ///
    /// # Errors
    /// When the frame does not fit the model, which leaves the filter as it was, or when the filter has diverged and must
    /// be restarted.
    pub fn step(&mut self, frame: Frame<'_>) -> Result<ParticleStep, FilterError> {
        if !self.warming {
            return self.particles.step(frame);
        }
        let step = self.kalman.step(frame)?;
        if self.kalman.steps() >= self.warm_steps {
            self.take_noise_levels(self.kalman.noise().mean.clone())?;
            self.particles.restart_from(self.particles.model().start_after(&self.kalman))?;
            self.warming = false;
        }
        Ok(ParticleStep {
            log_evidence: step.log_evidence,
            used_channels: step.used_channels,
            effective_size: self.particles.settings().particles as f64,
            coefficient_of_variation: 0.0,
            resampled: false,
        })
    }

    /// Returns the particle filter, or `None` while the Kalman filter runs.
    pub fn particles(&mut self) -> Option<&mut ParticleFilter<ExcitedSystem<M>>> {
        (!self.warming).then_some(&mut self.particles)
    }

    /// Returns the Kalman filter; it stands still once the particles run.
    pub fn kalman(&self) -> &ExtendedKalmanFilter<M> {
        &self.kalman
    }

    /// Returns the mean of the state (n), from whichever filter runs.
    pub fn mean(&self) -> &[f64] {
        let n = self.kalman.mean().len();
        if self.warming { self.kalman.mean().as_slice() } else { &self.particles.mean().as_slice()[..n] }
    }

    /// Returns the standard deviation of one entry of the state, from whichever filter runs; `None` beyond its end.
    pub fn std(&self, component: usize) -> Option<f64> {
        if component >= self.kalman.mean().len() {
            None
        } else if self.warming {
            Some(self.kalman.covariance()[(component, component)].max(0.0).sqrt())
        } else {
            Some(self.particles.std()[component])
        }
    }

    /// Writes the covariance of the filter that runs.
    ///
    /// `out`: as long and wide as the state of the particles, which holds the excitation behind the state of a model with
    /// a direct term; those entries are zero while the Kalman filter runs.
    pub fn covariance_to(&self, out: &mut DMatrix<f64>) {
        if self.warming {
            let n = self.kalman.mean().len();
            out.fill(0.0);
            out.view_mut((0, 0), (n, n)).copy_from(self.kalman.covariance());
        } else {
            self.particles.covariance_to(out);
        }
    }

    /// Returns the state for a checkpoint.
    pub fn state(&self) -> WarmStartState {
        if self.warming {
            WarmStartState::Warming(self.kalman.state().clone())
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
            WarmStartState::Warming(state) => {
                self.kalman.restore(state)?;
                self.warming = true;
            }
            WarmStartState::Running { particles, noise_levels } => {
                self.particles.restore(particles)?;
                self.take_noise_levels(noise_levels)?;
                self.warming = false;
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
