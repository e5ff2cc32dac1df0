//! Decisions in the layout of Spandrel 0.1.0, a part of version 2 of the checkpoint of alert.
//!
//! postcard writes fields in order and without names. Each type here therefore has the fields of
//! 0.1.0 in the order of 0.1.0. Types without later changes are used directly. Anyone who changes
//! one of them must add its former layout here.

use serde::Deserialize;
use spandrel_bus::{AlertState, EstimateFlags, FitReasons};

use super::{DecisionInput, Knowledge};
use crate::alert::Acknowledged;
use crate::motion::Motion;
use crate::support::{DecidedFrames, Jump, Support};
use crate::{AlertError, Learning, LossEstimate, ParameterEstimate};

/// [`crate::Decision`] of version 2.
#[derive(Debug, Deserialize)]
pub(crate) struct Decision {
    rule_number: usize,
    rule: Rule,
    subject: Subject,
    stage: Stage,
    knowledge: Knowledge,
    last_estimate: Option<ParameterEstimate>,
    last_alert: Option<Alert>,
}

impl From<Decision> for crate::Decision {
    fn from(former: Decision) -> Self {
        let mut decision = Self {
            rule_number: former.rule_number,
            rule: former.rule.into(),
            subject: former.subject.into(),
            stage: former.stage.into(),
            knowledge: former.knowledge,
            support: Support::default(),
            jump: Jump::default(),
            motion: Motion::default(),
            decided: DecidedFrames::default(),
            last: former
                .last_estimate
                .map(|estimate| (estimate, EstimateFlags::working())),
            last_alert: former.last_alert.map(Into::into),
            sustained_std: None,
            changes_without: Vec::new(),
            left_out: super::left_out::LeftOut::default(),
            strong_m_per_s2: None,
            acknowledged_up_to: None,
            contradicting_modes: None,
        };
        // The filter that made those estimates does not continue. The present filter starts from
        // its prior.
        decision.handle(DecisionInput::NewSource, &mut Vec::new());
        decision
    }
}

/// [`crate::Subject`] of version 2, which did not contain the bounds of the parameter.
#[derive(Debug, Deserialize)]
struct Subject {
    parameter: usize,
    name: String,
    quantity: String,
    prior_std: f64,
}

impl From<Subject> for crate::Subject {
    fn from(
        Subject {
            parameter,
            name,
            quantity,
            prior_std,
        }: Subject,
    ) -> Self {
        Self {
            parameter,
            name,
            quantity,
            prior_std,
            bounds: (f64::NEG_INFINITY, f64::INFINITY),
        }
    }
}

/// [`crate::Rule`] of version 2.
#[derive(Debug, Deserialize)]
struct Rule {
    loss: f64,
    credibility: f64,
    sustain_ns: i64,
    clear_credibility: f64,
    reference: ReferenceRule,
}

impl From<Rule> for crate::Rule {
    fn from(
        Rule {
            loss,
            credibility,
            sustain_ns,
            clear_credibility,
            reference,
        }: Rule,
    ) -> Self {
        let reference = match reference {
            ReferenceRule::Given(Reference(reference)) => crate::ReferenceRule::Given(reference),
            ReferenceRule::Learnt { span_ns } => crate::ReferenceRule::Learnt { span_ns },
        };
        Self {
            loss,
            credibility,
            sustain_ns,
            clear_credibility,
            reference,
        }
    }
}

/// [`crate::ReferenceRule`] of version 2.
#[derive(Debug, Deserialize)]
enum ReferenceRule {
    Given(Reference),
    Learnt { span_ns: i64 },
}

/// [`crate::Reference`] of version 2: mean and standard deviation. 0.1.0 treated the whole
/// deviation as known.
#[derive(Debug, Deserialize)]
#[serde(try_from = "(f64, f64)")]
struct Reference(crate::Reference);

impl TryFrom<(f64, f64)> for Reference {
    type Error = AlertError;

    fn try_from((mean, std): (f64, f64)) -> Result<Self, AlertError> {
        crate::Reference::new(mean, std).map(Self)
    }
}

/// [`super::Stage`] of version 2.
#[derive(Debug, Deserialize)]
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

impl From<Stage> for super::Stage {
    fn from(former: Stage) -> Self {
        match former {
            Stage::Learning {
                started_ns,
                span_ns,
                learning,
            } => Self::Learning {
                started_ns,
                span_ns,
                learning,
            },
            Stage::Watching {
                reference: Reference(reference),
                watch,
            } => Self::Watching {
                reference,
                watch: watch.into(),
            },
        }
    }
}

/// [`super::Watching`] of version 2. Every raised alert counts as confirmed, because 0.1.0 had no
/// undecided state.
#[derive(Debug, Deserialize)]
enum Watching {
    Normal,
    Pending {
        since_ns: i64,
    },
    Raised {
        since_ns: i64,
        acknowledged: Option<Acknowledged>,
        low_since_ns: Option<i64>,
    },
    ClearedUnseen,
    PendingUnseen {
        since_ns: i64,
    },
}

impl From<Watching> for super::Watching {
    fn from(former: Watching) -> Self {
        match former {
            Watching::Normal => Self::Normal,
            Watching::Pending { since_ns } => Self::Pending { since_ns },
            Watching::Raised {
                since_ns,
                acknowledged,
                low_since_ns,
            } => Self::Raised {
                since_ns,
                acknowledged,
                low_since_ns,
                is_confirmed: true,
            },
            Watching::ClearedUnseen => Self::ClearedUnseen,
            Watching::PendingUnseen { since_ns } => Self::PendingUnseen { since_ns },
        }
    }
}

/// [`crate::Alert`] of version 2, which had no verdict on the fit and no revisions.
#[derive(Debug, Deserialize)]
pub(crate) struct Alert {
    rule: usize,
    parameter: usize,
    state: AlertState,
    estimate: ParameterEstimate,
    since_ns: Option<i64>,
    rule_loss: f64,
    rule_credibility: f64,
    probability_of_loss: f64,
    reference: Option<Reference>,
    loss: Option<LossEstimate>,
    acknowledgement: Option<Acknowledged>,
    why: String,
}

impl From<Alert> for crate::Alert {
    fn from(former: Alert) -> Self {
        Self {
            rule: former.rule,
            parameter: former.parameter,
            state: former.state,
            estimate: former.estimate,
            since_ns: former.since_ns,
            rule_loss: former.rule_loss,
            rule_credibility: former.rule_credibility,
            probability_of_loss: former.probability_of_loss,
            reference: former.reference.map(|Reference(reference)| reference),
            loss: former.loss,
            acknowledgement: former.acknowledgement,
            why: former.why,
            fit: None,
            fit_reasons: FitReasons::default(),
            follows_jump: false,
            undecided_because: None,
            revision: 0,
        }
    }
}
