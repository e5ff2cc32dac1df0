//! One measured condition, such as a temperature.

use serde::{Deserialize, Serialize};

use super::{Format, Malformed, Message, check_finite, check_label, check_range};
use crate::name::Name;

/// Units of conditions, each with its lowest possible value.
///
/// Source: BIPM, *The International System of Units* (9th edition, 2019), tables 2 to 4 and 8, and
/// section 5.4.7 (per cent).
const UNITS: &[(&str, f64)] = &[
    ("degC", -273.15),
    ("K", 0.0),
    ("%", f64::MIN),
    ("1", f64::MIN),
    ("m/s", f64::MIN),
    ("km/h", f64::MIN),
    ("deg", f64::MIN),
    ("rad", f64::MIN),
    ("mrad", f64::MIN),
    ("m", f64::MIN),
    ("cm", f64::MIN),
    ("mm", f64::MIN),
    ("um", f64::MIN),
    ("N", f64::MIN),
    ("kN", f64::MIN),
    ("MN", f64::MIN),
    ("N m", f64::MIN),
    ("kN m", f64::MIN),
    ("kg", 0.0),
    ("t", 0.0),
    ("Pa", f64::MIN),
    ("hPa", f64::MIN),
    ("kPa", f64::MIN),
    ("MPa", f64::MIN),
    ("m/s2", f64::MIN),
    ("microstrain", f64::MIN),
    ("W/m2", f64::MIN),
    ("mm/h", 0.0),
    ("Hz", 0.0),
    ("1/h", 0.0),
    ("V", f64::MIN),
    ("mV", f64::MIN),
    ("mA", f64::MIN),
];

/// A value of a slow quantity that describes the conditions of a structure.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ConditionDisplay {
    /// Name of the structure.
    pub structure: Name,
    /// Name of the condition.
    pub name: Name,
    /// Time of the measurement, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// Value, in `unit`.
    pub value: f64,
    /// Unit, one of [`Self::units`].
    pub unit: String,
    /// Expected time until the next value, s. `None` if the publisher states none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub interval_s: Option<f64>,
    /// Label of the instrument, for people. `None` if the publisher states none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub instrument: Option<String>,
}

impl ConditionDisplay {
    /// Maximum time by which a value may be ahead of the clock of its reader, ns. A value of the
    /// future would exclude all values before it.
    pub const MAX_AHEAD_NS: i64 = 60_000_000_000;

    /// Returns the units of conditions.
    pub fn units() -> impl Iterator<Item = &'static str> {
        UNITS.iter().map(|(unit, _)| *unit)
    }
}

impl Message for ConditionDisplay {
    const TYPE: &'static str = "condition";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        check_finite("value", self.value)?;
        check_label("unit", &self.unit)?;
        let Some((_, lowest)) = UNITS.iter().find(|(unit, _)| *unit == self.unit) else {
            return Err(Malformed::Unit {
                found: self.unit.clone(),
            });
        };
        check_range("value", self.value, *lowest, f64::MAX)?;
        if let Some(interval_s) = self.interval_s {
            check_range("interval_s", interval_s, 0.0, f64::MAX)?;
        }
        self.instrument
            .as_ref()
            .map_or(Ok(()), |label| check_label("instrument", label))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decode(value: &str, unit: &str) -> Result<ConditionDisplay, String> {
        let text = format!(
            "{{\"structure\":\"bridge\",\"name\":\"deck-temperature\",\"time_ns\":5,\"value\":{value},\"unit\":\"{unit}\"}}"
        );
        let decoded = ConditionDisplay::decode("application/json", text.as_bytes());
        decoded.map_err(|error| error.with_cause())
    }

    #[test]
    fn value_below_absolute_zero_is_malformed() {
        assert_eq!(decode("-273.15", "degC").unwrap().value, -273.15);
        for (value, unit) in [("-273.16", "degC"), ("-0.1", "K")] {
            let told = decode(value, unit).unwrap_err();
            assert!(told.contains("value is -"), "{told}");
        }
    }

    #[test]
    fn unknown_unit_is_malformed_and_the_units_are_named() {
        let told = decode("20.5", "°C").unwrap_err();
        let expected = "message is malformed: unit is \"°C\", must be one of degC, K, %, ";
        assert!(told.starts_with(expected), "{told}");
    }

    #[test]
    fn value_that_is_no_number_is_rejected() {
        assert!(decode("null", "degC").is_err());
        assert!(decode("1e999", "degC").is_err());
    }
}
