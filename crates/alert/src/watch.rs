//! Watches all parameters of one structure: processes blocks of estimates and returns alerts.

use std::collections::BTreeMap;
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use spandrel_bus::{
    AlertState, Decimation, Estimate, EstimateBlock, EstimateFlags, FitReason, FitVerdict,
    UndecidedBecause,
};
use spandrel_checkpoint::Position;
use spandrel_structure::{AlertRule, Parameter, Structure};

use crate::{
    Alert, AlertError, Baseline, DecidedFrames, Decision, DecisionInput, Model, ParameterEstimate,
    ParameterLoss, Reference, Rule, Subject, alert::Acknowledged, decision::Vigilance,
    wording::End,
};

/// Maximum shift of the times of the frames that interrupts no sustain time, in frames.
///
/// A busy station of distributed identification skips up to three fusions, and a fusion can be half
/// a period late. A longer shift is a gap, a step of the clock, or a record that is replayed again.
const SKIPPED_FRAMES: f64 = 3.5;

/// The decisions on all watched parameters of one structure.
///
/// A watch takes blocks of estimates in order and passes each estimate to the decision of its
/// parameter. It contains no clock and no network, and also serves as the state in the checkpoint
/// of the alert service.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Watch {
    parameter_count: usize,
    decisions: Vec<Decision>,
    /// Position of the next estimate.
    pub(crate) expected: Option<Position>,
    /// Time of frame 0 in the last block, ns. A gap is not detected across a restart, because this
    /// is not stored.
    #[serde(skip)]
    t0_ns: Option<i64>,
    /// Whether measured modes contradict the model. It is set again after a restart.
    #[serde(skip)]
    is_contradicted_by_modes: bool,
}

impl Watch {
    /// Creates the decisions for the alert rules of a structure file.
    ///
    /// `baseline` replaces a reference that a rule would learn, if it contains the parameter.
    ///
    /// # Errors
    /// Returns an error if a rule does not match the parameters, a reference is invalid, or the
    /// baseline belongs to another structure.
    pub fn new(structure: &Structure, baseline: Option<&Baseline>) -> Result<Self, AlertError> {
        if let Some(baseline) = baseline.filter(|baseline| baseline.structure() != structure.name())
        {
            return Err(AlertError::BaselineStructure {
                found: baseline.structure().to_owned(),
                expected: structure.name().to_owned(),
            });
        }
        let parameters = structure.parameters();
        let mut decisions = Vec::new();
        for (number, rule) in structure.alert_rules().iter().enumerate() {
            for (position, &index) in rule.parameters.iter().enumerate() {
                let decision =
                    decision_from_structure(number, rule, position, parameters, baseline)
                        .map_err(|source| in_parameter(parameters, index, source))?;
                let changes = changes_without(structure, baseline, index);
                let limit = structure.earthquakes().map(|plan| plan.strong_m_per_s2);
                decisions.push(
                    decision
                        .with_changes_without(changes)
                        .with_strong_motion(limit),
                );
            }
        }
        Ok(Self::from_decisions(parameters.len(), decisions))
    }

    /// Creates a watch with these decisions for a structure of `parameter_count` parameters.
    pub fn from_decisions(parameter_count: usize, decisions: Vec<Decision>) -> Self {
        Self {
            parameter_count,
            decisions,
            expected: None,
            t0_ns: None,
            is_contradicted_by_modes: false,
        }
    }

    /// Removes what a checkpoint does not contain.
    pub(crate) fn forget_unstored(&mut self) {
        self.t0_ns = None;
        self.decisions
            .iter_mut()
            .for_each(Decision::forget_unstored);
    }

    /// Continues from `former`, the watch of an earlier structure file. Appends alerts for changes.
    ///
    /// `names` contains the parameter names by the indices in alerts: first those of this watch,
    /// then former parameters.
    pub(crate) fn succeed(
        &mut self,
        former: &Self,
        names: &[String],
        model: Model,
        alerts: &mut Vec<Alert>,
    ) {
        (self.expected, self.t0_ns) = (former.expected, former.t0_ns);
        let mut left: Vec<Option<&Decision>> = former.decisions.iter().map(Some).collect();
        let mut heirs: Vec<Option<&Decision>> = vec![None; self.decisions.len()];
        // Equal rules are matched first, so that a changed order or additional rules have no
        // effect.
        for is_equal in [true, false] {
            for (heir, own) in heirs
                .iter_mut()
                .zip(&self.decisions)
                .filter(|(heir, _)| heir.is_none())
            {
                let fits = |former: &&Decision| {
                    former.subject().name == own.subject().name
                        && (!is_equal || former.rule() == own.rule())
                };
                *heir = left
                    .iter_mut()
                    .find(|former| former.as_ref().is_some_and(fits))
                    .and_then(Option::take);
            }
        }
        for former in left.into_iter().flatten() {
            let Some(parameter) = names.iter().position(|name| *name == former.subject().name)
            else {
                continue; // `names` contains every former parameter
            };
            let end = if parameter < self.parameter_count {
                End::Unwatched
            } else {
                End::NoSuchParameter
            };
            alerts.extend(
                former
                    .clone()
                    .ended(&end)
                    .map(|alert| Alert { parameter, ..alert }),
            );
        }
        for (own, former) in self.decisions.iter_mut().zip(heirs) {
            if let Some(former) = former {
                own.succeed(former, model, alerts);
            }
        }
    }

