//! Decides whether one parameter has lost the share specified by one rule, without clock or
//! network.
//!
//! ```text
//! learning → normal ⇄ pending → raised → acknowledged
//!              ↑  ↖              ↓            ↓
//!              │   └─────────  cleared    (cleared and)
//!              └──────────────────────────  normal
//! ```
//!
//! Two further states apply while the data support no decision. `undecided` replaces learning,
//! normal and pending. `unconfirmed` replaces raised and acknowledged until the loss is confirmed
//! or cleared. A cleared alert remains cleared, and its message states that nothing is decided.
//!
//! In strong motion, and until the structure has settled, `softening-in-motion` replaces pending
//! and raised. An alert that was raised before neither changes nor clears.
//!
//! A normal state becomes pending when the probability P of the loss reaches the credibility. It
//! becomes raised when P has stayed there for the sustain time. A raised alert is cleared when P
//! has stayed below the clear credibility for the sustain time, which prevents flapping. A cleared
//! alert remains until a person acknowledges it. An alert that was acknowledged before becomes
//! normal at once.

use std::sync::Arc;

use serde::{Deserialize, Serialize};
use spandrel_bus::{
    AlertState, EstimateFlags, Excluded, FitReason, FitVerdict, Phase, UndecidedBecause,
};

use self::left_out::LeftOut;
use crate::{
    Alert, Learning, ParameterEstimate, Reference, Rule,
    alert::Acknowledged,
    credibility::{ParameterLoss, loss_estimate, probability_of_loss},
    motion::Motion,
    rule::ReferenceRule,
    support::{DecidedFrames, Jump, Support, is_on_bound},
};

/// The inputs of a decision.
#[derive(Debug, Clone, PartialEq)]
pub enum DecisionInput {
    /// The estimate of a frame with its flags, in order of time.
    Estimate(ParameterEstimate, EstimateFlags),
    /// Some estimates are missing, so the sustain time starts again.
    Gap,
    /// The source of the estimates has restarted, from a checkpoint or from its prior.
    NewSource,
    /// The filter diverged and has restarted from its prior.
    Restart,
    /// A person has acknowledged the alert.
    Acknowledge(Acknowledged),
}

/// The parameter that a decision watches.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Subject {
    /// Index of the parameter in state order.
    pub parameter: usize,
    /// Name of the parameter.
    pub name: String,
    /// The quantity that the parameter scales, in words, such as `stiffness`.
    pub quantity: String,
    /// Standard deviation of the filter's prior, as a ratio to nominal.
    pub prior_std: f64,
    /// Lower and upper bound of the parameter in the filter, as ratios to nominal.
    pub bounds: (f64, f64),
}

/// The state machine that decides about one parameter under one rule.
///
/// [`Decision::handle`] takes estimates and acknowledgements in order of time, and appends an
/// [`Alert`] for each change of state. The decision has no clock: all durations are in measurement
/// time.
///
/// With a learnt reference, the decision first learns for the span of the rule. It decides nothing
/// in this time. It also decides nothing while the data do not support a decision, and states why
/// in [`Decision::undecided_because`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Decision {
    rule_number: usize,
    rule: Rule,
    subject: Subject,
    stage: Stage,
    knowledge: Knowledge,
    support: Support,
    jump: Jump,
    motion: Motion,
    decided: DecidedFrames,
    last: Option<(ParameterEstimate, EstimateFlags)>,
    last_alert: Option<Alert>,
    /// Standard deviation that the present learning rate sustains. Each estimate sets it.
    #[serde(skip)]
    sustained_std: Option<f64>,
    /// Standard deviation by which the estimate changes if a channel is left out, per observation
    /// row, as a ratio to nominal. Empty if it is unknown. The structure file and the baseline set
    /// it.
    #[serde(skip)]
    changes_without: Vec<Option<f64>>,
    /// Reference while a sensor is left out. It is learnt again after a restart.
    #[serde(skip)]
    left_out: LeftOut,
    /// Acceleration above which motion is strong, m/s². `None` if the structure file does not state
    /// it: strong motion is then judged like any other.
    #[serde(skip)]
    strong_m_per_s2: Option<f64>,
    /// Upper end of the interval of the loss that a person has acknowledged. The first estimate
    /// after the acknowledgement, or after a restart, sets it.
    #[serde(skip)]
    acknowledged_up_to: Option<f64>,
    /// Measured modes that contradict the model, in words. The comparison sets it.
    #[serde(skip)]
    contradicting_modes: Option<Arc<str>>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
