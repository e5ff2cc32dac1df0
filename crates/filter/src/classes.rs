//! Several models of one system, compared while they run: real-time model class selection.
//!
//! Source: Huang & Yuen (2023), chapter 5. A model class says which components of a structure share a stiffness multiplier.
//! Every class has an extended Kalman filter; the density that each predicts for the coming datum moves its plausibility,
//! and the simplest class that explains the data wins, because a prior spread over more parameters predicts less sharply.
//!
//! - [`Grouping`]: a class, that is, a partition of the components
//! - [`ClassPlan`]: which classes there are, and whether the nominal model is calibrated by the winner
//! - [`ClassBank`]: the filters with their plausibilities, and what they say together
//! - [`ComponentSystem`]: how a model is made for a class
//!
//! The components are parameters of the system one by one; a class reports each of them, whatever it groups. The noise levels
//! and the screening of outliers are those of the most plausible class: all classes see the same data with the same noise,
//! so that their evidences can be compared.

mod bank;
mod grouping;
mod persistence;
mod plausibility;

pub use bank::{ClassBank, ClassBankState};
pub use grouping::Grouping;
pub use persistence::PersistenceRule;
pub use plausibility::Plausibilities;

use crate::error::FilterError;
use crate::model::{ObservationModel, ProcessModel};
use serde::{Deserialize, Serialize};

/// A system whose components can be scaled singly or in groups.
///
/// Its full model has all components as parameters, among others such as damping, in the order that
/// [`FilterSettings`](crate::FilterSettings) has them; the model of a class has one multiplier per group first, and then the
/// other parameters in their order.
pub trait ComponentSystem {
    /// The model of one class.
    type Model: ProcessModel + ObservationModel + Send;

    /// Returns the place of each component among the parameters of the full model (N_k, increasing).
    fn components(&self) -> &[usize];

    /// Returns the number of parameters of the full model, components and others.
    fn parameter_len(&self) -> usize;

    /// Makes the model of a class, with each component's nominal value scaled by its entry of `factors` (N_k).
    fn grouped(&self, grouping: &Grouping, factors: &[f64]) -> Self::Model;
}

/// Which classes there are, and what their winner does.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum ClassPlan {
    /// Classes that stay as they are, §5.3: the most plausible one reports.
    Predefined {
        /// The classes.
        classes: Vec<Grouping>,
    },
    /// Class 0 has one multiplier for everything; whenever another one wins, its estimates become the nominal model of all
    /// of them, §5.4.
    SelfCalibrating {
        /// The classes from 1 on.
        classes: Vec<Grouping>,
    },
    /// As before, from coarse to fine, §5.5: first which substructure has changed, then which component of it.
    Hierarchical {
        /// The substructures, as groups of components.
        substructures: Grouping,
    },
}

impl ClassPlan {
    /// Returns the classes of a level.
    fn classes(&self, level: Level, components: usize) -> Result<Vec<Grouping>, FilterError> {
        let with_baseline = |classes: Vec<Grouping>| {
            let mut all = vec![Grouping::together(components)];
            all.extend(classes);
            all
        };
        let apart = |members: &[Vec<usize>]| -> Result<Vec<Grouping>, FilterError> {
            members
                .iter()
                .map(|members| Grouping::apart(members.clone(), components))
                .collect()
        };
        Ok(match (self, level) {
            (Self::Predefined { classes }, _) => classes.clone(),
            (Self::SelfCalibrating { classes }, _) => with_baseline(classes.clone()),
            (Self::Hierarchical { substructures }, Level::First) => {
                with_baseline(apart(substructures.groups())?)
            }
            (Self::Hierarchical { substructures }, Level::Second { substructure }) => {
                let single: Vec<Vec<usize>> = substructures.groups()[substructure]
                    .iter()
                    .map(|component| vec![*component])
                    .collect();
                with_baseline(apart(&single)?)
            }
        })
    }

    /// Checks that there are classes, that each groups all components, and that no two of one level are the same.
    ///
    /// # Errors
    /// With the first thing that is wrong.
    pub fn check(&self, components: usize) -> Result<(), FilterError> {
        let groupings: Vec<&Grouping> = match self {
            Self::Predefined { classes } | Self::SelfCalibrating { classes } => {
                classes.iter().collect()
            }
            Self::Hierarchical { substructures } => vec![substructures],
        };
        if groupings.is_empty() {
            let (what, allowed) = ("number of model classes", "at least 1");
            return Err(FilterError::Setting {
                what,
                found: 0.0,
                allowed,
            });
        }
        for grouping in groupings {
            if grouping.components() != components {
                let (what, found) = ("grouping of a model class", grouping.components());
                return Err(FilterError::Dimension {
                    what,
                    found,
                    expected: components,
                });
            }
        }
        let levels = match self {
            Self::Predefined { .. } | Self::SelfCalibrating { .. } => vec![Level::First],
            Self::Hierarchical { substructures } => {
                let second = (0..substructures.groups().len())
                    .map(|substructure| Level::Second { substructure });
                [Level::First].into_iter().chain(second).collect()
            }
        };
        for level in levels {
            let classes = self.classes(level, components)?;
            for (class, grouping) in classes.iter().enumerate() {
                // what cannot be told apart would take turns for ever
                if classes[..class]
                    .iter()
                    .any(|earlier| earlier.is_same_partition(grouping))
                {
                    let (what, allowed) = (
                        "model class",
                        "another partition than the classes before it, 0 the baseline",
                    );
                    return Err(FilterError::Setting {
                        what,
                        found: class as f64,
                        allowed,
                    });
                }
            }
        }
        Ok(())
    }
}

