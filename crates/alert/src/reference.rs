//! What a loss is counted from.

use serde::{Deserialize, Serialize};

use crate::AlertError;
use crate::scatter::NormalPlusStudent;

/// Mean and standard deviation of the sound value of a parameter, ratios to nominal.
///
/// The deviation has a known part, and a part that was estimated from the scatter of a few records. The second one is
/// itself uncertain: a Student variable stands for it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Reference {
    mean: f64,
    known_std: f64,
    scatter: Option<Scatter>,
}

/// Scatter between records, estimated from a number of them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Scatter {
    /// Its standard deviation as estimated, ratio to nominal.
    pub std: f64,
    /// How many independent deviations it was estimated from: one less than the records.
    pub degrees_of_freedom: f64,
}

impl Reference {
    /// As designed: exactly 1.
    pub const DESIGN: Self = Self {
        mean: 1.0,
        known_std: 0.0,
        scatter: None,
    };

    /// Checks a reference whose deviation is known: the mean must be positive and more than three standard deviations from
    /// zero, otherwise no loss against it can be told.
    ///
    /// # Errors
    /// [`AlertError::Reference`]
    pub fn new(mean: f64, std: f64) -> Result<Self, AlertError> {
        let is_usable = mean.is_finite() && mean > 0.0 && std >= 0.0 && LEAST_RATIO * std < mean;
        if is_usable {
            return Ok(Self {
                mean,
                known_std: std,
                scatter: None,
            });
        }
        Err(AlertError::Reference { mean, std })
    }

    /// Adds scatter between records that was estimated. The probability that the sound value is positive must stay above
    /// 0.975, otherwise no interval of a loss is finite.
    ///
    /// # Errors
    /// [`AlertError::FewRecords`] if the scatter is too large for so few degrees of freedom.
    pub fn with_scatter(self, scatter: Scatter) -> Result<Self, AlertError> {
        let reference = Self {
            scatter: Some(scatter),
            ..self
        };
        let is_finite =
            scatter.std >= 0.0 && scatter.std.is_finite() && scatter.degrees_of_freedom > 0.0;
        if is_finite
            && reference
                .deviation(0.0, 1.0)
                .is_none_or(|sum| sum.cdf(self.mean) > LEAST_POSITIVE)
        {
            return Ok(reference);
        }
        let Scatter {
            std,
            degrees_of_freedom,
        } = scatter;
        Err(AlertError::FewRecords {
            mean: self.mean,
            std,
            degrees_of_freedom,
        })
    }

    /// Mean, ratio to nominal.
    pub fn mean(&self) -> f64 {
        self.mean
    }

    /// Standard deviation with both parts as estimated, ratio to nominal.
    pub fn std(&self) -> f64 {
        self.known_std
            .hypot(self.scatter.map_or(0.0, |scatter| scatter.std))
    }

    /// The part of the deviation that is known, ratio to nominal.
    pub fn known_std(&self) -> f64 {
        self.known_std
    }

    /// The part that was estimated from few records; `None` where all is known.
    pub fn scatter(&self) -> Option<Scatter> {
        self.scatter
    }

    /// The distribution of an estimate of deviation `std` less `kept` times the reference, about its mean; `None` where it is
    /// normal.
    pub(crate) fn deviation(&self, std: f64, kept: f64) -> Option<NormalPlusStudent> {
        self.scatter.map(|scatter| NormalPlusStudent {
            normal_std: std.hypot(kept * self.known_std),
            student_scale: kept.abs() * scatter.std,
            degrees_of_freedom: scatter.degrees_of_freedom,
            largest_usual: kept.abs() * largest_usual_scatter(self.mean),
        })
    }

    /// Largest estimate, ratio to nominal, that shows a loss of more than `loss` with probability `credibility` however sure
    /// the estimate is; `None` if no positive estimate does.
    ///
    /// Between two and four records this is often far below (1 − loss)·mean: too few records cannot tell a loss from
    /// the scatter between them.
    pub fn largest_credible(&self, loss: f64, credibility: f64) -> Option<f64> {
        let kept = 1.0 - loss;
        let margin = match self.deviation(0.0, kept) {
            Some(sum) => sum.quantile(credibility),
            None => kept * self.known_std * standard_normal_quantile(credibility),
        };
        Some(kept * self.mean - margin).filter(|estimate| *estimate > 0.0)
    }
}

/// Φ⁻¹, by way of the sum without a Student part.
fn standard_normal_quantile(probability: f64) -> f64 {
    let normal = NormalPlusStudent {
        normal_std: 1.0,
        student_scale: 0.0,
        degrees_of_freedom: 1.0,
        largest_usual: 1.0,
    };
    normal.quantile(probability)
}

/// Standard deviation that sound values from different records rarely exceed, in the unit of their mean.
pub(crate) fn largest_usual_scatter(mean: f64) -> f64 {
    LARGEST_USUAL_SHARE * mean
}

/// Share of the mean that the scatter between sound records rarely exceeds.
///
/// Weak earthquakes of the highway bridge scatter by 5 % of its stiffness, motions of the laboratory frame by 5 %, and a year
/// with frost by some 10 %. With two records and a true scatter of 10 %, a bound of 0.99 is exceeded by 2.2 % of sound records.
const LARGEST_USUAL_SHARE: f64 = 0.25;

/// Least mean per standard deviation; above the quantile 1.96, so that every 95 % interval of a loss is finite.
const LEAST_RATIO: f64 = 3.0;

/// Least probability that the sound value is positive; above 0.975, so that every 95 % interval of a loss is finite.
const LEAST_POSITIVE: f64 = 0.98;
