//! The filters of all classes, their plausibilities and their combined estimate.

mod lead;
mod members;
mod mixture;

use super::persistence::Persistence;
use super::{
    ClassEvent, ClassId, ClassPlan, ClassSettings, ComponentSystem, Grouping, Level, Plausibilities,
};
use crate::error::FilterError;
use crate::extended::{ExtendedKalmanFilter, FilterSettings, FilterState, Frame, Step};
use crate::noise::{NoiseRule, NoiseState};
use crate::outlier::OutlierState;
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// State length from which the filters step in parallel.
///
/// Smaller filters complete a step faster than threads wake up.
const PARALLEL_FROM: usize = 24;

/// The complete state of a bank between two steps, for a checkpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ClassBankState {
    bank: BankState,
    filters: Vec<FilterState>,
}

/// One filter for each class of a plan, with plausibilities: Huang & Yuen (2023), §5.3 to §5.5.
///
/// One call of [`ClassBank::step`] is one time step. The estimates are those of all classes or of
/// the most plausible class, as each method states. The bank restarts single filters that have
/// diverged. The caller must restart the bank only if all filters have diverged.
///
/// Banks of large filters step in parallel. The results are bit-identical for any number of
/// threads. The cost of a step is that of one filter times the number of classes.
#[derive(Debug)]
pub struct ClassBank<S: ComponentSystem> {
    system: S,
    /// Settings of the full model.
    template: FilterSettings,
    settings: ClassSettings,
    members: Vec<Member<S::Model>>,
    state: BankState,
    events: Vec<ClassEvent>,
    work: Workspace,
    /// Whether the coming frames contain information about the parameters.
    teaches: bool,
}

/// The state of a bank without its filters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct BankState {
    level: Level,
    /// Product of all calibration factors of each component (N_k).
    factors: Vec<f64>,
    plausibilities: Plausibilities,
    persistence: Persistence,
    /// Class whose filter identifies the noise levels and screens outliers.
    lead: usize,
    /// Last class whose lead was reported as lasting.
    believed: ClassId,
    /// Number of observed steps, for the training stage.
    steps: usize,
    calibrations: u64,
}

#[derive(Debug)]
struct Member<M> {
    id: ClassId,
    grouping: Grouping,
    filter: ExtendedKalmanFilter<M>,
    result: Result<Step, FilterError>,
}

#[derive(Debug)]
struct Workspace {
    /// ln p(z | D, C) of each class.
    log_evidences: Vec<f64>,
    /// The frame without the channels that the leading filter rejected (N_0).
    observations: Vec<f64>,
    /// Noise levels of the leading filter (N_ψ).
    psi: Vec<f64>,
    /// Motion (N_x), combined over the classes. `mean` and `covariance` are the combined parameters
    /// of the full model (N_θ) and their covariance.
    motion: DVector<f64>,
    mean: DVector<f64>,
    covariance: DMatrix<f64>,
    /// Parameters of the full model according to one class (N_θ).
    of_class: DVector<f64>,
    /// For each parameter of the full model: its entry in the parameters of a class, and the factor
    /// on this entry.
    mapped: Vec<(usize, f64)>,
    /// Parameters of the full model that the most plausible class kept at a bound.
    limited: Vec<usize>,
}

impl<S: ComponentSystem> ClassBank<S> {
    /// Creates a bank with every filter at its prior and all classes equally plausible.
    ///
    /// `template` contains the settings for a filter of the full model. The prior mean of a group
    /// is the mean over its components.
    ///
    /// # Errors
    /// Returns an error if a setting does not fit the system or is out of range.
    pub fn new(
        system: S,
        template: FilterSettings,
        settings: ClassSettings,
    ) -> Result<Self, FilterError> {
        let components = system.components().len();
        settings.check(components)?;
        let (found, expected) = (template.prior_mean.len(), system.parameter_len());
        if found < expected {
            return Err(FilterError::Dimension {
                what: "prior mean",
                found,
                expected,
            });
        }
        let motion = found - expected;
        let psi = template
            .noise
            .parameters
            .iter()
            .map(|parameter| parameter.start)
            .collect();
        let work = Workspace {
            log_evidences: Vec::new(),
            observations: Vec::new(),
            psi,
            motion: DVector::zeros(motion),
            mean: DVector::zeros(expected),
            covariance: DMatrix::zeros(expected, expected),
            of_class: DVector::zeros(expected),
            mapped: vec![(0, 1.0); expected],
            limited: Vec::with_capacity(expected),
        };
        let state = BankState {
            level: Level::First,
            factors: vec![1.0; components],
            plausibilities: Plausibilities::uniform(0),
            persistence: Persistence::new(0),
            lead: 0,
            believed: ClassId::Baseline,
            steps: 0,
            calibrations: 0,
        };
        let mut bank = Self {
            system,
            template,
            settings,
            members: Vec::new(),
            state,
            events: Vec::new(),
            work,
            teaches: true,
        };
        bank.start()?;
        Ok(bank)
    }

