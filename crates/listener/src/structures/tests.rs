use super::*;
use crate::testing::{alert, at, ingested, loss, name, parameter, present, status};
use spandrel_bus::{
    AlertState, MAX_CHANNELS, ModeDisplay, ModeState, MonitoringDisplay, MonitoringState,
    ParameterMonitoring, Service,
};

/// Returns the state after these inputs.
fn after(inputs: impl IntoIterator<Item = Input>) -> Structures {
    let mut structures = Structures::default();
    inputs.into_iter().for_each(|input| {
        changes(&mut structures, input);
    });
    structures
}

fn changes(structures: &mut Structures, input: Input) -> Vec<AlertState> {
    let mut changes = Vec::new();
    structures.handle(input, &mut changes);
    changes.iter().map(|change| change.alert.state).collect()
}

fn tower(structures: &Structures) -> &StructureState {
    structures.structure(&name("tower")).unwrap()
}

fn stale_for_s(structures: &Structures) -> Option<u64> {
    tower(structures)
        .stale_for()
        .map(|silence| silence.as_secs())
}

fn stale_alerts(structures: &Structures) -> Vec<&str> {
    let tower = tower(structures);
    let stale = tower
        .alerts
        .keys()
        .filter(|name| tower.is_alert_stale(name));
    stale.map(Name::as_str).collect()
}

/// The losses of an alert service that stalls or disappears must not pass for present ones.
#[test]
fn loss_expires_when_its_service_ends_or_sends_nothing_while_estimates_arrive() {
    let value = |second| Input::Parameter(parameter("storey-1", second));
    let there = || present(&[(Service::Alert, "a"), (Service::Identify, "a")]);
    let known = |structures: &Structures| tower(structures).losses.contains_key("storey-1");
    let start = || [at(10), there(), value(0), Input::Loss(loss("storey-1", 0))];

    let mut structures = after(start());
    changes(&mut structures, at(40));
    assert!(known(&structures), "the measurement has ended");
    changes(&mut structures, value(1));
    assert!(!known(&structures), "the alert service stalls");

    let mut structures = after(start());
    changes(&mut structures, at(12));
    changes(&mut structures, value(1));
    assert!(known(&structures));
    changes(&mut structures, present(&[(Service::Identify, "a")]));
    assert!(!known(&structures), "the alert service has disappeared");
}

#[test]
fn data_are_stale_after_three_seconds_without_a_value() {
    let mut structures = after([at(10), Input::Parameter(parameter("storey-1", 0))]);
    changes(&mut structures, at(13));
    assert_eq!(stale_for_s(&structures), None);
    changes(&mut structures, at(22));
    assert_eq!(stale_for_s(&structures), Some(12));
}

fn monitoring(state: MonitoringState, of_storey_2: MonitoringState, reasons: &[&str]) -> Input {
    let parameters = [
        ("storey-1", MonitoringState::Watching),
        ("storey-2", of_storey_2),
    ];
    let parameters = parameters.map(|(parameter, state)| ParameterMonitoring {
        parameter: name(parameter),
        state,
        why: (state != MonitoringState::Watching).then(|| "too few samples".to_owned()),
        sustained_std: None,
    });
    Input::Monitoring(MonitoringDisplay {
        structure: name("tower"),
        time_ns: 0,
        measured_ns: None,
        state,
        since_ns: 0,
        reasons: reasons.iter().map(|reason| (*reason).to_owned()).collect(),
        parameters: parameters.into(),
        channels: vec![],
    })
}

/// Regression test: the parts of a structure without data were normal, because only the structure
/// as a whole was blind.
#[test]
fn no_part_is_watched_without_new_data_or_in_a_blind_structure() {
    use MonitoringState::{Blind, Degraded, Watching};
    let why = |structures: &Structures, parameter: &str| {
        let unwatched = tower(structures).unwatched(&name(parameter));
        unwatched.map(|of| (of.state, of.why.unwrap_or_default()))
    };
    let told = |state, why: &str| Some((state, why.to_owned()));
    let value = || Input::Parameter(parameter("storey-1", 0));
    let mut structures = after([at(10), value(), monitoring(Watching, Watching, &[])]);
    assert_eq!(why(&structures, "storey-1"), None);
    let degraded = monitoring(Degraded, Degraded, &["storey-2: too few samples"]);
    changes(&mut structures, degraded);
    assert_eq!(why(&structures, "storey-1"), None);
    let few = told(Degraded, "too few samples");
    assert_eq!(why(&structures, "storey-2"), few);
    changes(&mut structures, at(20));
    let degraded = monitoring(Degraded, Degraded, &["storey-2: too few samples"]);
    changes(&mut structures, degraded);
    assert_eq!(why(&structures, "storey-2"), told(Blind, "too few samples"));
    let mut structures = after([at(10), value()]);
    let ended = "the samples have ended";
    changes(&mut structures, monitoring(Blind, Degraded, &[ended]));
    assert_eq!(why(&structures, "storey-1"), told(Blind, ended));
    assert_eq!(why(&structures, "storey-2"), told(Blind, "too few samples"));
    changes(&mut structures, monitoring(Blind, Watching, &[ended]));
    for parameter in ["storey-1", "storey-2"] {
        assert_eq!(why(&structures, parameter), told(Blind, ended));
    }
    changes(&mut structures, at(20));
    let unreported = told(Blind, "no new data arrive");
    assert_eq!(why(&structures, "storey-1"), unreported);
}

