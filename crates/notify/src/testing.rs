//! Messages of the structure `house` for tests.

use crate::content::{Circumstances, Content, Report};
use crate::origin::Origin;
use crate::settings::Delays;
use spandrel_bus::{
    AlertMessage, AlertState, ChannelMonitoring, CredibleInterval, FitReasons, Maintenance,
    MonitoringDisplay, MonitoringState, Name,
};
use std::time::Duration;

pub(crate) fn name(text: &str) -> Name {
    Name::new(text).unwrap()
}

pub(crate) fn s(seconds: u64) -> Duration {
    Duration::from_secs(seconds)
}

pub(crate) fn delays() -> Delays {
    Delays {
        blind: s(60),
        degraded: s(900),
        watching: s(60),
    }
}

pub(crate) fn alert(seconds: i64, state: AlertState) -> AlertMessage {
    AlertMessage {
        structure: name("house"),
        parameter: name("storey-2"),
        time_ns: seconds * 1_000_000_000,
        state,
        since_ns: Some(15_000_000_000),
        rule_loss: 0.05,
        rule_credibility: 0.99,
        credibility: 0.997,
        loss: Some(0.124),
        loss_interval: Some(CredibleInterval {
            level: 0.99,
            low: 0.09,
            high: 0.15,
        }),
        loss_interval_within_record: None,
        mean: 0.876,
        std: 0.0123,
        reference: Some(1.0),
        reference_std: Some(0.0),
        acknowledged_by: None,
        why: "storey-2 has lost 12.4 % of its stiffness".to_owned(),
        fit: None,
        fit_reasons: FitReasons::default(),
        follows_jump: false,
        undecided_because: None,
        revision: 0,
    }
}

pub(crate) fn monitoring(
    seconds: i64,
    state: MonitoringState,
    since_s: i64,
    reasons: &[&str],
) -> MonitoringDisplay {
    MonitoringDisplay {
        structure: name("house"),
        time_ns: seconds * 1_000_000_000,
        measured_ns: Some(seconds * 1_000_000_000),
        state,
        since_ns: since_s * 1_000_000_000,
        reasons: reasons.iter().map(|reason| (*reason).to_owned()).collect(),
        parameters: Vec::new(),
        channels: vec![ChannelMonitoring {
            channel: name("roof"),
            state,
            used_share: 0.33,
        }],
    }
}

pub(crate) fn circumstances() -> Circumstances {
    Circumstances {
        title: "House by the lake".to_owned(),
        place: "Lake Road 4".to_owned(),
        fit: "supported".to_owned(),
        quality: "watching".to_owned(),
        others: vec!["storey-1 pending: it has lost 6 %".to_owned()],
        origin: Origin::Measured,
        advice: "Inspect storey-2.".to_owned(),
        link: "https://site.example/#/structure/house".to_owned(),
        contact: "Ada, +41 44 123 45 67".to_owned(),
        runbook: "https://site.example/alarm".to_owned(),
    }
}

pub(crate) fn content(report: Report) -> Content {
    Content::new(report, circumstances())
}

pub(crate) fn of_alert(alert: &AlertMessage) -> Content {
    content(Report::Alert(alert.clone()))
}

pub(crate) fn maintenance(part: Option<&str>, time_ns: i64, until_ns: i64) -> Maintenance {
    Maintenance {
        structure: name("house"),
        parameter: part.map(name),
        time_ns,
        until_ns,
        who: "ada".to_owned(),
        reason: "new bearings".to_owned(),
    }
}
