//! The most plausible class: its lead over the others, and what follows from a lasting lead.

use super::ClassBank;
use crate::classes::{ClassEvent, ClassId, ClassPlan, ComponentSystem, Level};
use crate::error::FilterError;
use crate::noise::NoiseState;
use crate::outlier::OutlierState;

/// Upper limit of the state entries; a filter beyond it has diverged (state units).
const LARGEST_STATE: f64 = 1e8;

/// A filter has diverged if its log evidence is this far below the best (nats).
const WORST: f64 = 1000.0;

impl<S: ComponentSystem> ClassBank<S> {
    /// Collects the evidences; the evidence of a lost filter is minus infinity.
    pub(super) fn weigh(&mut self) {
        let Self { members, work, .. } = self;
        work.log_evidences.clear();
        for member in members.iter() {
            let kept = member
                .filter
                .mean()
                .iter()
                .all(|value| value.abs() <= LARGEST_STATE);
            let evidence = member
                .result
                .as_ref()
                .ok()
                .filter(|_| kept)
                .map(|step| step.log_evidence);
            work.log_evidences
                .push(evidence.unwrap_or(f64::NEG_INFINITY));
        }
        let best = work
            .log_evidences
            .iter()
            .copied()
            .fold(f64::NEG_INFINITY, f64::max);
        for evidence in &mut work.log_evidences {
            if *evidence < best - WORST {
                *evidence = f64::NEG_INFINITY;
            }
        }
    }

    /// Returns noise levels and outlier state of a filter; noise levels that are not finite return
    /// to their initial state.
    pub(super) fn findings_of(&self, class: usize) -> (NoiseState, Option<OutlierState>) {
        let known = self.members[class].filter.state();
        let is_lost = known
            .noise()
            .mean
            .iter()
            .chain(&known.noise().covariance)
            .any(|value| !value.is_finite());
        let noise = match is_lost {
            true => NoiseState::start(&self.template.noise, &self.template.noise_settings),
            false => known.noise().clone(),
        };
        (noise, known.outliers().cloned())
    }

    /// Makes the filter of a class identify the noise levels and screen outliers.
    pub(super) fn appoint(&mut self, class: usize) {
        let former = self.state.lead;
        if former != class {
            let (noise, outliers) = self.findings_of(former);
            self.members[class].filter.lead(noise, outliers);
            self.state.lead = class;
        }
        self.work
            .psi
            .copy_from_slice(self.members[class].filter.noise().mean.as_slice());
        if !self.has_common_findings() {
            return;
        }
        let psi = std::mem::take(&mut self.work.psi);
        for (index, member) in self.members.iter_mut().enumerate() {
            if index != class {
                member.filter.follow(&psi);
            }
        }
        self.work.psi = psi;
    }

    /// Restarts every lost filter from the leading filter.
    pub(super) fn restart_lost(&mut self, leader: usize) -> Result<(), FilterError> {
        for class in 0..self.members.len() {
            if self.work.log_evidences[class] == f64::NEG_INFINITY {
                let source = &self.members[leader];
                let grouping = self.members[class].grouping.clone();
                let multipliers: Vec<f64> = grouping
                    .groups()
                    .iter()
                    .map(|group| {
                        let of = |component: &usize| {
                            source.filter.mean()
                                [self.work.motion.len() + source.grouping.group_of(*component)]
                        };
                        group.iter().map(of).sum::<f64>() / group.len() as f64
                    })
                    .collect();
                let mut member =
                    self.member(self.state.level, class, grouping, &self.state.factors)?;
                self.continue_member(&mut member, leader, &multipliers);
                self.events.push(ClassEvent::Restarted { class: member.id });
                self.members[class] = member;
            }
        }
        self.appoint(leader);
        Ok(())
    }

    /// Acts on a lasting lead: calibrates, changes the level, or only reports the lead.
    pub(super) fn act(&mut self, leader: usize) -> Result<(), FilterError> {
        let steps = self.settings.persistence_steps;
        self.state.steps += 1;
        if self.state.steps <= steps {
            return Ok(()); // training stage
        }
        let lead = (!self.state.plausibilities.is_tied()).then_some(leader);
        let Some(lasting) =
            self.state
                .persistence
                .update(lead, steps, self.settings.persistence_rule)
        else {
            return Ok(());
        };
        let id = self.members[lasting].id;
        if id != self.state.believed {
            self.events.push(ClassEvent::Leading {
                from: self.state.believed,
                to: id,
            });
            self.state.believed = id;
        }
        match (&self.settings.plan, self.state.level, id) {
            (ClassPlan::Predefined { .. }, _, _) | (_, Level::First, ClassId::Baseline) => Ok(()),
            (ClassPlan::Hierarchical { .. }, Level::First, ClassId::Substructure(substructure)) => {
                self.events.push(ClassEvent::LevelUp { substructure });
                self.enter(Level::Second { substructure }, lasting)
            }
            (ClassPlan::Hierarchical { .. }, Level::Second { .. }, ClassId::Baseline) => {
                let factors = self.fold(lasting);
                self.events.push(ClassEvent::LevelDown { factors });
                self.enter(Level::First, lasting)
            }
            (_, level, by) => {
                let factors = self.fold(lasting);
                self.state.calibrations += 1;
                self.events.push(ClassEvent::Calibrated { by, factors });
                self.enter(level, lasting)
            }
        }
    }

    /// Makes the estimates of a class the nominal values, (5.48) and (5.67).
    ///
    /// Returns the factor for each component.
    fn fold(&mut self, class: usize) -> Vec<f64> {
        let (member, motion) = (&self.members[class], self.work.motion.len());
        let multiplier =
            |component: usize| member.filter.mean()[motion + member.grouping.group_of(component)];
        let multipliers: Vec<f64> = (0..self.state.factors.len()).map(multiplier).collect();
        for (factor, multiplier) in self.state.factors.iter_mut().zip(&multipliers) {
            *factor *= multiplier;
        }
        multipliers
    }

    /// Starts the classes of a level from the running class `source`, all equally plausible: (5.54)
    /// to (5.56).
    fn enter(&mut self, level: Level, source: usize) -> Result<(), FilterError> {
        let groupings = self
            .settings
            .plan
            .classes(level, self.state.factors.len())?;
        let mut members = Vec::with_capacity(groupings.len());
        for (class, grouping) in groupings.into_iter().enumerate() {
            let multipliers = vec![1.0; grouping.groups().len()];
            let mut member = self.member(level, class, grouping, &self.state.factors)?;
            self.continue_member(&mut member, source, &multipliers);
            members.push(member);
        }
        let (noise, outliers) = self.findings_of(self.state.lead);
        members[0].filter.lead(noise, outliers);
        self.state.level = level;
        self.state.lead = 0;
        self.install(members);
        self.appoint(0);
        Ok(())
    }
}
