//! Settings of a particle filter.

use crate::error::FilterError;
use serde::{Deserialize, Serialize};

/// Where the particles of a step are drawn from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ImportanceDensity {
    /// The Gaussian density of one extended Kalman step from each particle: few particles are wasted, at the cost of a
    /// Jacobian each. Best with accurate sensors and with a cheap Jacobian.
    #[default]
    Optimal,
    /// The prediction, without a look at the datum: several times cheaper, and enough where the sensors are noisy.
    Prior,
}

/// How particles are drawn anew.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Resampling {
    /// One uniform number and equidistant points on the cumulative weights: least variance.
    #[default]
    Systematic,
    /// Independent draws.
    Multinomial,
}

/// All that a particle filter needs to know besides its model and its start.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ParticleSettings {
    /// `N`; the error of an estimate falls with its square root.
    pub particles: usize,
    /// Where particles are drawn from.
    pub density: ImportanceDensity,
    /// Coefficient of variation of the weights above which particles are drawn anew; 2 means an effective size of `N/5`.
    pub resampling_threshold: f64,
    /// How they are drawn.
    pub resampling: Resampling,
    /// `a` of the kernel at resampling, in (0, 1]; 1 for none.
    ///
    /// A smaller one keeps the particles apart where nothing else disturbs them, at the price of some smoothing.
    pub kernel: f64,
    /// Seed of all draws.
    pub seed: u64,
    /// Threads that share the particles; the result does not depend on it.
    ///
    /// A step allocates nothing with one thread; handing work to more may allocate now and then.
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
