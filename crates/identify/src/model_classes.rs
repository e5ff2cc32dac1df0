//! The display of model classes.

use spandrel_bus::{ClassCalibration, ClassPlausibility, EventKind, ModelClassDisplay, Name};
use spandrel_filter::{ClassBank, ClassEvent, ClassId};
use spandrel_structure::{Structure, StructureClasses};

/// The displayed state of the model classes.
#[derive(Debug)]
pub(crate) struct ClassView {
    structure: Structure,
    /// Persistence of a lead, in words.
    persistence: String,
    latest: Option<ClassCalibration>,
}

/// The words of an event.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Told {
    pub(crate) kind: EventKind,
    pub(crate) what: String,
    pub(crate) why: String,
}

impl ClassView {
    pub(crate) fn new(structure: &Structure, bank: &ClassBank<StructureClasses>) -> Self {
        let persistence_s = bank.settings().persistence_steps as f64 * structure.step_s();
        Self {
            structure: structure.clone(),
            persistence: format!("{persistence_s:.2} s"),
            latest: None,
        }
    }

    /// Returns the last calibration.
    pub(crate) fn calibration(&self) -> Option<&ClassCalibration> {
        self.latest.as_ref()
    }

    /// Restores the last calibration from a checkpoint.
    pub(crate) fn set_calibration(&mut self, calibration: Option<ClassCalibration>) {
        self.latest = calibration;
    }

    /// Processes the class events of one frame. Returns their words.
    pub(crate) fn take(&mut self, time_ns: i64, bank: &ClassBank<StructureClasses>) -> Vec<Told> {
        bank.events()
            .iter()
            .map(|event| self.tell(time_ns, event, bank))
            .collect()
    }

    fn tell(
        &mut self,
        time_ns: i64,
        event: &ClassEvent,
        bank: &ClassBank<StructureClasses>,
    ) -> Told {
        let name = |class: &ClassId| self.structure.class_name(*class).to_owned();
        match event {
            ClassEvent::Leading { from, to } => Told {
                kind: EventKind::LeadingClass,
                what: format!("class {} leads, previously {}", name(to), name(from)),
                why: format!(
                    "it has been the most plausible one for {}",
                    self.persistence
                ),
            },
            ClassEvent::Calibrated { by, factors } => {
                let change = self
                    .structure
                    .singled_out(*by)
                    .map_or(0.0, |component| factors[component] - 1.0);
                let class = name(by);
                self.latest = Some(ClassCalibration {
                    time_ns,
                    class: class.clone(),
                    change,
                });
                Told {
                    kind: EventKind::Calibration,
                    what: format!("class {class} recalibrated by {}", percent(change)),
                    why: format!(
                        "it has been the most plausible one for {}",
                        self.persistence
                    ),
                }
            }
            ClassEvent::LevelUp { substructure } => {
                let suspect = name(&ClassId::Substructure(*substructure));
                Told {
                    kind: EventKind::LeadingClass,
                    what: format!("now comparing the parts of {suspect}"),
                    why: format!("{suspect} has changed relative to the rest"),
                }
            }
            ClassEvent::LevelDown { .. } => Told {
                kind: EventKind::LeadingClass,
                what: "now comparing whole substructures again".to_owned(),
                why: "no part needs to be singled out any more".to_owned(),
            },
            ClassEvent::Restarted { class } => {
                let leader = bank
                    .classes()
                    .nth(bank.leader())
                    .map_or_else(String::new, |leader| name(&leader));
                Told {
                    kind: EventKind::Restart,
                    what: format!(
                        "the filter of class {} continues from class {leader}",
                        name(class)
                    ),
                    why: "it had diverged".to_owned(),
                }
            }
        }
    }

    /// Returns the display message of one time.
    pub(crate) fn display(
        &self,
        structure: &Name,
        time_ns: i64,
        bank: &ClassBank<StructureClasses>,
    ) -> ModelClassDisplay {
        let name = |class: ClassId| self.structure.class_name(class).to_owned();
        let classes: Vec<ClassPlausibility> = bank
            .classes()
            .zip(bank.plausibilities().iter())
            .map(|(class, plausibility)| ClassPlausibility {
                class: name(class),
                plausibility: plausibility.min(1.0),
            })
            .collect();
        ModelClassDisplay {
            structure: structure.clone(),
            time_ns,
            leading: classes[bank.leader()].class.clone(),
            classes,
            believed: name(bank.believed()),
            calibrations: bank.calibrations(),
            calibration: self.latest.clone(),
        }
    }
}

/// Formats a change of stiffness with its sign.
fn percent(change: f64) -> String {
    let sign = if change < 0.0 { '−' } else { '+' };
    format!("{sign}{:.1} %", 100.0 * change.abs())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn changes_are_written_with_their_sign() {
        assert_eq!(percent(-0.049), "−4.9 %");
        assert_eq!(percent(0.0012), "+0.1 %");
    }
}
