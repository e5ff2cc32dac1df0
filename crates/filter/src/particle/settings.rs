//! Settings of a particle filter.

use crate::error::FilterError;
use serde::{Deserialize, Serialize};

/// The density from which the particles of a step are drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ImportanceDensity {
    /// The Gaussian density of one extended Kalman step from each particle.
    ///
    /// It wastes few particles but costs one Jacobian per particle. It is best with accurate
    /// sensors and a cheap Jacobian.
    #[default]
    Optimal,
    /// The prediction, independent of the datum.
    ///
    /// It is several times cheaper and sufficient with noisy sensors.
    Prior,
}

/// The resampling scheme.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Resampling {
    /// One uniform number and equidistant points on the cumulative weights: lowest variance.
    #[default]
    Systematic,
    /// Independent draws.
    Multinomial,
}

/// Settings of a particle filter, apart from its model and its start density.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ParticleSettings {
    /// `N`. The error of an estimate decreases with its square root.
    pub particles: usize,
    /// The density from which particles are drawn.
    pub density: ImportanceDensity,
    /// Coefficient of variation of the weights above which the filter resamples; 2 means an
    /// effective size of `N/5`.
    pub resampling_threshold: f64,
    /// The resampling scheme.
    pub resampling: Resampling,
    /// `a` of the resampling kernel, in (0, 1]; 1 for no kernel.
    ///
    /// A smaller value separates particles without any other disturbance, but smooths the
    /// distribution.
    pub kernel: f64,
    /// Seed of all draws.
    pub seed: u64,
    /// Number of threads that share the particles; the result does not depend on it.
    ///
    /// With one thread, a step does not allocate. With more threads, it may allocate occasionally.
    pub threads: usize,
}

impl Default for ParticleSettings {
    fn default() -> Self {
        Self {
            particles: 2000,
            density: ImportanceDensity::Optimal,
            resampling_threshold: 2.0,
            resampling: Resampling::Systematic,
            kernel: 1.0,
            seed: 0,
            threads: 1,
        }
    }
}

impl ParticleSettings {
    pub(super) fn check(&self) -> Result<(), FilterError> {
        if self.particles < 2 || u32::try_from(self.particles).is_err() {
            let found = self.particles as f64;
            return Err(FilterError::Setting {
                what: "number of particles",
                found,
                allowed: "at least 2, below 2³²",
            });
        }
        if self.resampling_threshold.is_nan() || self.resampling_threshold < 0.0 {
            let (what, found) = ("resampling threshold", self.resampling_threshold);
            return Err(FilterError::Setting {
                what,
                found,
                allowed: "not negative",
            });
        }
        if !(self.kernel > 0.0 && self.kernel <= 1.0) {
            let allowed = "above 0 and at most 1";
            return Err(FilterError::Setting {
                what: "kernel of the resampling",
                found: self.kernel,
                allowed,
            });
        }
        if !(1..=1024).contains(&self.threads) {
            let found = self.threads as f64;
            return Err(FilterError::Setting {
                what: "number of threads",
                found,
                allowed: "between 1 and 1024",
            });
        }
        Ok(())
    }
}
