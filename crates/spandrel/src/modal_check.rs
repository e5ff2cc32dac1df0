//! Report of a check: the quantities that natural frequencies can and cannot identify.
//!
//! The structure has no model, or the natural frequencies update its model. The report is text for
//! people, or JSON.
//!
//! The JSON object has the following fields:
//!
//! - `structure`, `description`, `sampling_rate_hz`, `channels`, `nodes`: as in the file
//! - `epoch_s`, `start_up_s`: length of an epoch, and of the time before the first one
//! - `bands`: list of objects with `lowest_hz`, `highest_hz` and `highest_order`
//! - `modes`: the declared modes, with `name`, `frequency_hz`, `lowest_hz` and `highest_hz` of the
//!   range in which it is first looked for, `frequency_std_hz` (the smallest standard deviation of
//!   one epoch at a damping ratio of `damping`), `stiffness_std` (the share of the stiffness that
//!   corresponds to it), and whether it is `judged`
//! - `parameters`: the stiffnesses that the modes update, with `name`, `change_std` (standard
//!   deviation of the relative change that one epoch shows), and `smallest_loss` (the loss that one
//!   epoch shows with a probability of 0.99 in half of the cases; null if the modes do not show it)
//! - `can_tell`, `cannot_tell`, `warnings`: sentences

use crate::commands::counted;
use crate::error::AppError;
use crate::modes::stiffness::trading;
use serde::Serialize;
use spandrel_judge::QuantityKind;
use spandrel_modal::{ModalSettings, UpdatePrecision, UpdateReference, smallest_uncertainty};
use spandrel_structure::{ModalPlan, Structure, UpdatePlan};
use std::fmt;

/// Damping ratio for which uncertainties are stated: that of many bridges and tall buildings.
const DAMPING: f64 = 0.01;

/// Standard deviation of a value of a shape in one epoch, relative to its largest value.
const SHAPE_STD: f64 = 0.02;

/// The report of a checked structure whose natural frequencies are followed.
#[derive(Debug, Clone, Serialize)]
pub struct ModalCheckPage {
    structure: String,
    description: String,
    sampling_rate_hz: f64,
    channels: usize,
    nodes: usize,
    epoch_s: f64,
    start_up_s: f64,
    damping: f64,
    bands: Vec<Band>,
    modes: Vec<ModeLine>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    parameters: Vec<PartLine>,
    can_tell: Vec<String>,
    cannot_tell: Vec<String>,
    warnings: Vec<String>,
}

#[derive(Debug, Clone, Serialize)]
struct Band {
    lowest_hz: f64,
    highest_hz: f64,
    highest_order: usize,
}

#[derive(Debug, Clone, Serialize)]
struct ModeLine {
    name: String,
    frequency_hz: f64,
    lowest_hz: f64,
    highest_hz: f64,
    frequency_std_hz: f64,
    stiffness_std: f64,
    judged: bool,
}

#[derive(Debug, Clone, Serialize)]
struct PartLine {
    name: String,
    change_std: f64,
    smallest_loss: Option<f64>,
}

impl ModalCheckPage {
    /// Creates the page of a structure with a table `[modal]`.
    ///
    /// # Errors
    /// Returns an error if the settings of the table do not fit each other, which reading the file
    /// has excluded.
    pub fn new(structure: &Structure, plan: &ModalPlan) -> Result<Self, AppError> {
        let stream = plan.stream().map_err(spandrel_modes::ModesError::from)?;
        let settings: Vec<&ModalSettings> = stream.settings().collect();
        // The epochs of several bands are equally long.
        let epoch_s = settings
            .first()
            .map_or(plan.settings.epoch_s, |settings| settings.epoch_s);
        let start_up_s = settings.iter().map(|settings| settings.start_up_s());
        let bands = settings.iter().map(|settings| Band {
            lowest_hz: settings.lowest_hz.max(settings.lowest_mode_hz),
            highest_hz: settings.highest_hz,
            highest_order: settings.highest_order,
        });
        let judged = structure.judge().into_iter();
        let judged = judged.flat_map(|plan| &plan.settings.quantities);
        let judged: Vec<&str> = judged
            .filter(|quantity| quantity.kind == QuantityKind::Frequency)
            .map(|quantity| quantity.name.as_str())
            .collect();
        let modes = plan.modes.iter().map(|mode| {
            let std_hz = smallest_uncertainty(mode.frequency_hz, DAMPING, epoch_s).frequency_hz;
            ModeLine {
                name: mode.name.clone(),
                frequency_hz: mode.frequency_hz,
                lowest_hz: mode.frequency_hz * (1.0 - mode.within),
                highest_hz: mode.frequency_hz * (1.0 + mode.within),
                frequency_std_hz: std_hz,
                stiffness_std: 2.0 * std_hz / mode.frequency_hz, // f ∝ √k
                judged: judged.contains(&mode.name.as_str()),
            }
        });
        let modes: Vec<ModeLine> = modes.collect();
        let channels = plan.channels.len();
        Self {
            structure: structure.name().to_owned(),
            description: structure.description().to_owned(),
            sampling_rate_hz: structure.sampling_rate_hz(),
            channels,
            nodes: structure.nodes().len(),
            epoch_s,
            start_up_s: start_up_s.fold(0.0, f64::max),
            damping: DAMPING,
            bands: bands.collect(),
            can_tell: can_tell(structure, channels, &modes),
            cannot_tell: cannot_tell(structure, plan.update.as_ref()),
            warnings: warnings(&modes),
            modes,
            parameters: Vec::new(),
        }
        .with_parts(structure, plan)
    }

