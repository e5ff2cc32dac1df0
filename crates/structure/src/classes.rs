//! The model classes of a structure: its stiffness parameters, singly or in groups.

use crate::linear_system::LinearSystem;
use crate::model::StructureModel;
use crate::parameter::{Parameter, Scales};
use crate::structure::Structure;
use nalgebra_sparse::CsrMatrix;
use spandrel_filter::{
    ClassBank, ClassId, ClassPlan, ClassSettings, ComponentSystem, FilterError, Grouping,
    PersistenceRule,
};
use std::f64::consts::PI;

/// The `[classes]` table of a structure file.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct ClassesPlan {
    /// Names of the classes or substructures that the file declares.
    pub(crate) names: Vec<String>,
    pub(crate) plan: ClassPlan,
    /// `P_l`; the default depends on the plan.
    pub(crate) floor: Option<f64>,
    /// `N_t Δt` (s); two fundamental periods where the file says nothing.
    pub(crate) persistence_s: Option<f64>,
    pub(crate) persistence_rule: PersistenceRule,
    pub(crate) reset_std: f64,
}

impl ClassesPlan {
    /// Default floor of predefined classes: what was hopeless for a year comes back within seconds, and nested classes
    /// hardly take turns.
    pub(crate) const PREDEFINED_FLOOR: f64 = 1e-12;
    /// Default deviation of a multiplier after a calibration: Huang & Yuen (2023), (5.55).
    pub(crate) const RESET_STD: f64 = 1.0 / 3.0;
    /// Default persistence, in fundamental periods: Huang & Yuen (2023), §5.4.
    const PERSISTENCE_PERIODS: f64 = 2.0;
    /// Longest persistence (steps): four times as many leads are remembered.
    pub(crate) const MOST_PERSISTENCE_STEPS: usize = 10_000_000;
}

/// Makes the models of the classes of a structure; its stiffness parameters are the components.
#[derive(Debug, Clone)]
pub struct StructureClasses {
    structure: Structure,
    components: Vec<usize>,
}

impl ComponentSystem for StructureClasses {
    type Model = StructureModel;

    fn components(&self) -> &[usize] {
        &self.components
    }

    fn parameter_len(&self) -> usize {
        self.structure.parameters.len()
    }

    fn grouped(&self, grouping: &Grouping, factors: &[f64]) -> StructureModel {
        let mut structure = self.structure.clone();
        for (component, factor) in self.components.iter().zip(factors) {
            structure
                .system
                .scale(&self.structure.parameters[*component].scales, *factor);
        }
        let parts = |component: &usize| match &self.structure.parameters
            [self.components[*component]]
            .scales
        {
            Scales::Stiffness(parts) => parts.clone(),
            _ => Vec::new(), // no component
        };
        let group = |members: &Vec<usize>| Parameter {
            scales: Scales::Stiffness(members.iter().flat_map(parts).collect()),
            ..self.structure.parameters[self.components[members[0]]].clone()
        };
        let others = self
            .structure
            .parameters
            .iter()
            .filter(|parameter| !parameter.is_stiffness())
            .cloned();
        structure.parameters = grouping.groups().iter().map(group).chain(others).collect();
        structure.model()
    }
}

impl LinearSystem {
    /// Multiplies the stiffness of the substructures that `scales` names.
    fn scale(&mut self, scales: &Scales, factor: f64) {
        let Scales::Stiffness(parts) = scales else {
            return;
        };
        for part in parts {
            let stiffness: &mut CsrMatrix<f64> = &mut self.substructures[*part].stiffness;
            *stiffness *= factor;
        }
    }
}

impl Structure {
    /// Tells whether several model classes are to be compared.
    #[must_use]
    pub fn has_classes(&self) -> bool {
        self.classes.is_some()
    }

    /// Makes the filters of the model classes; `None` where the file declares none.
    ///
    /// # Errors
    /// When the filters refuse their settings.
    pub fn class_bank(&self) -> Result<Option<ClassBank<StructureClasses>>, FilterError> {
        let Some(settings) = self.class_settings() else {
            return Ok(None);
        };
        ClassBank::new(self.class_system(), self.filter_settings()?, settings).map(Some)
    }

    /// Returns what makes the models of the classes, for a bank with settings of its own.
    #[must_use]
    pub fn class_system(&self) -> StructureClasses {
        let components = (0..self.parameters.len())
            .filter(|index| self.parameters[*index].is_stiffness())
            .collect();
        StructureClasses {
            structure: self.clone(),
            components,
        }
    }

    /// Returns which classes are compared, and how; `None` where the file declares none.
    #[must_use]
    pub fn class_settings(&self) -> Option<ClassSettings> {
        let plan = self.classes.as_ref()?;
        let persistence_s = plan
            .persistence_s
            .unwrap_or_else(|| ClassesPlan::PERSISTENCE_PERIODS * self.fundamental_period_s());
        let default_floor = match plan.plan {
            ClassPlan::Predefined { .. } => ClassesPlan::PREDEFINED_FLOOR,
            ClassPlan::SelfCalibrating { .. } | ClassPlan::Hierarchical { .. } => {
                ClassSettings::FLOOR
            }
        };
        Some(ClassSettings {
            plan: plan.plan.clone(),
            floor: plan.floor.unwrap_or(default_floor),
            persistence_steps: ((persistence_s * self.sampling_rate_hz).round() as usize)
                .clamp(1, ClassesPlan::MOST_PERSISTENCE_STEPS),
            persistence_rule: plan.persistence_rule,
            reset_std: plan.reset_std,
        })
    }

    /// Returns the name of a model class: that of the file, `baseline`, or that of the component it singles out.
    #[must_use]
    pub fn class_name(&self, class: ClassId) -> &str {
        let declared = |index: usize| self.classes.as_ref().and_then(|plan| plan.names.get(index));
        match class {
            ClassId::Baseline => "baseline",
            ClassId::Predefined(index)
            | ClassId::Calibrating(index)
            | ClassId::Substructure(index) => declared(index).map_or("unnamed", String::as_str),
            ClassId::Component { component, .. } => {
                let mut components = self
                    .parameters
                    .iter()
                    .filter(|parameter| parameter.is_stiffness());
                components.nth(component).map_or("unnamed", Parameter::name)
            }
        }
    }

    /// Returns the component, counted among the stiffness parameters, whose change tells of a calibration by a class: the
    /// first that it singles out; `None` for a class that singles out none.
    #[must_use]
    pub fn singled_out(&self, class: ClassId) -> Option<usize> {
        let plan = &self.classes.as_ref()?.plan;
        match (class, plan) {
            (ClassId::Component { component, .. }, _) => Some(component),
            (ClassId::Calibrating(index), ClassPlan::SelfCalibrating { classes }) => {
                classes.get(index)?.groups().first()?.first().copied()
            }
            (ClassId::Substructure(index), ClassPlan::Hierarchical { substructures }) => {
                substructures.groups().get(index)?.first().copied()
            }
            _ => None,
        }
    }

    /// Returns the fundamental period `T` as designed (s), 0 where there is none.
    pub(crate) fn fundamental_period_s(&self) -> f64 {
        let first = self
            .nominal_modes()
            .and_then(|modes| modes.angular_frequencies.first().copied());
        first.map_or(0.0, |omega| 2.0 * PI / omega)
    }
}

#[cfg(test)]
mod tests;
