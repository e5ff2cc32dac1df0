//! Reads the conditions of a source.

use spandrel_structure::Condition;

use super::Reading;
use crate::calibration::Calibration;
use crate::section::Section;
use crate::source_plan::ConditionPlan;

impl Reading<'_> {
    /// Reads a condition of a source.
    pub(super) fn condition(&mut self, mut section: Section<'_>) -> Option<ConditionPlan> {
        let mistakes = &mut self.mistakes;
        let allowed = "must be the name of the channel in the source";
        let label = section.required_text("source", allowed, mistakes);
        let structure = section.text("structure", mistakes);
        let allowed = "must be the name of a condition in the structure file";
        let name = section.required_text("condition", allowed, mistakes);
        let is_factor = |number: f64| number != 0.0;
        let allowed = "must be a finite number except 0: numbers per unit of the condition";
        let sensitivity = section.number("sensitivity", is_factor, allowed, mistakes);
        let offset = section.number("offset", |_| true, "must be a finite number", mistakes);
        let structure = self.structure_index(&section, structure);
        let found = structure
            .zip(name)
            .and_then(|(structure, name)| self.declared(&section, structure, name));
        section.finish(&mut self.mistakes);
        let (structure, condition) = (structure?, found?);
        Some(ConditionPlan {
            label: label?,
            structure,
            name: condition.name().to_owned(),
            unit: condition.unit(),
            range: condition.range(),
            interval_s: condition.interval_s(),
            calibration: Calibration::new(sensitivity.unwrap_or(1.0), offset.unwrap_or(0.0), 1.0),
        })
    }

    /// Finds a condition in a structure. It may have only one source.
    fn declared(
        &mut self,
        section: &Section<'_>,
        structure: usize,
        name: String,
    ) -> Option<Condition> {
        let of = self.structures.get(structure)?;
        let found = of.conditions().iter().find(|known| known.name() == name);
        let Some(condition) = found.cloned() else {
            let names: Vec<&str> = of.conditions().iter().map(Condition::name).collect();
            let allowed = match names.is_empty() {
                true => format!("must be a [[condition]] of {}, which has none", of.name()),
                false => format!("must be one of {} ({})", names.join(", "), of.name()),
            };
            let found = format!("is \"{name}\"");
            section.report("condition", found, allowed, &mut self.mistakes);
            return None;
        };
        let key = (structure, name.clone());
        if let Some(first) = self.fed_conditions.get(&key) {
            let allowed = format!("must be a condition that {first} does not feed");
            let found = format!("is \"{name}\" again");
            section.report("condition", found, allowed, &mut self.mistakes);
            return None;
        }
        self.fed_conditions.insert(key, section.key("condition"));
        Some(condition)
    }
}
