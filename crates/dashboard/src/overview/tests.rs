use super::*;
use crate::sensors::SensorHealth;
use crate::testing::{alert, at, demo, fit, hear, monitoring, name, present, undecided};
use spandrel_bus::{
    ChannelHealthDisplay, Estimate, EstimateBlock, EstimateFlags, Event, FaultKind, FitReason,
    Header, NodeClock, Pace, ParameterMonitoring, Progress, SensorHealthDisplay, Soundness, Status,
    StreamState,
};
use spandrel_listener::Input;

fn raised_among_others() -> Store {
    let mut store = demo();
    hear(&mut store, "storey-1", 1, 1.0, 0.001);
    hear(&mut store, "storey-2", 1, 0.85, 1.0);
    hear(&mut store, "storey-3", 1, 0.94, 1.0);
    store.handle(Input::Alert(alert("storey-1", 1, AlertState::Normal)));
    store.handle(Input::Alert(AlertMessage {
        loss: Some(0.06),
        ..alert("storey-3", 2, AlertState::Raised)
    }));
    store.handle(Input::Alert(AlertMessage {
        loss: Some(0.15),
        ..alert("storey-2", 1, AlertState::Raised)
    }));
    store
}

#[test]
fn the_largest_loss_that_is_raised_is_told_first() {
    let found = overview(&raised_among_others());
    assert_eq!((found.level, found.raised), (Level::Alarm, 2));
    assert_eq!(found.sentence, "storey-2 is raised; storey-3 is raised too");
    assert_eq!(found.worst.unwrap().parameter, "storey-2");
}

#[test]
fn a_silence_is_told_but_does_not_hide_an_alarm() {
    let mut store = raised_among_others();
    store.handle(at(60.0));
    let found = overview(&store);
    assert_eq!((found.level, found.age_s), (Level::Alarm, Some(60.0)));
    for of in ["storey-2", "storey-3"] {
        let seen = AlertMessage {
            acknowledged_by: Some("Ada".into()),
            ..alert(of, 3, AlertState::Acknowledged)
        };
        store.handle(Input::Alert(seen));
    }
    let found = overview(&store);
    assert_eq!((found.level, found.acknowledged), (Level::Stale, 2));
    hear(&mut store, "storey-1", 4, 1.0, 0.001);
    let found = overview(&store);
    assert_eq!(found.level, Level::Notice);
    assert_eq!(
        found.sentence,
        "storey-2 is acknowledged; storey-3 is acknowledged too"
    );
}

#[test]
fn only_a_report_that_damage_would_be_noticed_makes_a_structure_normal() {
    let mut store = demo();
    hear(&mut store, "storey-1", 1, 1.0, 0.001);
    store.handle(Input::Alert(alert("storey-1", 1, AlertState::Normal)));
    assert_eq!(overview(&store).level, Level::Undecided);
    store.handle(monitoring(MonitoringState::Watching));
    assert_eq!(overview(&store).level, Level::Normal);
    for state in [MonitoringState::Degraded, MonitoringState::Blind] {
        store.handle(monitoring(state));
        let found = overview(&store);
        assert_eq!(found.level, Level::Warning);
        let sentence = format!(
            "{}: 33 % of the samples of floor-2 are used",
            state.as_str()
        );
        assert_eq!(found.sentence, sentence);
    }
    // The alert service reports once per second.
    store.handle(monitoring(MonitoringState::Watching));
    store.handle(at(10.0));
    hear(&mut store, "storey-1", 2, 1.0, 0.001);
    assert_eq!(overview(&store).level, Level::Undecided);
}

#[test]
fn acknowledged_alert_does_not_hide_a_blind_structure() {
    let mut store = demo();
    hear(&mut store, "storey-1", 1, 1.0, 0.001);
    store.handle(Input::Alert(alert("storey-1", 1, AlertState::Acknowledged)));
    store.handle(Input::Alert(alert("storey-2", 1, AlertState::Normal)));
    store.handle(monitoring(MonitoringState::Watching));
    assert_eq!(overview(&store).level, Level::Notice);
    let Input::Monitoring(mut display) = monitoring(MonitoringState::Blind) else {
        unreachable!()
    };
    display.channels.clear();
    display.parameters = vec![ParameterMonitoring {
        parameter: name("storey-2"),
        state: MonitoringState::Blind,
        why: Some("no samples".into()),
        sustained_std: None,
    }];
    store.handle(Input::Monitoring(display));
    let found = overview(&store);
    assert_eq!(found.level, Level::Warning);
    assert!(
        found.sentence.starts_with("blind: 33 %"),
        "{}",
        found.sentence
    );
    let unwatched: Vec<_> = crate::view::standing_alerts(&store)
        .map(|alert| alert.unwatched.map(|of| of.state))
        .collect();
    // The report on the structure counts for each part.
    assert_eq!(unwatched, [Some(MonitoringState::Blind); 2]);
}

