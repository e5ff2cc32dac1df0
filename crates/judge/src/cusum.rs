//! One-sided CUSUM of the residuals, as a cross-check of the e-detector.
//!
//! S = max(0, S − z − k). Its average run length is approximately
//! (e^(2kb) − 2kb − 1)/(2k²) with b = h + 1.166. Source: Siegmund (1985), Sequential Analysis,
//! in the form that Woodall & Adams (1993) recommend.

/// Allowance k, in units of σ.
const ALLOWANCE: f64 = 0.5;
/// Correction of the threshold for the overshoot of a random walk, 2 · 0.583.
const OVERSHOOT: f64 = 1.166;

/// Returns the next value of the CUSUM.
pub(crate) fn next(sum: f64, z: f64) -> f64 {
    (sum - z - ALLOWANCE).max(0.0)
}

/// Returns the average run length (days) of a threshold h.
fn run_length(threshold: f64) -> f64 {
    let kb = ALLOWANCE * (threshold + OVERSHOOT);
    ((2.0 * kb).exp() - 2.0 * kb - 1.0) / (2.0 * ALLOWANCE * ALLOWANCE)
}

/// Returns the threshold h with an average run length of `days`.
pub(crate) fn threshold(days: f64) -> f64 {
    let (mut low, mut high) = (0.0, 60.0); // 60 stands for more days than any structure lives
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if run_length(middle) < days {
            low = middle;
        } else {
            high = middle;
        }
    }
    high
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn four_quantities_and_ten_years_give_the_published_threshold() {
        // Montgomery, Introduction to Statistical Quality Control: k = 0.5, h = 5 has a one-sided
        // average run length of 938.
        assert!((run_length(5.0) - 938.2).abs() < 1.0, "{}", run_length(5.0));
        assert!((run_length(threshold(14_610.0)) / 14_610.0 - 1.0).abs() < 1e-9);
    }
}
