//! The estimate of the full model, combined over the classes.

use super::ClassBank;
use crate::classes::{ComponentSystem, Grouping};

impl<S: ComponentSystem> ClassBank<S> {
    /// Records the parameters that a class returned to their bounds, before a calibration replaces
    /// their entries.
    pub(super) fn note_limited(&mut self, class: usize, limited_states: usize) {
        let Self {
            system,
            members,
            state,
            work,
            ..
        } = self;
        work.limited.clear();
        if limited_states == 0 {
            return;
        }
        let (member, motion) = (&members[class], work.motion.len());
        let (mean, settings) = (member.filter.mean(), member.filter.settings());
        map_parameters(system, &member.grouping, &state.factors, &mut work.mapped);
        for (parameter, (entry, _)) in work.mapped.iter().enumerate() {
            let at = motion + entry;
            if mean[at] <= settings.lower[at] || mean[at] >= settings.upper[at] {
                work.limited.push(parameter);
            }
        }
    }

    /// Computes the estimate over all classes, (5.33), and the covariance of the mixture.
    pub(super) fn combine(&mut self) {
        let motion = self.work.motion.len();
        let Self {
            system,
            members,
            state,
            work,
            ..
        } = self;
        work.motion.fill(0.0);
        work.mean.fill(0.0);
        work.covariance.fill(0.0);
        let plausibilities = &state.plausibilities;
        for pass in 0..2 {
            for (class, member) in members.iter().enumerate() {
                let weight = plausibilities.of(class);
                let y = member.filter.mean();
                map_parameters(system, &member.grouping, &state.factors, &mut work.mapped);
                for (value, (entry, factor)) in work.of_class.iter_mut().zip(&work.mapped) {
                    *value = factor * y[motion + entry];
                }
                if pass == 0 {
                    for (mean, value) in work.motion.iter_mut().zip(y) {
                        *mean += weight * value;
                    }
                    work.mean.axpy(weight, &work.of_class, 1.0);
                    continue;
                }
                work.of_class -= &work.mean;
                let of_class = member.filter.covariance();
                for (column, (b, factor_b)) in work.mapped.iter().enumerate() {
                    for (row, (a, factor_a)) in work.mapped.iter().enumerate() {
                        let within = factor_a * factor_b * of_class[(motion + a, motion + b)];
                        let between = work.of_class[row] * work.of_class[column];
                        work.covariance[(row, column)] += weight * (within + between);
                    }
                }
            }
        }
    }
}

/// Maps each parameter of the full model to a parameter of a class and a factor.
fn map_parameters(
    system: &impl ComponentSystem,
    grouping: &Grouping,
    factors: &[f64],
    mapped: &mut [(usize, f64)],
) {
    let components = system.components();
    let groups = grouping.groups().len();
    let (mut component, mut other) = (0, 0);
    for (parameter, target) in mapped.iter_mut().enumerate() {
        if components.get(component) == Some(&parameter) {
            *target = (grouping.group_of(component), factors[component]);
            component += 1;
        } else {
            *target = (groups + other, 1.0);
            other += 1;
        }
    }
}
