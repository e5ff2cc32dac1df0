//! Real-time model class selection: compares several models of one system while they run.
//!
//! Source: Huang & Yuen (2023), chapter 5. A model class specifies which components of a structure
//! share a stiffness multiplier. Each class has its own extended Kalman filter. Each filter
//! predicts a density for the next datum, and this density updates the plausibility of its class.
//! The simplest class that explains the data wins, because a prior spread over more parameters
//! predicts less sharply.
//!
//! - [`Grouping`]: a class, that is, a partition of the components
//! - [`ClassPlan`]: the list of classes, and whether the winner calibrates the nominal model
//! - [`ClassBank`]: the filters with their plausibilities, and the combined estimate
//! - [`ComponentSystem`]: creates the model of a class
//!
//! In the full model, each component is a parameter of its own. A class reports an estimate of
//! every component, whatever its grouping. The noise levels and the outlier screening come from the
//! most plausible class. All classes therefore see the same data with the same noise, so that their
//! evidences are comparable.

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

/// A system whose components can be scaled individually or in groups.
///
/// The parameters of its full model are all components and other parameters such as damping, in the
/// order of [`FilterSettings`](crate::FilterSettings). In the model of a class, one multiplier per
/// group comes first. The other parameters follow in their order.
pub trait ComponentSystem {
    /// The model of one class.
    type Model: ProcessModel + ObservationModel + Send;

    /// Returns the index of each component among the parameters of the full model (N_k,
    /// increasing).
    fn components(&self) -> &[usize];

    /// Returns the number of parameters of the full model, including the components.
    fn parameter_len(&self) -> usize;

    /// Creates the model of a class.
    ///
    /// The nominal value of each component is scaled by its entry of `factors` (N_k).
    fn grouped(&self, grouping: &Grouping, factors: &[f64]) -> Self::Model;
}

/// The list of model classes, and the effect of a winning class.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum ClassPlan {
    /// Fixed classes, §5.3. The most plausible class reports the estimates.
    Predefined {
        /// The classes.
        classes: Vec<Grouping>,
    },
    /// Class 0, the baseline, has one multiplier for all components, §5.4.
    ///
    /// When another class wins, its estimates become the nominal model of all classes.
    SelfCalibrating {
        /// The classes from number 1.
        classes: Vec<Grouping>,
    },
    /// Self-calibration from coarse to fine, §5.5.
    ///
    /// The first level finds the changed substructure, the second level the changed component in
    /// it.
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

    /// Checks the classes of this plan.
    ///
    /// # Errors
    /// Returns an error for the first problem found: no classes, a class that does not group all
    /// components, or two equal partitions on one level.
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
                // Classes with equal partitions would alternate forever, because the data cannot
                // distinguish them.
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

/// The level of the competition: substructures or components.
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

/// Identifies a class.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum ClassId {
    /// A class of a predefined plan, by its index in the plan (from 0).
    Predefined(usize),
    /// One multiplier for all components.
    Baseline,
    /// A class of a self-calibrating plan (from 0).
    Calibrating(usize),
    /// One substructure with its own multiplier (from 0), against all other components.
    Substructure(usize),
    /// One component with its own multiplier, against all other components.
    Component {
        /// The component (from 0).
        component: usize,
        /// The substructure of the component (from 0).
        substructure: usize,
    },
}

/// A change of the classes in one step.
#[derive(Debug, Clone, PartialEq)]
pub enum ClassEvent {
    /// Another class has been the most plausible class for long enough to be accepted.
    Leading {
        /// The former leading class.
        from: ClassId,
        /// The new leading class.
        to: ClassId,
    },
    /// The estimates of a class became the nominal model.
    Calibrated {
        /// The class.
        by: ClassId,
        /// The factor that multiplied each component (N_k).
        factors: Vec<f64>,
    },
    /// The components of one substructure now compete.
    LevelUp {
        /// The substructure (from 0).
        substructure: usize,
    },
    /// The substructures compete again.
    LevelDown {
        /// The factor that multiplied each component (N_k).
        factors: Vec<f64>,
    },
    /// The filter of a class diverged and continues from the most plausible class.
    Restarted {
        /// The class.
        class: ClassId,
    },
}

/// Settings of the class comparison.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ClassSettings {
    /// The classes.
    pub plan: ClassPlan,
    /// `P_l`: lower limit of each plausibility, 0 for none.
    ///
    /// It must be below 1 over the number of classes.
    pub floor: f64,
    /// `N_t` (steps): required duration of a lead before the bank acts on it.
    ///
    /// It is also the length of the initial training stage, in which the bank does not act.
    pub persistence_steps: usize,
    /// The criterion for a lasting lead.
    pub persistence_rule: PersistenceRule,
    /// Standard deviation of a multiplier after a calibration, 1/3 in the source.
    pub reset_std: f64,
}

impl ClassSettings {
    /// The floor for plans that calibrate.
    ///
    /// A smaller floor allows the calibration of healthy components in error.
    pub const FLOOR: f64 = 1e-4;

    /// Returns the settings of the source, with its rule of persistence.
    ///
    /// The floor is 0 for predefined classes and `P_l = 10⁻⁴` for all other plans.
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