    /// Sets the measured modes that contradict the model, in words. No alert is decided until this
    /// is `None` again.
    pub(crate) fn set_contradicting_modes(&mut self, modes: Option<&str>) {
        self.is_contradicted_by_modes = modes.is_some();
        let modes: Option<Arc<str>> = modes.map(Arc::from);
        for decision in &mut self.decisions {
            decision.set_contradicting_modes(modes.clone());
        }
    }

    /// Returns `true` if measured modes contradicted the model at the last estimate.
    pub(crate) fn was_contradicted_by_modes(&self) -> bool {
        self.decisions
            .iter()
            .any(Decision::was_contradicted_by_modes)
    }

    /// Processes a block of estimates and appends an alert for each change.
    ///
    /// The result does not depend on how the estimates are divided into blocks.
    ///
    /// # Errors
    /// Returns [`AlertError::ParameterCount`] if the block belongs to another structure. The watch
    /// is then unchanged.
    pub fn handle_block(
        &mut self,
        block: &EstimateBlock,
        alerts: &mut Vec<Alert>,
    ) -> Result<(), AlertError> {
        self.handle_each(block, alerts, |_, _| {})
    }

    /// Processes a block as [`Watch::handle_block`] does, and appends the losses of each parameter
    /// at the display rate (Hz).
    ///
    /// # Errors
    /// Returns the same errors as [`Watch::handle_block`].
    pub fn handle_block_with_display(
        &mut self,
        block: &EstimateBlock,
        display_rate_hz: f64,
        alerts: &mut Vec<Alert>,
        losses: &mut Vec<ParameterLoss>,
    ) -> Result<(), AlertError> {
        let decimation = Decimation::new(block.sampling_rate_hz, display_rate_hz);
        self.handle_each(block, alerts, |watch, frame| {
            if decimation.shows(frame) {
                losses.extend(watch.losses());
            }
        })
    }

    /// Processes a block, and calls `after` with the number of each frame.
    fn handle_each(
        &mut self,
        block: &EstimateBlock,
        alerts: &mut Vec<Alert>,
        mut after: impl FnMut(&Self, u64),
    ) -> Result<(), AlertError> {
        let widths = std::iter::once(usize::from(block.parameters))
            .chain(block.estimates.iter().map(|estimate| estimate.mean.len()));
        if let Some(found) = { widths }.find(|width| *width != self.parameter_count) {
            return Err(AlertError::ParameterCount {
                found,
                expected: self.parameter_count,
            });
        }
        let Some(grid) = block.grid() else {
            return Ok(()); // a checked block has a grid
        };
        let start = Position {
            epoch: block.header.epoch,
            sequence: block.header.sequence,
        };
        match self.expected {
            Some(expected) if expected.epoch != start.epoch => {
                self.handle_all(&DecisionInput::NewSource, alerts)
            }
            Some(expected) if expected != start || self.has_shifted(block) => {
                self.handle_all(&DecisionInput::Gap, alerts);
            }
            Some(_) | None => {}
        }
        for (number, estimate) in block.iter() {
            self.handle_estimate(grid.time_ns(number), estimate, alerts);
            after(self, number);
        }
        self.expected = Some(Position {
            sequence: start.sequence + block.estimates.len() as u64,
            ..start
        });
        self.t0_ns = Some(block.t0_ns);
        Ok(())
    }

    /// Returns `true` if the times of the frames have shifted by more than [`SKIPPED_FRAMES`] since
    /// the last block.
    fn has_shifted(&self, block: &EstimateBlock) -> bool {
        self.t0_ns.is_some_and(|t0_ns| {
            let shift_s = block.t0_ns.abs_diff(t0_ns) as f64 * 1e-9;
            shift_s * block.sampling_rate_hz > SKIPPED_FRAMES
        })
    }