enum Stage {
    Learning {
        started_ns: Option<i64>,
        span_ns: i64,
        learning: Learning,
    },
    Watching {
        reference: Reference,
        watch: Watching,
    },
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
enum Watching {
    Normal,
    Pending {
        since_ns: i64,
    },
    Raised {
        since_ns: i64,
        acknowledged: Option<Acknowledged>,
        low_since_ns: Option<i64>,
        /// Whether the loss has been found again since the last interval without decisions.
        is_confirmed: bool,
    },
    ClearedUnseen,
    /// The alert was cleared without acknowledgement, and the loss is credible again.
    PendingUnseen {
        since_ns: i64,
    },
}

/// Whether the estimate comes from measurements or from the prior.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
enum Knowledge {
    Measured,
    /// The filter has restarted, and its estimate is still close to its prior.
    Prior,
}

/// Share of the prior's standard deviation below which an estimate counts as measured.
const MEASURED_SHARE_OF_PRIOR: f64 = 0.5;

/// Ratio of the sustained standard deviation to the largest one that reveals twice the loss of the
/// rule. Above it, the parameter is blind.
///
/// The learning rate follows the vibration. A calm with a quarter of the amplitude has four times
/// the standard deviation, and is not blindness.
const BLIND_FROM: f64 = 4.0;

/// Standard deviation of the change of an estimate if a sensor is left out, as a share of the
/// estimate. It applies until a baseline or a reference without the sensor is known.
const USUAL_CHANGE_WITHOUT: f64 = 0.15;

/// Whether a change of a parameter would be noticed at present, and if not, why. The least vigilant
/// is the largest.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Vigilance {
    /// The present data reveal twice the loss of the rule.
    Watching,
    /// The data reveal it only after more time than usual.
    LearnsLittle,
    /// The reference is being learnt, so that there are no decisions yet.
    LearnsReference,
    /// Nothing is decided.
    Undecided(UndecidedBecause),
    /// The present data reveal no change of the parameter, so that decisions depend on earlier
    /// data.
    LearnsNothing,
}

impl Decision {
    /// Creates the decision on `subject` by the rule with index `rule_number` in the structure
    /// file, from 0.
    pub fn new(rule_number: usize, rule: Rule, subject: Subject) -> Self {
        let stage = match rule.reference() {
            ReferenceRule::Given(reference) => Stage::Watching {
                reference,
                watch: Watching::Normal,
            },
            ReferenceRule::Learnt { span_ns } => Stage::Learning {
                started_ns: None,
                span_ns,
                learning: Learning::new(),
            },
        };
        Self {
            rule_number,
            rule,
            subject,
            stage,
            knowledge: Knowledge::Measured,
            support: Support::default(),
            jump: Jump::default(),
            motion: Motion::default(),
            decided: DecidedFrames::default(),
            last: None,
            last_alert: None,
            acknowledged_up_to: None,
            sustained_std: None,
            changes_without: Vec::new(),
            left_out: LeftOut::default(),
            strong_m_per_s2: None,
            contradicting_modes: None,
        }
    }

    /// Removes what a checkpoint does not contain.
    pub(crate) fn forget_unstored(&mut self) {
        self.sustained_std = None;
        self.changes_without.clear();
        self.left_out = LeftOut::default();
        self.strong_m_per_s2 = None;
        self.contradicting_modes = None;
    }

    /// Sets the change of the estimate if a channel is left out, per observation row. `None` if it
    /// is unknown.
    #[must_use]
    pub(crate) fn with_changes_without(mut self, changes: Vec<Option<f64>>) -> Self {
        self.changes_without = changes;
        self
    }

    /// Sets the acceleration above which motion is strong, m/s². `None` if it is not stated.
    #[must_use]
    pub(crate) fn with_strong_motion(mut self, limit_m_per_s2: Option<f64>) -> Self {
        self.strong_m_per_s2 = limit_m_per_s2;
        self
    }

