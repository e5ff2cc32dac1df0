//! Reads `[outliers]`: whether and how outliers are screened.

use crate::filter_plan::OutlierPlan;
use crate::section::{Allowed, Section};

/// Words for the training: whether it is gated.
const TRAININGS: [(&str, bool); 2] = [("gated", true), ("raw", false)];

/// Reads `[outliers]`; without the table nothing is screened.
pub(super) fn read_outliers(section: Option<Section<'_>>) -> Option<OutlierPlan> {
    let mut section = section?;
    let mut plan = OutlierPlan::default();
    if let Some(gated) = section.choice("training", &TRAININGS) {
        plan.gated = gated.into_inner();
    }
    let mut seconds = |key| section.number(key, Allowed::POSITIVE).map(toml::Spanned::into_inner);
    plan.training_s = seconds("training-s");
    plan.window_s = seconds("window-s");
    plan.fault_window_s = seconds("fault-window-s");
    plan.fault_share = section.number_or("fault-share", Allowed::INSIDE_UNIT, plan.fault_share);
    section.finish();
    Some(plan)
}
