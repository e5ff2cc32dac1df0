//! Decides when one parameter has lost what one rule asks about; no clock, no network.
//!
//! ```text
//! learning → normal ⇄ pending → raised → acknowledged
//!              ↑  ↖              ↓            ↓
//!              │   └─────────  cleared    (cleared and)
//!              └──────────────────────────  normal
//! ```
//!
//! Beside these, `undecided` stands in the place of learning, normal and pending while the data support no decision, and
//! `unconfirmed` in the place of raised and acknowledged, until the loss is confirmed or cleared. A cleared alert stays
//! cleared, and says that nothing is decided.
//!
//! Normal becomes pending when the probability P of the loss reaches the credibility, and raised when it has stayed there
//! for the sustain time. A raised alert is cleared when P has stayed below the clear credibility for the sustain time: so
//! it does not flap. A cleared alert that nobody has acknowledged waits for it; one that was acknowledged is normal at once.

use serde::{Deserialize, Serialize};
use spandrel_bus::{AlertState, EstimateFlags, FitVerdict, Phase, UndecidedBecause};

use crate::{
    Alert, Learning, ParameterEstimate, Reference, Rule,
    alert::Acknowledged,
    credibility::probability_of_loss,
    rule::ReferenceRule,
    support::{DecidedFrames, Jump, Support, rests_on_bound},
};

/// What a decision reacts to.
#[derive(Debug, Clone, PartialEq)]
pub enum Input {
    /// The estimate of a frame, in order of time, with what was special about the frame.
    Estimate(ParameterEstimate, EstimateFlags),
    /// Estimates are missing: what was sustained is not known to have been.
    Gap,
    /// The source of the estimates has started again, from a checkpoint or from its prior.
    NewSource,
    /// The filter diverged, and was restarted from its prior.
    Restart,
    /// A person has seen the alert.
    Acknowledge(Acknowledged),
}

/// The parameter that a decision watches.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Subject {
    /// Number of the parameter in state order.
    pub parameter: usize,
    /// Its name.
    pub name: String,
    /// What it scales, in words, such as `stiffness`.
    pub quantity: String,
    /// Standard deviation that the filter starts from, ratio to nominal.
    pub prior_std: f64,
    /// Least and largest value that the filter may report, ratios to nominal.
    pub bounds: (f64, f64),
}

/// The state of one parameter against one rule.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Decision {
    rule_number: usize,
    rule: Rule,
    subject: Subject,
    stage: Stage,
    knowledge: Knowledge,
    support: Support,
    jump: Jump,
    decided: DecidedFrames,
    last: Option<(ParameterEstimate, EstimateFlags)>,
    last_alert: Option<Alert>,
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
        /// Since the last stretch without decisions, the loss has been found again.
        is_confirmed: bool,
    },
    ClearedUnseen,
    /// Cleared without being acknowledged, and credible again.
    PendingUnseen {
        since_ns: i64,
    },
}

/// Whether the estimate rests on measurements.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
enum Knowledge {
    Measured,
    /// The filter has restarted from its prior and has not yet gone far from it.
    Prior,
}

/// A filter has measured something once its standard deviation is less than this share of the prior's.
const MEASURED_SHARE_OF_PRIOR: f64 = 0.5;