    /// Processes one input and appends an alert for each change of state.
    ///
    /// Returns `false` for an acknowledgement if there is nothing to acknowledge.
    pub fn handle(&mut self, input: DecisionInput, alerts: &mut Vec<Alert>) -> bool {
        match input {
            DecisionInput::Estimate(estimate, flags) => {
                self.handle_estimate(estimate, flags, alerts)
            }
            DecisionInput::Gap => self.interrupt(),
            DecisionInput::NewSource => {
                self.interrupt();
                self.knowledge = Knowledge::Prior;
            }
            DecisionInput::Restart => {
                self.interrupt();
                self.restart();
            }
            DecisionInput::Acknowledge(acknowledged) => {
                return self.acknowledge(acknowledged, alerts);
            }
        }
        true
    }

    /// Returns the last alert. `None` before the first change.
    pub fn last_alert(&self) -> Option<&Alert> {
        self.last_alert.as_ref()
    }

    /// Returns the current state if no alert has announced one yet.
    ///
    /// Returns `None` before the first estimate that permits a decision.
    pub fn unannounced(&self) -> Option<Alert> {
        self.alert(self.state())
            .filter(|_| self.last_alert.is_none() && self.support.decides())
    }

    /// Returns the loss at the last estimate. `None` before the first estimate and while the
    /// reference is being learnt.
    pub fn loss(&self) -> Option<ParameterLoss> {
        let reference = self.reference()?;
        let (estimate, _) = self.last.as_ref()?;
        Some(ParameterLoss {
            parameter: self.subject.parameter,
            time_ns: estimate.time_ns,
            loss: loss_estimate(estimate, &reference),
            probability: probability_of_loss(estimate, &reference, self.rule.loss()),
            rule_loss: self.rule.loss(),
            rule_credibility: self.rule.credibility(),
            reference,
        })
    }

    /// Returns the reference of the sensors in use. `None` while it is being learnt.
    fn reference(&self) -> Option<Reference> {
        match &self.stage {
            Stage::Learning { .. } => None,
            Stage::Watching { reference, .. } => self.left_out.reference().or(Some(*reference)),
        }
    }

    /// Returns the watched parameter.
    pub fn subject(&self) -> &Subject {
        &self.subject
    }

    /// Returns the rule.
    pub fn rule(&self) -> &Rule {
        &self.rule
    }

    /// Returns the reason why no decision is possible. `None` while alerts are decided.
    pub fn undecided_because(&self) -> Option<UndecidedBecause> {
        let of_reference = || {
            self.lacks_reference()
                .then_some(UndecidedBecause::NothingLearnt)
        };
        self.support.undecided_because().or_else(of_reference)
    }

    /// Returns `true` if a span is over, and its estimates were too uncertain for a reference.
    fn lacks_reference(&self) -> bool {
        matches!(self.stage, Stage::Learning { .. }) && self.decided.frames() > 0
    }

    /// Returns the number of frames with and without a decision since the reference was known, or
    /// should have been.
    pub fn decided_frames(&self) -> &DecidedFrames {
        &self.decided
    }

    fn handle_estimate(
        &mut self,
        estimate: ParameterEstimate,
        flags: EstimateFlags,
        alerts: &mut Vec<Alert>,
    ) {
        let before_ns = self.last.map_or(estimate.time_ns, |(last, _)| last.time_ns);
        self.last = Some((estimate, flags));
        if self.is_measured(&estimate) {
            self.knowledge = Knowledge::Measured;
        }
        self.jump.take(&flags, estimate.time_ns);
        let strong = self.strong_m_per_s2.and(flags.strong_motion);
        let has_calmed = self.motion.take(strong, estimate.time_ns);
        let hindrance = self.hindrance(&estimate, &flags);
        let was_undecided = self.support.undecided_because().is_some();
        self.support.take(hindrance, estimate.time_ns);
        if !was_undecided && self.support.undecided_because().is_some() {
            self.suspend();
        }
        let decides = self.support.decides();
        let is_unsettled = self.motion.is_unsettled();
        if self.lacks_reference() {
            self.decided.count(hindrance.or(self.undecided_because()));
        }
        let without_sensor = self.left_out.reference();
        match &mut self.stage {
            // A reference is learnt from weak motion, as a loss is raised from it.
            Stage::Learning { .. } if decides && !is_unsettled => self.learn(estimate, alerts),
            Stage::Learning { started_ns, .. } => {
                // Skipped frames do not count towards the learning span.
                let skipped_ns = estimate.time_ns.saturating_sub(before_ns).max(0);
                *started_ns = started_ns.map(|start_ns| start_ns.saturating_add(skipped_ns));
                self.announce_change(alerts);
                self.revise_undecided(alerts);
            }
            Stage::Watching { reference, watch } => {
                let reference = without_sensor.as_ref().unwrap_or(reference);
                let undecided = hindrance.or(self.support.undecided_because());
                self.decided.count(undecided);
                if decides {
                    let probability = probability_of_loss(&estimate, reference, self.rule.loss());
                    if is_unsettled {
                        self.soften(&estimate, probability);
                        self.announce_change(alerts);
                        self.revise_softening(has_calmed, alerts);
                        return;
                    }
                    let watch = watch.clone();
                    let next = self.next(watch, probability, flags.fit, estimate.time_ns);
                    self.enter(next, alerts);
                    self.revise(alerts);
                } else {
                    self.announce_change(alerts);
                    self.revise_undecided(alerts);
                }
            }
        }
    }