/// Regression test: for three seconds after a restart of all services, values of disconnected
/// sensors counted as new.
#[test]
fn reread_values_after_a_restart_do_not_end_a_silence() {
    let there = || present(&[(Service::Ingest, "a"), (Service::Identify, "a")]);
    let value = |time_ns| Input::Parameter(parameter("storey-1", time_ns));
    let mut structures = after([
        at(10),
        there(),
        ingested(7, 0),
        value(10),
        present(&[]),
        at(20),
        there(),
        value(8),
        ingested(7, 12),
        at(21),
    ]);
    assert_eq!(stale_for_s(&structures), Some(11));
    assert!(tower(&structures).is_from_the_recording());
    changes(&mut structures, value(13));
    assert_eq!(stale_for_s(&structures), None);
    assert!(!tower(&structures).is_from_the_recording());
}

/// Regression test: the repeated parameters of `modes` counted as data. A structure without sensors
/// was therefore never stale for more than a few seconds.
#[test]
fn repeated_parameters_of_modes_do_not_hide_that_no_frame_arrives() {
    let repeated = || Input::Parameter(parameter("storey-1", 300));
    let mut structures = after([
        at(10),
        present(&[(Service::Ingest, "a"), (Service::Modes, "a")]),
        ingested(7, 200),
        ingested(7, 310),
        repeated(),
    ]);
    assert_eq!(stale_for_s(&structures), None);
    for second in [15, 20] {
        changes(&mut structures, at(second));
        changes(&mut structures, repeated());
        changes(&mut structures, ingested(7, 310));
    }
    assert_eq!(stale_for_s(&structures), Some(10));
    assert_eq!(tower(&structures).time_ns, Some(310), "time of the frames");
}

#[test]
fn a_status_does_not_hide_that_data_are_stale() {
    let value = Input::Parameter(parameter("storey-1", 0));
    let structures = after([at(0), value, at(9), Input::Status(status(Service::Ingest))]);
    assert_eq!(stale_for_s(&structures), Some(9));
}

#[test]
fn data_never_received_are_not_stale() {
    let structures = after([present(&[(Service::Ingest, "a")]), at(100)]);
    assert_eq!(stale_for_s(&structures), None);
    let instance = &tower(&structures).instances[&(Service::Ingest, name("a"))];
    assert_eq!(tower(&structures).status_stale_for(instance), None);
}

#[test]
fn each_change_of_an_alert_is_reported_once() {
    let mut structures = Structures::default();
    let mut told = |input| changes(&mut structures, input);
    let pending = alert("storey-2", 40, AlertState::Pending);
    let raised = alert("storey-2", 45, AlertState::Raised);
    assert_eq!(told(Input::Alert(pending)), [AlertState::Pending]);
    assert_eq!(told(Input::Alert(raised.clone())), [AlertState::Raised]);
    assert_eq!(told(Input::Alert(raised.clone())), []);
    assert_eq!(told(Input::StandingAlert(raised)), []);
}

#[test]
fn query_reply_does_not_replace_a_newer_publication() {
    let acknowledged = alert("storey-2", 45, AlertState::Acknowledged);
    let mut structures = after([Input::Alert(acknowledged)]);
    let mut told = |time_ns, state| {
        let answer = alert("storey-2", time_ns, state);
        changes(&mut structures, Input::StandingAlert(answer))
    };
    // Both have the same frame, because an acknowledgement brings no new estimate.
    assert_eq!(told(45, AlertState::Raised), []);
    assert_eq!(told(50, AlertState::Cleared), [AlertState::Cleared]);
}