impl Decision {
    /// Watches `subject` by rule number `rule_number` of the structure file, from 0.
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
            decided: DecidedFrames::default(),
            last: None,
            last_alert: None,
        }
    }

    /// Reacts to one input; appends an alert for each change of state. Tells whether the input had a meaning now: an
    /// acknowledgement of nothing has none.
    pub fn handle(&mut self, input: Input, alerts: &mut Vec<Alert>) -> bool {
        match input {
            Input::Estimate(estimate, flags) => self.handle_estimate(estimate, flags, alerts),
            Input::Gap => self.interrupt(),
            Input::NewSource => {
                self.interrupt();
                self.knowledge = Knowledge::Prior;
            }
            Input::Restart => {
                self.interrupt();
                self.restart();
            }
            Input::Acknowledge(acknowledged) => return self.acknowledge(acknowledged, alerts),
        }
        true
    }

    /// The state; `None` before the first change.
    pub fn last_alert(&self) -> Option<&Alert> {
        self.last_alert.as_ref()
    }

    /// Where the parameter stands at the last estimate, for a decision that has had nothing to announce; `None` before the
    /// first estimate that was decided on.
    pub fn unannounced(&self) -> Option<Alert> {
        self.alert(self.state())
            .filter(|_| self.last_alert.is_none() && self.support.decides())
    }

    /// The parameter watched.
    pub fn subject(&self) -> &Subject {
        &self.subject
    }

    /// The rule by which it is watched.
    pub fn rule(&self) -> &Rule {
        &self.rule
    }

    /// Why nothing is decided now; `None` while alerts are decided.
    pub fn undecided_because(&self) -> Option<UndecidedBecause> {
        self.support.undecided_because()
    }

    /// How many frames were decided on since the reference was known.
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
        let hindrance = self.hindrance(&estimate, &flags);
        let was_undecided = self.support.undecided_because().is_some();
        self.support.take(hindrance, estimate.time_ns);
        if !was_undecided && self.support.undecided_because().is_some() {
            self.suspend();
        }
        let decides = self.support.decides();
        match &mut self.stage {
            Stage::Learning { .. } if decides => self.learn(estimate, alerts),
            Stage::Learning { started_ns, .. } => {
                // what was not learnt from does not count towards the span
                let skipped_ns = estimate.time_ns.saturating_sub(before_ns).max(0);
                *started_ns = started_ns.map(|start_ns| start_ns.saturating_add(skipped_ns));
                self.announce_change(alerts);
            }
            Stage::Watching { reference, watch } => {
                let undecided = hindrance.or(self.support.undecided_because());
                self.decided.count(undecided);
                if decides {
                    let probability = probability_of_loss(&estimate, reference, self.rule.loss());
                    let watch = watch.clone();
                    let next = self.next(watch, probability, flags.fit, estimate.time_ns);
                    self.enter(next, alerts);
                    self.revise(alerts);
                } else {
                    self.announce_change(alerts);
                }
            }
        }
    }

    /// What keeps a frame from being decided on, the most fundamental first.
    fn hindrance(
        &self,
        estimate: &ParameterEstimate,
        flags: &EstimateFlags,
    ) -> Option<UndecidedBecause> {
        match flags.phase {
            Phase::Training => return Some(UndecidedBecause::NoiseTraining),
            Phase::ExcitationSilent => return Some(UndecidedBecause::ExcitationSilent),
            Phase::Working => {}
        }
        if flags.fit == Some(FitVerdict::Contradicted) {
            return Some(UndecidedBecause::FitContradicted);
        }
        if rests_on_bound(estimate, self.subject.bounds) {
            return Some(UndecidedBecause::ParameterAtBound);
        }
        let Stage::Watching { reference, .. } = &self.stage else {
            return None; // whether a loss would show depends on the reference
        };
        let answers = || {
            let is_credible = probability_of_loss(estimate, reference, self.rule.loss())
                >= self.rule.credibility();
            is_credible
                || self
                    .support
                    .excludes_losses(estimate, reference, &self.rule)
        };
        // An uncertain estimate can answer the rule all the same, if it rests on data: a narrow prior excludes losses without
        // any, and an estimate that rests on an unmeasured excitation is never much narrower than its prior.
        let is_learnt = self.knowledge == Knowledge::Measured
            && (self.support.shows_losses(estimate, reference, &self.rule)
                || (self.is_measured(estimate) && answers()));
        (!is_learnt).then_some(UndecidedBecause::NothingLearnt)
    }

    fn is_measured(&self, estimate: &ParameterEstimate) -> bool {
        estimate.std < MEASURED_SHARE_OF_PRIOR * self.subject.prior_std
    }

    /// Nothing is decided from now on: what was sustained starts anew, and what is raised has to be confirmed.
    fn suspend(&mut self) {
        self.interrupt();
        if let Stage::Watching {
            watch: Watching::Raised { is_confirmed, .. },
            ..
        } = &mut self.stage
        {
            *is_confirmed = false;
        }
    }

    /// Adds an estimate to the reference, and starts to watch when the span is over.
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
            // A source that starts again at an earlier time, such as a record replayed twice.
            (*started_ns, *learning) = (Some(estimate.time_ns), Learning::new());
        }
        let is_over = estimate.time_ns.saturating_sub(start_ns) >= *span_ns;
        learning.add(estimate.mean, estimate.std);
        let learnt = learning.summary().filter(|_| is_over);
        // A reference that is too uncertain is learnt on.
        match learnt.and_then(|span| Reference::new(span.mean, span.variance().sqrt()).ok()) {
            Some(reference) => {
                self.stage = Stage::Watching {
                    reference,
                    watch: Watching::Normal,
                };
                self.announce(alerts);
            }
            None => self.announce_change(alerts),
        }
    }

    /// The state after an estimate with this probability of the loss.
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
        let is_held = self.jump.holds(fit, time_ns); // others are not blamed for a sudden change
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
                // The prior of a filter that has just restarted is no news of the structure: it clears no alert.
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

    /// Takes up a state, and announces it if that is a change.
    fn enter(&mut self, next: Watching, alerts: &mut Vec<Alert>) {
        if let Stage::Watching { watch, .. } = &mut self.stage {
            *watch = next;
        }
        self.announce_change(alerts);
    }

    /// Announces the state if people have been told another one, or another time of its start.
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
                self.support.undecided_because(),
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

    /// What was sustained starts anew; what is raised stays raised.
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
            // The filter diverged: what it said before is no reference.
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
        self.enter(next, alerts);
        true
    }

    fn state(&self) -> AlertState {
        let is_undecided = self.support.undecided_because().is_some();
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

    /// Since when the loss has been credible, ns.
    fn since_ns(&self) -> Option<i64> {
        match &self.stage {
            Stage::Learning { .. } => None,
            Stage::Watching { watch, .. } => match watch {
                Watching::Pending { since_ns }
                | Watching::PendingUnseen { since_ns }
                | Watching::Raised { since_ns, .. } => Some(*since_ns),
                Watching::Normal | Watching::ClearedUnseen => None,
            },
        }
    }
}

mod announcement;
mod succession;
pub(crate) mod version_2;

pub use succession::Model;

#[cfg(test)]
mod tests;