    /// Processes an acknowledgement of the alerts of one parameter. Returns `false` if there was
    /// nothing to acknowledge.
    pub fn acknowledge(
        &mut self,
        parameter: usize,
        by: &Acknowledged,
        alerts: &mut Vec<Alert>,
    ) -> bool {
        let mut is_taken = false;
        for decision in self
            .decisions
            .iter_mut()
            .filter(|decision| decision.subject().parameter == parameter)
        {
            is_taken |= decision.handle(DecisionInput::Acknowledge(by.clone()), alerts);
        }
        is_taken
    }

    /// Returns the most severe alert of a parameter among its rules. `None` before the first alert.
    pub fn standing(&self, parameter: usize) -> Option<&Alert> {
        let of_parameter = self
            .decisions
            .iter()
            .filter(|decision| decision.subject().parameter == parameter);
        of_parameter
            .filter_map(Decision::last_alert)
            .max_by(|a, b| {
                severity(a.state)
                    .cmp(&severity(b.state))
                    .then(a.rule_loss.total_cmp(&b.rule_loss))
            })
    }

    /// Returns the state of a parameter under its first rule, if no alert has announced one yet.
    ///
    /// Returns `None` without a rule, or before the first estimate that permits a decision.
    pub fn unannounced(&self, parameter: usize) -> Option<Alert> {
        let of_parameter = || {
            self.decisions
                .iter()
                .filter(|decision| decision.subject().parameter == parameter)
        };
        let is_announced = of_parameter().any(|decision| decision.last_alert().is_some());
        of_parameter()
            .next()
            .filter(|_| !is_announced)?
            .unannounced()
    }

    /// Returns the loss of each parameter under its first rule, once the reference is known.
    fn losses(&self) -> impl Iterator<Item = ParameterLoss> {
        let mut seen = vec![false; self.parameter_count];
        self.decisions.iter().filter_map(move |decision| {
            let seen = seen.get_mut(decision.subject().parameter)?;
            let is_first = !std::mem::replace(seen, true);
            is_first.then(|| decision.loss()).flatten()
        })
    }

    /// Returns the number of frames of a parameter with and without a decision since its reference
    /// was known, summed over its rules.
    pub fn decided_frames(&self, parameter: usize) -> DecidedFrames {
        let of_parameter = self
            .decisions
            .iter()
            .filter(|decision| decision.subject().parameter == parameter);
        of_parameter.fold(DecidedFrames::default(), |sum, decision| {
            sum.plus(decision.decided_frames())
        })
    }

    /// Returns the share of frames of a parameter with a decision since its reference was known, 0
    /// to 1.
    ///
    /// Returns `None` before the first such frame, and without a rule.
    pub fn decided_share(&self, parameter: usize) -> Option<f64> {
        self.decided_frames(parameter).share()
    }

    /// Returns the frame counts of each watched parameter, by its index.
    pub fn decided_shares(&self) -> BTreeMap<usize, DecidedFrames> {
        let watched = self
            .decisions
            .iter()
            .map(|decision| decision.subject().parameter);
        watched
            .map(|parameter| (parameter, self.decided_frames(parameter)))
            .collect()
    }

    /// Returns the number of decisions that are undecided now, by reason.
    pub fn undecided(&self) -> BTreeMap<UndecidedBecause, u64> {
        let mut counts = BTreeMap::new();
        for because in self
            .decisions
            .iter()
            .filter_map(Decision::undecided_because)
        {
            *counts.entry(because).or_default() += 1;
        }
        counts
    }

    /// Returns whether a change of a parameter would be noticed at present, under the rule for
    /// which the least would. `None` without a rule, or before the first estimate.
    pub(crate) fn vigilance(&self, parameter: usize) -> Option<Vigilance> {
        let decisions = self.decisions.iter();
        decisions
            .filter(|decision| decision.subject().parameter == parameter)
            .filter_map(Decision::vigilance)
            .max()
    }

    /// Returns the number of parameters of the structure.
    pub fn parameter_count(&self) -> usize {
        self.parameter_count
    }

    /// Returns the position of the first estimate that has not been processed. `None` before the
    /// first.
    pub fn position(&self) -> Option<Position> {
        self.expected
    }

    /// Returns the decisions, by rule and parameter in the order of the structure file.
    pub fn decisions(&self) -> &[Decision] {
        &self.decisions
    }

