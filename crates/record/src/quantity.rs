//! Units that a column may have, and their factors to SI.
//!
//! Source: BIPM, *The International System of Units* (9th edition, 2019), table 8 and section 2.3.
//! Standard gravity is g = 9.80665 m/s², as defined by the 3rd CGPM (1901).

use std::f64::consts::PI;

/// A physical quantity that a channel measures.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Quantity {
    /// Acceleration, SI unit m/s².
    Acceleration,
    /// Velocity, SI unit m/s.
    Velocity,
    /// Displacement, SI unit m.
    Displacement,
    /// Force, SI unit N.
    Force,
    /// Moment, SI unit N m.
    Moment,
    /// Rotation, SI unit rad.
    Rotation,
    /// Angular velocity, SI unit rad/s.
    AngularVelocity,
    /// Angular acceleration, SI unit rad/s².
    AngularAcceleration,
    /// Strain and other ratios, SI unit 1.
    Strain,
    /// Pressure, SI unit Pa.
    Pressure,
    /// Electric voltage, SI unit V.
    Voltage,
    /// Temperature in °C. Only differences matter, so no offset is added.
    Temperature,
}

/// All quantities, in the order in which [`Quantity::of_unit`] searches them.
const ALL: [Quantity; 12] = [
    Quantity::Acceleration,
    Quantity::Velocity,
    Quantity::Displacement,
    Quantity::Force,
    Quantity::Moment,
    Quantity::Rotation,
    Quantity::AngularVelocity,
    Quantity::AngularAcceleration,
    Quantity::Strain,
    Quantity::Pressure,
    Quantity::Voltage,
    Quantity::Temperature,
];

/// Standard gravity, in m/s².
const STANDARD_GRAVITY: f64 = 9.80665;
const DEGREE: f64 = PI / 180.0;

impl Quantity {
    /// Returns the units of this quantity with their factors to SI. The SI unit comes first.
    fn units(self) -> &'static [(&'static str, f64)] {
        match self {
            Self::Acceleration => &[
                ("m/s2", 1.0),
                ("m/s^2", 1.0),
                ("m/s²", 1.0),
                ("mm/s2", 1e-3),
                ("cm/s2", 1e-2),
                ("gal", 1e-2),
                ("g", STANDARD_GRAVITY),
                ("mg", STANDARD_GRAVITY / 1000.0),
            ],
            Self::Velocity => &[("m/s", 1.0), ("cm/s", 1e-2), ("mm/s", 1e-3)],
            Self::Displacement => &[
                ("m", 1.0),
                ("cm", 1e-2),
                ("mm", 1e-3),
                ("um", 1e-6),
                ("µm", 1e-6),
            ],
            Self::Force => &[("N", 1.0), ("kN", 1e3), ("MN", 1e6)],
            Self::Moment => &[("N m", 1.0), ("Nm", 1.0), ("kN m", 1e3), ("kNm", 1e3)],
            Self::Rotation => &[("rad", 1.0), ("mrad", 1e-3), ("deg", DEGREE)],
            Self::AngularVelocity => &[("rad/s", 1.0), ("deg/s", DEGREE)],
            Self::AngularAcceleration => &[
                ("rad/s2", 1.0),
                ("rad/s^2", 1.0),
                ("rad/s²", 1.0),
                ("deg/s2", DEGREE),
            ],
            Self::Strain => &[
                ("1", 1.0),
                ("m/m", 1.0),
                ("mm/m", 1e-3),
                ("microstrain", 1e-6),
                ("um/m", 1e-6),
                ("%", 1e-2),
            ],
            Self::Pressure => &[
                ("Pa", 1.0),
                ("hPa", 1e2),
                ("kPa", 1e3),
                ("MPa", 1e6),
                ("mbar", 1e2),
                ("bar", 1e5),
            ],
            Self::Voltage => &[("V", 1.0), ("mV", 1e-3), ("uV", 1e-6)],
            Self::Temperature => &[("degC", 1.0), ("°C", 1.0)],
        }
    }

    /// Returns the factor from `unit` to SI, or `None` if `unit` does not belong to this quantity.
    pub fn si_from(self, unit: &str) -> Option<f64> {
        self.units()
            .iter()
            .find(|(symbol, _)| *symbol == unit)
            .map(|(_, factor)| *factor)
    }

    /// Returns the quantity of a unit, and the factor from this unit to SI.
    ///
    /// Accepts common spellings in files: `CM/SEC/SEC`, `cm/s^2` and `cm/s2` are the same. A plain
    /// length (`m`) is a displacement. Returns `None` if the unit is unknown.
    pub fn of_unit(unit: &str) -> Option<(Self, f64)> {
        let exact = |symbol: &str| {
            ALL.into_iter()
                .find_map(|quantity| Some((quantity, quantity.si_from(symbol)?)))
        };
        exact(unit).or_else(|| exact(&plain(unit)))
    }

    /// Returns the SI unit.
    pub fn si_unit(self) -> &'static str {
        self.units().first().map_or("1", |(symbol, _)| *symbol)
    }

    /// Returns the units of this quantity, with the SI unit first.
    pub fn allowed_units(self) -> Vec<&'static str> {
        self.units().iter().map(|(symbol, _)| *symbol).collect()
    }

    /// Returns the name of the quantity.
    pub fn name(self) -> &'static str {
        match self {
            Self::Acceleration => "acceleration",
            Self::Velocity => "velocity",
            Self::Displacement => "displacement",
            Self::Force => "force",
            Self::Moment => "moment",
            Self::Rotation => "rotation",
            Self::AngularVelocity => "angular velocity",
            Self::AngularAcceleration => "angular acceleration",
            Self::Strain => "strain",
            Self::Pressure => "pressure",
            Self::Voltage => "voltage",
            Self::Temperature => "temperature",
        }
    }
}