    /// Adds the parts that the modes show, if they update stiffnesses.
    fn with_parts(mut self, structure: &Structure, plan: &ModalPlan) -> Result<Self, AppError> {
        let (Some(update), Some(model)) = (&plan.update, structure.part_model()) else {
            return Ok(self);
        };
        let model = model.map_err(spandrel_modes::ModesError::from)?;
        // The law of Au with the damping of the model.
        let modes = plan.modes.iter().map(|mode| {
            let damping = structure.damping_ratio_near(mode.frequency_hz);
            let damping = damping.unwrap_or(DAMPING);
            let law = smallest_uncertainty(mode.frequency_hz, damping, self.epoch_s);
            (mode.frequency_hz, law.frequency_hz)
        });
        let modes: Vec<(f64, f64)> = modes.collect();
        let has_shapes = model.channels() > 0;
        let shape_std = has_shapes.then_some(SHAPE_STD);
        let expected = UpdateReference::expected(&model, &update.settings, &modes, shape_std);
        let expected = match expected {
            Ok(expected) => expected,
            Err(error) => {
                self.warnings
                    .push(format!("stiffnesses are not updated: {error}"));
                return Ok(self);
            }
        };
        let precision = expected
            .precision(&model)
            .map_err(spandrel_modes::ModesError::from)?;
        let names = update.parts.iter().enumerate();
        self.parameters = names
            .map(|(part, name)| PartLine {
                name: name.clone(),
                change_std: precision.std(part),
                smallest_loss: precision.smallest_loss(part),
            })
            .collect();
        if !has_shapes {
            self.warnings.push(
                "the channels measure different derivatives of the motion, so that only \
                 frequencies update the stiffnesses"
                    .to_owned(),
            );
        }
        for (mode, of_model) in plan.modes.iter().zip(expected.of_model()) {
            if of_model.is_none() {
                self.warnings.push(format!(
                    "{} resembles no mode of the model and does not update it",
                    mode.name
                ));
            }
        }
        let names: Vec<&str> = update.parts.iter().map(String::as_str).collect();
        self.cannot_tell.extend(unseen(&self.parameters));
        self.warnings.extend(trading(&precision, &names));
        Ok(self)
    }

    /// Returns the report as one line with a JSON object.
    pub fn json(&self) -> String {
        // Cannot fail, because the object contains only names and numbers.
        serde_json::to_string(self).map_or_else(|error| error.to_string(), |line| line + "\n")
    }
}

/// Names the parts that the modes do not show.
fn unseen(parts: &[PartLine]) -> Option<String> {
    let unseen = parts.iter().filter(|part| part.smallest_loss.is_none());
    let unseen: Vec<&str> = unseen.map(|part| part.name.as_str()).collect();
    (!unseen.is_empty()).then(|| {
        format!(
            "changes of {}, which hardly affect the declared modes",
            unseen.join(", ")
        )
    })
}

fn cannot_tell(structure: &Structure, update: Option<&UpdatePlan>) -> Vec<String> {
    let of_parts = match update {
        None => [
            "which part of the structure has changed",
            "stiffnesses, displacements, strains and forces",
        ]
        .as_slice(),
        Some(_) => [
            "displacements, strains and forces",
            "whether all parts have changed alike, or the temperature",
        ]
        .as_slice(),
    };
    let mut all: Vec<String> = of_parts.iter().map(|text| (*text).to_owned()).collect();
    all.push("changes that last for less than an epoch".to_owned());
    all.extend(without_decisions(structure));
    all
}

