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
    /// `N_t Δt` (s); `None` stands for two fundamental periods.
    pub(crate) persistence_s: Option<f64>,
    pub(crate) persistence_rule: PersistenceRule,
    pub(crate) reset_std: f64,
}

impl ClassesPlan {
    /// Default floor of predefined classes.
    ///
    /// A class that was hopeless for a year recovers within seconds, and nested classes rarely
    /// alternate.
    pub(crate) const PREDEFINED_FLOOR: f64 = 1e-12;
    /// Default standard deviation of a multiplier after a calibration: Huang & Yuen (2023), (5.55).
    pub(crate) const RESET_STD: f64 = 1.0 / 3.0;
    /// Default persistence, in fundamental periods: Huang & Yuen (2023), §5.4.
    const PERSISTENCE_PERIODS: f64 = 2.0;
    /// Maximum persistence (steps). The bank stores four times as many leading classes.
    pub(crate) const MOST_PERSISTENCE_STEPS: usize = 10_000_000;
}

/// Builds the models of the classes of a structure. Its stiffness parameters are the components.
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
            _ => Vec::new(), // not a component
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
    /// Multiplies the stiffness of the substructures in `scales` by `factor`.
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
    /// Returns `true` if the structure file declares model classes.
    #[must_use]
    pub fn has_classes(&self) -> bool {
        self.classes.is_some()
    }

    /// Creates the filters of the model classes; `None` if the file declares none.
    ///
    /// # Errors
    /// Returns an error if the filters reject their settings.
    pub fn class_bank(&self) -> Result<Option<ClassBank<StructureClasses>>, FilterError> {
        let Some(settings) = self.class_settings() else {
            return Ok(None);
        };
        ClassBank::new(self.class_system(), self.filter_settings()?, settings).map(Some)
    }

    /// Returns the builder of the class models, for a bank with its own settings.
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

    /// Returns the compared classes and the settings of the comparison; `None` if the file declares
    /// none.
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

    /// Returns the name of a model class.
    ///
    /// This is the name in the file, `baseline`, or the name of the component that the class
    /// singles out.
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

    /// Returns the component whose change a calibration by this class indicates.
    ///
    /// The component is counted among the stiffness parameters. It is the first that the class
    /// singles out; `None` for a class that singles out none.
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

    /// Returns the fundamental period `T` as designed (s), or 0 if there is none.
    pub fn fundamental_period_s(&self) -> f64 {
        let first = self.modes.angular_frequencies.first();
        first.map_or(0.0, |omega| 2.0 * PI / omega)
    }
}

#[cfg(test)]
mod tests;
