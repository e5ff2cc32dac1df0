use super::*;
use crate::store::Input;
use crate::testing::{alert, at, demo, name, parameter};
use spandrel_bus::{Estimate, EstimateBlock, EstimateFlags, Event, Header, Pace, Progress, Status, StreamState};

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

#[test]
fn a_structure_of_which_nothing_ever_comes_needs_attention() {
    let mut store = demo();
    store.handle(at(29.0));
    assert_eq!(overview(&store).level, Level::Learning);
    store.handle(at(31.0));
    let found = overview(&store);
    assert_eq!(found.level, Level::Stale);
    assert!(found.sentence.contains("nothing has been measured"), "{}", found.sentence);
}

#[test]
fn an_alert_that_somebody_has_seen_is_still_told_when_data_stop() {
    let mut store = demo();
    store.handle(at(1.0));
    store.handle(parameter("storey-2", 1, 0.85, 1.0));
    let seen = AlertMessage { acknowledged_by: Some("Ada".into()), ..alert("storey-2", 1, AlertState::Acknowledged) };
    let why = seen.why.clone();
    store.handle(Input::Alert(seen));
    store.handle(at(60.0));
    let found = overview(&store);
    assert_eq!(found.level, Level::Stale);
    assert!(found.sentence.starts_with(&why) && found.sentence.contains("nothing is measured"), "{}", found.sentence);
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
        term: 0,
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

/// How far ingest has come: `time_ns` is that of its last frame.
fn ingested(epoch: u64, time_ns: i64) -> Input {
    let header = Header { source: "ingest".into(), epoch, sequence: 400, time_ns };
    Input::Ingested(Progress { header, done: 400, kept: 400 })
}

#[test]
fn what_is_read_again_from_the_recording_makes_no_sensor_alive_and_no_data_new() {
    let recorded_s = 4.0;
    for is_told_first in [true, false] {
        let mut store = demo();
        let word = || ingested(1, (recorded_s * 1e9) as i64);
        let read_again = |store: &mut Store| {
            store.handle(Input::Estimates(estimates_without_the_third_channel()));
            store.handle(parameter("storey-1", 3_990_000_000, 1.0, 0.001));
        };
        if is_told_first {
            store.handle(word());
            read_again(&mut store);
        } else {
            read_again(&mut store);
            store.handle(word());
        }
        let found = overview(&store);
        assert_eq!((found.sensors.alive, found.age_s), (0, None), "told first: {is_told_first}");
        assert_eq!(found.time_s, Some(3.99), "it is shown all the same, with its time");
        // and the next sample counts
        store.handle(parameter("storey-1", 4_010_000_000, 1.0, 0.001));
        assert_eq!(overview(&store).age_s, Some(0.0));
    }
}

#[test]
fn a_record_that_begins_while_somebody_looks_is_live_whatever_its_dates() {
    let mut store = demo();
    store.handle(ingested(1, 1_700_000_000_000_000_000));
    store.handle(ingested(2, 0));
    store.handle(Input::Estimates(estimates_without_the_third_channel()));
    store.handle(parameter("storey-1", 1, 1.0, 0.001));
    let found = overview(&store);
    assert_eq!((found.sensors.alive, found.age_s), (4, Some(0.0)));
}

#[test]
fn the_sentence_of_an_alert_has_the_present_state_beside_it() {
    let mut store = demo();
    store.handle(parameter("storey-2", 1, 0.85, 1.0));
    store.handle(Input::Alert(alert("storey-2", 1, AlertState::Raised)));
    assert_eq!(overview(&store).now, None, "nothing newer has come");
    store.handle(parameter("storey-2", 2, 0.97, 0.02));
    let found = overview(&store);
    assert_eq!(found.sentence, "storey-2 is raised");
    let now = found.now.unwrap();
    assert!(now.starts_with("loss 3.0 % (estimate 0.970") && now.ends_with("probability 0.023"), "{now}");
}

/// The status of ingest at `time_ns` of the clock on the wall, with samples of a record.
fn replaying(time_ns: i64) -> Input {
    let (structure, ingest) = (name("demo"), name("ingest"));
    Input::Status(Status {
        structure,
        service: ingest.clone(),
        id: ingest,
        time_ns,
        lag_s: Some(1e9),
        pace: Some(Pace::Replayed),
        load: None,
        frames_behind: None,
        state: None,
        done: 1,
        drops: std::collections::BTreeMap::new(),
        restarts: 0,
        version: String::new(),
    })
}

fn identify(lag_s: f64) -> Input {
    let Input::Status(status) = replaying(0) else { panic!("not a status") };
    let service = name("identify");
    Input::Status(Status { service: service.clone(), id: service, lag_s: Some(lag_s), pace: None, ..status })
}

#[test]
fn a_replayed_record_has_the_time_of_its_data_and_no_lag() {
    let clock_ns = 1_795_000_000_000_000_000;
    let lag = |time_ns: i64, word: Option<Input>| {
        let mut store = demo();
        word.into_iter().chain([identify(20.0)]).for_each(|status| store.handle(status));
        store.handle(parameter("storey-1", time_ns, 1.0, 0.001));
        let found = overview(&store);
        (found.lag_s, found.replayed)
    };
    assert_eq!(lag(clock_ns - 20_000_000_000, None), (Some(20.0), false));
    assert_eq!(lag(clock_ns - 20_000_000_000, Some(replaying(clock_ns))), (Some(20.0), false), "a simulation of now");
    assert_eq!(lag(1_600_000_000_000_000_000, Some(replaying(clock_ns))), (None, true), "dates in the past");
    assert_eq!(lag(5_000_000_000, None), (None, true), "no dates");
}

#[test]
fn where_nothing_comes_there_is_no_lag_to_tell() {
    let mut store = demo();
    store.handle(identify(20.0));
    store.handle(parameter("storey-1", 1_795_000_000_000_000_000, 1.0, 0.001));
    store.handle(at(4.0));
    let found = overview(&store);
    assert_eq!((found.lag_s, found.age_s), (None, Some(4.0)));
}
