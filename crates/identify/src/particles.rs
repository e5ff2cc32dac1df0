//! Particles instead of a Kalman filter, and a check whether they still follow the data.

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};
use spandrel_filter::{
    ExtendedKalmanFilter, FilterError, Frame, ParticleSettings, ProcessModel, Step, WarmStartState,
    WarmStartedParticleFilter,
};
use spandrel_structure::{ParticleKeys, Structure, StructureModel};

/// Memory of [`Health`] (s). With 50 frames per second it can distinguish 1 from 2, and it is short
/// enough to stop an alert.
const MEMORY_S: f64 = 5.0;
/// Mean normalised innovation squared per channel above which the particles have diverged. Their
/// predictions are then wrong by twice their stated deviation.
const LOST_MISFIT: f64 = 4.0;
/// The same mean below which the particles follow the data again.
const FOUND_MISFIT: f64 = 2.0;
/// Maximum contribution of one frame. A loss still shows within about a second, and a single
/// implausible frame fades within a few.
const MOST_MISFIT: f64 = 4.0 * LOST_MISFIT;
/// Mean relative effective sample size below which the particles have diverged, because hardly any
/// of them explains a frame.
const LOST_SHARE: f64 = 0.02;
/// The same size above which the particles follow the data again. A working filter has about a
/// third.
const FOUND_SHARE: f64 = 0.05;

/// Duration of a divergence (s) after which the particles are drawn from the prior again. A wrong
/// motion does not recover by itself.
const RESTART_AFTER_S: f64 = 30.0;

/// Settings of particles that replace a Kalman filter.
#[derive(Debug, Clone, PartialEq)]
pub struct ParticlePlan {
    /// Settings of the particle filter.
    pub settings: ParticleSettings,
    /// Standard deviation of the drift of each parameter within a second (ratio to nominal per √s).
    pub drift_per_root_s: f64,
    /// Run time of a Kalman filter before the particles are drawn (s).
    pub warm_up_s: f64,
}

impl Default for ParticlePlan {
    /// Returns 2000 particles from the optimal density after two seconds, with a drift of 1 % in
    /// four seconds.
    fn default() -> Self {
        Self::of(&ParticleKeys::default())
    }
}

impl ParticlePlan {
    /// Creates the plan that a structure file specifies, with one thread.
    #[must_use]
    pub fn of(keys: &ParticleKeys) -> Self {
        let ParticleKeys {
            particles,
            density,
            drift_per_root_s,
            warm_up_s,
        } = *keys;
        let settings = ParticleSettings {
            particles,
            density,
            ..ParticleSettings::default()
        };
        Self {
            settings,
            drift_per_root_s,
            warm_up_s,
        }
    }
}

/// How well the particles follow the data, as exponentially weighted means over about 5 s.
///
/// The particles have diverged if hardly any of them explains a frame, or if their predictions are
/// wrong by much more than they state.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Health {
    /// Mean relative effective sample size of the particles.
    share: f64,
    /// Mean normalised innovation squared per channel.
    misfit: f64,
    /// Number of frames with a channel since the particles were drawn.
    frames: u64,
    /// Number of frames with a channel since the particles diverged. `None` while they follow the
    /// data.
    lost: Option<u64>,
}

impl Health {
    const NEW: Self = Self {
        share: 1.0,
        misfit: 1.0,
        frames: 0,
        lost: None,
    };

    /// Returns the mean relative effective sample size, 0 to 1: the effective sample size divided
    /// by the number of particles.
    #[must_use]
    pub fn effective_share(&self) -> f64 {
        self.share
    }

    /// Returns the mean normalised innovation squared per channel, about 1 while the particles
    /// follow the data and larger if they do not.
    #[must_use]
    pub fn misfit(&self) -> f64 {
        self.misfit
    }

    /// Returns `true` while the particles have diverged. Their estimates are then meaningless.
    #[must_use]
    pub fn is_lost(&self) -> bool {
        self.lost.is_some()
    }

    /// Processes a frame with a channel. `memory` is in frames.
    fn take(&mut self, share: f64, misfit: f64, memory: f64) {
        let weight = 1.0 / memory.max(1.0);
        self.frames += 1;
        self.share += weight * (share - self.share);
        self.misfit += weight * (misfit.min(MOST_MISFIT) - self.misfit);
        self.lost = match self.lost {
            None => (self.misfit > LOST_MISFIT || self.share < LOST_SHARE).then_some(0),
            Some(frames) => {
                (self.misfit > FOUND_MISFIT || self.share < FOUND_SHARE).then_some(frames + 1)
            }
        };
    }
}

/// The state of particles between two frames, as stored in a checkpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ParticleMemory {
    filter: WarmStartState,
    health: Health,
    effective: (f64, u64),
}

/// A particle filter with the interface of the other filters.
#[derive(Debug)]
pub struct Particles {
    filter: WarmStartedParticleFilter<StructureModel>,
    /// Number of state entries before the parameters.
    first: usize,
    mean: DVector<f64>,
    /// Covariance of the state of the particles.
    covariance: DMatrix<f64>,
    /// Sum of the relative effective sample sizes, and the number of terms.
    effective: (f64, u64),
    health: Health,
    /// Memory of `health`, in frames.
    memory: f64,
}

