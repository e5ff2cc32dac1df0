//! Conditions: slow quantities, such as temperatures, that instruments measure beside the motion.

/// A measured condition of a structure.
///
/// No model contains it. Its values remain in the unit of the structure file.
#[derive(Debug, Clone, PartialEq)]
pub struct Condition {
    pub(crate) name: String,
    pub(crate) unit: &'static str,
    pub(crate) range: Option<(f64, f64)>,
    pub(crate) interval_s: Option<f64>,
}

impl Condition {
    /// All units of conditions, spelt as in condition messages.
    pub const UNITS: [&'static str; 33] = [
        "degC",
        "K",
        "%",
        "1",
        "m/s",
        "km/h",
        "deg",
        "rad",
        "mrad",
        "m",
        "cm",
        "mm",
        "um",
        "N",
        "kN",
        "MN",
        "N m",
        "kN m",
        "kg",
        "t",
        "Pa",
        "hPa",
        "kPa",
        "MPa",
        "m/s2",
        "microstrain",
        "W/m2",
        "mm/h",
        "Hz",
        "1/h",
        "V",
        "mV",
        "mA",
    ];

    /// Returns the name, which is one chunk of a key expression.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the unit, one of [`Self::UNITS`].
    #[must_use]
    pub fn unit(&self) -> &'static str {
        self.unit
    }

    /// Returns the lowest and highest plausible value (in the unit). `None` if the file states
    /// none.
    #[must_use]
    pub fn range(&self) -> Option<(f64, f64)> {
        self.range
    }

    /// Returns `true` if a value (in the unit) lies in the plausible range.
    #[must_use]
    pub fn is_plausible(&self, value: f64) -> bool {
        self.range
            .is_none_or(|(low, high)| (low..=high).contains(&value))
    }

    /// Returns the expected time between two values (s). `None` if the file states none.
    #[must_use]
    pub fn interval_s(&self) -> Option<f64> {
        self.interval_s
    }
}
