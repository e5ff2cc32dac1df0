use super::*;
use crate::store::Input;
use crate::testing::{alert, at, demo, name, parameter};
use spandrel_bus::{Estimate, EstimateBlock, EstimateFlags, Event, Header, StreamState};

fn raised_among_others() -> Store {
    let mut store = demo();
    store.handle(parameter("storey-1", 1, 1.0, 0.001));
    store.handle(parameter("storey-2", 1, 0.85, 1.0));
    store.handle(parameter("storey-3", 1, 0.94, 1.0));
    store.handle(Input::Alert(alert("storey-1", 1, AlertState::Normal)));
    store.handle(Input::Alert(AlertMessage { loss: Some(0.06), ..alert("storey-3", 2, AlertState::Raised) }));
    store.handle(Input::Alert(AlertMessage { loss: Some(0.15), ..alert("storey-2", 1, AlertState::Raised) }));
    store
}

#[test]
fn the_largest_loss_that_is_raised_is_told_first() {
    let found = overview(&raised_among_others());
    assert_eq!((found.level, found.raised), (Level::Alarm, 2));
    assert_eq!(found.sentence, "storey-2 is raised; one more alert is raised");
    assert_eq!(found.worst.unwrap().parameter, "storey-2");
}

#[test]
fn a_silence_is_told_but_does_not_hide_an_alarm() {
    let mut store = raised_among_others();
    store.handle(at(60.0));
    let found = overview(&store);
    assert_eq!((found.level, found.age_s), (Level::Alarm, Some(60.0)));
    for of in ["storey-2", "storey-3"] {
        let seen = AlertMessage { acknowledged_by: Some("Ada".into()), ..alert(of, 3, AlertState::Acknowledged) };
        store.handle(Input::Alert(seen));
    }
    assert_eq!(overview(&store).level, Level::Stale);
    store.handle(parameter("storey-1", 4, 1.0, 0.001));
    let found = overview(&store);
    assert_eq!(found.level, Level::Notice);
    assert_eq!(found.sentence, "storey-2 is acknowledged");
}

#[test]
fn a_sensor_that_is_told_to_be_faulty_makes_a_warning_until_it_is_back() {
    let mut store = demo();
    store.handle(parameter("storey-1", 1, 1.0, 0.001));
    store.handle(Input::Alert(alert("storey-1", 1, AlertState::Normal)));
    let normal = overview(&store);
    assert_eq!((normal.level, normal.sensors.total), (Level::Normal, 6));
    let event = |kind| Event {
        structure: name("demo"),
        time_ns: 1,
        kind,
        subject: "floor-3".into(),
        what: "the sensor is faulty".into(),
        why: "test".into(),
    };
    store.handle(Input::Event(event(spandrel_bus::EventKind::ChannelExcluded)));
    let warned = overview(&store);
    assert_eq!((warned.level, warned.sensors.troubled), (Level::Warning, vec!["floor-3".to_owned()]));
    store.handle(Input::Event(event(spandrel_bus::EventKind::ChannelBack)));
    assert_eq!(overview(&store).level, Level::Normal);
}

#[test]
fn a_node_that_leaves_alone_is_gone_and_all_together_have_ended() {
    let nodes = |names: &[&str]| Input::Present(names.iter().map(|node| (Service::Sensor, name(node))).collect());
    let mut store = demo();
    store.handle(nodes(&["ground", "floor-1", "floor-2"]));
    assert_eq!(overview(&store).sensors.alive, 3);
    store.handle(nodes(&["ground", "floor-1"]));
    assert_eq!(overview(&store).sensors.troubled, ["floor-2"]);
    store.handle(nodes(&[]));
    assert!(overview(&store).sensors.troubled.is_empty());
}

#[test]
fn a_service_that_has_gone_is_missed() {
    let mut store = demo();
    store.handle(Input::Present([(Service::Alert, name("alert"))].into()));
    store.handle(Input::Present([].into()));
    let found = overview(&store);
    assert_eq!((found.level, found.sentence.as_str()), (Level::Warning, "the service alert is gone"));
}

#[test]
fn alerts_that_stand_while_nothing_is_measured_are_how_it_was() {
    let mut store = demo();
    store.handle(Input::StandingAlert(alert("storey-2", 1, AlertState::Acknowledged)));
    assert_eq!(overview(&store).level, Level::Notice);
    store.handle(at(4.0));
    assert_eq!(overview(&store).level, Level::Stale);
}

#[test]
fn before_anything_was_heard_nothing_is_claimed() {
    let found = overview(&demo());
    assert_eq!((found.level, found.worst, found.age_s), (Level::Learning, None, None));
}

/// Four seconds of estimates, in which the third channel could never be used.
fn estimates_without_the_third_channel() -> EstimateBlock {
    let estimate = Estimate {
        mean: vec![],
        covariance: vec![],
        noise_mean: vec![],
        noise_covariance: vec![],
        innovations: vec![0.1, 0.1, f64::NAN, 0.1, 0.1],
        normalised_innovation_squared: 4.0,
        log_evidence: 0.0,
        used_channels: 4,
        flags: EstimateFlags { phase: Phase::Working, restarted: false, prediction_only: false },
    };
    EstimateBlock {
        header: Header { source: "identify".into(), epoch: 1, sequence: 0, time_ns: 0 },
        t0_ns: 0,
        sampling_rate_hz: 100.0,
        parameters: 0,
        noise_parameters: 0,
        channels: 5,
        estimates: vec![estimate; 400],
        state: StreamState::Running,
    }
}

#[test]
fn a_channel_that_is_never_used_is_silent() {
    let mut store = demo();
    store.handle(Input::Estimates(estimates_without_the_third_channel()));
    let found = overview(&store).sensors;
    assert_eq!((found.alive, found.troubled), (4, vec!["floor-3".to_owned()]));
}
