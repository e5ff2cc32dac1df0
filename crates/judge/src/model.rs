//! The regressors of a quantity, and how their coefficients change in time.
//!
//! The coefficients are, in this order: the level; the slope of each condition, for an amplitude
//! that above r0; the slope of the thermometer, if another quantity serves as one; for each
//! temperature
//!
//! - the additional slope below T0 (frost), and the change of slope where the frost is complete
//! - the change of slope at each of two warmer knots
//! - the effect of the interior, which follows with a delay: of its temperature, and of its frost
//! - the offset in the frost zone, which differs from one cold spell to the next;
//!
//! and the deviation u, which has no measured cause. All have a prior in physical units. The level
//! wanders slowly, the offsets and the deviation forget.

use crate::amplitude::{HINGES, above, hinges};
use crate::day::Day;
use crate::frost::{BENDS, KNOTS, below, zone};
use crate::inertia::{Interior, Past};
use crate::settings::{Condition, ConditionKind, Quantity, indices, thermometer_prior};
use nalgebra::DVector;
use serde::{Deserialize, Serialize};

/// Prior standard deviation of ln(value) at the conditions of zero, around the commissioning mean.
const INTERCEPT: f64 = 0.2;
/// Standard deviation of the sound change of ln(frequency) within a year: settling, creep.
const WANDER_PER_YEAR: f64 = 0.003;
/// Part of the prior of a slope that its change at a warm knot has.
const BEND_PART: f64 = 1.0 / 3.0;
/// Memory of the offset in the frost zone (days): a cold spell.
const SPELL_DAYS: f64 = 4.0;
/// Candidates of the standard deviation of this offset in ln(frequency), and of the additional
/// scatter of a day in the frost zone. Without frost in the commissioning, the largest ones hold.
pub(crate) const OFFSETS: [f64; 2] = [0.003, 0.01];
pub(crate) const ZONE_SCATTERS: [f64; 2] = [0.002, 0.006];
/// Candidates of the memory of the deviation (days), and of its standard deviation in
/// ln(frequency). The smallest one holds for structures that seem perfectly predictable. Moisture,
/// traffic and the identification change frequencies by this much within weeks, and no
/// commissioning sees all of it.
pub(crate) const MEMORIES: [f64; 2] = [10.0, 40.0];
pub(crate) const DEVIATIONS: [f64; 3] = [0.003, 0.006, 0.012];
/// Share of the variance of a day that its epochs have each for itself.
const EPOCH_SHARE: f64 = 0.5;

/// What explains a quantity.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Explanation<'s> {
    pub(crate) conditions: &'s [Condition],
    /// Name of the quantity that serves as a thermometer. Its ln(stiffness) follows the conditions.
    pub(crate) thermometer: Option<&'s str>,
}

impl Explanation<'_> {
    /// Returns the number of values that explain the quantity.
    pub(crate) fn count(self) -> usize {
        self.conditions.len() + usize::from(self.thermometer.is_some())
    }
}

/// What the days before the judgement decide about the model.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct Structure {
    /// Index of T0 among the candidates.
    pub(crate) knot: usize,
    /// Standard deviation of an offset in the frost zone, in ln(frequency).
    pub(crate) offset: f64,
    /// Additional scatter of a day in the frost zone, in ln(frequency).
    pub(crate) zone_scatter: f64,
    /// Time constant with which the structure follows the temperatures (days).
    pub(crate) inertia_days: f64,
    /// Memory of the deviation (days), and its standard deviation in ln(frequency).
    pub(crate) memory_days: f64,
    pub(crate) deviation: f64,
    /// ν: degrees of freedom of the errors.
    pub(crate) freedom: f64,
    /// Usual number of epochs of a day.
    pub(crate) usual_epochs: f64,
    /// Index of r0 among the candidates.
    pub(crate) hinge: usize,
}

/// u: changes of ln(value) without a measured cause. They can begin at any time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Deviation {
    /// Standard deviation of ln(value).
    pub(crate) std: f64,
    pub(crate) memory_days: f64,
}

impl Deviation {
    /// Returns the standard deviation of the mean over a number of days.
    pub(crate) fn of_mean(self, days: i64) -> f64 {
        let share = 2.0 * self.memory_days / days.max(1) as f64;
        self.std * share.min(1.0).sqrt()
    }
}

