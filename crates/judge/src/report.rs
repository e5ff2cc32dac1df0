//! Report of a reference: its rate of false alarms, and the changes that it can detect.

use crate::calibration::Performance;
use crate::judgement::Finding;
use crate::reference::{Missing, YEAR_DAYS};
use crate::thermometers::QuantityCourse;
use serde::{Deserialize, Serialize};

/// State of the judgement of one quantity: its reference, or why there is none, and its finding.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct QuantityReport {
    /// Name of the quantity.
    pub quantity: String,
    /// Summary of the reference. `None` until the reference has been learnt.
    pub reference: Option<ReferenceReport>,
    /// What the commissioning lacked at the last attempt to learn the reference. `None` if the
    /// reference has been learnt or before the first attempt.
    pub missing: Option<Missing>,
    /// Lasting change that has been found and still holds. `None` without a lasting change.
    pub finding: Option<Finding>,
}

/// Summary of the reference of one quantity: its commissioning, model and expected performance.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ReferenceReport {
    /// First day of the commissioning (days since 1970-01-01 UTC).
    pub from_day: i64,
    /// Last day of the commissioning (days since 1970-01-01 UTC).
    pub to_day: i64,
    /// Share of the days of the commissioning within their 95 % interval, 0 to 1.
    pub coverage: f64,
    /// Standard deviation of the daily value under known conditions, as a share of the value.
    pub scatter: f64,
    /// Correlation of the residuals of two successive days, −1 to 1.
    pub correlation: f64,
    /// T0 of the frost hinge (°C), if a condition is a temperature.
    pub frost_knot: Option<f64>,
    /// r0 of each amplitude, in its unit: the quantity depends on the amplitude above it only.
    pub amplitude_hinges: Vec<f64>,
    /// Whether the commissioning, with the later winters that are over, contained at least five
    /// days of frost, if a condition is a temperature.
    pub knows_frost: Option<bool>,
    /// Coefficients: at zero, per unit of each condition, and per degree of frost.
    pub coefficients: Vec<f64>,
    /// Natural logarithm of the threshold of the detector.
    pub ln_threshold: f64,
    /// Promised and achieved rate of false alarms, and detection delays.
    pub performance: Performance,
}

/// Returns the warning about a commissioning of a number of days, if it lacks a season.
///
/// ```
/// assert!(spandrel_judge::season_warning(90).is_some());
/// assert_eq!(spandrel_judge::season_warning(365), None);
/// ```
#[must_use]
pub fn season_warning(days: i64) -> Option<String> {
    (days < YEAR_DAYS).then(|| {
        format!(
            "the commissioning of {days} days does not contain all seasons; a seasonal change can \
             look like a lasting one"
        )
    })
}

impl ReferenceReport {
    /// Returns the length of the commissioning (days).
    #[must_use]
    pub fn commissioning_days(&self) -> i64 {
        self.to_day - self.from_day + 1
    }
}

impl QuantityReport {
    pub(crate) fn new(name: &str, course: &QuantityCourse) -> Self {
        let (reference, missing) = match course.reference() {
            Ok(reference) => {
                let has_temperature = !reference.columns.temperatures.is_empty();
                let sigma = reference.posterior.sigma;
                let report = ReferenceReport {
                    from_day: reference.from_day,
                    to_day: reference.to_day,
                    coverage: reference.coverage,
                    scatter: reference.scatter(),
                    correlation: reference.columns.correlation(&reference.structure, sigma),
                    frost_knot: has_temperature.then(|| reference.knot_celsius()),
                    amplitude_hinges: reference.hinges().map(|a| 10_f64.powf(a)).collect(),
                    knows_frost: has_temperature.then(|| reference.knows_frost()),
                    coefficients: reference.posterior.mean.iter().copied().collect(),
                    ln_threshold: reference.ln_threshold,
                    performance: reference.performance.clone(),
                };
                (Some(report), None)
            }
            Err(missing) => (None, missing.cloned()),
        };
        Self {
            quantity: name.to_owned(),
            reference,
            missing,
            finding: course.finding().copied(),
        }
    }
}