/// Returns the alert rules, which decide nothing, because they need the estimates of each frame.
fn without_decisions(structure: &Structure) -> Option<String> {
    let rules = structure.alert_rules();
    let parameters = structure.parameters();
    let watched = rules.iter().flat_map(|rule| &rule.parameters);
    let mut watched: Vec<&str> = watched
        .filter_map(|index| Some(parameters.get(*index)?.name()))
        .collect();
    watched.sort_unstable();
    watched.dedup();
    (!rules.is_empty()).then(|| {
        format!(
            "alerts: {} [[alert]] on {} {} nothing live, because no filter runs; [judge] judges \
             lasting changes",
            counted(rules.len(), "rule", "rules"),
            watched.join(", "),
            if rules.len() == 1 {
                "decides"
            } else {
                "decide"
            },
        )
    })
}

fn can_tell(structure: &Structure, channels: usize, modes: &[ModeLine]) -> Vec<String> {
    let mut all = vec![format!(
        "natural frequencies, damping ratios and shapes at {channels} channels after each epoch"
    )];
    let judged: Vec<&str> = modes
        .iter()
        .filter(|mode| mode.judged)
        .map(|mode| mode.name.as_str())
        .collect();
    if let Some(update) = structure.modal().and_then(|plan| plan.update.as_ref()) {
        all.push(format!(
            "the change of {} after each epoch, after a commissioning of {} epochs",
            counted(update.parts.len(), "stiffness", "stiffnesses"),
            update.settings.commissioning_epochs,
        ));
    }
    if let (Some(plan), false) = (structure.judge(), judged.is_empty()) {
        let days = plan.settings.commissioning_days;
        all.push(format!(
            "lasting changes of {}, after a commissioning of {days} days",
            judged.join(", ")
        ));
    }
    all
}

fn warnings(modes: &[ModeLine]) -> Vec<String> {
    let mut all = Vec::new();
    if modes.is_empty() {
        all.push(
            "no mode is declared, so that none is published; spandrel modes RECORD --declare \
             prints the tables [[modal.mode]] for a recording"
                .to_owned(),
        );
    }
    for (position, mode) in modes.iter().enumerate() {
        let overlaps = |other: &&ModeLine| {
            mode.lowest_hz < other.highest_hz && other.lowest_hz < mode.highest_hz
        };
        for other in modes[position + 1..].iter().filter(overlaps) {
            all.push(format!(
                "the initial search ranges of {} and {} overlap; a smaller `within` separates them",
                mode.name, other.name
            ));
        }
    }
    if !modes.is_empty() && !modes.iter().any(|mode| mode.judged) {
        all.push(
            "[judge] judges no natural frequency, so that no lasting change is reported".to_owned(),
        );
    }
    all
}

impl fmt::Display for ModalCheckPage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let separator = if self.description.is_empty() {
            ""
        } else {
            ": "
        };
        writeln!(f, "{}{separator}{}", self.structure, self.description)?;
        let kind = match self.parameters.is_empty() {
            true => "no model: natural frequencies only",
            false => "natural frequencies update the model",
        };
        writeln!(
            f,
            "{kind}; {} on {}, {} Hz",
            counted(self.channels, "channel", "channels"),
            counted(self.nodes, "node", "nodes"),
            self.sampling_rate_hz
        )?;
        writeln!(
            f,
            "\nepochs of {:.1} s, the first after {:.1} s\n",
            self.epoch_s,
            self.epoch_s + self.start_up_s
        )?;
        writeln!(f, "  band (Hz)           highest order")?;
        for band in &self.bands {
            let range = format!("{:.3} to {:.3}", band.lowest_hz, band.highest_hz);
            writeln!(f, "  {range:18}  {:>13}", band.highest_order)?;
        }
        if !self.modes.is_empty() {
            self.write_modes(f)?;
        }
        if !self.parameters.is_empty() {
            self.write_parts(f)?;
        }
        writeln!(f)?;
        for text in &self.can_tell {
            writeln!(f, "identifies: {text}")?;
        }
        for text in &self.cannot_tell {
            writeln!(f, "does not identify: {text}")?;
        }
        if !self.warnings.is_empty() {
            writeln!(f)?;
        }
        for text in &self.warnings {
            writeln!(f, "warning: {text}")?;
        }
        Ok(())
    }
}

