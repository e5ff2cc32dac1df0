//! What is judged, under which conditions, and with which budget.

use crate::error::JudgeError;
use serde::{Deserialize, Serialize};

/// What a quantity measures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum QuantityKind {
    /// A natural frequency. The stiffness is proportional to its square.
    Frequency,
    /// A stiffness, in any unit.
    Stiffness,
}

impl QuantityKind {
    /// Change of ln(value) per change of ln(stiffness).
    #[must_use]
    pub fn per_stiffness(self) -> f64 {
        match self {
            Self::Frequency => 0.5, // Δ ln k = 2 Δ ln f
            Self::Stiffness => 1.0,
        }
    }
}

/// A judged quantity.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Quantity {
    /// Name of the quantity or condition, unique within the structure.
    pub name: String,
    /// What the quantity measures: a natural frequency or a stiffness.
    pub kind: QuantityKind,
    /// Other quantities that serve as thermometers of this one: none, or at least
    /// [`Settings::FEWEST_THERMOMETERS`]. They have no thermometers themselves.
    #[serde(default)]
    pub thermometers: Vec<String>,
}

/// A mistake in a list of thermometers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ThermometerMistake {
    /// What the list contains.
    pub found: String,
    /// What it must contain.
    pub allowed: String,
}

/// What a condition measures, and in which unit its values arrive.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ConditionKind {
    /// Temperature (°C).
    Celsius,
    /// Temperature (K).
    Kelvin,
    /// Temperature (°F).
    Fahrenheit,
    /// Root mean square of the response, in any unit. Above some amplitude, the quantity depends on
    /// its logarithm.
    Amplitude,
    /// Any other covariate, with the standard deviation of the relative change of the stiffness
    /// per unit.
    Other {
        /// Standard deviation of d ln(stiffness) / d(condition).
        slope_std: f64,
    },
}

/// Prior standard deviation of the slope of ln(frequency) (1/°C): 0.3 %/°C.
const TEMPERATURE_SLOPE: f64 = 0.003;
/// Prior standard deviation of the additional slope of ln(frequency) in frost (1/°C): 3 %/°C.
const FROST_SLOPE: f64 = 0.03;
/// Prior standard deviation of the change of ln(frequency) per decade of amplitude above r0.
const AMPLITUDE_SLOPE: f64 = 0.5;
/// Prior standard deviation of the relative change of the stiffness per relative change of the
/// stiffness of a thermometer. Members of one structure have materials of a similar sensitivity.
const THERMOMETER_SLOPE: f64 = 1.0;
/// Lowest and highest plausible temperature of a structure (°C).
pub const PLAUSIBLE_CELSIUS: (f64, f64) = (-60.0, 80.0);

/// Prior standard deviations of the coefficients of a condition.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct SlopePrior {
    pub(crate) slope: f64,
    /// Of the additional slope in frost, if the condition is a temperature.
    pub(crate) frost: Option<f64>,
}

impl ConditionKind {
    /// Returns `true` if the condition is a temperature.
    #[must_use]
    pub fn is_temperature(self) -> bool {
        matches!(self, Self::Celsius | Self::Kelvin | Self::Fahrenheit)
    }

    pub(crate) fn is_amplitude(self) -> bool {
        matches!(self, Self::Amplitude)
    }

    /// Converts a value to the scale of the model: °C, log10 of the amplitude, or unchanged.
    ///
    /// # Errors
    /// Returns the allowed range if the value is not plausible in its unit.
    pub fn convert(self, value: f64) -> Result<f64, Implausible> {
        let converted = match self {
            Self::Celsius | Self::Other { .. } => value,
            Self::Kelvin => value - 273.15,
            Self::Fahrenheit => (value - 32.0) / 1.8,
            Self::Amplitude => value.log10(),
        };
        let (low, high) = PLAUSIBLE_CELSIUS;
        let plausible = !self.is_temperature() || (low..=high).contains(&converted);
        match converted.is_finite() && plausible {
            true => Ok(converted),
            false => Err(Implausible { value, kind: self }),
        }
    }

