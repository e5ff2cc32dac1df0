use super::*;
use crate::testing::{alert, at, demo, demo_with_air, hear, mode, name};
use spandrel_bus::{ChannelWaveform, SampleLevel};

#[test]
fn names_missing_in_the_structure_file_are_ignored() {
    let mut store = demo();
    hear(&mut store, "storey-99", 0, 1.0, 0.0);
    store.handle(Input::Alert(alert("storey-99", 0, AlertState::Raised)));
    assert!(store.state.parameters.is_empty() && store.state.alerts.is_empty());
    assert_eq!(store.series_names().count(), 0);
}

#[test]
fn initial_normal_state_is_no_change() {
    let mut store = demo();
    store.handle(Input::Alert(alert("storey-1", 0, AlertState::Normal)));
    assert!(store.changes.is_empty());
    store.handle(Input::Alert(alert("storey-1", 1, AlertState::Raised)));
    store.handle(Input::Alert(alert("storey-1", 2, AlertState::Cleared)));
    let states = store.changes.iter().map(|change| change.alert.state);
    let states: Vec<AlertState> = states.collect();
    assert_eq!(states, [AlertState::Cleared, AlertState::Raised]);
}

/// Regression test: an acknowledgement had the time of the data, and that of an earlier alert had
/// the note of the last one.
#[test]
fn an_alert_has_the_note_and_the_time_of_its_own_acknowledgement() {
    let mut store = demo();
    let seen = |who: &str, time_ns: i64| Acknowledgement {
        structure: name("demo"),
        parameter: name("storey-2"),
        time_ns,
        who: who.into(),
        note: format!("{who} at {time_ns}"),
    };
    let acknowledged = |time_ns: i64| AlertMessage {
        acknowledged_by: Some("Ada".into()),
        since_ns: Some(time_ns),
        ..alert("storey-2", time_ns, AlertState::Acknowledged)
    };
    let (first, second) = (acknowledged(1), acknowledged(5));
    store.handle(Input::Acknowledgement(seen("Bob", 800)));
    store.handle(Input::Alert(first.clone()));
    assert_eq!(store.acknowledgement(&first), None);
    store.handle(Input::Acknowledgement(seen("Ada", 900)));
    assert_eq!(store.acknowledgement(&first), Some(&seen("Ada", 900)));
    store.handle(Input::Alert(alert("storey-2", 2, AlertState::Cleared)));
    store.handle(Input::Acknowledgement(seen("Ada", 990)));
    store.handle(Input::Alert(second.clone()));
    assert_eq!(store.acknowledgement(&second), Some(&seen("Ada", 990)));
    assert_eq!(store.acknowledgement(&first), Some(&seen("Ada", 900)));
}

#[test]
fn client_receives_each_point_once_and_many_points_combined() {
    let mut store = demo();
    let mut read = BTreeMap::new();
    (0..1_000).for_each(|time| hear(&mut store, "storey-1", time, 1.0, 0.0));
    let news = store.news(&mut read, 200, |_| true);
    let points: Vec<usize> = news.iter().map(|(_, _, table)| table.len()).collect();
    assert_eq!(points, [200, 200], "the parameter and its loss");
    assert!(store.news(&mut read, 200, |_| true).is_empty());
    hear(&mut store, "storey-1", 1_000, 1.0, 0.0);
    assert_eq!(store.news(&mut read, 200, |_| true)[0].2.len(), 1);
}

/// A message of the channel `floor-1` and of a channel that the structure file lacks.
fn waveform(second: i64) -> Input {
    let channel = |channel: &str| ChannelWaveform {
        channel: name(channel),
        missing: 10,
        level: Some(SampleLevel {
            mean: 0.0,
            rms: 0.5,
            last: 0.25,
        }),
        extremes: [vec![Some([-1.0, 1.0]); 9], vec![None]].concat(),
    };
    Input::Waveform(WaveformDisplay {
        structure: name("demo"),
        node: name("floor-1"),
        time_ns: second * 1_000_000_000,
        frames: 100,
        bucket_s: 0.1,
        channels: vec![channel("floor-1"), channel("floor-99")],
    })
}

#[test]
fn buckets_without_samples_are_gaps() {
    let mut store = demo();
    store.handle(waveform(3));
    let names: Vec<String> = store.series_names().map(ToString::to_string).collect();
    assert_eq!(names, ["waveform/floor-1"]);
    let name = SeriesName::new(Kind::Waveform, "floor-1");
    let table = store.series(&name).unwrap().span(0, i64::MAX, 100);
    let times: Vec<i64> = table.times_ns().collect();
    assert_eq!(times[..2], [3_050_000_000, 3_150_000_000]);
    let largest: Vec<f64> = table.column(1).collect();
    assert_eq!(largest[..9], [1.0; 9]);
    assert!(largest[9].is_nan());
    assert_eq!(store.levels.of("floor-1").unwrap().last, 0.25);
}

#[test]
fn only_a_reader_that_wants_waveforms_receives_them() {
    let mut store = demo();
    let mut read = BTreeMap::new();
    (0..60).for_each(|second| store.handle(waveform(second)));
    let unwanted = store.news(&mut read, 200, |kind| kind != Kind::Waveform);
    assert!(unwanted.is_empty());
    // The last points again, because the reader may have fetched the past just before them.
    let wanted = store.news(&mut read, 200, |_| true);
    assert_eq!((wanted.len(), wanted[0].2.len()), (1, OVERLAP as usize));
    assert!(store.news(&mut read, 200, |_| true).is_empty());
}