/// Columns of the regression of a quantity.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Columns {
    /// Index of the temperatures among the conditions.
    pub(crate) temperatures: Vec<usize>,
    /// Index of the amplitudes among the conditions, and the candidates of r0 of each one.
    pub(crate) amplitudes: Vec<usize>,
    pub(crate) hinges: Vec<[f64; HINGES]>,
    /// Prior standard deviation of each coefficient that does not forget.
    prior: DVector<f64>,
    /// Number of the conditions, with the thermometer.
    conditions: usize,
    /// Mean ln(stiffness) of the thermometer in the commissioning.
    thermometer_mean: Option<f64>,
    /// Size of changes of ln(value) relative to those of ln(frequency).
    size: f64,
}

/// A row of the regression.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Row {
    /// Regressors, with their own unit.
    pub(crate) x: DVector<f64>,
    /// ln(value), relative to the mean of the commissioning.
    pub(crate) y: f64,
    /// Number of epochs.
    pub(crate) epochs: f64,
}

/// Columns per temperature: two of frost, one per warm knot, two of the interior, the offset.
const PER_TEMPERATURE: usize = 5 + BENDS.len();

impl Columns {
    /// Creates the columns of a quantity whose commissioning has these days.
    pub(crate) fn new(quantity: &Quantity, explanation: Explanation<'_>, days: &[Day]) -> Self {
        let conditions = explanation.conditions;
        let amplitudes = indices(conditions, ConditionKind::is_amplitude);
        let priors = || conditions.iter().map(|c| c.kind.prior(quantity.kind));
        let of_thermometer = explanation
            .thermometer
            .map(|_| thermometer_prior(quantity.kind));
        let slopes = priors().chain(of_thermometer).map(|prior| prior.slope);
        let of_temperature = priors().filter_map(|prior| {
            let frost = prior.frost?;
            let mut stds = vec![frost, frost];
            stds.extend(BENDS.map(|_| BEND_PART * prior.slope));
            stds.extend([prior.slope, frost, 0.0]);
            Some(stds)
        });
        let prior: Vec<f64> = std::iter::once(INTERCEPT)
            .chain(slopes)
            .chain(of_temperature.flatten())
            .chain(std::iter::once(0.0))
            .collect();
        Self {
            temperatures: indices(conditions, ConditionKind::is_temperature),
            hinges: (0..amplitudes.len())
                .map(|place| hinges(days, place))
                .collect(),
            amplitudes,
            prior: DVector::from_vec(prior),
            conditions: explanation.count(),
            thermometer_mean: explanation.thermometer.map(|_| {
                let values = days
                    .iter()
                    .map(|day| f64::from(day.conditions[conditions.len()]));
                values.sum::<f64>() / days.len().max(1) as f64
            }),
            size: 2.0 * quantity.kind.per_stiffness(),
        }
    }

    /// Returns the number of the coefficients.
    pub(crate) fn count(&self) -> usize {
        self.prior.len()
    }

    /// Returns the standard deviation of a day under known conditions, with the deviation.
    pub(crate) fn scatter(&self, structure: &Structure, sigma: f64) -> f64 {
        sigma.hypot(self.size * structure.deviation)
    }

    /// Returns the deviation u. `least` is its smallest standard deviation, in ln(frequency).
    pub(crate) fn deviation(&self, structure: &Structure, least: f64) -> Deviation {
        Deviation {
            std: self.size * structure.deviation.max(least),
            memory_days: structure.memory_days,
        }
    }

    /// Returns the correlation of two successive days.
    pub(crate) fn correlation(&self, structure: &Structure, sigma: f64) -> f64 {
        let share = self.size * structure.deviation / self.scatter(structure, sigma);
        share * share * (-1.0 / structure.memory_days).exp()
    }

    /// Returns the prior variance of each coefficient that does not forget.
    pub(crate) fn prior_variance(&self) -> DVector<f64> {
        self.prior.map(|std| std * std)
    }

    /// Returns the variance of the level that a number of days adds.
    pub(crate) fn wander(&self, days: i64) -> f64 {
        (self.size * WANDER_PER_YEAR).powi(2) * days.max(0) as f64 / 365.25
    }