    fn handle_estimate(&mut self, time_ns: i64, estimate: &Estimate, alerts: &mut Vec<Alert>) {
        if estimate.flags.restarted {
            self.handle_all(&DecisionInput::Restart, alerts);
        }
        let flags = match self.is_contradicted_by_modes {
            true => contradicted_by_modes(estimate.flags),
            false => estimate.flags,
        };
        for decision in &mut self.decisions {
            let index = decision.subject().parameter;
            let (Some(mean), Some(variance)) = (estimate.mean.get(index), estimate.variance(index))
            else {
                continue; // a checked block contains every parameter
            };
            let std = variance.max(0.0).sqrt();
            let of_parameter = ParameterEstimate {
                time_ns,
                mean: *mean,
                std,
            };
            let information = estimate.sustained_information.get(index);
            decision.set_sustained_std(
                information.map(|information| f64::from(*information).sqrt().recip()),
            );
            let of_parameter =
                decision.with_missing_sensor(of_parameter, estimate.excluded, &flags);
            decision.handle(DecisionInput::Estimate(of_parameter, flags), alerts);
        }
    }

    fn handle_all(&mut self, input: &DecisionInput, alerts: &mut Vec<Alert>) {
        for decision in &mut self.decisions {
            decision.handle(input.clone(), alerts);
        }
    }
}

/// Returns the flags of an estimate whose model measured modes contradict.
fn contradicted_by_modes(flags: EstimateFlags) -> EstimateFlags {
    EstimateFlags {
        fit: Some(FitVerdict::Contradicted),
        fit_reasons: flags.fit_reasons.with(FitReason::NaturalFrequencies),
        ..flags
    }
}

/// Returns the severity of a state, higher if it requires more attention.
fn severity(state: AlertState) -> u8 {
    match state {
        AlertState::Normal => 0,
        AlertState::Learning => 1,
        AlertState::Cleared => 2,
        AlertState::Undecided => 3,
        AlertState::SofteningInMotion => 4,
        AlertState::Pending => 5,
        AlertState::Acknowledged => 6,
        AlertState::Unconfirmed => 7,
        AlertState::Raised => 8,
    }
}

/// Creates the decision for the parameter at `position` in the list of a rule.
fn decision_from_structure(
    number: usize,
    rule: &AlertRule,
    position: usize,
    parameters: &[Parameter],
    baseline: Option<&Baseline>,
) -> Result<Decision, AlertError> {
    use spandrel_structure::Reference as Asked;

    let index = rule.parameters.get(position).copied().unwrap_or(usize::MAX);
    let no_such = || AlertError::NoSuchParameter {
        rule: number + 1,
        index,
        count: parameters.len(),
    };
    let parameter = parameters.get(index).ok_or_else(no_such)?;
    let own = Rule::new(
        rule.loss,
        rule.credibility,
        rule.clear_credibility,
        rule.sustain_s,
    )?;
    let from_baseline = baseline.and_then(|baseline| baseline.reference(parameter.name()));
    let own = match (&rule.reference, from_baseline) {
        (Asked::Baseline { .. }, Some(reference)) => own.with_reference(reference),
        (Asked::Baseline { learn_s }, None) => own.with_learnt_reference(*learn_s)?,
        (Asked::Given { mean, std }, _) => {
            let (mean, std) = mean
                .get(position)
                .zip(std.get(position))
                .ok_or_else(no_such)?;
            own.with_reference(Reference::new(*mean, *std)?)
        }
    };
    let quantity = if parameter.is_stiffness() {
        "stiffness"
    } else {
        "nominal value"
    };
    let subject = Subject {
        parameter: index,
        name: parameter.name().to_owned(),
        quantity: quantity.to_owned(),
        prior_std: parameter.std(),
        bounds: parameter.bounds(),
    };
    Ok(Decision::new(number, own, subject))
}

/// Returns the change of a parameter without each channel of the response, if it is known.
fn changes_without(
    structure: &Structure,
    baseline: Option<&Baseline>,
    parameter: usize,
) -> Vec<Option<f64>> {
    let names: Vec<&str> = structure.channels().map(|channel| channel.name()).collect();
    let rows = structure.observation_channels().iter();
    let parameter = structure.parameters().get(parameter);
    let change =
        |channel: &usize| baseline?.change_without(names.get(*channel)?, parameter?.name());
    rows.map(change).collect()
}

/// Adds the name of the parameter to an error of its rule.
fn in_parameter(parameters: &[Parameter], index: usize, source: AlertError) -> AlertError {
    match parameters.get(index) {
        Some(parameter) => AlertError::Parameter {
            parameter: parameter.name().to_owned(),
            source: Box::new(source),
        },
        None => source,
    }
}

#[cfg(test)]
mod tests;