impl ModalCheckPage {
    fn write_parts(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let names = self.parameters.iter().map(|part| part.name.len());
        let width = names.max().unwrap_or(0).max("parameter".len());
        writeln!(f, "\n  {:width$}  ± change (%)  least seen", "parameter")?;
        for part in &self.parameters {
            let least = match part.smallest_loss {
                Some(loss) => format!("{:.0} %", 100.0 * loss),
                None => "none".to_owned(),
            };
            let (name, std) = (&part.name, 100.0 * part.change_std);
            writeln!(f, "  {name:width$}  {std:>12.1}  {least:>10}")?;
        }
        writeln!(
            f,
            "\n  least seen: loss that one epoch shows with a probability of {} in half of the \
             cases",
            UpdatePrecision::found_at(),
        )
    }

    fn write_modes(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let names = self.modes.iter().map(|mode| mode.name.len());
        let width = names.max().unwrap_or(0).max("declared mode".len());
        writeln!(
            f,
            "\n  {:width$}  frequency (Hz)    searched (Hz)   ± (Hz)  ± stiffness (%)",
            "declared mode"
        )?;
        for mode in &self.modes {
            let range = format!("{:.3} to {:.3}", mode.lowest_hz, mode.highest_hz);
            writeln!(
                f,
                "  {:width$}  {:>14.4}  {range:>15}  {:>7.4}  {:>15.2}",
                mode.name,
                mode.frequency_hz,
                mode.frequency_std_hz,
                100.0 * mode.stiffness_std
            )?;
        }
        writeln!(
            f,
            "\n  ±: smallest standard deviation of one epoch at a damping ratio of {} %",
            100.0 * self.damping
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    const SENSORS_ONLY: &str = include_str!("../../../docs/examples/modes/sensors-only.toml");

    fn page(text: &str) -> ModalCheckPage {
        let structure = Structure::parse(text, Path::new("sensors-only.toml")).unwrap();
        ModalCheckPage::new(&structure, structure.modal().unwrap()).unwrap()
    }

    /// Au (2014): √(0.01/(2π · 300)) = 0.2303 % of 1 Hz in 300 s, twice that of the stiffness.
    #[test]
    fn resolution_is_that_of_the_uncertainty_law() {
        let page = page(SENSORS_ONLY);
        let first = &page.modes[0];
        assert!(
            (first.frequency_std_hz - 0.002_303).abs() < 1e-6,
            "{first:?}"
        );
        assert!((first.stiffness_std - 0.004_607).abs() < 1e-6, "{first:?}");
        let text = page.to_string();
        assert!(text.contains("epochs of 300.0 s"), "{text}");
        assert!(
            text.contains("lasting changes of sway-1, sway-2, after"),
            "{text}"
        );
        assert!(text.contains("does not identify: which part"), "{text}");
        assert!(page.warnings.is_empty(), "{text}");
    }

    #[test]
    fn missing_modes_and_overlapping_ranges_are_warned_of() {
        let (before, _) = SENSORS_ONLY.split_once("[modal]").unwrap();
        let bare = page(before);
        assert_eq!(bare.warnings.len(), 1, "{bare}");
        assert!(bare.bands.len() > 1, "{bare}");
        let near = page(&SENSORS_ONLY.replacen("frequency-hz = 2.92", "frequency-hz = 1.1", 1));
        assert_eq!(near.warnings.len(), 1, "{near}");
        let ranges = "the initial search ranges of sway-1 and sway-2 overlap";
        assert!(near.warnings[0].starts_with(ranges), "{near}");
        let (unjudged, _) = SENSORS_ONLY.split_once("[judge]").unwrap();
        let unjudged = page(unjudged);
        assert!(
            unjudged.warnings[0].starts_with("[judge] judges no"),
            "{unjudged}"
        );
        assert!(!unjudged.json().contains("null"));
    }

    #[test]
    fn rules_that_no_filter_serves_are_named() {
        let updated = include_str!("../../../docs/examples/modes/stiffness.toml");
        let text = page(updated).to_string();
        let told = "does not identify: alerts: 1 rule [[alert]] on storey-1, storey-2, storey-3, \
                    storey-4, storey-5 decides nothing live, because no filter runs";
        assert!(text.contains(told), "{text}");
        assert!(!page(SENSORS_ONLY).to_string().contains("alerts:"));
    }
}