#[test]
fn a_sensor_that_is_told_to_be_faulty_makes_a_warning_until_it_is_back() {
    let mut store = demo();
    hear(&mut store, "storey-1", 1, 1.0, 0.001);
    store.handle(Input::Alert(alert("storey-1", 1, AlertState::Normal)));
    store.handle(monitoring(MonitoringState::Watching));
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
    store.handle(Input::Event(event(EventKind::ChannelExcluded)));
    let warned = overview(&store);
    assert_eq!(
        (warned.level, warned.sensors.troubled),
        (Level::Warning, vec!["floor-3".to_owned()])
    );
    store.handle(Input::Event(event(EventKind::ChannelBack)));
    assert_eq!(overview(&store).level, Level::Normal);
}

#[test]
fn a_node_that_leaves_alone_is_gone_and_all_together_have_ended() {
    let nodes = |names: &[&'static str]| {
        present(
            &names
                .iter()
                .map(|node| (Service::Sensor, *node))
                .collect::<Vec<_>>(),
        )
    };
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
    store.handle(present(&[(Service::Alert, "alert")]));
    store.handle(present(&[]));
    let found = overview(&store);
    assert_eq!(
        (found.level, found.sentence.as_str()),
        (Level::Warning, "the service alert is gone")
    );
}

#[test]
fn alerts_that_stand_while_nothing_is_measured_are_how_it_was() {
    let mut store = demo();
    store.handle(Input::StandingAlert(alert(
        "storey-2",
        1,
        AlertState::Acknowledged,
    )));
    assert_eq!(overview(&store).level, Level::Notice);
    store.handle(at(4.0));
    assert_eq!(overview(&store).level, Level::Stale);
}

#[test]
fn before_anything_was_heard_nothing_is_claimed() {
    let found = overview(&demo());
    assert_eq!(
        (found.level, found.worst, found.age_s),
        (Level::Learning, None, None)
    );
}

#[test]
fn a_structure_of_which_nothing_ever_comes_needs_attention() {
    let mut store = demo();
    let health = |store: &Store| sensor_states(store)[0].health;
    store.handle(at(29.0));
    assert_eq!(overview(&store).level, Level::Learning);
    assert_eq!(health(&store), SensorHealth::Unknown);
    store.handle(at(31.0));
    assert_eq!(health(&store), SensorHealth::NoSample);
    let found = overview(&store);
    assert_eq!(found.level, Level::Stale);
    assert!(
        found
            .sentence
            .contains("no data since the server was started"),
        "{}",
        found.sentence
    );
}

#[test]
fn an_alert_that_somebody_has_seen_is_still_told_when_data_stop() {
    let mut store = demo();
    store.handle(at(1.0));
    hear(&mut store, "storey-2", 1, 0.85, 1.0);
    let seen = AlertMessage {
        acknowledged_by: Some("Ada".into()),
        ..alert("storey-2", 1, AlertState::Acknowledged)
    };
    let why = seen.why.clone();
    store.handle(Input::Alert(seen));
    store.handle(at(60.0));
    let found = overview(&store);
    assert_eq!(found.level, Level::Stale);
    assert!(
        found.sentence.starts_with(&why) && found.sentence.contains("no new data"),
        "{}",
        found.sentence
    );
}

