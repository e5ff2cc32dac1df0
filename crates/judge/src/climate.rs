//! Checks whether the temperatures of a commissioning can be those of a structure.
//!
//! Degrees Celsius that are declared as Fahrenheit make a year of frost, and the opposite makes a
//! year of heat. Neither lets a frost begin where it does, so that a season looks like a loss.

use crate::day::Day;
use crate::reference::Missing;
use crate::settings::{Condition, ConditionKind, indices};

/// Number of days after which a commissioning includes warm ones in any climate but that of ice
/// sheets.
const WITH_A_SUMMER: i64 = 270;
/// Share of the days, and temperature (°C) below which so many days are too cold. The summer of a
/// valley in permafrost is warmer.
const COLD_SHARE: f64 = 0.9;
const TOO_COLD: f64 = 0.0;
/// Median (°C) above which a year is too hot, and a shorter time. A deck in a desert is colder.
const TOO_HOT: f64 = 35.0;
const TOO_HOT_A_SUMMER: f64 = 45.0;

/// Returns the first condition whose unit is probably wrong.
pub(crate) fn implausible(days: &[Day], conditions: &[Condition]) -> Option<Missing> {
    let spans = days.last()?.number - days.first()?.number + 1;
    let has_summer = spans >= WITH_A_SUMMER;
    let of_condition = |index: usize| {
        let condition = conditions[index].name.clone();
        let values = days.iter().map(|day| f64::from(day.conditions[index]));
        let mut celsius: Vec<f64> = values.collect();
        celsius.sort_by(f64::total_cmp);
        let quantile = |share: f64| celsius[((celsius.len() - 1) as f64 * share) as usize];
        let (median, warm) = (quantile(0.5), quantile(COLD_SHARE));
        let too_hot = if has_summer {
            TOO_HOT
        } else {
            TOO_HOT_A_SUMMER
        };
        if median > too_hot {
            return Some(Missing::Hot { condition, median });
        }
        (has_summer && warm < TOO_COLD).then_some(Missing::Cold { condition, warm })
    };
    let temperatures = indices(conditions, ConditionKind::is_temperature);
    temperatures.into_iter().find_map(of_condition)
}
