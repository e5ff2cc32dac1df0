//! Converts the numbers of an instrument to SI units.

use crate::station_xml::Sensitivities;

/// Conversion of the numbers of one channel to the SI unit of its quantity.
///
/// The value is `sign · (number − offset) / sensitivity`.
#[derive(Clone, Debug, PartialEq)]
pub struct Calibration {
    sensitivity: Sensitivity,
    offset: f64,
    sign: f64,
}

/// Numbers per SI unit.
#[derive(Clone, Debug, PartialEq)]
enum Sensitivity {
    Constant(f64),
    /// From a StationXML file, by epoch.
    Epochs(Sensitivities),
}

impl Calibration {
    /// Creates a conversion with a constant `sensitivity` (numbers per SI unit).
    ///
    /// The instrument shows `offset` (numbers) at zero. `sign` is 1 or −1.
    #[must_use]
    pub fn new(sensitivity: f64, offset: f64, sign: f64) -> Self {
        Self {
            sensitivity: Sensitivity::Constant(sensitivity),
            offset,
            sign,
        }
    }

    /// Creates a conversion with the sensitivities of a StationXML file.
    pub(crate) fn of_epochs(epochs: Sensitivities, offset: f64, sign: f64) -> Self {
        Self {
            sensitivity: Sensitivity::Epochs(epochs),
            offset,
            sign,
        }
    }

    /// Returns the value of a number that was measured at `time_ns` (ns since the Unix epoch), in
    /// the SI unit.
    ///
    /// Returns `None` if the StationXML file has no sensitivity for this time.
    #[must_use]
    pub fn si_from_number(&self, number: f64, time_ns: i64) -> Option<f64> {
        let sensitivity = match &self.sensitivity {
            Sensitivity::Constant(sensitivity) => *sensitivity,
            Sensitivity::Epochs(epochs) => epochs.at(time_ns)?,
        };
        Some(self.sign * (number - self.offset) / sensitivity)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn offset_acts_before_sensitivity_and_sign() {
        // A zero at 100 counts, 200 counts per m/s², mounted upside down: 500 counts are −2 m/s².
        let upside_down = Calibration::new(200.0, 100.0, -1.0);
        assert_eq!(upside_down.si_from_number(500.0, 0), Some(-2.0));
    }
}
