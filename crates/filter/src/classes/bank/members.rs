//! The filters of the classes, at their prior or continued from a running filter.

use super::{ClassBank, Member};
use crate::classes::{ClassId, ClassPlan, ComponentSystem, Grouping, Level};
use crate::error::FilterError;
use crate::extended::{ExtendedKalmanFilter, FilterSettings};
use crate::model::ProcessModel;
use nalgebra::{DMatrix, DVector};

impl<S: ComponentSystem> ClassBank<S> {
    pub(super) fn members_at_prior(&self) -> Result<Vec<Member<S::Model>>, FilterError> {
        let groupings = self
            .settings
            .plan
            .classes(Level::First, self.state.factors.len())?;
        let member =
            |(class, grouping)| self.member(Level::First, class, grouping, &self.state.factors);
        groupings.into_iter().enumerate().map(member).collect()
    }

    pub(super) fn member(
        &self,
        level: Level,
        class: usize,
        grouping: Grouping,
        factors: &[f64],
    ) -> Result<Member<S::Model>, FilterError> {
        let model = self.system.grouped(&grouping, factors);
        let settings = self.settings_of(&grouping, factors, model.state_len())?;
        let filter = ExtendedKalmanFilter::new(model, settings)?;
        let id = match (&self.settings.plan, level) {
            (ClassPlan::Predefined { .. }, _) => ClassId::Predefined(class),
            (_, _) if class == 0 => ClassId::Baseline,
            (ClassPlan::SelfCalibrating { .. }, _) => ClassId::Calibrating(class - 1),
            (ClassPlan::Hierarchical { .. }, Level::First) => ClassId::Substructure(class - 1),
            (ClassPlan::Hierarchical { substructures }, Level::Second { substructure }) => {
                ClassId::Component {
                    component: substructures.groups()[substructure][class - 1],
                    substructure,
                }
            }
        };
        let result = Err(FilterError::NotFinite {
            what: "state before the first step",
            index: class,
        });
        Ok(Member {
            id,
            grouping,
            filter,
            result,
        })
    }

    /// Returns the parameters of the full model that are not components, in order.
    fn others(&self) -> impl Iterator<Item = usize> {
        let components = self.system.components();
        (0..self.system.parameter_len())
            .filter(|parameter| components.binary_search(parameter).is_err())
    }

    /// Derives the settings of a class from the settings of the full model.
    fn settings_of(
        &self,
        grouping: &Grouping,
        factors: &[f64],
        len: usize,
    ) -> Result<FilterSettings, FilterError> {
        let motion = self.work.motion.len();
        let (components, others): (_, Vec<usize>) =
            (self.system.components(), self.others().collect());
        let expected = motion + grouping.groups().len() + others.len();
        if len != expected {
            return Err(FilterError::Dimension {
                what: "state of a class",
                found: len,
                expected,
            });
        }
        let mean_of = |values: &mut dyn Iterator<Item = f64>, count: usize| {
            values.sum::<f64>() / count as f64
        };
        let reduce = |of: &DVector<f64>, group: &dyn Fn(&[usize]) -> f64| {
            let grouped = grouping.groups().iter().map(|members| group(members));
            let rest = others.iter().map(|other| of[motion + other]);
            DVector::from_iterator(
                len,
                of.iter().take(motion).copied().chain(grouped).chain(rest),
            )
        };
        let template = &self.template;
        let entry = |of: &DVector<f64>, component: usize| of[motion + components[component]];
        let least_bound = match self.settings.plan {
            ClassPlan::Predefined { .. } => 0.0,
            // A calibration resets the variance of a multiplier to `reset_std`², so the variance
            // bound must be at least as large.
            ClassPlan::SelfCalibrating { .. } | ClassPlan::Hierarchical { .. } => {
                self.settings.reset_std.powi(2)
            }
        };
        let mut settings = FilterSettings {
            prior_mean: reduce(&template.prior_mean, &|members| {
                mean_of(
                    &mut members.iter().map(|n| entry(&template.prior_mean, *n)),
                    members.len(),
                )
            }),
            prior_std: reduce(&template.prior_std, &|members| {
                mean_of(
                    &mut members
                        .iter()
                        .map(|n| entry(&template.prior_std, *n).powi(2)),
                    members.len(),
                )
                .sqrt()
            }),
            variance_bound: reduce(&template.variance_bound, &|members| {
                members
                    .iter()
                    .map(|n| entry(&template.variance_bound, *n))
                    .fold(least_bound, f64::max)
            }),
            lower: reduce(&template.lower, &|members| {
                members
                    .iter()
                    .map(|n| entry(&template.lower, *n) / factors[*n])
                    .fold(f64::NEG_INFINITY, f64::max)
            }),
            upper: reduce(&template.upper, &|members| {
                members
                    .iter()
                    .map(|n| entry(&template.upper, *n) / factors[*n])
                    .fold(f64::INFINITY, f64::min)
            }),
            considered_std: DVector::zeros(len),
            misfit: None,
            ..template.clone()
        };
        for (low, high) in settings.lower.iter_mut().zip(&settings.upper) {
            // If calibrations have moved the components of a group far apart, their bounds do not
            // overlap. The multiplier of the group is then fixed.
            *low = low.min(*high);
        }
        Ok(settings)
    }

    /// Initialises a new filter with the motion and the other parameters of class `source`.
    ///
    /// The multipliers start uncertain, with standard deviation `reset_std`.
    pub(super) fn continue_member(
        &self,
        member: &mut Member<S::Model>,
        source: usize,
        multipliers: &[f64],
    ) {
        let motion = self.work.motion.len();
        let (source, target) = (&self.members[source], &member.grouping);
        let (source_groups, groups) = (source.grouping.groups().len(), target.groups().len());
        let origin = |entry: usize| match entry {
            entry if entry < motion => Some(entry),
            entry if entry < motion + groups => None,
            entry => Some(entry - groups + source_groups),
        };
        let (known, uncertain) = (source.filter.mean(), source.filter.covariance());
        let len = member.filter.mean().len();
        let mean = DVector::from_fn(len, |entry, _| match origin(entry) {
            Some(entry) => known[entry],
            None => multipliers[entry - motion],
        });
        let open = self.settings.reset_std.powi(2);
        let covariance = DMatrix::from_fn(len, len, |row, column| {
            match (origin(row), origin(column)) {
                (Some(row), Some(column)) => uncertain[(row, column)],
                (None, None) if row == column => open,
                _ => 0.0,
            }
        });
        member
            .filter
            .continue_from(source.filter.state(), mean, covariance, origin);
    }
}
