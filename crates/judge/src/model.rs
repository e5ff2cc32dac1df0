//! The regressors of a quantity: 1, each condition, and each temperature below T0.

use crate::day::Day;
use crate::settings::{Condition, Quantity};
use crate::whitening::{Row, Step};
use nalgebra::DVector;
use serde::{Deserialize, Serialize};

/// Prior standard deviation of ln(value) at the conditions of zero, around the commissioning mean.
const INTERCEPT: f64 = 0.2;

/// Columns of the regression of a quantity.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Columns {
    /// Index of the temperatures among the conditions.
    pub(crate) temperatures: Vec<usize>,
    /// Prior standard deviation of each coefficient.
    pub(crate) prior: DVector<f64>,
}

impl Columns {
    pub(crate) fn new(quantity: &Quantity, conditions: &[Condition]) -> Self {
        let is_temperature = |index: &usize| conditions[*index].kind.is_temperature();
        let temperatures = (0..conditions.len()).filter(is_temperature).collect();
        let priors = || conditions.iter().map(|c| c.kind.prior(quantity.kind));
        let slopes = priors().map(|prior| prior.slope);
        let frost = priors().filter_map(|prior| prior.frost);
        let prior: Vec<f64> = std::iter::once(INTERCEPT)
            .chain(slopes)
            .chain(frost)
            .collect();
        Self {
            temperatures,
            prior: DVector::from_vec(prior),
        }
    }

    /// Returns the row of a day for the candidate of T0 with index `knot`. `centre` is subtracted
    /// from ln(value).
    pub(crate) fn row(&self, day: &Day, knot: usize, centre: f64) -> Row {
        let frost = self.frost(day, knot);
        let values = std::iter::once(1.0)
            .chain(day.conditions.iter().copied())
            .chain(frost);
        Row {
            x: DVector::from_iterator(self.prior.len(), values),
            y: day.y - centre,
        }
    }

    /// Returns the mean of min(T − T0, 0) (°C) of each temperature.
    pub(crate) fn frost<'d>(&'d self, day: &'d Day, knot: usize) -> impl Iterator<Item = f64> + 'd {
        self.temperatures
            .iter()
            .map(move |index| f64::from(day.below[*index][knot]))
    }

    /// Returns the whitened rows of days in ascending order.
    pub(crate) fn whitened(&self, days: &[Day], knot: usize, centre: f64, phi: f64) -> Vec<Row> {
        let rows: Vec<Row> = days.iter().map(|day| self.row(day, knot, centre)).collect();
        let mut whitened = rows.first().cloned().into_iter().collect::<Vec<_>>();
        for ((days, pair), _) in days.windows(2).zip(rows.windows(2)).zip(1..) {
            let step = Step::over(phi, days[1].number - days[0].number);
            whitened.push(step.whiten(&pair[1], &pair[0]));
        }
        whitened
    }
}
