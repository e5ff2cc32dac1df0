//! What can go wrong while a filter is built or steps.

use thiserror::Error;

/// Why a filter could not be built, could not step, or could not take a checkpoint.
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
        /// The length that the model needs.
        expected: usize,
    },
    /// A setting lies outside its range.
    #[error("{what} is {found}, must be {allowed}")]
    Setting {
        /// The setting.
        what: &'static str,
        /// Its value.
        found: f64,
        /// What is allowed.
        allowed: &'static str,
    },
    /// The innovation covariance is not positive definite beyond repair; the filter must be restarted.
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
    /// A state or a variance is no longer finite; the filter must be restarted.
    #[error("{what} {index} is not finite")]
    NotFinite {
        /// What is not finite: mean or variance of a state, a noise level, the normalised innovation.
        what: &'static str,
        /// Which one, from 0.
        index: usize,
    },
    /// A linear system has no stationary filter, or the filter in question is not stable.
    #[error(
        "no stationary filter: a mode is neither damped nor observed, or the gain does not make the error decay"
    )]
    NoStationaryFilter,
    /// A variance has become negative beyond rounding; the filter must be restarted.
    #[error("variance of state {index} is {variance:e}")]
    NegativeVariance {
        /// The entry of the state.
        index: usize,
        /// Its variance.
        variance: f64,
    },
    /// No particle explains the datum, or none has a finite state; the filter must be restarted.
    #[error("none of {particles} particles has any weight left")]
    Depleted {
        /// How many there are.
        particles: usize,
    },
    /// The threads of a particle filter could not be started.
    #[error("threads of the particle filter did not start: {reason}")]
    Threads {
        /// What the system said.
        reason: String,
    },
}