    /// Returns the estimate with the uncertainty of a model that fewer sensors test.
    ///
    /// The error of a model moves the estimate as soon as a sensor is left out. The reference was
    /// learnt with all sensors. If no baseline has measured the change, a reference without the
    /// sensor is learnt, and nothing is added from then on: see [`left_out`].
    pub(crate) fn with_missing_sensor(
        &mut self,
        estimate: ParameterEstimate,
        excluded: Excluded,
        flags: &EstimateFlags,
    ) -> ParameterEstimate {
        self.left_out.enter(excluded);
        let change = match excluded {
            Excluded::None => return estimate,
            Excluded::One(row) => self
                .changes_without
                .get(usize::from(row))
                .copied()
                .flatten(),
            Excluded::Several => None,
        };
        if change.is_none() {
            self.learn_without_sensor(&estimate, flags);
            if self.left_out.reference().is_some() {
                return estimate;
            }
        }
        let change = change.unwrap_or(USUAL_CHANGE_WITHOUT * estimate.mean);
        ParameterEstimate {
            std: estimate.std.hypot(change),
            ..estimate
        }
    }

    /// Adds an estimate to the reference without a sensor, if the estimate could also raise an
    /// alert.
    ///
    /// A rule with a given reference states no span of estimates.
    fn learn_without_sensor(&mut self, estimate: &ParameterEstimate, flags: &EstimateFlags) {
        let ReferenceRule::Learnt { span_ns } = self.rule.reference() else {
            return;
        };
        let is_usable = flags.phase == Phase::Working
            && flags.fit != Some(FitVerdict::Contradicted)
            && !flags.restarted
            && !self.jump.holds(flags.fit, estimate.time_ns)
            && !self.motion.is_unsettled()
            && !is_on_bound(estimate, self.subject.bounds)
            && self.is_measured(estimate);
        let Stage::Watching {
            reference,
            watch: Watching::Normal,
        } = &self.stage
        else {
            return self.left_out.interrupt();
        };
        if !is_usable {
            return self.left_out.interrupt();
        }
        let (support, rule) = (&self.support, &self.rule);
        // A larger change may be a loss, or the model says nothing without the sensor.
        let allowed = 1.0 - rule.loss()..=1.0 + 2.0 * USUAL_CHANGE_WITHOUT;
        self.left_out.learn(estimate, span_ns, |found| {
            allowed.contains(&(found.mean() / reference.mean()))
                && (support.shows_losses(estimate, found, rule)
                    || support.excludes_losses(estimate, found, rule))
        });
    }

    /// Sets the standard deviation that the present learning rate sustains, for the next estimate.
    /// `None` if it is not measured.
    pub(crate) fn set_sustained_std(&mut self, std: Option<f64>) {
        self.sustained_std = std;
    }

    /// Sets the measured modes that contradict the model, in words. `None` if none does.
    pub(crate) fn set_contradicting_modes(&mut self, modes: Option<Arc<str>>) {
        self.contradicting_modes = modes;
    }

    /// Returns `true` if measured modes contradicted the model at the last estimate.
    pub(crate) fn was_contradicted_by_modes(&self) -> bool {
        let last = self.last.as_ref();
        last.is_some_and(|(_, flags)| flags.fit_reasons.contains(FitReason::NaturalFrequencies))
    }

