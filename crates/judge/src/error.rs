//! Errors of the judgement.

use jiff::Timestamp;

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
    #[error(
        "epoch at {} is not later than the previous one at {}", utc(*time_s), utc(*previous_s)
    )]
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

/// Returns a time (s since 1970-01-01 UTC, at a millisecond) in ISO 8601.
fn utc(time_s: f64) -> Timestamp {
    // The years in which an epoch is allowed are in the calendar of `jiff`.
    Timestamp::from_millisecond((1e3 * time_s).round() as i64).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn order_is_stated_with_dates() {
        let error = JudgeError::OutOfOrder {
            time_s: 1_551_946_142.0,
            previous_s: 1_551_947_946.5,
        };
        assert_eq!(
            error.to_string(),
            "epoch at 2019-03-07T08:09:02Z is not later than the previous one at \
             2019-03-07T08:39:06.5Z"
        );
    }
}
