//! Model classes at display rate.

use serde::{Deserialize, Serialize};

use super::{
    Format, MAX_CHANNELS, Malformed, Message, bounded, check_finite, check_label, check_range,
};
use crate::name::Name;

/// Plausibility of one model class.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ClassPlausibility {
    /// Name of the class: from the structure file, `baseline`, or the parameter that the class
    /// singles out.
    pub class: String,
    /// Probability of the class among the competing classes, 0 to 1.
    pub plausibility: f64,
}

/// Calibration of the nominal model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ClassCalibration {
    /// Time of the frame, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// Class whose estimates became the nominal model.
    pub class: String,
    /// Relative change of the stiffness that the class singles out: −0.049 for a loss of 4.9 %.
    pub change: f64,
}

/// State of the model classes of a structure.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ModelClassDisplay {
    /// Name of the structure.
    pub structure: Name,
    /// Time of the frame, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// The competing classes.
    #[serde(deserialize_with = "bounded::list::<_, _, MAX_CHANNELS>")]
    pub classes: Vec<ClassPlausibility>,
    /// Most plausible class at this frame.
    pub leading: String,
    /// Latest class that has led for long enough to be accepted.
    pub believed: String,
    /// Number of calibrations of the nominal model.
    pub calibrations: u64,
    /// Latest calibration.
    pub calibration: Option<ClassCalibration>,
}

impl Message for ModelClassDisplay {
    const TYPE: &'static str = "model-class";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        for class in &self.classes {
            check_label("class", &class.class)?;
            check_range("plausibility", class.plausibility, 0.0, 1.0)?;
        }
        check_label("leading class", &self.leading)?;
        check_label("believed class", &self.believed)?;
        if let Some(calibration) = &self.calibration {
            check_label("calibrated class", &calibration.class)?;
            check_finite("change", calibration.change)?;
        }
        Ok(())
    }
}
