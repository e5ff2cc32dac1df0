//! Time that a step of the particle filter takes, from the size of the state and the number of
//! particles.

use super::{Finding, TimeStepReport};
use crate::settings::ParticleKeys;
use crate::structure::Structure;
use spandrel_filter::{ImportanceDensity, ProcessModel};

/// Maximum number of states and parameters for which thousands of particles suffice.
pub const MOST_PARTICLE_STATES: usize = 10;
/// Maximum share of the frame interval for a step; the services need the rest.
const MOST_OF_A_STEP: f64 = 0.5;
/// Measured time (s) of one particle in a step with the prior density, on one 2.5 GHz core.
///
/// The three constants cover the cost of a particle with either density and the cost of each number
/// in a series term. Four examples agree with the sum to 15 %.
const PER_PARTICLE_PRIOR_S: f64 = 1.8e-6;
const PER_PARTICLE_OPTIMAL_S: f64 = 5e-6;
const PER_NUMBER_S: f64 = 6e-9;

impl Structure {
    /// Reports whether the particles are fast enough and numerous enough; empty without particles.
    pub(super) fn particle_findings(&self, time_step: &TimeStepReport) -> Vec<Finding> {
        let Some(keys) = self.particles() else {
            return Vec::new();
        };
        let (states, step_s) = (self.model().state_len(), self.step_s());
        let needed_s = self.particle_step_s(&keys, time_step);
        let mut findings = vec![match needed_s > MOST_OF_A_STEP * step_s {
            true => Finding::ParticlesTooSlow { needed_s, step_s },
            false => Finding::ParticlesInTime { needed_s, step_s },
        }];
        if states > MOST_PARTICLE_STATES {
            findings.push(Finding::ParticlesTooFew {
                states,
                particles: keys.particles,
            });
        }
        findings
    }

    /// Estimates the time of a step (s) on one core.
    ///
    /// It depends on the number of particles, the size of the state and the terms of the series.
    /// Other machines differ by a factor of two or three.
    fn particle_step_s(&self, keys: &ParticleKeys, time_step: &TimeStepReport) -> f64 {
        let (per_particle_s, columns) = match keys.density {
            ImportanceDensity::Prior => (PER_PARTICLE_PRIOR_S, 1),
            // The motion twice, the excitations and the parameters, for the Jacobian of the frame.
            ImportanceDensity::Optimal => (
                PER_PARTICLE_OPTIMAL_S,
                2 + self.excitation_channels().len() + self.parameters().len(),
            ),
        };
        let terms = time_step.substeps * time_step.series_order;
        let numbers = (terms * self.model().state_len() * columns) as f64;
        keys.particles as f64 * (per_particle_s + PER_NUMBER_S * numbers)
    }
}