/// Converts a unit in seismological spelling to the spelling of this module.
fn plain(unit: &str) -> String {
    let lower = unit.trim().to_ascii_lowercase();
    let seconds = lower
        .replace("seconds", "s")
        .replace("second", "s")
        .replace("sec", "s");
    let squared = seconds
        .replace("/s/s", "/s2")
        .replace("**2", "2")
        .replace(['^', ' '], "")
        .replace('²', "2");
    squared.trim_end_matches('.').replace(['µ', 'μ'], "u") // micro sign and Greek mu
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn factors_are_those_of_the_si_brochure() {
        assert_eq!(Quantity::Acceleration.si_from("g"), Some(9.80665));
        assert_eq!(Quantity::Acceleration.si_from("gal"), Some(0.01));
        assert_eq!(Quantity::Displacement.si_from("mm"), Some(0.001));
        assert_eq!(Quantity::Force.si_from("kN"), Some(1000.0));
        assert_eq!(Quantity::Strain.si_from("microstrain"), Some(1e-6));
        assert_eq!(
            Quantity::Rotation.si_from("deg"),
            Some(0.017_453_292_519_943_295)
        );
    }

    #[test]
    fn spellings_of_units_in_files_are_known() {
        for unit in [
            "cm/sec2",
            "CM/SEC/SEC",
            "cm/s^2",
            "cm/sec2.",
            "cm/s²",
            "gal",
        ] {
            assert_eq!(
                Quantity::of_unit(unit),
                Some((Quantity::Acceleration, 0.01)),
                "{unit}"
            );
        }
        assert_eq!(
            Quantity::of_unit("G"),
            Some((Quantity::Acceleration, 9.80665))
        );
        assert_eq!(
            Quantity::of_unit("CM/SEC"),
            Some((Quantity::Velocity, 0.01))
        );
        assert_eq!(
            Quantity::of_unit("CM"),
            Some((Quantity::Displacement, 0.01))
        );
        assert_eq!(Quantity::of_unit("µm/m"), Some((Quantity::Strain, 1e-6)));
        assert_eq!(Quantity::of_unit("Pa"), Some((Quantity::Pressure, 1.0)));
        assert_eq!(Quantity::of_unit("kN"), Some((Quantity::Force, 1000.0)));
        assert_eq!(
            Quantity::of_unit("MN"),
            Some((Quantity::Force, 1e6)),
            "and not a milli"
        );
        assert_eq!(Quantity::of_unit("counts"), None);
    }

    #[test]
    fn unit_of_another_quantity_is_refused() {
        assert_eq!(Quantity::Acceleration.si_from("mm"), None);
        assert_eq!(Quantity::Displacement.si_from("g"), None);
    }
}
