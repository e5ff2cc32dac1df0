//! What a reference promises and what it can find.

use crate::calibration::Performance;
use crate::course::Course;
use crate::judgement::Finding;
use crate::reference::Missing;
use serde::{Deserialize, Serialize};

/// Report of one quantity.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct QuantityReport {
    /// Name of the quantity.
    pub quantity: String,
    /// Reference, if it has been learnt.
    pub reference: Option<ReferenceReport>,
    /// What the last attempt to learn it missed.
    pub missing: Option<Missing>,
    /// Finding that holds.
    pub finding: Option<Finding>,
}

/// Report of a reference.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ReferenceReport {
    /// First and last day of the commissioning (days since 1970-01-01 UTC).
    pub from_day: i64,
    /// Last day of the commissioning.
    pub to_day: i64,
    /// Coverage of the 95 % interval over the weeks of the commissioning.
    pub coverage: f64,
    /// Standard deviation of a day under known conditions, as a share of the value.
    pub scatter: f64,
    /// Correlation of two successive days.
    pub correlation: f64,
    /// T0 of the frost hinge (°C), if a condition is a temperature.
    pub frost_knot: Option<f64>,
    /// Whether the commissioning contained at least five days of frost, if a condition is a
    /// temperature.
    pub knows_frost: Option<bool>,
    /// Coefficients: at zero, per unit of each condition, and per degree of frost.
    pub coefficients: Vec<f64>,
    /// ln of the threshold of the detector.
    pub ln_threshold: f64,
    /// Promised and achieved rate, and delays.
    pub performance: Performance,
}

impl QuantityReport {
    pub(crate) fn new(name: &str, course: &Course) -> Self {
        let (reference, missing) = match course.reference() {
            Ok(reference) => {
                let has_temperature = !reference.columns.temperatures.is_empty();
                let sigma = reference.posterior.sigma;
                let report = ReferenceReport {
                    from_day: reference.from_day,
                    to_day: reference.to_day,
                    coverage: reference.coverage,
                    scatter: reference.columns.scatter(&reference.structure, sigma),
                    correlation: reference.columns.correlation(&reference.structure, sigma),
                    frost_knot: has_temperature.then(|| reference.knot_celsius()),
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
