//! Difference of two estimates of one parameter, relative to their stated uncertainty.

use super::course::Point;
use spandrel_alert::{Baseline, ParameterEstimate};

/// Mean and standard deviation of a parameter at one point of a record.
#[derive(Debug, Clone, Copy)]
pub(super) struct Level {
    pub(super) mean: f64,
    pub(super) std: f64,
}

impl Level {
    /// Returns the estimate of a parameter within a record.
    pub(super) fn within(point: &Point, parameter: usize) -> Self {
        Self {
            mean: point.mean[parameter],
            std: point.std[parameter],
        }
    }

    /// Returns the estimate for the structure, including the scatter between the records of
    /// `baseline`.
    ///
    /// The interval of 95 % is 1.96 deviations on either side. The deviation is NaN if the
    /// scatter is unknown, so that no difference counts as small.
    pub(super) fn for_structure(self, baseline: &Baseline, name: &str) -> Self {
        let estimate = ParameterEstimate {
            time_ns: 0,
            mean: self.mean,
            std: self.std,
        };
        let interval = baseline.for_structure(name, &estimate);
        Self {
            std: interval.map_or(f64::NAN, |interval| {
                (interval.high - interval.low) / (2.0 * QUANTILE)
            }),
            ..self
        }
    }
}

/// Quantile of a two-sided normal interval of 95 %.
const QUANTILE: f64 = 1.96;

/// Returns |difference| / combined deviation of each pair.
pub(super) fn differences(levels: &[Level]) -> Vec<f64> {
    let pairs = levels
        .iter()
        .enumerate()
        .flat_map(|(i, a)| levels[..i].iter().map(move |b| (a, b)));
    pairs
        .map(|(a, b)| (a.mean - b.mean).abs() / a.std.hypot(b.std))
        .collect()
}

/// Returns the share of values up to a limit, or `None` without values.
pub(super) fn share_up_to(limit: f64, values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| {
        values.iter().filter(|value| **value <= limit).count() as f64 / values.len() as f64
    })
}

/// Returns the median, NaN without values.
pub(super) fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(f64::NAN)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_pair_counts_once_in_combined_deviations() {
        let level = |mean: f64, std: f64| Level { mean, std };
        let found = differences(&[level(1.0, 0.03), level(1.1, 0.04), level(0.9, 0.04)]);
        let expected = [0.1 / 0.05, 0.1 / 0.05, 0.2 / 0.04_f64.hypot(0.04)];
        assert!(
            found
                .iter()
                .zip(expected)
                .all(|(a, b)| (a - b).abs() < 1e-12),
            "{found:?}"
        );
        assert_eq!(share_up_to(2.5, &found), Some(2.0 / 3.0));
        assert_eq!(share_up_to(2.0, &[]), None);
    }
}