/// The service repeats its last message every few seconds.
#[test]
fn a_repeated_mode_is_one_point() {
    let mut store = demo_with_air();
    for second in [600, 600, 1200, 1200, 1200] {
        store.handle(Input::Mode(Box::new(mode("bending", second))));
    }
    store.handle(Input::Mode(Box::new(mode("torsion", 600))));
    let points = store.news(&mut BTreeMap::new(), 200, |_| true);
    let names: Vec<String> = points.iter().map(|(name, ..)| name.to_string()).collect();
    assert_eq!(names, ["mode/bending"]);
    let times: Vec<i64> = points[0].2.times_ns().collect();
    assert_eq!(times, [600_000_000_000, 1_200_000_000_000]);
}

#[test]
fn lists_are_bounded() {
    let mut store = demo();
    for time_ns in 0..2_000 {
        let state = if time_ns % 2 == 0 {
            AlertState::Raised
        } else {
            AlertState::Cleared
        };
        store.handle(Input::Alert(alert("storey-1", time_ns, state)));
        store.handle(Input::Event(Event {
            structure: name("demo"),
            time_ns,
            kind: EventKind::Gap,
            subject: "identify".into(),
            what: "1 frame is lost".into(),
            why: "test".into(),
        }));
    }
    assert_eq!(
        (store.changes.len(), store.events.len()),
        (CHANGES_KEPT, EVENTS_KEPT)
    );
    assert_eq!(store.events[0].time_ns, 1_999);
}

#[test]
fn data_are_stale_after_three_seconds_without_a_value() {
    let mut store = demo();
    store.handle(at(10.0));
    assert!(!store.is_stale(), "nothing has come yet");
    hear(&mut store, "storey-1", 0, 1.0, 0.0);
    store.handle(at(12.9));
    assert!(!store.is_stale());
    store.handle(at(13.1));
    assert!(store.is_stale());
}

#[test]
fn revisions_are_one_change_with_the_newest_loss() {
    let revised = |time_ns, revision, loss| AlertMessage {
        revision,
        loss: Some(loss),
        ..alert("storey-2", time_ns, AlertState::Raised)
    };
    let mut store = demo();
    store.handle(Input::Alert(revised(1, 0, 0.1)));
    store.handle(Input::Alert(alert("storey-1", 2, AlertState::Raised)));
    store.handle(Input::Alert(revised(3, 1, 0.2)));
    store.handle(Input::Alert(revised(5, 2, 0.3)));
    // Past changes from the history do not count as news.
    let alerts = vec![revised(1, 0, 0.1), revised(3, 1, 0.2)];
    let past = HistoryLog {
        structure: name("demo"),
        alerts,
        acknowledgements: vec![],
        events: vec![],
    };
    store.handle(Input::Past(past));
    let changes: Vec<_> = store
        .changes
        .iter()
        .map(|change| (change.alert.parameter.as_str(), change.alert.loss))
        .collect();
    assert_eq!(changes.len(), 2);
    assert_eq!(changes[1], ("storey-2", Some(0.3)));
    assert_eq!(store.state.alerts["storey-2"].revision, 2);
}

/// Regression test: each revision moved the time at which an alert was raised, and its mark in the
/// plots. The order in which a restarted dashboard receives the messages must not matter.
#[test]
fn revisions_do_not_move_the_time_of_a_change() {
    let revised = |time_ns, revision| AlertMessage {
        revision,
        ..alert("storey-2", time_ns, AlertState::Raised)
    };
    let past = |alerts| {
        Input::Past(HistoryLog {
            structure: name("demo"),
            alerts,
            acknowledgements: vec![],
            events: vec![],
        })
    };
    let of = |inputs: Vec<Input>| {
        let mut store = demo();
        inputs.into_iter().for_each(|input| store.handle(input));
        let newest = &store.state.alerts["storey-2"];
        (
            store.changed_ns(newest),
            newest.time_ns,
            store.changes.len(),
        )
    };
    let [first, second, third] = [revised(1, 0), revised(3, 1), revised(5, 2)];
    let live = [&first, &second, &third].map(|alert| Input::Alert(alert.clone()));
    assert_eq!(of(live.to_vec()), (1, 5, 1));
    let standing = Input::StandingAlert(third.clone());
    let earlier = past(vec![first, second, third]);
    assert_eq!(of(vec![standing.clone(), earlier.clone()]), (1, 5, 1));
    assert_eq!(of(vec![earlier, standing]), (1, 5, 1));
}

/// Regression test: the history stores the way back to normal, but the changes lacked it. A report
/// of a past period therefore named an alert that had ended before.
#[test]
fn way_back_to_normal_in_the_history_is_a_change() {
    let past = |alerts: &[(i64, AlertState)]| {
        let alerts = alerts.iter();
        Input::Past(HistoryLog {
            structure: name("demo"),
            alerts: alerts
                .map(|(time_ns, state)| alert("storey-2", *time_ns, *state))
                .collect(),
            acknowledgements: vec![],
            events: vec![],
        })
    };
    let mut store = demo();
    let first = [
        (1, AlertState::Normal),
        (2, AlertState::Raised),
        (3, AlertState::Normal),
        (4, AlertState::Normal),
    ];
    store.handle(past(&first));
    store.handle(past(&[(5, AlertState::Undecided)]));
    store.handle(past(&first));
    let changes = store.changes.iter();
    let changes: Vec<_> = changes
        .map(|change| (change.time_ns, change.alert.state))
        .collect();
    let expected = [
        (5, AlertState::Undecided),
        (3, AlertState::Normal),
        (2, AlertState::Raised),
    ];
    assert_eq!(changes, expected);
}