/// Regression test: only "no new data" was shown above the button that acknowledges a
/// cleared alert.
#[test]
fn what_somebody_should_look_at_is_told_when_data_stop() {
    let as_it_was = "no new data; this page shows the last state";
    for state in [AlertState::Cleared, AlertState::Pending] {
        let mut store = demo();
        hear(&mut store, "storey-2", 1, 0.85, 1.0);
        store.handle(Input::Alert(alert("storey-2", 1, state)));
        hear(&mut store, "storey-2", 2, 0.97, 0.02);
        store.handle(at(60.0));
        let found = overview(&store);
        assert_eq!(found.level, Level::Stale);
        assert_eq!(
            found.sentence,
            format!("storey-2 is {}; {as_it_was}", state.as_str())
        );
        assert!(
            found.now.is_some_and(|now| now.starts_with("loss 3 %")),
            "by the last value"
        );
    }
    let mut store = demo();
    store.handle(present(&[(Service::Alert, "alert")]));
    store.handle(present(&[]));
    store.handle(Input::Estimates(
        name("demo"),
        estimates_without_the_third_channel(),
    ));
    hear(&mut store, "storey-2", 1, 0.85, 1.0);
    store.handle(Input::Alert(alert("storey-2", 1, AlertState::Cleared)));
    store.handle(Input::Alert(alert("storey-3", 1, AlertState::Acknowledged)));
    store.handle(at(60.0));
    let all = "not used: floor-3; the estimates use the other sensors; the service alert is gone; \
               storey-2 is cleared; storey-3 is acknowledged; ";
    assert_eq!(overview(&store).sentence, format!("{all}{as_it_was}"));
}

fn health(channel: &str, state: Soundness) -> Input {
    Input::SensorHealth(SensorHealthDisplay {
        structure: name("demo"),
        node: name(channel),
        time_ns: 1,
        channels: vec![ChannelHealthDisplay {
            channel: name(channel),
            state,
            probability: 0.9,
            fault: Some(FaultKind::Gain),
            gain: Some(0.8),
            delay_s: Some(0.0),
            coherence: Some(0.9),
        }],
    })
}

/// The samples of a sensor in doubt are used. The sentence said that they are not.
#[test]
fn sensor_in_doubt_is_not_named_as_unused() {
    let mut store = demo();
    hear(&mut store, "storey-2", 1, 1.0, 0.0);
    store.handle(health("ground", Soundness::InDoubt));
    let found = overview(&store);
    assert_eq!(found.sentence, "probably faulty: ground");
    assert_eq!((found.sensors.alive, found.sensors.doubtful.len()), (1, 1));
    assert_eq!(found.sensors.troubled, ["ground"]);
    store.handle(health("floor-1", Soundness::Faulty));
    let both = "not used: floor-1; the estimates use the other sensors; probably faulty: ground";
    assert_eq!(overview(&store).sentence, both);
}

/// Regression test: the sentence was a list of all sensors, however many.
#[test]
fn sentence_names_four_sensors_and_counts_the_others() {
    let mut store = demo();
    hear(&mut store, "storey-2", 1, 1.0, 0.0);
    let sensors = store.about.drawing.sensors.iter();
    let channels: Vec<String> = sensors.map(|sensor| sensor.channel.clone()).collect();
    for channel in &channels {
        store.handle(health(channel, Soundness::Faulty));
    }
    let found = overview(&store);
    let [ground, a, b, c, d, rest @ ..] = &channels[..] else {
        panic!("too few channels: {channels:?}");
    };
    let named = format!("not used: {a}, {b}, {c}, {d} and {} more; ", rest.len());
    assert!(found.sentence.starts_with(&named), "{}", found.sentence);
    // The filter still uses the sensor on the ground, because nothing replaces it.
    let doubtful = format!("probably faulty: {ground}");
    assert!(found.sentence.ends_with(&doubtful), "{}", found.sentence);
    assert_eq!(found.sensors.troubled, channels);
}

/// Four seconds of estimates in which the third channel was never used.
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
        flags: EstimateFlags::working(),
        excluded: spandrel_bus::Excluded::None,
        sustained_information: Vec::new(),
    };
    EstimateBlock {
        header: Header {
            source: "identify".into(),
            epoch: 1,
            sequence: 0,
            time_ns: 0,
        },
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
    store.handle(Input::Estimates(
        name("demo"),
        estimates_without_the_third_channel(),
    ));
    let found = overview(&store).sensors;
    assert_eq!(
        (found.alive, found.troubled),
        (4, vec!["floor-3".to_owned()])
    );
}