#[test]
fn alerts_are_stale_until_their_restarted_service_publishes() {
    let there = || present(&[(Service::Alert, "alert")]);
    let raised = alert("storey-2", 45, AlertState::Raised);
    let mut structures = after([
        there(),
        Input::Alert(alert("storey-1", 0, AlertState::Normal)),
        Input::Alert(raised.clone()),
    ]);
    assert_eq!(stale_alerts(&structures), [""; 0]);
    changes(&mut structures, present(&[]));
    assert_eq!(stale_alerts(&structures), ["storey-1", "storey-2"]);
    changes(&mut structures, there());
    let by_presence = "that somebody is there says nothing of them";
    assert_eq!(
        stale_alerts(&structures),
        ["storey-1", "storey-2"],
        "{by_presence}"
    );
    // Only the link was lost; the service is the same.
    assert_eq!(changes(&mut structures, Input::StandingAlert(raised)), []);
    assert_eq!(stale_alerts(&structures), ["storey-1"]);
}

#[test]
fn restarted_alert_service_counts_although_its_estimates_are_earlier() {
    let there = || present(&[(Service::Alert, "alert")]);
    for of_new_life in [Input::Alert, Input::StandingAlert] {
        let raised = alert("storey-2", 45, AlertState::Raised);
        let mut structures = after([there(), Input::Alert(raised), present(&[]), there()]);
        let normal = of_new_life(alert("storey-2", 1, AlertState::Normal));
        assert_eq!(changes(&mut structures, normal), [AlertState::Normal]);
        assert_eq!(stale_alerts(&structures), [""; 0]);
    }
}

#[test]
fn end_of_another_structures_service_makes_no_alert_stale() {
    let mut mast = alert("storey-1", 0, AlertState::Raised);
    mast.structure = name("mast");
    let structures = after([
        present(&[(Service::Alert, "alert")]),
        Input::Alert(mast),
        Input::Alert(alert("storey-2", 45, AlertState::Raised)),
        present(&[]),
    ]);
    let mast = structures.structure(&name("mast")).unwrap();
    assert!(!mast.is_alert_stale(&name("storey-1")));
    assert_eq!(stale_alerts(&structures), ["storey-2"]);
}

#[test]
fn ended_service_stays_listed_and_an_ended_node_does_not() {
    let structures = after([
        present(&[(Service::Ingest, "a"), (Service::Sensor, "floor-1")]),
        Input::Status(status(Service::Ingest)),
        present(&[]),
    ]);
    let instances: Vec<(Service, bool)> = tower(&structures)
        .instances
        .iter()
        .map(|((service, _), instance)| (*service, instance.is_present))
        .collect();
    assert_eq!(instances, [(Service::Ingest, false)]);
}

#[test]
fn structure_without_values_leaves_no_entry() {
    let structures = after([present(&[(Service::Sensor, "floor-1")]), present(&[])]);
    assert_eq!(structures.structures().len(), 0);
}

/// Otherwise, a structure without a filter would vanish when it becomes blind.
#[test]
fn structure_with_modes_alone_stays_after_its_services_have_ended() {
    let mode = ModeDisplay {
        structure: name("tower"),
        mode: name("mode-1"),
        time_ns: 0,
        epoch_s: 600.0,
        epochs: 1,
        state: ModeState::Missing,
        partner: None,
        estimate: None,
        presence: 0.0,
        machine: false,
        declared_hz: 1.25,
    };
    let structures = after([
        present(&[(Service::Modes, "a")]),
        Input::Mode(Box::new(mode)),
        present(&[]),
    ]);
    assert_eq!(structures.structures().len(), 1);
}

#[test]
fn structures_beyond_the_limit_are_counted() {
    let of = |number: usize| {
        let mut display = parameter("storey-1", 0);
        display.structure = name(&format!("s-{number}"));
        Input::Parameter(display)
    };
    let structures = after((0..MOST_STRUCTURES + 7).map(of));
    let counts = (structures.structures().len(), structures.left_out());
    assert_eq!(counts, (MOST_STRUCTURES, 7));
}

#[test]
fn names_beyond_the_limit_are_counted() {
    let of = |number: usize| Input::Parameter(parameter(&format!("p-{number}"), 0));
    let structures = after((0..MAX_CHANNELS + 7).map(of));
    let counts = (tower(&structures).parameters.len(), structures.left_out());
    assert_eq!(counts, (MAX_CHANNELS, 7));
}

#[test]
fn misplaced_messages_and_unknown_services_are_counted() {
    let mut unknown = status(Service::Ingest);
    unknown.service = name("nobody");
    let structures = after([Input::Misplaced, Input::Status(unknown), present(&[])]);
    assert_eq!(structures.left_out(), 2);
}