    /// Returns to the prior with uniform plausibilities and discards all calibrations.
    ///
    /// # Errors
    /// Returns an error if a filter cannot be created. This cannot happen after a successful
    /// [`ClassBank::new`].
    pub fn restart(&mut self) -> Result<(), FilterError> {
        self.events.clear();
        self.start()
    }

    fn start(&mut self) -> Result<(), FilterError> {
        let motion = self.work.motion.len();
        self.state.level = Level::First;
        self.state.factors.fill(1.0);
        let mut members = self.members_at_prior()?;
        if let Some(former) = self.members.get(self.state.lead) {
            for member in &mut members {
                member.filter.expect_motion_of(&former.filter, motion);
            }
        }
        self.state.lead = 0;
        self.install(members);
        self.state.believed = self.members[0].id;
        self.state.steps = 0;
        self.appoint(0);
        self.combine();
        Ok(())
    }

    /// Processes one frame; [`ClassBank::events`] then returns the resulting changes.
    ///
    /// The result is that of the most plausible class, with `ln p(z | D)` over all classes.
    ///
    /// # Errors
    /// Returns an error in these cases:
    ///
    /// - The frame does not fit the models. The bank is then unchanged.
    /// - All filters have diverged. The caller must then restart the bank.
    pub fn step(&mut self, frame: Frame<'_>) -> Result<Step, FilterError> {
        self.members[0].filter.check_frame(frame)?;
        self.events.clear();
        self.step_filters(frame);
        self.weigh();
        let plausibilities = &mut self.state.plausibilities;
        let log_evidence = match self.teaches {
            true => plausibilities.update(&self.work.log_evidences, self.settings.floor),
            false => self.work.log_evidences[self.state.lead],
        };
        if log_evidence == f64::NEG_INFINITY {
            let lost = &self.members[self.state.lead].result;
            return Err(lost.clone().err().unwrap_or(FilterError::NotFinite {
                what: "state of every class",
                index: 0,
            }));
        }
        let (leader, former) = (self.state.plausibilities.leader(), self.state.lead);
        let told = self.members[former].result.clone().ok();
        let Ok(mut step) = self.members[leader].result.clone() else {
            return Err(FilterError::NotFinite {
                what: "state of the most plausible class",
                index: leader,
            });
        };
        step.log_evidence = log_evidence;
        if let Some(told) = told {
            step.rejected_channels = told.rejected_channels;
            step.noise_phase = told.noise_phase;
            step.training_ended = told.training_ended;
            step.training_overdue = told.training_overdue;
            step.training_restarted = told.training_restarted;
        }
        self.note_limited(leader, step.limited_states);
        self.appoint(leader);
        self.restart_lost(leader)?;
        if step.used_channels > 0 && self.teaches {
            self.act(leader)?;
        }
        self.combine();
        Ok(step)
    }

    /// Discards the motion after a gap that is too long to bridge.
    ///
    /// Parameters, noise levels and plausibilities remain.
    pub fn forget_motion(&mut self) {
        for member in &mut self.members {
            member.filter.forget_motion();
        }
        self.combine();
    }

    /// Returns the changes of the classes in the last step.
    #[must_use]
    pub fn events(&self) -> &[ClassEvent] {
        &self.events
    }