/// Returns the progress of ingest whose last frame has time `time_ns`.
fn ingested(epoch: u64, time_ns: i64) -> Input {
    let header = Header {
        source: "ingest".into(),
        epoch,
        sequence: 400,
        time_ns,
    };
    let progress = Progress {
        header,
        done: 400,
        kept: 400,
    };
    Input::Ingested(name("demo"), progress)
}

#[test]
fn what_is_read_again_from_the_recording_makes_no_sensor_alive_and_no_data_new() {
    let recorded_s = 4.0;
    for is_told_first in [true, false] {
        let mut store = demo();
        let word = || ingested(1, (recorded_s * 1e9) as i64);
        let read_again = |store: &mut Store| {
            store.handle(Input::Estimates(
                name("demo"),
                estimates_without_the_third_channel(),
            ));
            hear(store, "storey-1", 3_990_000_000, 1.0, 0.001);
        };
        if is_told_first {
            store.handle(word());
            read_again(&mut store);
        } else {
            read_again(&mut store);
            store.handle(word());
        }
        let found = overview(&store);
        assert_eq!(
            (found.sensors.alive, found.age_s),
            (0, None),
            "told first: {is_told_first}"
        );
        assert_eq!(
            found.time_s,
            Some(3.99),
            "it is shown all the same, with its time"
        );
        // The next sample counts.
        hear(&mut store, "storey-1", 4_010_000_000, 1.0, 0.001);
        assert_eq!(overview(&store).age_s, Some(0.0));
    }
}

#[test]
fn a_record_that_begins_while_somebody_looks_is_live_whatever_its_dates() {
    let mut store = demo();
    store.handle(ingested(1, 1_700_000_000_000_000_000));
    store.handle(ingested(2, 0));
    store.handle(Input::Estimates(
        name("demo"),
        estimates_without_the_third_channel(),
    ));
    hear(&mut store, "storey-1", 1, 1.0, 0.001);
    let found = overview(&store);
    assert_eq!((found.sensors.alive, found.age_s), (4, Some(0.0)));
}

#[test]
fn the_sentence_of_an_alert_has_the_present_state_beside_it() {
    let mut store = demo();
    hear(&mut store, "storey-2", 1, 0.85, 1.0);
    store.handle(Input::Alert(alert("storey-2", 1, AlertState::Raised)));
    assert_eq!(overview(&store).now, None, "nothing newer has come");
    hear(&mut store, "storey-2", 2, 0.97, 0.02);
    let found = overview(&store);
    assert_eq!(found.sentence, "storey-2 is raised");
    let now = found.now.unwrap();
    assert!(
        now.starts_with("loss 3 % (95 % interval 1 to 5 %)") && now.ends_with("probability 0.020"),
        "{now}"
    );
    let unconfirmed = alert("storey-2", 1, AlertState::Unconfirmed);
    store.handle(Input::Alert(unconfirmed));
    let found = overview(&store);
    assert_eq!(found.sentence, "storey-2 is unconfirmed");
    assert_eq!(found.now, None, "the newest value is no finding");
}

/// Returns the status of a service whose samples have this pace.
///
/// Its clock is at `time_ns`, and its data is 27 s ahead of that clock.
fn status(service: Service, time_ns: i64, pace: Option<Pace>) -> Input {
    Input::Status(Status {
        structure: name("demo"),
        service: name(service.as_str()),
        id: name(service.as_str()),
        time_ns,
        lag_s: Some(-27.0),
        pace,
        load: None,
        frames_behind: None,
        fit: None,
        undecided: std::collections::BTreeMap::new(),
        instruments: std::collections::BTreeMap::new(),
        clocks: std::collections::BTreeMap::new(),
        missing: std::collections::BTreeMap::new(),
        maintenance: Vec::new(),
        state: None,
        done: 1,
        drops: std::collections::BTreeMap::new(),
        restarts: 0,
        version: String::new(),
    })
}

