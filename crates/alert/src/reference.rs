//! The reference of a loss.

use serde::{Deserialize, Serialize};

use crate::AlertError;
use crate::scatter::NormalPlusStudent;

/// Mean and standard deviation of a parameter of the undamaged structure, as ratios to nominal.
///
/// The deviation has a known part and a part estimated from the scatter of a few records. The
/// estimated part is itself uncertain, so a Student variable represents it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Reference {
    mean: f64,
    known_std: f64,
    scatter: Option<Scatter>,
}

/// Scatter between records, estimated from a number of them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Scatter {
    /// Estimated standard deviation, as a ratio to nominal.
    pub std: f64,
    /// Degrees of freedom of the estimate: the number of records minus one.
    pub degrees_of_freedom: f64,
}

impl Reference {
    /// The design value: exactly 1.
    pub const DESIGN: Self = Self {
        mean: 1.0,
        known_std: 0.0,
        scatter: None,
    };

    /// Creates a reference whose deviation is known.
    ///
    /// The mean must be positive and more than three standard deviations from zero. Otherwise no
    /// loss against it has a finite interval.
    ///
    /// # Errors
    /// Returns [`AlertError::Reference`] if the reference is invalid.
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

    /// Adds an estimated scatter between records.
    ///
    /// The probability that the reference value is positive must exceed 0.98. Otherwise no interval
    /// of a loss is finite.
    ///
    /// # Errors
    /// Returns [`AlertError::FewRecords`] if the scatter is too large for so few degrees of
    /// freedom.
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

    /// Returns the mean, as a ratio to nominal.
    pub fn mean(&self) -> f64 {
        self.mean
    }

    /// Returns the standard deviation with both parts, as a ratio to nominal.
    pub fn std(&self) -> f64 {
        self.known_std
            .hypot(self.scatter.map_or(0.0, |scatter| scatter.std))
    }

    /// Returns the known part of the deviation, as a ratio to nominal.
    pub fn known_std(&self) -> f64 {
        self.known_std
    }

    /// Returns the part estimated from few records. `None` if the whole deviation is known.
    pub fn scatter(&self) -> Option<Scatter> {
        self.scatter
    }

    /// Returns the distribution of an estimate with deviation `std` minus `kept` times the
    /// reference, about its mean.
    ///
    /// Returns `None` if the distribution is normal.
    pub(crate) fn deviation(&self, std: f64, kept: f64) -> Option<NormalPlusStudent> {
        self.scatter.map(|scatter| NormalPlusStudent {
            normal_std: std.hypot(kept * self.known_std),
            student_scale: kept.abs() * scatter.std,
            degrees_of_freedom: scatter.degrees_of_freedom,
            largest_usual: kept.abs() * largest_usual_scatter(self.mean),
        })
    }

    /// Returns the largest estimate, as a ratio to nominal, that can show a loss of more than
    /// `loss` with probability `credibility`.
    ///
    /// This is the limit for an exact estimate. Returns `None` if no positive estimate shows the
    /// loss. For two to four records, the limit is often far below (1 − loss)·mean. So few records
    /// cannot distinguish a loss from the scatter between them.
    pub fn largest_credible(&self, loss: f64, credibility: f64) -> Option<f64> {
        let kept = 1.0 - loss;
        let margin = match self.deviation(0.0, kept) {
            Some(sum) => sum.quantile(credibility),
            None => kept * self.known_std * standard_normal_quantile(credibility),
        };
        Some(kept * self.mean - margin).filter(|estimate| *estimate > 0.0)
    }
}

/// Returns Φ⁻¹, computed as the sum without a Student part.
fn standard_normal_quantile(probability: f64) -> f64 {
    let normal = NormalPlusStudent {
        normal_std: 1.0,
        student_scale: 0.0,
        degrees_of_freedom: 1.0,
        largest_usual: 1.0,
    };
    normal.quantile(probability)
}

/// Returns the standard deviation between records that sound values rarely exceed, in the unit of
/// their mean.
pub(crate) fn largest_usual_scatter(mean: f64) -> f64 {
    LARGEST_USUAL_SHARE * mean
}

/// Share of the mean that the scatter between sound records rarely exceeds.
///
/// The stiffness of the highway bridge scatters by 5 % between weak earthquakes. The laboratory
/// frame scatters by 5 % between motions, and by some 10 % over a year with frost. With two records
/// and a true scatter of 10 %, 2.2 % of sound records exceed a bound of 0.99.
const LARGEST_USUAL_SHARE: f64 = 0.25;

/// Minimum ratio of mean to standard deviation. It exceeds the quantile 1.96, so that every 95 %
/// interval of a loss is finite.
const LEAST_RATIO: f64 = 3.0;

/// Minimum probability that the sound value is positive. It exceeds 0.975, so that every 95 %
/// interval of a loss is finite.
const LEAST_POSITIVE: f64 = 0.98;
