//! The tables of a structure file that declare the modes of a recording.

use super::analysis::{Analysis, Choice};
use spandrel_modal::{ModeSummary, Source};
use spandrel_structure::ModalPlan;
use std::fmt::Write as _;

/// Returns `[modal]` with what the user has chosen, and one `[[modal.mode]]` per mode.
///
/// With `plan`, the recording was followed by a table `[modal]`. Only the modes that it lacks are
/// then declared.
pub fn tables(
    choice: &Choice,
    without: &[String],
    plan: Option<&ModalPlan>,
    analysis: &Analysis,
) -> String {
    let mut text = String::new();
    if plan.is_none() {
        text += "[modal]\n";
        // Writing to a string cannot fail.
        if let Some(epoch_s) = choice.epoch_s {
            let _ = writeln!(text, "epoch-s = {:.0}", epoch_s.ceil());
        }
        if let Some((low, high)) = choice.band_hz {
            let _ = writeln!(text, "band-hz = [{low}, {high}]");
        }
        if let Some(order) = choice.highest_order {
            let _ = writeln!(text, "highest-order = {order}");
        }
        for (key, names) in [("references", &choice.references[..]), ("without", without)] {
            if !names.is_empty() {
                let _ = writeln!(text, "{key} = {names:?}");
            }
        }
    }
    let declared = plan.map_or(&[][..], |plan| &plan.modes);
    let is_new = |mode: &&ModeSummary| {
        mode.source == Source::Mode
            && !declared.iter().any(|known| {
                let difference = (mode.frequency_hz - known.frequency_hz).abs();
                difference <= known.within * known.frequency_hz
            })
    };
    let names = (1..).map(|number| format!("mode-{number}"));
    let mut free = names.filter(|name| !declared.iter().any(|known| known.name == *name));
    for mode in analysis.modes.iter().filter(is_new) {
        let name = free.next().unwrap_or_default();
        let separator = if text.is_empty() { "" } else { "\n" };
        let _ = writeln!(
            text,
            "{separator}[[modal.mode]]\nname = \"{name}\"\nfrequency-hz = {:.4}",
            mode.frequency_hz
        );
    }
    text
}
