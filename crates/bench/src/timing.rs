//! Times of single steps.

use std::time::Instant;

/// Runs `work` and returns its duration (s) and its result.
#[expect(
    clippy::disallowed_methods,
    reason = "a benchmark is there to read the clock"
)]
pub fn seconds<T>(work: impl FnOnce() -> T) -> (f64, T) {
    let start = Instant::now();
    let result = work();
    (start.elapsed().as_secs_f64(), result)
}

/// Times of the steps of one filter (s).
#[derive(Debug, Clone, Default)]
pub struct Times(Vec<f64>);

impl Times {
    /// Adds a time (s).
    pub fn push(&mut self, time_s: f64) {
        self.0.push(time_s);
    }

    /// Returns the median (s), or NaN if there are no times.
    ///
    /// Occasional load on the machine does not affect the median.
    #[must_use]
    pub fn median(&self) -> f64 {
        let mut sorted = self.0.clone();
        sorted.sort_by(f64::total_cmp);
        sorted.get(sorted.len() / 2).copied().unwrap_or(f64::NAN)
    }

    /// Returns the shortest time (s), or infinity if there are no times.
    #[must_use]
    pub fn shortest(&self) -> f64 {
        self.0.iter().copied().fold(f64::INFINITY, f64::min)
    }
}