    /// Returns whether a change of the parameter would be noticed at present. `None` before the
    /// first estimate.
    pub(crate) fn vigilance(&self) -> Option<Vigilance> {
        let (estimate, _) = self.last.as_ref()?;
        let because = self.undecided_because();
        let Some(reference) = self.reference() else {
            return Some(because.map_or(Vigilance::LearnsReference, Vigilance::Undecided));
        };
        let shows = |std: f64| {
            let of_std = ParameterEstimate { std, ..*estimate };
            self.support.shows_losses(&of_std, &reference, &self.rule)
        };
        let learns = |factor: f64| self.sustained_std.is_none_or(|std| shows(std / factor));
        Some(match because {
            Some(because) => Vigilance::Undecided(because),
            None if !learns(BLIND_FROM) => Vigilance::LearnsNothing,
            None if !learns(1.0) => Vigilance::LearnsLittle,
            None => Vigilance::Watching,
        })
    }

    /// Returns the most fundamental reason that prevents a decision on a frame, or `None`.
    fn hindrance(
        &self,
        estimate: &ParameterEstimate,
        flags: &EstimateFlags,
    ) -> Option<UndecidedBecause> {
        match flags.phase {
            Phase::Training => return Some(UndecidedBecause::NoiseTraining),
            Phase::ExcitationSilent => return Some(UndecidedBecause::ExcitationSilent),
            Phase::SensorInDoubt => return Some(UndecidedBecause::SensorInDoubt),
            Phase::ResponseSilent => return Some(UndecidedBecause::NothingLearnt),
            Phase::Working => {}
        }
        if flags.fit == Some(FitVerdict::Contradicted) {
            return Some(UndecidedBecause::FitContradicted);
        }
        if is_on_bound(estimate, self.subject.bounds) {
            return Some(UndecidedBecause::ParameterAtBound);
        }
        let Some(reference) = self.reference() else {
            return None; // the visibility of a loss depends on the reference
        };
        (!self.is_learnt(estimate, &reference)).then_some(UndecidedBecause::NothingLearnt)
    }

    /// Returns `true` if an estimate and a reference are certain enough for a decision.
    ///
    /// An uncertain estimate can still satisfy or exclude the rule, but it must come from data. A
    /// narrow prior excludes losses without any data. An estimate that depends on an unmeasured
    /// excitation is never much narrower than its prior.
    fn is_learnt(&self, estimate: &ParameterEstimate, reference: &Reference) -> bool {
        let answers = || {
            let is_credible = probability_of_loss(estimate, reference, self.rule.loss())
                >= self.rule.credibility();
            is_credible
                || self
                    .support
                    .excludes_losses(estimate, reference, &self.rule)
        };
        self.knowledge == Knowledge::Measured
            && (self.support.shows_losses(estimate, reference, &self.rule)
                || (self.is_measured(estimate) && answers()))
    }

    fn is_measured(&self, estimate: &ParameterEstimate) -> bool {
        estimate.std < MEASURED_SHARE_OF_PRIOR * self.subject.prior_std
    }

    /// Takes an estimate in strong motion, or before the structure has settled. Only softening in
    /// motion can begin or end.
    fn soften(&mut self, estimate: &ParameterEstimate, probability: f64) {
        self.interrupt();
        // As for a raised alert, a lower probability ends the state than begins it.
        let required = match self.motion.softening_since_ns() {
            None => self.rule.credibility(),
            Some(_) => self.rule.clear_credibility(),
        };
        self.motion.soften(estimate, probability >= required);
    }

    /// Stops decisions: the sustain time starts again, and a raised alert needs confirmation.
    fn suspend(&mut self) {
        self.interrupt();
        self.motion.suspend();
        if let Stage::Watching {
            watch: Watching::Raised { is_confirmed, .. },
            ..
        } = &mut self.stage
        {
            *is_confirmed = false;
        }
    }

    /// Adds an estimate to the reference. Watching starts when the span is over.
    ///
    /// A reference of uncertain estimates would permit no decision, however certain later estimates
    /// are. Such a span is repeated.
    fn learn(&mut self, estimate: ParameterEstimate, alerts: &mut Vec<Alert>) {
        let Stage::Learning {
            started_ns,
            span_ns,
            learning,
        } = &mut self.stage
        else {
            return;
        };
        let start_ns = *started_ns.get_or_insert(estimate.time_ns);
        if estimate.time_ns < start_ns {
            // The source has restarted at an earlier time, for example because a record is replayed
            // twice.
            (*started_ns, *learning) = (Some(estimate.time_ns), Learning::new());
        }
        let is_over = estimate.time_ns.saturating_sub(start_ns) >= *span_ns;
        learning.add(estimate.mean, estimate.std);
        let Some(span) = learning.summary().filter(|_| is_over) else {
            self.announce_change(alerts);
            self.revise_undecided(alerts);
            return;
        };
        let reference = Reference::new(span.mean, span.variance().sqrt()).ok();
        match reference.filter(|reference| self.is_learnt(&estimate, reference)) {
            Some(reference) => {
                self.stage = Stage::Watching {
                    reference,
                    watch: Watching::Normal,
                };
                self.announce(alerts);
            }
            None => {
                self.repeat_learning(estimate.time_ns);
                self.announce_change(alerts);
            }
        }
    }