// The page blamed the sound nodes, and counted the node with the wrong clock as alive.
#[test]
fn node_whose_clock_is_an_hour_off_has_a_wrong_clock_and_the_others_are_alive() {
    let mut store = demo();
    let nodes = [
        "ground", "floor-1", "floor-2", "floor-3", "floor-4", "floor-5",
    ];
    store.handle(present(&nodes.map(|node| (Service::Sensor, node))));
    // The clock was ahead and came first, so that a former run was on its time.
    let mut ahead = estimates_without_the_third_channel();
    ahead.t0_ns = 3_600_000_000_000;
    ahead.header.time_ns = ahead.t0_ns;
    for estimate in &mut ahead.estimates {
        estimate.innovations[2] = 0.1;
    }
    store.handle(Input::Estimates(name("demo"), ahead));
    let mut present_run = estimates_without_the_third_channel();
    present_run.header.epoch = 2;
    store.handle(Input::Estimates(name("demo"), present_run));
    let Input::Status(mut of_ingest) = status(Service::Ingest, CLOCK_NS, Some(Pace::Live)) else {
        panic!("a status");
    };
    let clock = NodeClock {
        difference_s: Some(3600.0),
        ..NodeClock::default()
    };
    of_ingest.clocks.insert(name("floor-3"), clock);
    store.handle(Input::Status(of_ingest));
    let expected = |node: &str| match node {
        "floor-3" => (SensorHealth::WrongClock, "0.0"),
        _ => (SensorHealth::Alive, "1.0"),
    };
    let no_refusals = std::collections::BTreeMap::new();
    let text = crate::metrics::metrics(std::iter::once(&store), &no_refusals).unwrap();
    let states = sensor_states(&store);
    assert_eq!(states.len(), nodes.len());
    for state in states {
        let (health, alive) = expected(&state.node);
        assert_eq!(state.health, health, "{}", state.node);
        let channel = &state.channel;
        let start = format!("spandrel_sensor_alive{{structure=\"demo\",channel=\"{channel}\"");
        let line = text.lines().find(|line| line.starts_with(&start)).unwrap();
        assert!(line.ends_with(&format!(" {alive}")), "{line}");
    }
    let found = overview(&store);
    assert_eq!((found.sensors.alive, found.sensors.total), (5, 6));
}

#[test]
fn stated_quality_of_a_clock_is_shown_and_its_sensor_is_alive() {
    let mut store = demo();
    store.handle(present(&[(Service::Sensor, "floor-3")]));
    let Input::Status(mut of_ingest) = status(Service::Ingest, CLOCK_NS, Some(Pace::Live)) else {
        panic!("a status");
    };
    let clock = NodeClock {
        quality_percent: Some(35),
        ..NodeClock::default()
    };
    of_ingest.clocks.insert(name("floor-3"), clock);
    store.handle(Input::Status(of_ingest));
    let states = sensor_states(&store);
    let state = states.iter().find(|state| state.node == "floor-3").unwrap();
    assert_eq!(state.health, SensorHealth::Alive);
    let shown = serde_json::to_value(state).unwrap();
    assert_eq!(shown["clock"]["quality_percent"], 35);
    let no_refusals = std::collections::BTreeMap::new();
    let text = crate::metrics::metrics(std::iter::once(&store), &no_refusals).unwrap();
    let mut lines = text
        .lines()
        .filter(|line| line.starts_with("spandrel_sensor_clock_quality_ratio{"));
    let line = lines.next().unwrap();
    assert!(
        line.contains("node=\"floor-3\"") && line.ends_with(" 0.35"),
        "{line}"
    );
    assert_eq!(lines.next(), None, "other nodes state no quality");
}

/// Regression test: the page said "no new data" after the end of a record.
#[test]
fn the_end_of_a_record_is_told() {
    let found = |pace: Pace, sensors: &[(Service, &str)]| {
        let mut store = demo();
        store.handle(status(Service::Ingest, CLOCK_NS, Some(pace)));
        store.handle(present(&[(Service::Sensor, "floor-1")]));
        hear(&mut store, "storey-1", CLOCK_NS, 1.0, 0.001);
        assert!(!overview(&store).ended, "its data are new");
        store.handle(present(sensors));
        store.handle(at(60.0));
        let found = overview(&store);
        assert_eq!(found.level, Level::Stale);
        (found.ended, found.sentence)
    };
    let ended = "the record has ended; this page shows its last state".to_owned();
    assert_eq!(found(Pace::Replayed, &[]), (true, ended));
    let silent = "no new data; this page shows the last state".to_owned();
    let sensor = [(Service::Sensor, "floor-1")];
    assert_eq!(found(Pace::Replayed, &sensor), (false, silent.clone()));
    assert_eq!(found(Pace::Live, &[]), (false, silent));
}

