//! Messages and a store for tests.

use crate::about::About;
use crate::store::Store;
use spandrel_bus::{
    AlertMessage, AlertState, ChangeKind, ChannelMonitoring, ConditionDisplay, CredibleInterval,
    DayExpectation, FitDisplay, FitReason, FitVerdict, JudgementDisplay, JudgementState,
    LastingChange, LossDisplay, ModeDisplay, ModeEstimate, ModeState, MonitoringDisplay,
    MonitoringState, Name, ParameterDisplay, Service, UndecidedBecause,
};
use spandrel_listener::{Input, Instance};
use spandrel_structure::Structure;
use std::path::Path;
use std::time::Duration;

pub(crate) fn name(text: &str) -> Name {
    Name::new(text).unwrap()
}

/// Returns the store of the demo before any message.
pub(crate) fn demo() -> Store {
    let text = include_str!("../../../docs/examples/demo.toml");
    Store::new(About::new(
        &Structure::parse(text, Path::new("demo.toml")).unwrap(),
    ))
}

/// Returns the store of the example without a model, whose mode `sway-1` is judged.
pub(crate) fn sensors_only() -> Store {
    let text = include_str!("../../../docs/examples/modes/sensors-only.toml");
    let structure = Structure::parse(text, Path::new("sensors-only.toml"));
    Store::new(About::new(&structure.unwrap()))
}

/// Returns the store of the demo with a temperature of the air, expected every 10 s, with the
/// judgement of storey 2, and with the mode `bending`.
pub(crate) fn demo_with_air() -> Store {
    let text = include_str!("../../../docs/examples/demo.toml");
    let air = "[[condition]]\nname = \"air\"\nunit = \"degC\"\nrange = [-40, 60]\ninterval-s = 10\n\
         [judge]\n[[judge.quantity]]\nname = \"storey-2\"\nis = \"stiffness\"\n\
         [modal]\n[[modal.mode]]\nname = \"bending\"\nfrequency-hz = 1.25\n";
    let structure = Structure::parse(&format!("{text}\n{air}"), Path::new("demo.toml"));
    Store::new(About::new(&structure.unwrap()))
}

/// Returns a temperature of the air (°C) at `second`.
pub(crate) fn air(second: i64, value: f64) -> ConditionDisplay {
    ConditionDisplay {
        structure: name("demo"),
        name: name("air"),
        time_ns: second * 1_000_000_000,
        value,
        unit: "degC".to_owned(),
        interval_s: Some(10.0),
        instrument: Some("mast".to_owned()),
    }
}

/// Returns a tracked mode after an epoch that ends at `second`.
pub(crate) fn mode(mode: &str, second: i64) -> ModeDisplay {
    ModeDisplay {
        structure: name("demo"),
        mode: name(mode),
        time_ns: second * 1_000_000_000,
        epoch_s: 600.0,
        epochs: 1,
        state: ModeState::Tracked,
        partner: None,
        estimate: Some(ModeEstimate {
            frequency_hz: 1.25,
            frequency_std_hz: 0.01,
            damping: 0.02,
            damping_std: 0.002,
            shape: Vec::new(),
            amplitude: 0.1,
        }),
        presence: 1.0,
        machine: false,
        declared_hz: 1.25,
    }
}

/// Returns the judgement of a quantity that has lost 5 %.
pub(crate) fn lasting_loss(quantity: &str) -> JudgementDisplay {
    let interval = |low, high| CredibleInterval {
        level: 0.95,
        low,
        high,
    };
    JudgementDisplay {
        structure: name("demo"),
        quantity: name(quantity),
        time_ns: 900_000_000_000,
        day_ns: Some(0),
        epoch_ns: Some(450_000_000_000),
        epochs: 1,
        measured: true,
        state: JudgementState::Judged,
        change: Some(LastingChange {
            kind: ChangeKind::LastingLoss,
            found_ns: 0,
            since_ns: 0,
            loss: 0.05,
            interval: interval(0.04, 0.06),
        }),
        seen: None,
        sentence: format!("{quantity} has lost 5.0 % of stiffness (95 % interval 4.0 to 6.0 %)."),
        expectation: Some(DayExpectation {
            measured: 0.95,
            expected: 1.0,
            interval: interval(0.98, 1.02),
            residual: -3.0,
            ln_evidence: 9.0,
            ln_threshold: 8.0,
            cusum_share: 1.2,
        }),
        false_alarms_per_year: 0.1,
        spent: None,
        configuration: None,
    }
}