    /// Discards the span that is over, and counts it as undecided.
    fn repeat_learning(&mut self, time_ns: i64) {
        if let Stage::Learning {
            started_ns,
            learning,
            ..
        } = &mut self.stage
        {
            (*started_ns, *learning) = (Some(time_ns), Learning::new());
        }
        if !self.lacks_reference() {
            self.decided.count(Some(UndecidedBecause::NothingLearnt));
        }
    }

    /// Returns the state after an estimate with this probability of the loss.
    fn next(
        &self,
        watch: Watching,
        probability: f64,
        fit: Option<FitVerdict>,
        time_ns: i64,
    ) -> Watching {
        let is_credible = probability >= self.rule.credibility();
        let is_sustained =
            |since_ns: i64| time_ns.saturating_sub(since_ns) >= self.rule.sustain_ns();
        // A sudden change must not raise alerts of other parameters.
        let is_held = self.jump.holds(fit, time_ns);
        let rise = |since_ns: i64, otherwise: Watching| match is_sustained(since_ns) && !is_held {
            true => Watching::Raised {
                since_ns,
                acknowledged: None,
                low_since_ns: None,
                is_confirmed: true,
            },
            false => otherwise,
        };
        match watch {
            Watching::Normal if is_credible => {
                rise(time_ns, Watching::Pending { since_ns: time_ns })
            }
            Watching::Pending { since_ns } if is_credible => {
                rise(since_ns, Watching::Pending { since_ns })
            }
            Watching::Normal | Watching::Pending { .. } => Watching::Normal,
            Watching::ClearedUnseen if is_credible => {
                rise(time_ns, Watching::PendingUnseen { since_ns: time_ns })
            }
            Watching::PendingUnseen { since_ns } if is_credible => {
                rise(since_ns, Watching::PendingUnseen { since_ns })
            }
            Watching::ClearedUnseen | Watching::PendingUnseen { .. } => Watching::ClearedUnseen,
            Watching::Raised {
                since_ns,
                acknowledged,
                low_since_ns,
                is_confirmed,
            } => {
                // The prior of a restarted filter contains no information about the structure, so
                // it clears no alert.
                let is_low = probability < self.rule.clear_credibility()
                    && self.knowledge == Knowledge::Measured;
                let low_since_ns = is_low.then(|| low_since_ns.unwrap_or(time_ns));
                match low_since_ns.filter(|since_ns| is_sustained(*since_ns)) {
                    Some(_) if acknowledged.is_some() => Watching::Normal,
                    Some(_) => Watching::ClearedUnseen,
                    None => Watching::Raised {
                        since_ns,
                        acknowledged,
                        low_since_ns,
                        is_confirmed: is_confirmed || !is_low,
                    },
                }
            }
        }
    }

    /// Enters a state and announces any change.
    fn enter(&mut self, next: Watching, alerts: &mut Vec<Alert>) {
        if let Stage::Watching { watch, .. } = &mut self.stage {
            *watch = next;
        }
        self.announce_change(alerts);
    }

    /// Announces the state if it, its start, its reason or its acknowledgement has changed.
    fn announce_change(&mut self, alerts: &mut Vec<Alert>) {
        let state = self.state();
        let last = self.last_alert.as_ref();
        let told = last.map_or((AlertState::Normal, None, None, None), |last| {
            (
                last.state,
                last.since_ns,
                last.undecided_because,
                last.acknowledgement.as_ref(),
            )
        });
        if told
            == (
                state,
                self.since_ns(),
                self.undecided_because(),
                self.acknowledgement(),
            )
        {
            return;
        }
        let was_seen = told.0 == AlertState::Acknowledged
            || (told.0 == AlertState::Unconfirmed && told.3.is_some());
        if was_seen && state == AlertState::Normal {
            alerts.extend(self.alert(AlertState::Cleared));
        }
        self.announce(alerts);
    }

