//! Decisions in version 4 of the checkpoint of alert, which knew no strong motion.
//!
//! As in [`version_2`](super::version_2), each type has the former fields in their order.

use serde::Deserialize;
use spandrel_bus::{FitReasons, FitVerdict, Phase};

use super::{Knowledge, Stage};
use crate::motion::Motion;
use crate::support::{DecidedFrames, Jump, Support};
use crate::{Alert, ParameterEstimate, Rule, Subject};

/// [`crate::Decision`] of version 4.
#[derive(Debug, Deserialize)]
pub(crate) struct Decision {
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

impl From<Decision> for crate::Decision {
    fn from(former: Decision) -> Self {
        Self {
            rule_number: former.rule_number,
            rule: former.rule,
            subject: former.subject,
            stage: former.stage,
            knowledge: former.knowledge,
            support: former.support,
            jump: former.jump,
            motion: Motion::default(),
            decided: former.decided,
            last: former.last.map(|(last, flags)| (last, flags.into())),
            last_alert: former.last_alert,
            sustained_std: None,
            changes_without: Vec::new(),
            left_out: super::left_out::LeftOut::default(),
            strong_m_per_s2: None,
            acknowledged_up_to: None,
            contradicting_modes: None,
        }
    }
}

/// [`spandrel_bus::EstimateFlags`] of version 4.
#[derive(Debug, Deserialize)]
struct EstimateFlags {
    phase: Phase,
    restarted: bool,
    prediction_only: bool,
    fit: Option<FitVerdict>,
    fit_reasons: FitReasons,
    follows_jump: bool,
}

impl From<EstimateFlags> for spandrel_bus::EstimateFlags {
    fn from(former: EstimateFlags) -> Self {
        Self {
            phase: former.phase,
            restarted: former.restarted,
            prediction_only: former.prediction_only,
            fit: former.fit,
            fit_reasons: former.fit_reasons,
            follows_jump: former.follows_jump,
            strong_motion: None,
        }
    }
}