/// A wall clock time.
const CLOCK_NS: i64 = 1_795_000_000_000_000_000;

/// Regression test: the demo, which runs ahead of the clock, showed a lag of -27 s, and the
/// distributed demo did so permanently.
#[test]
fn what_is_replayed_or_simulated_has_the_time_of_its_data_and_no_lag() {
    let found = |station: Service, time_ns: i64, pace: Option<Pace>| {
        let mut store = demo();
        store.about.distributed = station == Service::Fuse;
        store.handle(status(station, CLOCK_NS, pace));
        if station == Service::Ingest {
            store.handle(status(Service::Identify, CLOCK_NS, None));
        }
        hear(&mut store, "storey-1", time_ns, 1.0, 0.001);
        let found = overview(&store);
        (found.lag_s, found.replayed)
    };
    for station in [Service::Ingest, Service::Fuse] {
        for time_ns in [
            CLOCK_NS + 27_000_000_000,
            CLOCK_NS,
            1_600_000_000_000_000_000,
            5_000_000_000,
        ] {
            assert_eq!(
                found(station, time_ns, Some(Pace::Replayed)),
                (None, true),
                "{station:?} at {time_ns} ns"
            );
        }
        assert_eq!(
            found(station, CLOCK_NS, Some(Pace::Live)),
            (Some(-27.0), false),
            "the clock is wrong"
        );
        assert_eq!(
            found(station, CLOCK_NS, None),
            (None, false),
            "nobody has said yet what the samples are"
        );
    }
}

#[test]
fn a_lag_is_a_metric_of_samples_that_come_as_they_are_measured() {
    for (pace, is_told) in [(Pace::Live, true), (Pace::Replayed, false)] {
        let mut store = demo();
        store.handle(status(Service::Ingest, CLOCK_NS, Some(pace)));
        hear(&mut store, "storey-1", CLOCK_NS, 1.0, 0.001);
        let text =
            crate::metrics::metrics(std::iter::once(&store), &std::collections::BTreeMap::new())
                .unwrap();
        assert_eq!(
            text.contains("spandrel_lag_seconds{"),
            is_told,
            "{pace:?}: {text}"
        );
    }
}

#[test]
fn where_nothing_comes_there_is_no_lag_to_tell() {
    let mut store = demo();
    store.handle(status(Service::Ingest, CLOCK_NS, Some(Pace::Live)));
    store.handle(status(Service::Identify, CLOCK_NS, None));
    hear(&mut store, "storey-1", CLOCK_NS, 1.0, 0.001);
    assert_eq!(overview(&store).lag_s, Some(-27.0));
    store.handle(at(4.0));
    let found = overview(&store);
    assert_eq!((found.lag_s, found.age_s), (None, Some(4.0)));
}

#[test]
fn undecided_alerts_warn_where_something_is_wrong_and_not_where_little_is_learnt() {
    use UndecidedBecause::{
        ExcitationSilent, FitContradicted, NoiseTraining, NothingLearnt, ParameterAtBound,
    };
    for (because, level) in [
        (NothingLearnt, Level::Undecided),
        (NoiseTraining, Level::Undecided),
        (ExcitationSilent, Level::Warning),
        (FitContradicted, Level::Warning),
        (ParameterAtBound, Level::Warning),
    ] {
        let mut store = demo();
        hear(&mut store, "storey-1", 1, 1.0, 0.001);
        store.handle(Input::Alert(alert("storey-1", 1, AlertState::Normal)));
        store.handle(undecided("storey-2", AlertState::Undecided, because));
        let found = overview(&store);
        assert_eq!(
            (found.level, found.sentence.as_str()),
            (level, "storey-2 is undecided"),
            "{because:?}"
        );
        // The worst part has a decision until its own alert is undecided.
        assert!(!found.worst.unwrap().undecided);
        store.handle(undecided("storey-1", AlertState::Undecided, because));
        assert!(overview(&store).worst.unwrap().undecided);
    }
}