    /// Restarts the sustain time. A raised alert remains raised.
    fn interrupt(&mut self) {
        if let Stage::Watching { watch, .. } = &mut self.stage {
            match watch {
                Watching::Pending { .. } => *watch = Watching::Normal,
                Watching::PendingUnseen { .. } => *watch = Watching::ClearedUnseen,
                Watching::Raised { low_since_ns, .. } => *low_since_ns = None,
                Watching::Normal | Watching::ClearedUnseen => {}
            }
        }
    }

    fn restart(&mut self) {
        self.knowledge = Knowledge::Prior;
        if let Stage::Learning {
            started_ns,
            learning,
            ..
        } = &mut self.stage
        {
            // The filter diverged, so its earlier estimates are not a valid reference.
            (*started_ns, *learning) = (None, Learning::new());
        }
    }

    fn acknowledge(&mut self, by: Acknowledged, alerts: &mut Vec<Alert>) -> bool {
        let Stage::Watching { watch, .. } = &mut self.stage else {
            return false;
        };
        let next = match watch {
            Watching::Raised {
                since_ns,
                acknowledged: None,
                low_since_ns,
                is_confirmed,
            } => Watching::Raised {
                since_ns: *since_ns,
                acknowledged: Some(by),
                low_since_ns: *low_since_ns,
                is_confirmed: *is_confirmed,
            },
            Watching::ClearedUnseen => Watching::Normal,
            Watching::PendingUnseen { since_ns } => Watching::Pending {
                since_ns: *since_ns,
            },
            Watching::Normal | Watching::Pending { .. } | Watching::Raised { .. } => return false,
        };
        self.acknowledged_up_to = None;
        self.enter(next, alerts);
        true
    }

    /// Makes an acknowledged alert a raised one, because its loss has grown since.
    fn forget_acknowledgement(&mut self, alerts: &mut Vec<Alert>) {
        self.acknowledged_up_to = None;
        if let Stage::Watching {
            watch: Watching::Raised { acknowledged, .. },
            ..
        } = &mut self.stage
        {
            *acknowledged = None;
        }
        self.announce_change(alerts);
    }

    fn state(&self) -> AlertState {
        let is_undecided = self.undecided_because().is_some();
        match &self.stage {
            Stage::Learning { .. } if is_undecided => AlertState::Undecided,
            Stage::Learning { .. } => AlertState::Learning,
            Stage::Watching { watch, .. } => match watch {
                Watching::Raised { is_confirmed, .. } if is_undecided || !is_confirmed => {
                    AlertState::Unconfirmed
                }
                Watching::Raised {
                    acknowledged: None, ..
                } => AlertState::Raised,
                Watching::Raised {
                    acknowledged: Some(_),
                    ..
                } => AlertState::Acknowledged,
                Watching::ClearedUnseen => AlertState::Cleared,
                Watching::Normal | Watching::Pending { .. } | Watching::PendingUnseen { .. }
                    if is_undecided =>
                {
                    AlertState::Undecided
                }
                Watching::Normal if self.motion.softening_since_ns().is_some() => {
                    AlertState::SofteningInMotion
                }
                Watching::Normal => AlertState::Normal,
                Watching::Pending { .. } | Watching::PendingUnseen { .. } => AlertState::Pending,
            },
        }
    }

    fn acknowledgement(&self) -> Option<&Acknowledged> {
        match &self.stage {
            Stage::Watching {
                watch: Watching::Raised { acknowledged, .. },
                ..
            } => acknowledged.as_ref(),
            Stage::Learning { .. } | Stage::Watching { .. } => None,
        }
    }

    /// Returns the time since which the loss has been credible, ns.
    fn since_ns(&self) -> Option<i64> {
        match &self.stage {
            Stage::Learning { .. } => None,
            Stage::Watching { watch, .. } => match watch {
                Watching::Pending { since_ns }
                | Watching::PendingUnseen { since_ns }
                | Watching::Raised { since_ns, .. } => Some(*since_ns),
                Watching::Normal => self.motion.softening_since_ns(),
                Watching::ClearedUnseen => None,
            },
        }
    }
}

mod announcement;
mod left_out;
mod succession;
pub(crate) mod version_2;
pub(crate) mod version_4;

pub use succession::Model;

#[cfg(test)]
mod tests;