/// Whether substructures or components compete.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum Level {
    /// The classes of the plan; substructures in a hierarchy.
    First,
    /// The components of one substructure.
    Second {
        /// The substructure (from 0).
        substructure: usize,
    },
}

/// Names a class.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum ClassId {
    /// Class of the plan, as it counts them (from 0).
    Predefined(usize),
    /// One multiplier for everything.
    Baseline,
    /// Class of a self-calibrating plan (from 0).
    Calibrating(usize),
    /// One substructure against the rest (from 0).
    Substructure(usize),
    /// One component against the rest, and the substructure it belongs to.
    Component {
        /// The component (from 0).
        component: usize,
        /// Its substructure (from 0).
        substructure: usize,
    },
}

/// What happened to the classes at a step.
#[derive(Debug, Clone, PartialEq)]
pub enum ClassEvent {
    /// Another class has been the most plausible one for long enough to be believed.
    Leading {
        /// The class that led before.
        from: ClassId,
        /// The class that leads.
        to: ClassId,
    },
    /// The estimates of a class became the nominal model.
    Calibrated {
        /// The class.
        by: ClassId,
        /// What each component was multiplied by (N_k).
        factors: Vec<f64>,
    },
    /// The components of a substructure compete from now on.
    LevelUp {
        /// The substructure (from 0).
        substructure: usize,
    },
    /// The substructures compete again.
    LevelDown {
        /// What each component was multiplied by (N_k).
        factors: Vec<f64>,
    },
    /// The filter of a class was lost and continues from the most plausible class.
    Restarted {
        /// The class.
        class: ClassId,
    },
}

/// How classes are compared.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ClassSettings {
    /// The classes.
    pub plan: ClassPlan,
    /// `P_l`: no plausibility is below this; 0 for none. Below one over the number of classes.
    pub floor: f64,
    /// `N_t` (steps): how long a class must lead before it is acted on, and how long nothing is acted on at the start.
    pub persistence_steps: usize,
    /// What counts as a lasting lead.
    pub persistence_rule: PersistenceRule,
    /// Standard deviation of a multiplier after a calibration; the source has 1/3.
    pub reset_std: f64,
}

impl ClassSettings {
    /// Floor for plans that calibrate: a small one lets healthy components be calibrated in error.
    pub const FLOOR: f64 = 1e-4;

    /// Makes the settings of the source, with its rule of persistence.
    ///
    /// No floor for predefined classes, and `P_l = 10⁻⁴` for the others.
    #[must_use]
    pub fn published(plan: ClassPlan, persistence_steps: usize) -> Self {
        let floor = if matches!(plan, ClassPlan::Predefined { .. }) {
            0.0
        } else {
            Self::FLOOR
        };
        let persistence_rule = PersistenceRule::Consecutive;
        Self {
            plan,
            floor,
            persistence_steps,
            persistence_rule,
            reset_std: 1.0 / 3.0,
        }
    }

    fn check(&self, components: usize) -> Result<(), FilterError> {
        self.plan.check(components)?;
        let most = match &self.plan {
            ClassPlan::Predefined { classes } => classes.len(),
            ClassPlan::SelfCalibrating { classes } => classes.len() + 1,
            ClassPlan::Hierarchical { substructures } => {
                let largest = substructures
                    .groups()
                    .iter()
                    .map(Vec::len)
                    .max()
                    .unwrap_or(0);
                largest.max(substructures.groups().len()) + 1
            }
        };
        if !(self.floor >= 0.0 && self.floor * (most as f64) < 1.0) {
            let (what, allowed) = (
                "floor of the plausibilities",
                "not negative and below 1 over the number of classes",
            );
            return Err(FilterError::Setting {
                what,
                found: self.floor,
                allowed,
            });
        }
        if self.persistence_steps == 0 {
            let (what, allowed) = ("persistence of a leading class in steps", "at least 1");
            return Err(FilterError::Setting {
                what,
                found: 0.0,
                allowed,
            });
        }
        if !(self.reset_std > 0.0 && self.reset_std.is_finite()) {
            let (what, allowed) = ("standard deviation after a calibration", "positive");
            return Err(FilterError::Setting {
                what,
                found: self.reset_std,
                allowed,
            });
        }
        Ok(())
    }
}