    /// Returns the competing classes, in the order of [`ClassBank::plausibilities`].
    pub fn classes(&self) -> impl ExactSizeIterator<Item = ClassId> {
        self.members.iter().map(|member| member.id)
    }

    /// Returns the plausibilities of the competing classes.
    #[must_use]
    pub fn plausibilities(&self) -> &Plausibilities {
        &self.state.plausibilities
    }

    /// Returns the index of the most plausible class.
    #[must_use]
    pub fn leader(&self) -> usize {
        self.state.lead
    }

    /// Returns the last class whose lead was reported as lasting.
    #[must_use]
    pub fn believed(&self) -> ClassId {
        self.state.believed
    }

    /// Returns the filter of a class by its index.
    #[must_use]
    pub fn filter(&self, class: usize) -> &ExtendedKalmanFilter<S::Model> {
        &self.members[class].filter
    }

    /// Returns the grouping of a class by its index.
    #[must_use]
    pub fn grouping(&self, class: usize) -> &Grouping {
        &self.members[class].grouping
    }

    /// Returns the product of all calibration factors of each component (N_k).
    #[must_use]
    pub fn factors(&self) -> &[f64] {
        &self.state.factors
    }

    /// Returns the number of calibrations of the nominal model.
    #[must_use]
    pub fn calibrations(&self) -> u64 {
        self.state.calibrations
    }

    /// Returns the settings of the full model, in which each component is a parameter of its own.
    #[must_use]
    pub fn template(&self) -> &FilterSettings {
        &self.template
    }

    /// Returns the settings of the class comparison.
    #[must_use]
    pub fn settings(&self) -> &ClassSettings {
        &self.settings
    }

    /// Returns the physical state (N_x), weighted by the plausibilities, (5.33).
    #[must_use]
    pub fn motion(&self) -> &DVector<f64> {
        &self.work.motion
    }

    /// Returns the parameters of the full model (N_θ, ratios to nominal), weighted by the
    /// plausibilities, (5.33).
    #[must_use]
    pub fn parameter_mean(&self) -> &DVector<f64> {
        &self.work.mean
    }

    /// Returns the parameters of the full model at a bound in the most plausible class, after the
    /// last step (indices from 0).
    #[must_use]
    pub fn limited_parameters(&self) -> &[usize] {
        &self.work.limited
    }

    /// Returns the covariance of [`ClassBank::parameter_mean`] (N_θ × N_θ), of the mixture over the
    /// classes.
    #[must_use]
    pub fn parameter_covariance(&self) -> &DMatrix<f64> {
        &self.work.covariance
    }

    /// Returns the state of the noise identification.
    #[must_use]
    pub fn noise(&self) -> &NoiseState {
        self.members[self.state.lead].filter.noise()
    }

    /// Returns the state of the outlier screening; `None` if it is disabled.
    #[must_use]
    pub fn outliers(&self) -> Option<&OutlierState> {
        self.members[self.state.lead].filter.outliers()
    }

    /// Returns the innovation of the most plausible class (N_0), NaN for missing and rejected
    /// channels.
    #[must_use]
    pub fn innovation(&self) -> &DVector<f64> {
        self.members[self.state.lead].filter.innovation()
    }

    /// Returns the state for a checkpoint.
    #[must_use]
    pub fn state(&self) -> ClassBankState {
        let filters = self
            .members
            .iter()
            .map(|member| member.filter.state().clone())
            .collect();
        ClassBankState {
            bank: self.state.clone(),
            filters,
        }
    }

