//! The model classes of a recording: their final state and their changes.

use serde::Serialize;
use spandrel_bus::{ClassCalibration, ClassPlausibility, ModelClassDisplay};

/// State of the model classes.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ClassSummary {
    /// Most plausible class at the end.
    pub leading: String,
    /// Competing classes at the end, in file order.
    pub classes: Vec<ClassPlausibility>,
    /// Classes that led long enough to be believed, in order. The first class leads from the start.
    pub leads: Vec<Lead>,
    /// Calibrations of the nominal model, in order.
    pub calibrations: Vec<Calibration>,
}

/// A class that became the believed class.
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
    /// Class whose estimates became the nominal model.
    pub class: String,
    /// Relative change of the stiffness of the component that the class singles out: −0.049 for a
    /// loss of 4.9 %.
    pub change: f64,
}

/// Collects messages about the model classes.
#[derive(Debug, Clone, Default)]
pub(super) struct ClassCollector {
    last: Option<ModelClassDisplay>,
    leads: Vec<(i64, String)>,
    calibrations: Vec<ClassCalibration>,
}

impl ClassCollector {
    /// Processes the message of one frame. Every calibration and every change of the lead appears
    /// at its frame.
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

    /// Returns the summary of a record that starts at `t0_ns`, or `None` if there were no messages.
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
