//! Errors of building, stepping and restoring a filter.

use thiserror::Error;

/// Reason why a filter could not be built, could not step or could not restore a checkpoint.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum FilterError {
    /// A vector or matrix has the wrong size for the model.
    #[error("{what} has {found} entries, the model needs {expected}")]
    Dimension {
        /// The vector or matrix.
        what: &'static str,
        /// Its length.
        found: usize,
        /// The length that the model requires.
        expected: usize,
    },
    /// A setting lies outside its range.
    #[error("{what} is {found}, must be {allowed}")]
    Setting {
        /// The setting.
        what: &'static str,
        /// Its value.
        found: f64,
        /// The allowed range.
        allowed: &'static str,
    },
    /// The innovation covariance is not positive definite, even with jitter. The filter must be
    /// restarted.
    #[error("innovation covariance is not positive definite at channel {pivot}")]
    InnovationCovariance {
        /// The row at which the factorisation failed.
        pivot: usize,
    },
    /// A covariance is not positive definite.
    #[error("{what} is not positive definite at row {pivot}")]
    NotPositiveDefinite {
        /// The covariance.
        what: &'static str,
        /// The row at which the factorisation failed.
        pivot: usize,
    },
    /// A state, a variance or another quantity is not finite. If a step fails with this error, the
    /// filter must be restarted.
    #[error("{what} {index} is not finite")]
    NotFinite {
        /// The quantity, such as the mean or variance of a state, a noise level or the normalised
        /// innovation.
        what: &'static str,
        /// Index of the entry, from 0.
        index: usize,
    },
    /// A linear system has no stationary filter, or the given filter is not stable.
    #[error(
        "no stationary filter: a mode is neither damped nor observed, or the gain does not make \
         the error decay"
    )]
    NoStationaryFilter,
    /// A variance is negative by more than the rounding error. The filter must be restarted.
    #[error("variance of state {index} is {variance:e}")]
    NegativeVariance {
        /// Index of the state, from 0.
        index: usize,
        /// Its variance.
        variance: f64,
    },
    /// No particle explains the datum, or none has a finite state. The filter must be restarted.
    #[error("none of {particles} particles has any weight left")]
    Depleted {
        /// Number of particles.
        particles: usize,
    },
    /// The threads of a particle filter could not be started.
    #[error("threads of the particle filter did not start: {reason}")]
    Threads {
        /// Error message of the operating system.
        reason: String,
    },
}

impl FilterError {
    /// Compares sizes in order. Each one has the name of a vector or matrix, its length and the
    /// length that the model requires.
    ///
    /// # Errors
    /// Returns [`FilterError::Dimension`] with the first size that is wrong.
    pub fn check_sizes(
        sizes: impl IntoIterator<Item = (&'static str, usize, usize)>,
    ) -> Result<(), Self> {
        for (what, found, expected) in sizes {
            if found != expected {
                return Err(Self::Dimension {
                    what,
                    found,
                    expected,
                });
            }
        }
        Ok(())
    }
}
