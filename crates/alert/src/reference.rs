//! What a loss is counted from.

use serde::{Deserialize, Serialize};

use crate::AlertError;

/// Mean and standard deviation of the sound value of a parameter, ratios to nominal.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Reference {
    mean: f64,
    std: f64,
}

impl Reference {
    /// As designed: exactly 1.
    pub const DESIGN: Self = Self { mean: 1.0, std: 0.0 };

    /// Checks a reference: the mean must be positive and more than three standard deviations from zero, otherwise no loss
    /// against it can be told.
    ///
    /// # Errors
    /// [`AlertError::Reference`]
    pub fn new(mean: f64, std: f64) -> Result<Self, AlertError> {
        let is_usable = mean.is_finite() && mean > 0.0 && std >= 0.0 && LEAST_RATIO * std < mean;
        if is_usable {
            return Ok(Self { mean, std });
        }
        Err(AlertError::Reference { mean, std })
    }

    /// Mean, ratio to nominal.
    pub fn mean(&self) -> f64 {
        self.mean
    }

    /// Standard deviation, ratio to nominal.
    pub fn std(&self) -> f64 {
        self.std
    }
}

/// Least mean per standard deviation; above the quantile 1.96, so that every 95 % interval of a loss is finite.
const LEAST_RATIO: f64 = 3.0;
