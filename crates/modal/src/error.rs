//! Errors of settings and of epochs.

/// Reason why settings are not valid or an epoch has no modes.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ModalError {
    /// Too few channels.
    #[error("{found} usable channels, must be at least {at_least}")]
    Channels {
        /// Number of channels found.
        found: usize,
        /// Smallest allowed number.
        at_least: usize,
    },
    /// A reference channel does not exist or is listed twice.
    #[error(
        "reference channel {found}, must be one of the channels 0 to {last}, each at most once"
    )]
    Reference {
        /// Position found.
        found: usize,
        /// Position of the last channel.
        last: usize,
    },
    /// The sampling rate is not a positive number.
    #[error("sampling rate is {found_hz} Hz, must be a positive number")]
    Rate {
        /// Rate found (Hz).
        found_hz: f64,
    },
    /// The frequency band is not valid.
    #[error(
        "band is {lowest_hz} to {highest_hz} Hz, must increase, start at 0 Hz or above, and end at \
         most at {limit_hz} Hz"
    )]
    Band {
        /// Lower end (Hz).
        lowest_hz: f64,
        /// Upper end (Hz).
        highest_hz: f64,
        /// Highest allowed upper end (Hz).
        limit_hz: f64,
    },
    /// The epoch is too short for its blocks and time lags.
    #[error("epoch is {found_s:.4} s, must be at least {at_least_s:.4} s")]
    Epoch {
        /// Length found (s).
        found_s: f64,
        /// Smallest allowed length (s).
        at_least_s: f64,
    },
    /// A count is out of its range.
    #[error("{what} is {found}, must be {least} to {most}")]
    Count {
        /// Name of the setting.
        what: &'static str,
        /// Value found.
        found: usize,
        /// Smallest allowed value.
        least: usize,
        /// Largest allowed value.
        most: usize,
    },
    /// The overlap of epochs is not valid.
    #[error("overlap of epochs is {found}, must be at least 0 and below 1")]
    Overlap {
        /// Share found.
        found: f64,
    },
    /// A frame has another number of values than the stream has channels.
    #[error("frame has {found} values, must have {channels}, one for each channel")]
    Frame {
        /// Number of values found.
        found: usize,
        /// Number of channels.
        channels: usize,
    },
    /// The matrices of a model do not fit each other, or its mass is not positive definite.
    #[error("the matrices of the model differ in size, or its mass is not positive definite")]
    Model,
    /// No declared mode is one of the model.
    #[error("no declared mode resembles a mode of the model in frequency and shape")]
    NoModelMode,
    /// The output covariances of an epoch, or the matrices of a model, have no decomposition.
    #[error("the {what} did not converge")]
    NotConverged {
        /// The decomposition.
        what: &'static str,
    },
}
