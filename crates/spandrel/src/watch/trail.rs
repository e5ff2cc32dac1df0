//! The last minutes of one parameter, reduced to the resolution of a line of text.

use std::collections::VecDeque;

/// Measurement time of one entry (ns), 2 s.
const STEP_NS: i64 = 2_000_000_000;
/// Maximum number of entries, three minutes.
const LONGEST: usize = 90;

/// Means of the values of one parameter, over steps of [`STEP_NS`] of measurement time. It contains
/// at most the last [`LONGEST`] steps.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Trail {
    /// Number of the newest step, time / [`STEP_NS`].
    newest: i64,
    steps: VecDeque<Step>,
}

/// Values of one step. A step without values has count 0.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Step {
    sum: f64,
    count: u32,
}

impl Trail {
    /// Adds a value (ratio to nominal) at `time_ns` (ns since the Unix epoch, UTC). A time before
    /// the trail, or more than [`LONGEST`] steps after it, starts a new trail. A time within the
    /// trail first deletes all later steps.
    pub fn push(&mut self, time_ns: i64, value: f64) {
        let number = time_ns.div_euclid(STEP_NS);
        let back = usize::try_from(self.newest.saturating_sub(number)).unwrap_or(0);
        let ahead = usize::try_from(number.saturating_sub(self.newest)).unwrap_or(0);
        if self.steps.is_empty() || back >= self.steps.len() || ahead >= LONGEST {
            self.steps.clear();
            self.steps.push_back(Step::default());
        } else {
            self.steps
                .extend(std::iter::repeat_n(Step::default(), ahead));
            let from_another_run = back.min(self.steps.len() - 1);
            self.steps.truncate(self.steps.len() - from_another_run);
        }
        self.newest = number;
        let surplus = self.steps.len().saturating_sub(LONGEST);
        self.steps.drain(..surplus);
        if let Some(step) = self.steps.back_mut() {
            step.sum += value;
            step.count += 1;
        }
    }

    /// Returns the means of the last `count` steps, oldest first. There are fewer if the trail is
    /// shorter.
    pub fn last(&self, count: usize) -> impl Iterator<Item = Option<f64>> {
        let skipped = self.steps.len().saturating_sub(count);
        self.steps
            .iter()
            .skip(skipped)
            .map(|step| (step.count > 0).then(|| step.sum / f64::from(step.count)))
    }

    /// Returns the measurement time of `count` steps (s), at most that of the whole trail.
    pub fn span_s(count: usize) -> f64 {
        count.min(LONGEST) as f64 * STEP_NS as f64 * 1e-9
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: i64 = 1_000_000_000;

    fn trail(points: &[(i64, f64)]) -> Vec<Option<f64>> {
        let mut trail = Trail::default();
        for (second, value) in points {
            trail.push(second * SECOND, *value);
        }
        trail.last(usize::MAX).collect()
    }

    #[test]
    fn values_within_a_step_become_their_mean_and_silence_is_a_gap() {
        assert_eq!(
            trail(&[(0, 1.0), (1, 2.0), (6, 4.0)]),
            [Some(1.5), None, None, Some(4.0)]
        );
    }

    #[test]
    fn only_the_last_minutes_are_kept() {
        let points: Vec<(i64, f64)> = (0..600).map(|second| (second, second as f64)).collect();
        let kept = trail(&points);
        assert_eq!(kept.len(), LONGEST);
        assert_eq!(kept.last(), Some(&Some(598.5)));
    }

    #[test]
    fn another_run_starts_a_new_trail() {
        assert_eq!(
            trail(&[(100, 1.0), (102, 1.0), (0, 0.9)]),
            [Some(0.9)],
            "time went back"
        );
        assert_eq!(
            trail(&[(100, 1.0), (9_000_000_000, 0.9)]),
            [Some(0.9)],
            "time jumped ahead"
        );
        assert_eq!(
            trail(&[(i64::MIN / SECOND, 1.0), (i64::MAX / SECOND, 0.9)]),
            [Some(0.9)],
            "as far as it goes"
        );
    }

    #[test]
    fn late_value_truncates_the_trail_at_its_time() {
        assert_eq!(
            trail(&[(0, 1.0), (2, 2.0), (4, 3.0), (2, 4.0)]),
            [Some(1.0), Some(3.0)]
        );
    }
}