#[test]
fn unconfirmed_alert_is_an_alarm_until_somebody_has_seen_it() {
    let mut store = demo();
    hear(&mut store, "storey-1", 1, 1.0, 0.001);
    let because = UndecidedBecause::FitContradicted;
    store.handle(undecided("storey-2", AlertState::Unconfirmed, because));
    let found = overview(&store);
    assert_eq!(
        (found.level, found.raised, found.sentence.as_str()),
        (Level::Alarm, 1, "storey-2 is unconfirmed")
    );
    let seen = AlertMessage {
        acknowledged_by: Some("Ada".into()),
        undecided_because: Some(because),
        ..alert("storey-2", 6, AlertState::Unconfirmed)
    };
    store.handle(Input::Alert(seen));
    let found = overview(&store);
    assert_eq!((found.level, found.raised), (Level::Notice, 0));
}

#[test]
fn contradicted_fit_warns_also_where_no_rule_watches() {
    let mut store = demo();
    hear(&mut store, "storey-1", 1, 1.0, 0.001);
    store.handle(fit(FitVerdict::Contradicted, &[FitReason::ExcessNoise]));
    let found = overview(&store);
    let words =
        "the data contradict the model: the estimated noise is much larger than the stated noise";
    assert_eq!(
        (found.level, found.sentence.as_str(), found.fit),
        (Level::Warning, words, Some(FitVerdict::Contradicted))
    );
    store.handle(fit(FitVerdict::Doubtful, &[FitReason::ExcessNoise]));
    assert_eq!(overview(&store).level, Level::Learning);
}

#[test]
fn softening_in_motion_is_a_notice_and_the_most_urgent_report_of_two_days_is_shown() {
    let mut store = demo();
    hear(&mut store, "storey-2", 1, 0.85, 1.0);
    let soft = alert("storey-2", 1, AlertState::SofteningInMotion);
    store.handle(Input::Alert(soft));
    let found = overview(&store);
    assert_eq!((found.level, found.raised), (Level::Notice, 0));
    assert_eq!(found.sentence, "storey-2 is softening-in-motion");
    let reported = |at_s: i64, report: &str, what: &str| {
        Input::Event(Event {
            structure: name("demo"),
            time_ns: at_s * 1_000_000_000,
            kind: EventKind::EarthquakeReport,
            subject: report.to_owned(),
            what: what.to_owned(),
            why: format!("It shook. Look. /events/demo/{report}.html"),
        })
    };
    assert_eq!(overview(&store).earthquake, None);
    store.handle(reported(1, "first", "earthquake report: inspect"));
    store.handle(reported(1, "second", "earthquake report: inspect first"));
    let shown = overview(&store).earthquake.unwrap();
    assert_eq!((shown.report.as_str(), shown.time_s), ("second", 1.0));
    assert_eq!(
        (shown.urgency.as_str(), shown.result.as_str()),
        ("inspect first", "It shook. Look.")
    );
    assert_eq!(shown.later, None);
    // A weak aftershock does not hide that an inspector is needed.
    store.handle(reported(60, "third", "earthquake report: no action"));
    let shown = overview(&store).earthquake.unwrap();
    assert_eq!(
        (shown.report.as_str(), shown.urgency.as_str()),
        ("second", "inspect first")
    );
    let later = shown.later.unwrap();
    assert_eq!(
        (later.report.as_str(), later.urgency.as_str(), later.time_s),
        ("third", "no action", 60.0)
    );
    let after_ns = (2 * 86_400 + 2) * 1_000_000_000;
    hear(&mut store, "storey-2", after_ns, 0.85, 1.0);
    let shown = overview(&store).earthquake.unwrap();
    assert_eq!((shown.report.as_str(), shown.later), ("third", None));
    let after_ns = (2 * 86_400 + 61) * 1_000_000_000;
    hear(&mut store, "storey-2", after_ns, 0.85, 1.0);
    assert_eq!(overview(&store).earthquake, None);
}

#[test]
fn an_equally_urgent_aftershock_does_not_replace_the_main_shock() {
    let mut store = demo();
    hear(&mut store, "storey-2", 1, 0.85, 1.0);
    for (second, report, peak) in [(1, "main", "5.56"), (2, "after", "0.46")] {
        store.handle(Input::Event(Event {
            structure: name("demo"),
            time_ns: second * 1_000_000_000,
            kind: EventKind::EarthquakeReport,
            subject: report.to_owned(),
            what: "earthquake report: inspect".to_owned(),
            why: format!("It shook. Peak {peak} m/s². /events/demo/{report}.html"),
        }));
    }
    let shown = overview(&store).earthquake.unwrap();
    assert_eq!(shown.report, "main");
    assert_eq!(shown.result, "It shook. Peak 5.56 m/s².");
    assert_eq!(shown.later.unwrap().report, "after");
}