pub(crate) fn at(seconds: f64) -> Input {
    Input::Now(Duration::from_secs_f64(seconds))
}

/// Passes an estimate of a parameter and its loss to a store.
pub(crate) fn hear(store: &mut Store, of: &str, time_ns: i64, mean: f64, probability: f64) {
    let (structure, parameter) = (name("demo"), name(of));
    store.handle(Input::Parameter(ParameterDisplay::of_normal(
        &structure, &parameter, time_ns, mean, 1e-4,
    )));
    store.handle(Input::Loss(LossDisplay {
        structure,
        parameter,
        time_ns,
        loss: 1.0 - mean,
        interval: CredibleInterval::of_normal(1.0 - mean, 0.01),
        probability_of_loss: probability,
        rule_loss: 0.05,
        rule_credibility: 0.99,
        reference: 1.0,
        reference_std: 0.0,
    }));
}

/// Returns the presence of these services and nodes, and of no others.
pub(crate) fn present(instances: &[(Service, &str)]) -> Input {
    let instance = |(service, id): &(Service, &str)| Instance {
        structure: name("demo"),
        service: *service,
        id: name(id),
    };
    Input::Present(instances.iter().map(instance).collect())
}

pub(crate) fn fit(verdict: FitVerdict, reasons: &[FitReason]) -> Input {
    let reasons = reasons.iter().copied().collect();
    Input::Fit(FitDisplay {
        structure: name("demo"),
        time_ns: 5,
        verdict,
        reasons,
        follows_jump: false,
        channels: vec![],
    })
}

/// Returns a report that the structure is in this state of monitoring, with a reason if it is not
/// watched.
pub(crate) fn monitoring(state: MonitoringState) -> Input {
    let reasons = match state {
        MonitoringState::Watching => vec![],
        _ => vec!["33 % of the samples of floor-2 are used".to_owned()],
    };
    Input::Monitoring(MonitoringDisplay {
        structure: name("demo"),
        time_ns: 5,
        measured_ns: Some(5),
        state,
        since_ns: 5,
        reasons,
        parameters: vec![],
        channels: vec![ChannelMonitoring {
            channel: name("floor-2"),
            state,
            used_share: 0.33,
        }],
    })
}

/// Returns an undecided alert.
pub(crate) fn undecided(of: &str, state: AlertState, because: UndecidedBecause) -> Input {
    Input::Alert(AlertMessage {
        undecided_because: Some(because),
        ..alert(of, 5, state)
    })
}

pub(crate) fn alert(of: &str, time_ns: i64, state: AlertState) -> AlertMessage {
    AlertMessage {
        structure: name("demo"),
        parameter: name(of),
        time_ns,
        state,
        since_ns: None,
        rule_loss: 0.05,
        rule_credibility: 0.99,
        credibility: 1.0,
        loss: Some(0.1),
        loss_interval: None,
        loss_interval_within_record: None,
        mean: 0.9,
        std: 0.01,
        reference: Some(1.0),
        reference_std: Some(0.0),
        acknowledged_by: None,
        why: format!("{of} is {}", state.as_str()),
        fit: None,
        fit_reasons: spandrel_bus::FitReasons::default(),
        follows_jump: false,
        undecided_because: None,
        revision: 0,
    }
}
