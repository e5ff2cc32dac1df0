//! Messages for the tests of the view.

use super::heard::Heard;
use spandrel_bus::{
    AlertMessage, AlertState, ChangeKind, ClassPlausibility, ConditionDisplay, CredibleInterval,
    Event, EventKind, Header, JudgementDisplay, JudgementState, LastingChange, LossDisplay,
    ModeDisplay, ModeEstimate, ModeState, ModelClassDisplay, Name, NodeDisplay, NodeHealth,
    NoiseDisplay, Pace, ParameterDisplay, Progress, Service, Status,
};
use spandrel_listener::{Input, Instance};
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

/// Default measurement time of the messages: 2024-02-29 12:00:00 UTC.
pub const TIME_NS: i64 = 1_709_208_000_000_000_000;

pub fn name(text: &str) -> Name {
    Name::new(text).unwrap()
}

/// Returns a parameter of `tower` at `second` after [`TIME_NS`].
pub fn parameter(parameter: &str, second: i64, mean: f64, std: f64) -> ParameterDisplay {
    ParameterDisplay {
        structure: name("tower"),
        parameter: name(parameter),
        time_ns: TIME_NS + second * 1_000_000_000,
        mean,
        std,
        interval: CredibleInterval {
            level: 0.95,
            low: mean - 1.96 * std,
            high: mean + 1.96 * std,
        },
    }
}

/// Returns the loss of a parameter of `tower` at `second` after [`TIME_NS`], against the design.
pub fn loss(parameter: &str, second: i64, mean: f64) -> LossDisplay {
    LossDisplay {
        structure: name("tower"),
        parameter: name(parameter),
        time_ns: TIME_NS + second * 1_000_000_000,
        loss: 1.0 - mean,
        interval: CredibleInterval::of_normal(1.0 - mean, 0.01),
        probability_of_loss: if mean < 0.95 { 0.997 } else { 0.012 },
        rule_loss: 0.05,
        rule_credibility: 0.95,
        reference: 1.0,
        reference_std: 0.0,
    }
}

pub fn noise(noise: &str, mean: f64, std: f64) -> NoiseDisplay {
    NoiseDisplay {
        structure: name("tower"),
        name: name(noise),
        time_ns: TIME_NS,
        mean,
        std,
    }
}

/// Returns the alert of a parameter of `tower`, changed at `second` after [`TIME_NS`].
pub fn alert(parameter: &str, second: i64, state: AlertState) -> AlertMessage {
    AlertMessage {
        structure: name("tower"),
        parameter: name(parameter),
        time_ns: TIME_NS + second * 1_000_000_000,
        state,
        since_ns: None,
        rule_loss: 0.05,
        rule_credibility: 0.95,
        credibility: 0.997,
        loss: Some(0.142),
        loss_interval: Some(CredibleInterval {
            level: 0.95,
            low: 0.121,
            high: 0.163,
        }),
        loss_interval_within_record: None,
        mean: 0.858,
        std: 0.011,
        reference: Some(1.0),
        reference_std: Some(0.0),
        acknowledged_by: None,
        fit: None,
        fit_reasons: spandrel_bus::FitReasons::default(),
        follows_jump: false,
        undecided_because: None,
        revision: 0,
        why: format!(
            "{parameter} has lost 14.2 % of its stiffness (95 % interval 12.1 to 16.3 %), more \
             than 5 % with probability 0.997, since 2024-02-29 12:00:40 UTC"
        ),
    }
}

/// Returns a node of `tower` at `second` after [`TIME_NS`]. It sends 500 bytes per second and
/// receives 100.
pub fn node(node: &str, second: i64, state: NodeHealth) -> NodeDisplay {
    let time_ns = TIME_NS + second * 1_000_000_000;
    NodeDisplay {
        structure: name("tower"),
        node: name(node),
        time_ns,
        state,
        distance: Some(2.1),
        distance_limit: Some(5.4),
        weight: Some(1.0),
        excluded_since_ns: None,
        silent_since_ns: None,
        heard_ns: Some(time_ns),
        excluded_share: 0.0,
        messages: second as u64,
        bytes_received: 500 * second as u64,
        bytes_sent: 100 * second as u64,
        refused: BTreeMap::new(),
        restarts: 0,
    }
}

/// Returns a condition of `tower` in °C that is expected every ten minutes.
pub fn condition(condition: &str, value: f64) -> ConditionDisplay {
    ConditionDisplay {
        structure: name("tower"),
        name: name(condition),
        time_ns: TIME_NS,
        value,
        unit: "degC".to_owned(),
        interval_s: Some(600.0),
        instrument: None,
    }
}

/// Returns the judgement of a quantity of `tower` that has lost 5 %.
pub fn lasting_loss(quantity: &str) -> JudgementDisplay {
    JudgementDisplay {
        structure: name("tower"),
        quantity: name(quantity),
        time_ns: TIME_NS,
        day_ns: Some(0),
        epoch_ns: Some(0),
        epochs: 1,
        measured: true,
        state: JudgementState::Judged,
        change: Some(LastingChange {
            kind: ChangeKind::LastingLoss,
            found_ns: 0,
            since_ns: 0,
            loss: 0.05,
            interval: CredibleInterval {
                level: 0.95,
                low: 0.04,
                high: 0.06,
            },
        }),
        seen: None,
        sentence: format!("{quantity} has lost 5.0 % of stiffness (95 % interval 4.0 to 6.0 %)."),
        expectation: None,
        false_alarms_per_year: 0.1,
        spent: None,
        configuration: None,
    }
}