    /// Returns the prior of a quantity of some kind.
    pub(crate) fn prior(self, kind: QuantityKind) -> SlopePrior {
        // The priors are those of a frequency. A stiffness changes twice as much.
        let size = 2.0 * kind.per_stiffness();
        match self {
            Self::Celsius | Self::Kelvin | Self::Fahrenheit => SlopePrior {
                slope: size * TEMPERATURE_SLOPE,
                frost: Some(size * FROST_SLOPE),
            },
            Self::Amplitude => SlopePrior {
                slope: size * AMPLITUDE_SLOPE,
                frost: None,
            },
            Self::Other { slope_std } => SlopePrior {
                slope: kind.per_stiffness() * slope_std,
                frost: None,
            },
        }
    }
}

/// Returns the prior of a quantity of some kind that another quantity explains.
pub(crate) fn thermometer_prior(kind: QuantityKind) -> SlopePrior {
    SlopePrior {
        slope: kind.per_stiffness() * THERMOMETER_SLOPE,
        frost: None,
    }
}

/// A value that its condition cannot have in the stated unit.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error("{value} is not plausible{}", advice(*kind))]
pub struct Implausible {
    /// Value as it arrived.
    pub value: f64,
    /// Kind of the condition.
    pub kind: ConditionKind,
}

fn advice(kind: ConditionKind) -> String {
    let (low, high) = PLAUSIBLE_CELSIUS;
    match kind {
        ConditionKind::Celsius => {
            format!(" in °C, must be {low} to {high} °C; check the unit")
        }
        ConditionKind::Kelvin => format!(
            " in K, must be {} to {} K; check the unit",
            low + 273.15,
            high + 273.15
        ),
        ConditionKind::Fahrenheit => format!(
            " in °F, must be {} to {} °F; check the unit",
            low * 1.8 + 32.0,
            high * 1.8 + 32.0
        ),
        ConditionKind::Amplitude => " as an amplitude, must be above 0".to_owned(),
        ConditionKind::Other { .. } => ", must be a finite number".to_owned(),
    }
}

/// A condition: a measured covariate.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Condition {
    /// Name of the quantity or condition, unique within the structure.
    pub name: String,
    /// What the condition measures, and in which unit its values arrive.
    pub kind: ConditionKind,
}

/// Returns the indices of the conditions of a kind.
pub(crate) fn indices(conditions: &[Condition], is: fn(ConditionKind) -> bool) -> Vec<usize> {
    let indices = conditions.iter().enumerate();
    let of_kind = indices.filter(|(_, condition)| is(condition.kind));
    of_kind.map(|(index, _)| index).collect()
}

/// Settings of the judgement of one structure.
///
/// [`Judge::new`](crate::Judge::new) checks that all settings are in range. The constants of this
/// type are the usual defaults: 0.1 false alarms per year, a loss of 2 % and a commissioning of 365
/// days. A smaller budget of false alarms delays the detection of a loss.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Settings {
    /// Budget: expected number of false alarms per year, for all quantities together.
    pub false_alarms_per_year: f64,
    /// Loss of stiffness that matters, as a share (0 to 1).
    pub loss: f64,
    /// Length of the commissioning (days).
    pub commissioning_days: u32,
    /// Whether a commissioning shorter than a season is accepted.
    pub season: Season,
    /// Judged quantities, at least one.
    pub quantities: Vec<Quantity>,
    /// Conditions, such as temperatures, whose effect on the quantities is removed. At most
    /// [`Settings::MOST_CONDITIONS`].
    pub conditions: Vec<Condition>,
}

/// Whether the commissioning must span a season.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Season {
    /// A commissioning shorter than 90 days is not ready.
    Required,
    /// A shorter commissioning is accepted, and its reference may be biased.
    Waived,
}

