//! Messages of the structure `tower` for tests.

use crate::input::{Input, Instance};
use spandrel_bus::{
    AlertMessage, AlertState, CredibleInterval, FitReasons, Header, LossDisplay, Name,
    ParameterDisplay, Progress, Service, Status,
};
use std::collections::BTreeMap;
use std::time::Duration;

pub(crate) fn name(text: &str) -> Name {
    Name::new(text).unwrap()
}

pub(crate) fn at(second: u64) -> Input {
    Input::Now(Duration::from_secs(second))
}

pub(crate) fn parameter(parameter: &str, time_ns: i64) -> ParameterDisplay {
    ParameterDisplay::of_normal(&name("tower"), &name(parameter), time_ns, 1.0, 0.1)
}

pub(crate) fn loss(parameter: &str, time_ns: i64) -> LossDisplay {
    LossDisplay {
        structure: name("tower"),
        parameter: name(parameter),
        time_ns,
        loss: 0.0,
        interval: CredibleInterval::of_normal(0.0, 0.1),
        probability_of_loss: 0.3,
        rule_loss: 0.05,
        rule_credibility: 0.95,
        reference: 1.0,
        reference_std: 0.0,
    }
}

pub(crate) fn alert(parameter: &str, time_ns: i64, state: AlertState) -> AlertMessage {
    AlertMessage {
        structure: name("tower"),
        parameter: name(parameter),
        time_ns,
        state,
        since_ns: None,
        rule_loss: 0.05,
        rule_credibility: 0.95,
        credibility: 0.997,
        loss: Some(0.142),
        loss_interval: None,
        loss_interval_within_record: None,
        mean: 0.858,
        std: 0.011,
        reference: Some(1.0),
        reference_std: Some(0.0),
        acknowledged_by: None,
        fit: None,
        fit_reasons: FitReasons::default(),
        follows_jump: false,
        undecided_because: None,
        revision: 0,
        why: format!("{parameter} is {}", state.as_str()),
    }
}

pub(crate) fn status(service: Service) -> Status {
    Status {
        structure: name("tower"),
        service: name(service.as_str()),
        id: name("a"),
        time_ns: 0,
        lag_s: None,
        pace: None,
        load: None,
        frames_behind: None,
        fit: None,
        undecided: BTreeMap::new(),
        instruments: BTreeMap::new(),
        clocks: BTreeMap::new(),
        missing: BTreeMap::new(),
        maintenance: Vec::new(),
        state: None,
        done: 0,
        drops: BTreeMap::new(),
        restarts: 0,
        version: String::new(),
    }
}

/// Returns the progress of ingest in an epoch up to `time_ns`.
pub(crate) fn ingested(epoch: u64, time_ns: i64) -> Input {
    let header = Header {
        source: "a".to_owned(),
        epoch,
        sequence: 1200,
        time_ns,
    };
    let progress = Progress {
        header,
        done: 1200,
        kept: 1200,
    };
    Input::Ingested(name("tower"), progress)
}

pub(crate) fn present(instances: &[(Service, &str)]) -> Input {
    let instance = |(service, id): &(Service, &str)| Instance {
        structure: name("tower"),
        service: *service,
        id: name(id),
    };
    Input::Present(instances.iter().map(instance).collect())
}