    /// Returns the coefficients that forget.
    pub(crate) fn forgetful<'c>(
        &'c self,
        structure: &'c Structure,
    ) -> impl Iterator<Item = Forgetful> + 'c {
        let offsets = self.offsets().map(|column| Forgetful {
            column,
            memory_days: SPELL_DAYS,
            std: self.size * structure.offset,
        });
        offsets.chain(std::iter::once(Forgetful {
            column: self.count() - 1,
            memory_days: structure.memory_days,
            std: self.size * structure.deviation,
        }))
    }

    fn offsets(&self) -> impl Iterator<Item = usize> + use<> {
        let first = 1 + self.conditions;
        (1..=self.temperatures.len()).map(move |count| first + count * PER_TEMPERATURE - 1)
    }

    /// Returns how far a row is in the frost zone, from 0 to 1.
    pub(crate) fn zone(&self, row: &Row) -> f64 {
        let zones = self.offsets().map(|column| row.x[column]);
        zones.fold(0.0, f64::max)
    }

    /// Returns `true` if a coefficient has an effect in the frost zone only.
    pub(crate) fn is_of_frost(&self, column: usize) -> bool {
        let Some(index) = column.checked_sub(1 + self.conditions) else {
            return false;
        };
        let of_frost = [0, 1, PER_TEMPERATURE - 2, PER_TEMPERATURE - 1];
        column + 1 < self.count() && of_frost.contains(&(index % PER_TEMPERATURE))
    }

    /// Returns the variance of a day alone, relative to σ²: above 1 in the frost zone, and with few
    /// epochs.
    pub(crate) fn variance(&self, row: &Row, structure: &Structure, sigma: f64) -> f64 {
        let scatter = self.zone(row) * self.size * structure.zone_scatter;
        let few = structure.usual_epochs / row.epochs.max(1.0);
        1.0 + EPOCH_SHARE * (few - 1.0).max(0.0) + (scatter / sigma).powi(2)
    }

    /// Returns the row of the next day after `past`, which moves on to it. `centre` is subtracted
    /// from ln(value).
    pub(crate) fn row(
        &self,
        day: &Day,
        past: &mut Past,
        structure: &Structure,
        centre: f64,
    ) -> Row {
        let knot = structure.knot;
        let today: Vec<Interior> = (self.temperatures.iter().zip(&day.below))
            .map(|(&index, below)| Interior {
                celsius: f64::from(day.conditions[index]),
                below: f64::from(below[knot]),
                zone: zone(below, knot),
            })
            .collect();
        let zones = past.follow(day.number, &today, structure.inertia_days);
        let mut x = Vec::with_capacity(self.count());
        x.push(1.0);
        x.extend(day.conditions.iter().map(|value| f64::from(*value)));
        let hinges = self.hinges.iter().map(|hinges| hinges[structure.hinge]);
        for ((index, hinge), parts) in self.amplitudes.iter().zip(hinges).zip(&day.amplitudes) {
            x[1 + index] = above(parts, hinge);
        }
        if let Some(mean) = self.thermometer_mean {
            x[self.conditions] -= mean; // the last one, after the level
        }
        for (place, day_below) in day.below.iter().enumerate() {
            let (today, interior) = (today[place], past.interiors[place]);
            x.extend([today.below, f64::from(day_below[KNOTS.len()])]);
            x.extend(BENDS.map(|bend| below(today.celsius, bend)));
            x.push(interior.celsius - today.celsius);
            x.push(interior.below - today.below);
            x.push(today.zone.max(zones[place]));
        }
        x.push(1.0);
        Row {
            x: DVector::from_vec(x),
            y: day.y - centre,
            epochs: f64::from(day.epochs),
        }
    }

    /// Returns a row without what forgets: the offsets and the deviation.
    pub(crate) fn lasting(&self, x: &DVector<f64>) -> DVector<f64> {
        let mut x = x.clone();
        for column in self.offsets() {
            x[column] = 0.0;
        }
        x[self.count() - 1] = 0.0;
        x
    }

    /// Returns the rows of days in ascending order, and the interior on the last one.
    pub(crate) fn rows(
        &self,
        days: &[Day],
        structure: &Structure,
        centre: f64,
    ) -> (Vec<Row>, Past) {
        let mut past = Past::default();
        let rows = days
            .iter()
            .map(|day| self.row(day, &mut past, structure, centre));
        (rows.collect(), past)
    }
}

/// A coefficient that forgets: a stationary process with a memory.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Forgetful {
    pub(crate) column: usize,
    memory_days: f64,
    /// Standard deviation in ln(value).
    std: f64,
}

impl Forgetful {
    /// Returns the share that remains after a number of days.
    pub(crate) fn kept(self, days: i64) -> f64 {
        (-(days.max(0) as f64) / self.memory_days).exp()
    }

    /// Returns the stationary variance relative to σ².
    pub(crate) fn variance(self, sigma: f64) -> f64 {
        (self.std / sigma).powi(2)
    }
}
