//! Notices with made-up values, for `spandrel notify --test` and for the check of templates.

use crate::clocks::ClockChange;
use crate::content::{Circumstances, Content, Report, Summary};
use crate::origin::Origin;
use spandrel_bus::{
    AlertMessage, AlertState, ChangeKind, ChannelMonitoring, CredibleInterval, FitReason,
    FitReasons, FitVerdict, JudgementDisplay, JudgementState, LastingChange, MonitoringDisplay,
    MonitoringState, Name, NameError,
};

/// Time of the made-up values, ns since the Unix epoch, UTC: 2026-01-01.
const TIME_NS: i64 = 1_767_225_600_000_000_000;

/// Returns one notice of each kind with made-up values, the alert first.
///
/// Returns no notice if `structure` is not a valid name.
pub(crate) fn samples(structure: &str) -> Vec<Content> {
    made_up(structure).unwrap_or_default()
}

fn made_up(structure: &str) -> Result<Vec<Content>, NameError> {
    let structure = Name::new(structure)?;
    let (part, channel) = (Name::new("test-part")?, Name::new("test-channel")?);
    let interval = CredibleInterval {
        level: 0.95,
        low: 0.1,
        high: 0.14,
    };
    let judgement = judgement(&structure, part.clone(), interval);
    let alert = alert(&structure, part, interval);
    let monitoring = monitoring(&structure, channel);
    let clock = ClockChange {
        structure: structure.clone(),
        node: Name::new("test-node")?,
        time_ns: TIME_NS,
        is_wrong: true,
        what: "TEST: the clock of the node is 3600.0 s ahead of most nodes (made up)".to_owned(),
        why: "TEST: 2 of 3 nodes agree on another time (made up)".to_owned(),
    };
    let summary = Summary {
        structure,
        time_ns: TIME_NS,
        cause: "TEST: maintenance by nobody (made up)".to_owned(),
        lines: vec!["TEST: test-part raised (made up)".to_owned()],
    };
    let reports = [
        Report::Alert(alert),
        Report::Monitoring(monitoring),
        Report::Summary(summary),
        Report::Clock(clock),
        Report::Judgement(judgement),
    ];
    let circumstances = Circumstances {
        title: "TEST: title".to_owned(),
        place: "TEST: place".to_owned(),
        fit: "TEST: doubtful".to_owned(),
        quality: "TEST: degraded; samples used in the last 5 s: test-channel 33 %".to_owned(),
        others: vec!["TEST: other-part pending (made up)".to_owned()],
        origin: Origin::Measured,
        advice: "Nothing has happened: this is a test with made-up values.".to_owned(),
        link: String::new(),
        contact: "TEST: nobody".to_owned(),
        runbook: String::new(),
    };
    let content = |report| Content {
        is_test: true,
        ..Content::new(report, circumstances.clone())
    };
    Ok(reports.into_iter().map(content).collect())
}

fn alert(structure: &Name, parameter: Name, interval: CredibleInterval) -> AlertMessage {
    AlertMessage {
        structure: structure.clone(),
        parameter,
        time_ns: TIME_NS,
        state: AlertState::Raised,
        since_ns: Some(TIME_NS - 60_000_000_000),
        rule_loss: 0.05,
        rule_credibility: 0.99,
        credibility: 0.998,
        loss: Some(0.12),
        loss_interval: Some(interval),
        loss_interval_within_record: Some(CredibleInterval {
            level: 0.95,
            low: 0.11,
            high: 0.13,
        }),
        mean: 0.88,
        std: 0.01,
        reference: Some(1.0),
        reference_std: Some(0.01),
        acknowledged_by: None,
        why: "TEST: test-part has lost 12.0 % of its stiffness (made-up values)".to_owned(),
        fit: Some(FitVerdict::Doubtful),
        fit_reasons: [FitReason::ExcessNoise].into_iter().collect::<FitReasons>(),
        follows_jump: false,
        undecided_because: None,
        revision: 0,
    }
}

fn monitoring(structure: &Name, channel: Name) -> MonitoringDisplay {
    MonitoringDisplay {
        structure: structure.clone(),
        time_ns: TIME_NS,
        measured_ns: Some(TIME_NS),
        state: MonitoringState::Degraded,
        since_ns: TIME_NS - 900_000_000_000,
        reasons: vec!["TEST: 33 % of the samples of test-channel are used".to_owned()],
        parameters: Vec::new(),
        channels: vec![ChannelMonitoring {
            channel,
            state: MonitoringState::Degraded,
            used_share: 0.33,
        }],
    }
}

fn judgement(structure: &Name, quantity: Name, interval: CredibleInterval) -> JudgementDisplay {
    JudgementDisplay {
        structure: structure.clone(),
        quantity,
        time_ns: TIME_NS,
        day_ns: Some(TIME_NS),
        epoch_ns: Some(TIME_NS),
        epochs: 40_000,
        measured: true,
        state: JudgementState::Judged,
        change: Some(LastingChange {
            kind: ChangeKind::LastingLoss,
            found_ns: TIME_NS,
            since_ns: TIME_NS,
            loss: 0.12,
            interval,
        }),
        seen: None,
        sentence: "TEST: test-part has lost 12.0 % of stiffness (made-up values).".to_owned(),
        expectation: None,
        false_alarms_per_year: 0.1,
        spent: None,
        configuration: None,
    }
}
