//! Summary of one day of a quantity: the mean of ln(value) and of everything that explains it.
//!
//! A day is the unit of decision. All regressors enter as means over the same epochs as the
//! quantity, so that the mean of a linear model is the model of the means.

use crate::frost::{KNOTS, below};
use serde::{Deserialize, Serialize};

/// Seconds of a day.
pub(crate) const DAY_S: f64 = 86_400.0;

/// One day of a quantity.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Day {
    /// Days since 1970-01-01 UTC.
    pub(crate) number: i64,
    /// Mean of ln(value).
    pub(crate) y: f64,
    /// Mean of each condition, in the scale of the model.
    pub(crate) conditions: Vec<f64>,
    /// Mean of min(T − T0, 0) (°C) for each condition and each candidate of T0.
    pub(crate) below: Vec<[f32; KNOTS.len()]>,
}

/// Sums of the day that is not over yet.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct DaySums {
    count: u32,
    y: f64,
    conditions: Vec<f64>,
    below: Vec<[f64; KNOTS.len()]>,
}

impl DaySums {
    /// Adds one epoch: ln(value), and the conditions in the scale of the model.
    pub(crate) fn add(&mut self, y: f64, conditions: &[f64]) {
        if self.count == 0 {
            self.conditions = vec![0.0; conditions.len()];
            self.below = vec![[0.0; KNOTS.len()]; conditions.len()];
        }
        self.count += 1;
        self.y += y;
        for (sum, value) in self.conditions.iter_mut().zip(conditions) {
            *sum += value;
        }
        for (sums, value) in self.below.iter_mut().zip(conditions) {
            for (sum, knot) in sums.iter_mut().zip(KNOTS) {
                *sum += below(*value, knot);
            }
        }
    }

    /// Returns the means, or `None` if no epoch had the quantity and all conditions. Starts anew.
    pub(crate) fn take(&mut self, number: i64) -> Option<Day> {
        let sums = std::mem::take(self);
        let count = f64::from(sums.count);
        (sums.count > 0).then(|| Day {
            number,
            y: sums.y / count,
            conditions: sums.conditions.iter().map(|sum| sum / count).collect(),
            below: sums
                .below
                .iter()
                .map(|sums| sums.map(|sum| (sum / count) as f32))
                .collect(),
        })
    }
}
