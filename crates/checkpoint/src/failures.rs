//! Counts failures to save a state and limits how often they are reported.

/// A counter of consecutive failures that selects the failures to report.
///
/// It selects the first failure in a row, and then each failure that doubles the length of the row.
/// It also selects the success that ends the row.
#[derive(Debug, Default)]
pub struct Failures {
    total: u64,
    consecutive: u64,
}

impl Failures {
    /// Counts a failure and returns `true` if it must be reported.
    #[must_use]
    pub fn failed(&mut self) -> bool {
        self.total += 1;
        self.consecutive += 1;
        self.consecutive.is_power_of_two()
    }

    /// Records a success. Returns the number of consecutive failures that it ends, or `None` if
    /// there were none.
    #[must_use]
    pub fn succeeded(&mut self) -> Option<u64> {
        let ended = std::mem::take(&mut self.consecutive);
        (ended > 0).then_some(ended)
    }

    /// Returns the number of failures since the last success.
    #[must_use]
    pub fn consecutive(&self) -> u64 {
        self.consecutive
    }

    /// Returns the total number of failures under the status key `checkpoints-not-kept`, or `None`
    /// if it is 0.
    #[must_use]
    pub fn drops(&self) -> Option<(String, u64)> {
        (self.total > 0).then(|| ("checkpoints-not-kept".to_owned(), self.total))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The second row must start at its own first failure. Powers of two of the total count would
    /// hide its start.
    #[test]
    fn each_series_of_failures_is_reported_at_its_first_failure_and_its_end() {
        let mut failures = Failures::default();
        assert_eq!((failures.succeeded(), failures.drops()), (None, None));
        let told: Vec<bool> = (0..5).map(|_| failures.failed()).collect();
        assert_eq!(told, [true, true, false, true, false]);
        assert_eq!(failures.consecutive(), 5);
        assert_eq!(
            (failures.succeeded(), failures.succeeded()),
            (Some(5), None)
        );
        assert!(failures.failed(), "the first of another row");
        assert_eq!(
            failures.drops(),
            Some(("checkpoints-not-kept".to_owned(), 6))
        );
    }
}