    /// Restores the state of a checkpoint; subsequent steps are bit-identical to an uninterrupted
    /// run.
    ///
    /// # Errors
    /// Returns an error if the state does not fit the plan or the models. The bank is then
    /// unchanged.
    pub fn restore(&mut self, state: ClassBankState) -> Result<(), FilterError> {
        let ClassBankState {
            bank: state,
            filters,
        } = state;
        let components = self.system.components().len();
        FilterError::check_sizes([(
            "components of a checkpoint",
            state.factors.len(),
            components,
        )])?;
        if let (ClassPlan::Hierarchical { substructures }, Level::Second { substructure }) =
            (&self.settings.plan, state.level)
            && substructure >= substructures.groups().len()
        {
            let (found, expected) = (substructure, substructures.groups().len());
            return Err(FilterError::Dimension {
                what: "substructure of a checkpoint",
                found,
                expected,
            });
        }
        let groupings = self.settings.plan.classes(state.level, components)?;
        let expected = groupings.len();
        let classes = [
            filters.len(),
            state.plausibilities.logarithms().len(),
            state.persistence.classes(),
        ];
        FilterError::check_sizes(
            classes.map(|found| ("classes of a checkpoint", found, expected)),
        )?;
        if state.lead >= expected {
            return Err(FilterError::Dimension {
                what: "leading class of a checkpoint",
                found: state.lead,
                expected,
            });
        }
        let mut members = Vec::with_capacity(expected);
        for ((class, grouping), filter) in groupings.into_iter().enumerate().zip(filters) {
            let mut member = self.member(state.level, class, grouping, &state.factors)?;
            member.filter.restore(filter)?;
            members.push(member);
        }
        self.members = members;
        self.state = state;
        self.events.clear();
        self.appoint(self.state.lead);
        self.combine();
        Ok(())
    }

    /// Returns `true` if the leading filter has results that all other filters must use.
    fn has_common_findings(&self) -> bool {
        let adapts = !self.template.noise.parameters.is_empty()
            && self.template.noise_settings.rule != NoiseRule::Fixed;
        adapts || self.template.outliers.is_some()
    }

    /// Sets whether the coming frames contain information about the parameters, as in
    /// [`ExtendedKalmanFilter::set_teaching`].
    ///
    /// Without it, the plausibilities do not change either, and nothing is calibrated.
    pub fn set_teaching(&mut self, teaches: bool) {
        self.teaches = teaches;
        let filters = self.members.iter_mut().map(|member| &mut member.filter);
        filters.for_each(|filter| filter.set_teaching(teaches));
    }

    /// Sets the reliability `κ` (N_f) of the known excitation of the next frame, as in
    /// [`ExtendedKalmanFilter::set_reliability`].
    ///
    /// # Errors
    /// Returns an error if the length does not fit the models, or if a value is outside 0 to 1.
    pub fn set_reliability(&mut self, reliability: &[f64]) -> Result<(), FilterError> {
        let mut filters = self.members.iter_mut().map(|member| &mut member.filter);
        filters.try_for_each(|filter| filter.set_reliability(reliability))
    }

    fn step_filters(&mut self, frame: Frame<'_>) {
        let lead = self.state.lead;
        let common = self.has_common_findings();
        let Self { members, work, .. } = self;
        work.observations.clear();
        work.observations.extend_from_slice(frame.observations);
        if common {
            let leading = &mut members[lead];
            leading.result = leading.filter.step(frame);
            if leading.result.is_ok() {
                for (datum, innovation) in work
                    .observations
                    .iter_mut()
                    .zip(leading.filter.innovation())
                {
                    if innovation.is_nan() {
                        *datum = f64::NAN;
                    }
                }
                work.psi
                    .copy_from_slice(leading.filter.noise().mean.as_slice());
            } else {
                // A frame without screening may contain the outlier that broke the filter. All
                // other filters only predict.
                work.observations.fill(f64::NAN);
            }
        }
        let frame = Frame {
            observations: &work.observations,
            excitation: frame.excitation,
        };
        let psi = &work.psi;
        let step = |(class, member): (usize, &mut Member<S::Model>)| {
            if common && class == lead {
                return;
            }
            if common {
                member.filter.follow(psi);
            }
            member.result = member.filter.step(frame);
        };
        let is_large = members
            .iter()
            .any(|member| member.filter.mean().len() >= PARALLEL_FROM);
        if is_large {
            members.par_iter_mut().enumerate().for_each(step);
        } else {
            members.iter_mut().enumerate().for_each(step);
        }
    }

    fn install(&mut self, members: Vec<Member<S::Model>>) {
        self.state.plausibilities = Plausibilities::uniform(members.len());
        self.state.persistence = Persistence::new(members.len());
        self.members = members;
    }
}

#[cfg(test)]
mod tests;
