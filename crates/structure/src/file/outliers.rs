//! Reads `[outliers]`, the settings of outlier screening.

use super::read_time;
use crate::filter_plan::OutlierPlan;
use crate::section::{Allowed, Section};

/// Values of `training`: `true` if the training is gated.
const TRAININGS: [(&str, bool); 2] = [("gated", true), ("raw", false)];

/// Reads `[outliers]`; without the table nothing is screened.
///
/// `rate_hz` is the sampling rate of the structure.
pub(super) fn read_outliers(
    section: Option<Section<'_>>,
    rate_hz: Option<f64>,
) -> Option<OutlierPlan> {
    let mut section = section?;
    let mut plan = OutlierPlan::default();
    if let Some(gated) = section.choice("training", &TRAININGS) {
        plan.gated = gated.into_inner();
    }
    plan.training_s = read_time(&mut section, "training-s", rate_hz, OutlierPlan::RESIDUALS);
    plan.window_s = read_time(&mut section, "window-s", rate_hz, OutlierPlan::WINDOW);
    plan.fault_window_s = read_time(
        &mut section,
        "fault-window-s",
        rate_hz,
        OutlierPlan::RESIDUALS,
    );
    plan.fault_share = section.number_or("fault-share", Allowed::INSIDE_UNIT, plan.fault_share);
    section.finish();
    Some(plan)
}

#[cfg(test)]
mod tests;
