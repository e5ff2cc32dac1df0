//! Learns the reference value of a parameter from the estimates of a time span.
//!
//! Notation: m_k, s_k mean and standard deviation of the parameter at frame k; w_k = 1/s_k².
//!
//! The weights w_k reduce the influence of the first frames, which still contain the prior.
//! Successive estimates of a filter share nearly all their data. They do not average out, so the
//! uncertainty of their mean equals that of a single estimate. Source of the running sums: D. H. D.
//! West, *Updating mean and variance estimates: an improved method*, Commun. ACM 22 (1979),
//! 532-535.

use serde::{Deserialize, Serialize};

/// Running sums over the frames of one span.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Learning {
    frames: u64,
    weight: f64,
    mean: f64,
    squares: f64,
}

/// Lower limit of the standard deviation, which keeps the weight of a frame finite.
const LEAST_STD: f64 = 1e-9;

impl Learning {
    /// Creates empty sums.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds the mean and the standard deviation of one frame, as ratios to nominal.
    pub fn add(&mut self, mean: f64, std: f64) {
        let weight = std.max(LEAST_STD).powi(-2);
        self.frames += 1;
        self.weight += weight; //                                  W = Σ w
        let off = mean - self.mean;
        self.mean += off * weight / self.weight; //                m̄ = Σ w m / W
        self.squares += weight * off * (mean - self.mean); //      Q = Σ w (m − m̄)²
    }

    /// Returns the summary of the span. `None` before the first frame.
    pub fn summary(&self) -> Option<SpanSummary> {
        (self.frames > 0).then(|| SpanSummary {
            mean: self.mean,
            estimate_variance: self.frames as f64 / self.weight,
            drift_variance: self.squares / self.weight,
        })
    }
}

/// Summary of the estimates of one span, as ratios to nominal and their squares.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SpanSummary {
    /// Weighted mean of the means.
    pub mean: f64,
    /// Harmonic mean of the variances, which is the uncertainty stated by the filter.
    pub estimate_variance: f64,
    /// Weighted variance of the means, which shows the drift of the estimate within the span.
    pub drift_variance: f64,
}

impl SpanSummary {
    /// Returns the variance of the difference between a later estimate and the mean of this span,
    /// without the stated variance of the later estimate.
    ///
    /// The stated variance and the drift variance count once. If the drift exceeds the stated
    /// variance, a later estimate drifts as well. Its difference from the mean of n independent
    /// stretches of the same drift has (n + 1)/(n − 1) times the variance in the span. The excess
    /// therefore counts this many times, with n = 2, because a span contains few stretches.
    pub fn variance(&self) -> f64 {
        let unstated = (self.drift_variance - self.estimate_variance).max(0.0);
        self.estimate_variance + self.drift_variance + (OF_TWO_STRETCHES - 1.0) * unstated
    }
}

/// (n + 1)/(n − 1) for n = 2.
const OF_TWO_STRETCHES: f64 = 3.0;

#[cfg(test)]
mod tests {
    use super::*;

    fn summary(frames: &[(f64, f64)]) -> SpanSummary {
        let mut learning = Learning::new();
        frames
            .iter()
            .for_each(|(mean, std)| learning.add(*mean, *std));
        learning.summary().unwrap()
    }

    #[test]
    fn steady_estimate_keeps_the_uncertainty_of_one_frame() {
        let found = summary(&[(0.9, 0.02); 1000]);
        assert!((found.mean - 0.9).abs() < 1e-12);
        assert!((found.variance().sqrt() - 0.02).abs() < 1e-12);
    }

    #[test]
    fn drift_of_the_estimate_adds_to_the_variance() {
        let found = summary(&[(0.93, 0.04), (0.97, 0.04)]);
        assert!((found.mean - 0.95).abs() < 1e-12);
        assert!((found.variance() - (0.04_f64.powi(2) + 0.02_f64.powi(2))).abs() < 1e-12);
    }

    #[test]
    fn drift_beyond_the_stated_deviation_counts_three_times() {
        let found = summary(&[(0.9, 0.02), (1.0, 0.02)]);
        let unstated = 0.05_f64.powi(2) - 0.02_f64.powi(2);
        assert!((found.variance() - (2.0 * 0.02_f64.powi(2) + 3.0 * unstated)).abs() < 1e-12);
    }

    #[test]
    fn uncertain_frames_have_little_weight() {
        let mut frames = vec![(1.0, 0.2); 100];
        frames.extend([(0.8, 0.01); 100]);
        assert!((summary(&frames).mean - 0.8).abs() < 0.001);
    }

    #[test]
    fn learning_without_frames_gives_no_summary() {
        assert_eq!(Learning::new().summary(), None);
    }
}
