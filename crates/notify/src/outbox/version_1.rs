//! The state of notices in the layout of Spandrel 0.1.0, a part of version 1 of the checkpoint of
//! notify.
//!
//! postcard writes fields in order and without names. Each type here therefore has the fields of
//! 0.1.0 in the order of 0.1.0. Types without later changes are used directly. Anyone who changes
//! one of them must add its former layout here.

use serde::Deserialize;
use spandrel_bus::{AlertState, CredibleInterval, FitReasons, Name};

/// [`super::Remembered`] of version 1, which becomes that of version 2.
#[derive(Debug, Deserialize)]
pub(crate) struct Remembered {
    keys: Vec<String>,
    last: Vec<AlertMessage>,
    waiting: Vec<Undelivered>,
}

impl From<Remembered> for super::version_2::Remembered {
    fn from(former: Remembered) -> Self {
        let last: Vec<spandrel_bus::AlertMessage> =
            former.last.into_iter().map(Into::into).collect();
        Self {
            keys: former.keys,
            // Version 1 sent every alert that it received, so the last one of each parameter is
            // known.
            told: last.clone(),
            last,
            waiting: former.waiting.into_iter().map(Into::into).collect(),
        }
    }
}

/// [`super::Undelivered`] of version 1.
#[derive(Debug, Deserialize)]
struct Undelivered {
    receiver: String,
    alert: AlertMessage,
    age_s: u64,
}

impl From<Undelivered> for super::version_2::Undelivered {
    fn from(
        Undelivered {
            receiver,
            alert,
            age_s,
        }: Undelivered,
    ) -> Self {
        Self {
            receiver,
            alert: alert.into(),
            age_s,
        }
    }
}

/// [`spandrel_bus::AlertMessage`] of version 1, which had no verdict on the fit and no revisions.
#[derive(Debug, Deserialize)]
struct AlertMessage {
    structure: Name,
    parameter: Name,
    time_ns: i64,
    state: AlertState,
    since_ns: Option<i64>,
    rule_loss: f64,
    rule_credibility: f64,
    credibility: f64,
    loss: Option<f64>,
    loss_interval: Option<CredibleInterval>,
    mean: f64,
    std: f64,
    reference: Option<f64>,
    reference_std: Option<f64>,
    acknowledged_by: Option<String>,
    why: String,
}

impl From<AlertMessage> for spandrel_bus::AlertMessage {
    fn from(former: AlertMessage) -> Self {
        Self {
            structure: former.structure,
            parameter: former.parameter,
            time_ns: former.time_ns,
            state: former.state,
            since_ns: former.since_ns,
            rule_loss: former.rule_loss,
            rule_credibility: former.rule_credibility,
            credibility: former.credibility,
            loss: former.loss,
            loss_interval: former.loss_interval,
            loss_interval_within_record: None,
            mean: former.mean,
            std: former.std,
            reference: former.reference,
            reference_std: former.reference_std,
            acknowledged_by: former.acknowledged_by,
            why: former.why,
            fit: None,
            fit_reasons: FitReasons::default(),
            follows_jump: false,
            undecided_because: None,
            revision: 0,
        }
    }
}