#[test]
fn an_alarm_does_not_hide_a_sensor_that_is_not_used() {
    let mut store = raised_among_others();
    assert_eq!(overview(&store).also, "");
    store.handle(monitoring(MonitoringState::Blind));
    let found = overview(&store);
    assert_eq!(found.level, Level::Alarm);
    assert_eq!(found.also, "blind: 33 % of the samples of floor-2 are used");
}

#[test]
fn routine_changes_are_no_last_alert() {
    let mut store = raised_among_others();
    let because = UndecidedBecause::NoiseTraining;
    store.handle(undecided("storey-1", AlertState::Undecided, because));
    assert_eq!(
        store.changes.front().unwrap().alert.parameter.as_str(),
        "storey-1"
    );
    assert_eq!(overview(&store).last_alert.unwrap().parameter, "storey-2");
}

#[test]
fn estimates_far_behind_the_samples_are_a_warning() {
    for (lag_s, is_late) in [(9.0, false), (100.0, true)] {
        let mut store = demo();
        store.handle(status(Service::Ingest, CLOCK_NS, Some(Pace::Live)));
        let Input::Status(mut late) = status(Service::Identify, CLOCK_NS, None) else {
            unreachable!()
        };
        late.lag_s = Some(lag_s);
        store.handle(Input::Status(late));
        hear(&mut store, "storey-1", CLOCK_NS, 1.0, 0.001);
        let found = overview(&store);
        let sentence = "the estimates are 100 s behind the samples";
        assert_eq!(found.sentence == sentence, is_late, "{}", found.sentence);
        assert_eq!(found.level == Level::Warning, is_late);
    }
}

#[test]
fn a_model_that_natural_frequencies_update_is_a_model() {
    let text = include_str!("../../../../docs/examples/modes/stiffness.toml");
    let path = std::path::Path::new("stiffness.toml");
    let structure = spandrel_structure::Structure::parse(text, path).unwrap();
    let found = overview(&Store::new(crate::about::About::new(&structure)));
    assert!(found.has_model && !found.is_filtered);
}

/// Regression test: the headline was about another part than *Worst part*, and a less probable loss
/// was before a certain one.
#[test]
fn the_headline_and_the_worst_part_are_the_most_severe_loss() {
    for ((probability_a, loss_a), (probability_b, loss_b)) in [
        ((0.91, 0.2), (0.9999, 0.1)),
        // Certain losses differ only in their size.
        ((0.999_99, 0.1), (0.999_1, 0.2)),
    ] {
        let mut store = demo();
        for (of, probability, loss) in [
            ("storey-2", probability_a, loss_a),
            ("storey-3", probability_b, loss_b),
        ] {
            hear(&mut store, of, 1, 1.0 - loss, probability);
            store.handle(Input::Alert(AlertMessage {
                credibility: probability,
                loss: Some(loss),
                ..alert(of, 1, AlertState::Raised)
            }));
        }
        let found = overview(&store);
        assert_eq!(found.part.as_deref(), Some("storey-3"));
        assert_eq!(found.worst.unwrap().parameter, "storey-3");
        assert!(found.sentence.starts_with("storey-3"), "{}", found.sentence);
    }
}

/// Regression test: an alert that somebody handles turned into "No data" when its record ended.
#[test]
fn the_end_of_a_record_does_not_hide_an_acknowledged_alert() {
    let mut store = demo();
    store.handle(status(Service::Ingest, CLOCK_NS, Some(Pace::Replayed)));
    store.handle(present(&[(Service::Sensor, "floor-1")]));
    hear(&mut store, "storey-2", CLOCK_NS, 0.85, 1.0);
    let seen = AlertMessage {
        acknowledged_by: Some("Ada".into()),
        ..alert("storey-2", CLOCK_NS, AlertState::Acknowledged)
    };
    store.handle(Input::Alert(seen));
    store.handle(present(&[]));
    store.handle(at(60.0));
    let found = overview(&store);
    assert_eq!((found.level, found.ended), (Level::Notice, true));
    let told = "storey-2 is acknowledged; the record has ended; this page shows its last state";
    assert_eq!(found.sentence, told);
}
