//! Failures to keep a state, counted, and told without a flood.

/// Failures of one kind: each is counted, and told when the first of a row comes, each time their number in the row has doubled, and when
/// the row is over.
#[derive(Debug, Default)]
pub struct Failures {
    total: u64,
    in_a_row: u64,
}

impl Failures {
    /// Notes a failure; returns whether it is to be told.
    #[must_use]
    pub fn failed(&mut self) -> bool {
        self.total += 1;
        self.in_a_row += 1;
        self.in_a_row.is_power_of_two()
    }

    /// Notes a success; returns how many failures it ends, if it is the first after any.
    #[must_use]
    pub fn succeeded(&mut self) -> Option<u64> {
        let ended = std::mem::take(&mut self.in_a_row);
        (ended > 0).then_some(ended)
    }

    /// Failures since the last success.
    #[must_use]
    pub fn in_a_row(&self) -> u64 {
        self.in_a_row
    }

    /// What a status tells of them: their number so far under `checkpoints-not-kept`, or nothing.
    #[must_use]
    pub fn drops(&self) -> Option<(String, u64)> {
        (self.total > 0).then(|| ("checkpoints-not-kept".to_owned(), self.total))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// They were told at powers of two of all there had ever been: a second time of trouble began without a word.
    #[test]
    fn each_row_of_failures_is_told_from_its_first_one_on_and_when_it_is_over() {
        let mut failures = Failures::default();
        assert_eq!((failures.succeeded(), failures.drops()), (None, None));
        let told: Vec<bool> = (0..5).map(|_| failures.failed()).collect();
        assert_eq!(told, [true, true, false, true, false]);
        assert_eq!(failures.in_a_row(), 5);
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