pub fn event(what: &str, why: &str) -> Event {
    Event {
        structure: name("tower"),
        time_ns: TIME_NS,
        kind: EventKind::NodeExcluded,
        subject: "floor-3".to_owned(),
        what: what.to_owned(),
        why: why.to_owned(),
    }
}

pub fn status(service: Service, lag_s: f64, drops: &[(&str, u64)]) -> Status {
    Status {
        structure: name("tower"),
        service: name(service.as_str()),
        id: name("a"),
        time_ns: TIME_NS,
        lag_s: Some(lag_s),
        pace: (service == Service::Ingest).then_some(Pace::Live),
        load: None,
        frames_behind: None,
        fit: None,
        undecided: BTreeMap::new(),
        instruments: BTreeMap::new(),
        clocks: BTreeMap::new(),
        missing: BTreeMap::new(),
        maintenance: Vec::new(),
        state: None,
        done: 1200,
        drops: drops
            .iter()
            .map(|(reason, count)| ((*reason).to_owned(), *count))
            .collect::<BTreeMap<_, _>>(),
        restarts: 0,
        version: "0.1.0".to_owned(),
    }
}

/// Returns the progress of ingest in an epoch up to `second` after [`TIME_NS`].
pub fn progress(epoch: u64, second: i64) -> Progress {
    let header = Header {
        source: "a".to_owned(),
        epoch,
        sequence: 1200,
        time_ns: TIME_NS + second * 1_000_000_000,
    };
    Progress {
        header,
        done: 1200,
        kept: 1200,
    }
}

/// Returns a class of `tower` that leads and is not yet believed.
pub fn classes(leading: &str, plausibility: f64, calibrations: u64) -> ModelClassDisplay {
    let class = |class: &str, plausibility| ClassPlausibility {
        class: class.to_owned(),
        plausibility,
    };
    ModelClassDisplay {
        structure: name("tower"),
        time_ns: TIME_NS,
        classes: vec![
            class("baseline", 1.0 - plausibility),
            class(leading, plausibility),
        ],
        leading: leading.to_owned(),
        believed: "baseline".to_owned(),
        calibrations,
        calibration: None,
    }
}

pub fn present(instances: &[(Service, &str)]) -> Input {
    let instance = |(service, id): &(Service, &str)| Instance {
        structure: name("tower"),
        service: *service,
        id: name(id),
    };
    Input::Present(instances.iter().map(instance).collect::<BTreeSet<_>>())
}

/// Returns the state after these inputs, received at 0 s.
pub fn heard(inputs: impl IntoIterator<Item = Input>) -> Heard {
    let mut heard = Heard::default();
    for input in inputs {
        heard.handle(input, &mut Vec::new());
    }
    heard
}

pub fn at(second: u64) -> Input {
    Input::Now(Duration::from_secs(second))
}

/// Returns a tower of five storeys with services and events. The second storey has lost stiffness.
pub fn damaged_tower() -> Heard {
    let services = [
        (Service::Ingest, "a"),
        (Service::Identify, "a"),
        (Service::Alert, "a"),
    ];
    let nodes = [
        (Service::Sensor, "ground"),
        (Service::Sensor, "floor-1"),
        (Service::Sensor, "floor-2"),
    ];
    let mut inputs = vec![
        at(0),
        present(&[services.as_slice(), nodes.as_slice()].concat()),
    ];
    for second in 0..60 {
        for storey in 1..=5 {
            let mean = if storey == 2 && second >= 30 {
                0.858
            } else {
                1.002
            };
            let name = format!("storey-{storey}");
            inputs.push(Input::Parameter(parameter(&name, second, mean, 0.011)));
            inputs.push(Input::Loss(loss(&name, second, mean)));
        }
    }
    for storey in [1, 3, 4, 5] {
        inputs.push(Input::Alert(alert(
            &format!("storey-{storey}"),
            0,
            AlertState::Normal,
        )));
    }
    inputs.push(Input::Alert(alert("storey-2", 45, AlertState::Raised)));
    inputs.push(Input::Noise(noise("ground", 0.01, 0.0004)));
    inputs.push(Input::Noise(noise("floors", 2.5e-5, 1e-6)));
    inputs.push(Input::Status(status(Service::Ingest, 0.12, &[])));
    inputs.push(Input::Status(status(
        Service::Identify,
        0.21,
        &[("overwritten", 3)],
    )));
    inputs.push(Input::Status(status(Service::Alert, 0.25, &[])));
    inputs.push(Input::Event(event(
        "floor-3 is no longer waited for",
        "its liveliness token is gone",
    )));
    heard(inputs)
}

/// Returns a tracked mode of `tower`.
pub fn mode(mode: &str, frequency_hz: f64) -> ModeDisplay {
    ModeDisplay {
        structure: name("tower"),
        mode: name(mode),
        time_ns: 600_000_000_000,
        epoch_s: 600.0,
        epochs: 1,
        state: ModeState::Tracked,
        partner: None,
        estimate: Some(ModeEstimate {
            frequency_hz,
            frequency_std_hz: 0.0084,
            damping: 0.0207,
            damping_std: 0.0031,
            shape: Vec::new(),
            amplitude: 0.02,
        }),
        presence: 1.0,
        machine: false,
        declared_hz: 2.92,
    }
}