impl Settings {
    /// Default of the budget (false alarms per year and structure).
    pub const FALSE_ALARMS_PER_YEAR: f64 = 0.1;
    /// Default of the loss of stiffness that matters, as a share (2 %).
    pub const LOSS: f64 = 0.02;
    /// Default length of the commissioning (days): all seasons.
    pub const COMMISSIONING_DAYS: u32 = 365;
    /// Shortest and longest commissioning (days).
    pub const COMMISSIONING_RANGE: (u32, u32) = (20, 400);
    /// Maximum number of conditions and thermometers of a quantity, which limits the size of the
    /// state.
    pub const MOST_CONDITIONS: usize = 3;
    /// Smallest number of thermometers. A change of a single one could not be distinguished from a
    /// change of the quantity.
    pub const FEWEST_THERMOMETERS: usize = 2;

    /// Returns the first mistake in the thermometers of a quantity.
    #[must_use]
    pub fn thermometer_mistake(&self, quantity: &Quantity) -> Option<ThermometerMistake> {
        let named = &quantity.thermometers;
        let (fewest, conditions) = (Self::FEWEST_THERMOMETERS, self.conditions.len());
        if named.is_empty() {
            return None;
        }
        let mistake = |found: String, allowed: String| Some(ThermometerMistake { found, allowed });
        for (place, name) in named.iter().enumerate() {
            let others = self
                .quantities
                .iter()
                .filter(|one| one.name != quantity.name);
            let Some(other) = others.clone().find(|other| other.name == *name) else {
                let others: Vec<&str> = others.map(|other| other.name.as_str()).collect();
                return mistake(
                    format!("contains \"{name}\""),
                    format!("must contain other quantities: {}", others.join(", ")),
                );
            };
            if named[..place].contains(name) {
                return mistake(format!("repeats \"{name}\""), "must be unique".to_owned());
            }
            // This also excludes quantities that are thermometers of each other.
            if !other.thermometers.is_empty() {
                return mistake(
                    format!("contains \"{name}\", which has thermometers itself"),
                    "must contain quantities without thermometers".to_owned(),
                );
            }
        }
        if named.len() < fewest {
            return mistake(
                format!("has {} name", named.len()),
                format!(
                    "must have at least {fewest}, because a change of a single thermometer cannot \
                     be distinguished from a change of the quantity"
                ),
            );
        }
        if named.len() + conditions > Self::MOST_CONDITIONS {
            return mistake(
                format!("has {} names beside {conditions} conditions", named.len()),
                format!("must be at most {} together", Self::MOST_CONDITIONS),
            );
        }
        None
    }

    /// Checks the ranges.
    ///
    /// # Errors
    /// Returns the first setting outside its range.
    pub(crate) fn check(&self) -> Result<(), JudgeError> {
        let (least, most) = Self::COMMISSIONING_RANGE;
        let problem = if self.quantities.is_empty() {
            Some("no quantity, must have at least one".to_owned())
        } else if self.conditions.len() > Self::MOST_CONDITIONS {
            Some(format!(
                "{} conditions, must be at most {}",
                self.conditions.len(),
                Self::MOST_CONDITIONS
            ))
        } else if !(self.false_alarms_per_year > 0.0 && self.false_alarms_per_year.is_finite()) {
            Some(format!(
                "false alarms per year are {}, must be above 0",
                self.false_alarms_per_year
            ))
        } else if !(self.loss > 0.0 && self.loss < 1.0) {
            Some(format!(
                "loss is {}, must be above 0 and below 1",
                self.loss
            ))
        } else if !(least..=most).contains(&self.commissioning_days) {
            Some(format!(
                "commissioning is {} days, must be {least} to {most}",
                self.commissioning_days
            ))
        } else {
            self.quantities.iter().find_map(|quantity| {
                let ThermometerMistake { found, allowed } = self.thermometer_mistake(quantity)?;
                let name = &quantity.name;
                Some(format!("list of thermometers of {name} {found}, {allowed}"))
            })
        };
        problem.map_or(Ok(()), |what| Err(JudgeError::Setting { what }))
    }
}
