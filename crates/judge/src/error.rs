//! Errors of the judgement.

/// Reason why a judge could not be created or an epoch could not be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum JudgeError {
    /// A setting is outside its range.
    #[error("{what}")]
    Setting {
        /// The setting, the value found and the allowed values.
        what: String,
    },
    /// An epoch is not later than the previous one.
    #[error("epoch at {time_s} s is not later than the previous one at {previous_s} s")]
    OutOfOrder {
        /// Time of the rejected epoch (s).
        time_s: f64,
        /// Time of the previous epoch (s).
        previous_s: f64,
    },
    /// The time of an epoch is not a number in the range of dates.
    #[error("epoch at {time_s} s is outside the years 1900 to 2200")]
    NoTime {
        /// Time of the rejected epoch (s).
        time_s: f64,
    },
    /// The number of values is not that of the settings.
    #[error("epoch has {found} {what}, must have {expected}")]
    Shape {
        /// `quantities` or `conditions`.
        what: &'static str,
        /// Number found.
        found: usize,
        /// Number in the settings.
        expected: usize,
    },
}
