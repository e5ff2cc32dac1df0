//! The model classes of a recording: how they stand at the end, and what they went through.

use serde::Serialize;
use spandrel_bus::{ClassCalibration, ClassPlausibility, ModelClassDisplay};

/// How the model classes stand.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ClassSummary {
    /// The most plausible class at the end.
    pub leading: String,
    /// The classes that compete at the end, in the order of the file.
    pub classes: Vec<ClassPlausibility>,
    /// The classes that led for long enough to be believed, in order; the first does from the start.
    pub leads: Vec<Lead>,
    /// Calibrations of the nominal model, in order.
    pub calibrations: Vec<Calibration>,
}

/// A class that came to be believed.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Lead {
    /// Measurement time since the first frame (s).
    pub time_s: f64,
    pub class: String,
}

/// A calibration of the nominal model.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Calibration {
    /// Measurement time since the first frame (s).
    pub time_s: f64,
    /// The class whose estimates became the nominal model.
    pub class: String,
    /// By which share the stiffness of what it singles out was changed.
    pub change: f64,
}

/// Collects what is said of the model classes.
#[derive(Debug, Clone, Default)]
pub(super) struct ClassCollector {
    last: Option<ModelClassDisplay>,
    leads: Vec<(i64, String)>,
    calibrations: Vec<ClassCalibration>,
}

impl ClassCollector {
    /// Takes what is said at one frame; every calibration and every lead is said at its frame.
    pub(super) fn take(&mut self, display: &ModelClassDisplay) {
        if self
            .leads
            .last()
            .is_none_or(|(_, class)| *class != display.believed)
        {
            self.leads.push((display.time_ns, display.believed.clone()));
        }
        if let Some(calibration) = &display.calibration
            && self.calibrations.last() != Some(calibration)
        {
            self.calibrations.push(calibration.clone());
        }
        self.last = Some(display.clone());
    }

    /// Returns the summary of a record that begins at `t0_ns`; `None` where nothing was said.
    pub(super) fn finish(self, t0_ns: i64) -> Option<ClassSummary> {
        let time_s = |time_ns: i64| time_ns.saturating_sub(t0_ns) as f64 / 1e9;
        let calibrations = self.calibrations.into_iter().map(
            |ClassCalibration {
                 time_ns,
                 class,
                 change,
             }| Calibration {
                time_s: time_s(time_ns),
                class,
                change,
            },
        );
        self.last.map(|last| ClassSummary {
            leading: last.leading,
            classes: last.classes,
            leads: self
                .leads
                .into_iter()
                .map(|(time_ns, class)| Lead {
                    time_s: time_s(time_ns),
                    class,
                })
                .collect(),
            calibrations: calibrations.collect(),
        })
    }
}