impl Particles {
    /// Creates a particle filter for the model of the structure, at its prior.
    pub(crate) fn new(structure: &Structure, plan: &ParticlePlan) -> Result<Self, FilterError> {
        let model = structure.model();
        let parameters = model.parameter_len();
        let first = model.state_len() - parameters;
        let drift_std = DVector::repeat(
            parameters,
            plan.drift_per_root_s * structure.step_s().sqrt(),
        );
        let warm_steps = (plan.warm_up_s * structure.sampling_rate_hz()).round() as u64;
        let settings = structure.filter_settings()?;
        let filter = WarmStartedParticleFilter::new(
            model,
            settings,
            drift_std,
            plan.settings.clone(),
            warm_steps,
        )?;
        let len = filter.state_len();
        let mut particles = Self {
            first,
            mean: DVector::zeros(parameters),
            covariance: DMatrix::zeros(len, len),
            effective: (0.0, 0),
            health: Health::NEW,
            memory: MEMORY_S * structure.sampling_rate_hz(),
            filter,
        };
        particles.take_estimates();
        Ok(particles)
    }

    pub(crate) fn step(&mut self, frame: Frame<'_>) -> Result<Step, FilterError> {
        let step = self.filter.step(frame)?;
        if let Some(particles) = self.filter.particles() {
            let share = step.effective_size / particles.settings().particles as f64;
            self.effective.0 += share;
            self.effective.1 += 1;
            if step.used_channels > 0 {
                let misfit = step.normalised_innovation_squared / step.used_channels as f64;
                self.health.take(share, misfit, self.memory);
            }
        }
        self.take_estimates();
        Ok(Step {
            normalised_innovation_squared: step.normalised_innovation_squared,
            log_evidence: step.log_evidence,
            used_channels: step.used_channels,
            rejected_channels: 0,
            limited_states: 0,
            bounded_variances: 0,
            noise_phase: self.filter.kalman().noise().phase,
            training_ended: false,
            training_overdue: false,
            training_restarted: false,
        })
    }

    pub(crate) fn restart(&mut self) -> Result<(), FilterError> {
        let restarted = self.filter.restart();
        (self.health, self.effective) = (Health::NEW, (0.0, 0));
        self.take_estimates();
        restarted
    }

    /// Discards the motion. Particles that have lost the state know nothing about the parameters
    /// either, and restart from the prior.
    pub(crate) fn forget_motion(&mut self) {
        if self.health.is_lost() && self.restart().is_ok() {
            return;
        }
        self.filter.forget_motion();
        self.health = Health::NEW;
        self.take_estimates();
    }

    pub(crate) fn state(&self) -> ParticleMemory {
        ParticleMemory {
            filter: self.filter.state(),
            health: self.health,
            effective: self.effective,
        }
    }

    pub(crate) fn restore(&mut self, memory: ParticleMemory) -> Result<(), FilterError> {
        self.filter.restore(memory.filter)?;
        (self.health, self.effective) = (memory.health, memory.effective);
        self.take_estimates();
        Ok(())
    }

    /// Returns the relative effective sample size before resampling, as the mean over all steps of
    /// the particles so far. `None` before the first step.
    ///
    /// It is the effective sample size divided by the number of particles (0 to 1).
    #[must_use]
    pub fn effective_share(&self) -> Option<f64> {
        let (sum, count) = self.effective;
        (count > 0).then(|| sum / count as f64)
    }

    /// Returns how well the particles follow the data. `None` while the Kalman filter warms up.
    #[must_use]
    pub fn health(&self) -> Option<Health> {
        (self.health.frames > 0).then_some(self.health)
    }

    /// Returns `true` if the particles have diverged for so long that they must be drawn from the
    /// prior again.
    pub(crate) fn are_beyond_recovery(&self) -> bool {
        self.health
            .lost
            .is_some_and(|frames| frames as f64 > RESTART_AFTER_S / MEMORY_S * self.memory)
    }

    /// Returns the number of particles.
    #[must_use]
    pub fn count(&self) -> usize {
        self.filter.particle_count()
    }

    pub(crate) fn kalman(&self) -> &ExtendedKalmanFilter<StructureModel> {
        self.filter.kalman()
    }

    pub(crate) fn innovation(&self) -> &[f64] {
        self.filter.innovation()
    }

    pub(crate) fn first(&self) -> usize {
        self.first
    }

    pub(crate) fn parameter_mean(&self) -> &[f64] {
        self.mean.as_slice()
    }

    pub(crate) fn parameter_covariance(&self, i: usize, j: usize) -> f64 {
        self.covariance[(self.first + i, self.first + j)]
    }

    pub(crate) fn state_mean(&self) -> &[f64] {
        self.filter.mean()
    }

    pub(crate) fn state_covariance(&self) -> &DMatrix<f64> {
        &self.covariance
    }

    fn take_estimates(&mut self) {
        self.mean.copy_from_slice(&self.filter.mean()[self.first..]);
        self.filter.covariance_to(&mut self.covariance);
    }
}
