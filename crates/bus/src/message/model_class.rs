//! The model classes at display rate.

use serde::{Deserialize, Serialize};

use super::{
    Format, MAX_CHANNELS, Malformed, Message, bounded, check_finite, check_label, check_range,
};
use crate::name::Name;

/// How plausible one class is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ClassPlausibility {
    /// The class: a name of the structure file, `baseline`, or the parameter that it singles out.
    pub class: String,
    /// Its probability among those that compete.
    pub plausibility: f64,
}

/// A calibration of the nominal model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ClassCalibration {
    /// Time of the frame, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// The class whose estimates became the nominal model.
    pub class: String,
    /// By which share the stiffness of what it singles out was changed: −0.049 for a loss of 4.9 %.
    pub change: f64,
}

/// How the model classes of a structure stand.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ModelClassDisplay {
    /// The structure.
    pub structure: Name,
    /// Time of the frame, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// The classes that compete.
    #[serde(deserialize_with = "bounded::list::<_, _, MAX_CHANNELS>")]
    pub classes: Vec<ClassPlausibility>,
    /// The most plausible one at this frame.
    pub leading: String,
    /// The last one that has led for long enough to be believed.
    pub believed: String,
    /// Calibrations of the nominal model so far.
    pub calibrations: u64,
    /// The latest of them.
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
