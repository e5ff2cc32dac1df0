//! Summary of one day of a quantity: the mean of ln(value) and of everything that explains it.
//!
//! A day is the unit of decision. All regressors enter as means over the same epochs as the
//! quantity, so that the mean of a linear model is the model of the means.

use crate::amplitude::{PARTS, parts};
use crate::frost::{DAY_KNOTS, FREEZING, below_all};
use crate::judgement::DayMeans;
use crate::model::Explanation;
use crate::settings::{ConditionKind, indices};
use serde::{Deserialize, Serialize};

/// Seconds of a day.
pub(crate) const DAY_S: f64 = 86_400.0;

/// Most epochs of a day that are kept. Beyond it, every second one is left out.
const MOST_EPOCHS: usize = 96;
/// An epoch that is farther than this from the median of its day belongs to another mode or is a
/// fault of the thermometer, in robust standard deviations,
const FARTHEST: f64 = 5.0;
/// and at least this far, in ln(value).
const SMALLEST_DISTANCE: f64 = 0.01;
/// The same distance of a temperature (°C). The sun heats a dark surface by this much at noon.
const SMALLEST_SPIKE: f64 = 20.0;
/// Robust standard deviation per median of the absolute deviations.
const ROBUST: f64 = 1.4826;

/// One day of a quantity.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Day {
    /// Days since 1970-01-01 UTC.
    pub(crate) number: i64,
    /// Number of epochs.
    pub(crate) epochs: u16,
    /// Mean of ln(value).
    pub(crate) y: f64,
    /// Mean of each condition, in the scale of the model.
    pub(crate) conditions: Vec<f32>,
    /// Mean of min(T − T0, 0) (°C) for each temperature and each knot.
    pub(crate) below: Vec<[f32; DAY_KNOTS]>,
    /// Means of equal parts of the epochs, from weak to strong, for each amplitude.
    pub(crate) amplitudes: Vec<[f32; PARTS]>,
}

impl Day {
    /// Returns the geometric mean of the quantity, in its unit.
    pub(crate) fn value(&self) -> f64 {
        self.y.exp()
    }

    /// Returns the depth of frost (°C, at most 0) of each temperature: the mean of min(T − T0, 0),
    /// or of min(T, 0) if T0 is below the freezing point. A commissioning without frost can give
    /// any T0.
    pub(crate) fn frost(&self, knot: usize) -> impl Iterator<Item = f64> {
        let knot = knot.max(FREEZING);
        self.below.iter().map(move |below| f64::from(below[knot]))
    }

    /// Returns the means in the units of the quantity and of the conditions.
    pub(crate) fn means(&self) -> DayMeans {
        DayMeans {
            value: self.value(),
            conditions: self.conditions.clone(),
            epochs: self.epochs,
        }
    }
}

/// Epochs of the day that is not over yet.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct DayEpochs {
    /// ln(value) and the conditions of each kept epoch.
    kept: Vec<(f64, Vec<f64>)>,
    /// Number of epochs so far, and the number of epochs per stored epoch.
    count: usize,
    stride: usize,
}

impl DayEpochs {
    /// Adds one epoch: ln(value), and the conditions in the scale of the model.
    pub(crate) fn add(&mut self, y: f64, conditions: &[f64]) {
        let stride = self.stride.max(1);
        if self.count.is_multiple_of(stride) {
            self.kept.push((y, conditions.to_vec()));
        }
        self.count += 1;
        if self.kept.len() >= MOST_EPOCHS {
            let mut index = 0;
            self.kept.retain(|_| {
                index += 1;
                index % 2 == 1
            });
            self.stride = 2 * stride;
        }
    }

    /// Returns the means of the day and starts the next day. `None` if no epoch had the quantity
    /// and everything that explains it.
    ///
    /// Epochs that are far from the others do not count.
    pub(crate) fn take(&mut self, number: i64, explanation: Explanation<'_>) -> Option<Day> {
        let Explanation {
            conditions,
            thermometer,
        } = explanation;
        let epochs = std::mem::take(self).kept;
        let of_quantity = Near::new(epochs.iter().map(|(y, _)| *y), SMALLEST_DISTANCE)?;
        let explains = |index: usize, smallest: f64| {
            let near = Near::new(epochs.iter().map(|(_, values)| values[index]), smallest)?;
            Some((index, near))
        };
        let temperatures = indices(conditions, ConditionKind::is_temperature);
        let of_temperatures = temperatures.iter().map(|index| (*index, SMALLEST_SPIKE));
        let of_thermometer = thermometer.map(|_| (conditions.len(), SMALLEST_DISTANCE));
        let explaining: Vec<(usize, Near)> = of_temperatures
            .chain(of_thermometer)
            .filter_map(|(index, smallest)| explains(index, smallest))
            .collect();
        let counts = |epoch: &&(f64, Vec<f64>)| {
            let (y, values) = epoch;
            let mut explaining = explaining.iter();
            of_quantity.contains(*y)
                && explaining.all(|(index, near)| near.contains(values[*index]))
        };
        let counting: Vec<_> = epochs.iter().filter(counts).collect();
        let (_, first) = counting.first()?;
        let count = counting.len() as f64;
        let mean = |of: &dyn Fn(&[f64]) -> f64| {
            counting.iter().map(|(_, values)| of(values)).sum::<f64>() / count
        };
        let below = |index: usize| {
            std::array::from_fn(|knot| mean(&|values| below_all(values[index])[knot]) as f32)
        };
        let amplitudes = indices(conditions, ConditionKind::is_amplitude);
        let amplitude =
            |index: usize| parts(counting.iter().map(|(_, values)| values[index]).collect());
        Some(Day {
            number,
            epochs: counting.len() as u16,
            y: counting.iter().map(|(y, _)| y).sum::<f64>() / count,
            conditions: (0..first.len())
                .map(|index| mean(&|values| values[index]) as f32)
                .collect(),
            below: temperatures.into_iter().map(below).collect(),
            amplitudes: amplitudes.into_iter().map(amplitude).collect(),
        })
    }
}

/// The values of a day that belong to one mode, or to a thermometer without its spikes.
#[derive(Debug, Clone, Copy)]
struct Near {
    median: f64,
    farthest: f64,
}

impl Near {
    /// `smallest` is the smallest distance that is far. Returns `None` without values.
    fn new(values: impl Iterator<Item = f64> + Clone, smallest: f64) -> Option<Self> {
        let middle = median(values.clone())?;
        let spread = median(values.map(|value| (value - middle).abs()))?;
        Some(Self {
            median: middle,
            farthest: (FARTHEST * ROBUST * spread).max(smallest),
        })
    }

    fn contains(self, value: f64) -> bool {
        (value - self.median).abs() <= self.farthest
    }
}

fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    let [low, high] = [values.len().checked_sub(1)? / 2, values.len() / 2];
    Some(0.5 * (values[low] + values[high]))
}
