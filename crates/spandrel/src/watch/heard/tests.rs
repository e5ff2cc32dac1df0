use super::super::testing::{alert, at, event, heard, name, parameter, present, progress, status};
use super::*;

fn tower(heard: &Heard) -> &StructureHeard {
    heard.structure(&name("tower")).unwrap()
}

fn changes(heard: &mut Heard, input: Input) -> Vec<AlertState> {
    let mut changes = Vec::new();
    heard.handle(input, &mut changes);
    changes.iter().map(|alert| alert.state).collect()
}

#[test]
fn last_value_of_each_parameter_is_kept_in_natural_order() {
    let heard = heard([
        Input::Parameter(parameter("storey-10", 0, 1.0, 0.1)),
        Input::Parameter(parameter("storey-2", 0, 1.0, 0.1)),
        Input::Parameter(parameter("storey-2", 1, 0.9, 0.1)),
    ]);
    let means: Vec<(&str, f64)> = tower(&heard)
        .parameters
        .iter()
        .map(|(name, heard)| (name.0.as_str(), heard.display.mean))
        .collect();
    assert_eq!(means, [("storey-2", 0.9), ("storey-10", 1.0)]);
}

#[test]
fn data_are_stale_after_three_seconds_without_a_value() {
    let mut heard = heard([at(10), Input::Parameter(parameter("storey-1", 0, 1.0, 0.1))]);
    heard.handle(at(13), &mut Vec::new());
    assert_eq!(heard.silence_of_data(tower(&heard)), None);
    heard.handle(at(22), &mut Vec::new());
    assert_eq!(
        heard.silence_of_data(tower(&heard)),
        Some(Duration::from_secs(12))
    );
}

/// Regression test: for three seconds after a restart of all services, values of disconnected
/// sensors counted as new.
#[test]
fn what_is_read_again_after_a_restart_does_not_end_a_silence() {
    let there = || present(&[(Service::Ingest, "a"), (Service::Identify, "a")]);
    let ingested = |second| Input::Ingested(name("tower"), progress(7, second));
    let mut heard = heard([
        at(10),
        there(),
        ingested(0),
        Input::Parameter(parameter("storey-1", 10, 1.0, 0.1)),
    ]);
    heard.handle(present(&[]), &mut Vec::new());
    for input in [
        at(20),
        there(),
        Input::Parameter(parameter("storey-1", 8, 1.0, 0.1)),
        ingested(12),
        at(21),
    ] {
        heard.handle(input, &mut Vec::new());
    }
    assert_eq!(
        heard.silence_of_data(tower(&heard)),
        Some(Duration::from_secs(11))
    );
    assert_eq!(tower(&heard).origin(), Origin::ReadAgain);
    heard.handle(
        Input::Parameter(parameter("storey-1", 13, 1.0, 0.1)),
        &mut Vec::new(),
    );
    assert_eq!(heard.silence_of_data(tower(&heard)), None);
    assert_eq!(tower(&heard).origin(), Origin::Measured);
}

#[test]
fn a_status_does_not_hide_that_data_are_stale() {
    let mut heard = heard([at(0), Input::Parameter(parameter("storey-1", 0, 1.0, 0.1))]);
    heard.handle(at(9), &mut Vec::new());
    heard.handle(
        Input::Status(status(Service::Ingest, 0.1, &[])),
        &mut Vec::new(),
    );
    assert_eq!(
        heard.silence_of_data(tower(&heard)),
        Some(Duration::from_secs(9))
    );
}

#[test]
fn what_was_never_heard_is_not_stale() {
    let heard = heard([present(&[(Service::Ingest, "a")]), at(100)]);
    assert_eq!(heard.silence_of_data(tower(&heard)), None);
    let instance = &tower(&heard).instances[&(Service::Ingest, name("a"))];
    assert_eq!(heard.silence_of_status(instance), None);
}

#[test]
fn each_change_of_an_alert_is_told_once() {
    let mut heard = Heard::default();
    let raised = alert("storey-2", 45, AlertState::Raised);
    assert_eq!(
        changes(
            &mut heard,
            Input::Alert(alert("storey-2", 40, AlertState::Pending))
        ),
        [AlertState::Pending]
    );
    assert_eq!(
        changes(&mut heard, Input::Alert(raised.clone())),
        [AlertState::Raised]
    );
    assert_eq!(changes(&mut heard, Input::Alert(raised.clone())), []);
    assert_eq!(changes(&mut heard, Input::StandingAlert(raised)), []);
}

#[test]
fn an_answer_does_not_undo_what_came_by_itself() {
    let mut heard = heard([Input::Alert(alert(
        "storey-2",
        45,
        AlertState::Acknowledged,
    ))]);
    // Both have the same frame, because an acknowledgement brings no new estimate.
    assert_eq!(
        changes(
            &mut heard,
            Input::StandingAlert(alert("storey-2", 45, AlertState::Raised))
        ),
        []
    );
    assert_eq!(
        changes(
            &mut heard,
            Input::StandingAlert(alert("storey-2", 50, AlertState::Cleared))
        ),
        [AlertState::Cleared]
    );
}

fn stale(heard: &Heard) -> Vec<&str> {
    tower(heard)
        .alerts
        .values()
        .filter(|alert| heard.is_stale(alert))
        .map(|alert| alert.parameter.as_str())
        .collect()
}

#[test]
fn alerts_are_stale_from_when_their_service_goes_until_it_speaks_again() {
    let there = || present(&[(Service::Alert, "alert")]);
    let raised = alert("storey-2", 45, AlertState::Raised);
    let mut heard = heard([
        there(),
        Input::Alert(alert("storey-1", 0, AlertState::Normal)),
        Input::Alert(raised.clone()),
    ]);
    assert_eq!(stale(&heard), [""; 0]);
    heard.handle(present(&[]), &mut Vec::new());
    assert_eq!(stale(&heard), ["storey-1", "storey-2"]);
    heard.handle(there(), &mut Vec::new());
    assert_eq!(
        stale(&heard),
        ["storey-1", "storey-2"],
        "that somebody is there says nothing of them"
    );
    // Only the link was lost; the service is the same.
    assert_eq!(changes(&mut heard, Input::StandingAlert(raised)), []);
    assert_eq!(stale(&heard), ["storey-1"]);
}

#[test]
fn a_new_life_of_the_alert_service_counts_though_it_is_at_earlier_estimates() {
    let there = || present(&[(Service::Alert, "alert")]);
    for of_new_life in [Input::Alert, Input::StandingAlert] {
        let mut heard = heard([
            there(),
            Input::Alert(alert("storey-2", 45, AlertState::Raised)),
            present(&[]),
            there(),
        ]);
        let normal = of_new_life(alert("storey-2", 1, AlertState::Normal));
        assert_eq!(changes(&mut heard, normal), [AlertState::Normal]);
        assert_eq!((stale(&heard).len(), heard.open_alerts().len()), (0, 0));
    }
}

#[test]
fn alerts_of_one_structure_are_not_stale_because_the_service_of_another_goes() {
    let mut mast = alert("storey-1", 0, AlertState::Raised);
    mast.structure = name("mast");
    let heard = heard([
        present(&[(Service::Alert, "alert")]),
        Input::Alert(mast.clone()),
        Input::Alert(alert("storey-2", 45, AlertState::Raised)),
        present(&[]),
    ]);
    assert!(!heard.is_stale(&mast));
    assert_eq!(stale(&heard), ["storey-2"]);
}

#[test]
fn that_a_parameter_is_normal_from_the_start_is_known_and_no_change() {
    let mut heard = Heard::default();
    assert_eq!(
        changes(
            &mut heard,
            Input::Alert(alert("storey-1", 0, AlertState::Normal))
        ),
        []
    );
    assert_eq!(
        tower(&heard)
            .alert(&name("storey-1"))
            .map(|alert| alert.state),
        Some(AlertState::Normal)
    );
}

#[test]
fn open_alerts_are_those_that_people_should_know_of_newest_first() {
    let heard = heard([
        Input::Alert(alert("storey-1", 50, AlertState::Normal)),
        Input::Alert(alert("storey-2", 10, AlertState::Acknowledged)),
        Input::Alert(alert("storey-3", 30, AlertState::Raised)),
        Input::Alert(alert("storey-4", 20, AlertState::Learning)),
        Input::Alert(alert("storey-5", 20, AlertState::Pending)),
    ]);
    let open: Vec<&str> = heard
        .open_alerts()
        .iter()
        .map(|alert| alert.parameter.as_str())
        .collect();
    assert_eq!(open, ["storey-3", "storey-5", "storey-2"]);
}

#[test]
fn a_service_that_goes_stays_on_record_and_a_node_does_not() {
    let mut heard = heard([
        present(&[(Service::Ingest, "a"), (Service::Sensor, "floor-1")]),
        Input::Status(status(Service::Ingest, 0.1, &[])),
    ]);
    heard.handle(present(&[]), &mut Vec::new());
    let instances: Vec<(Service, bool)> = tower(&heard)
        .instances
        .iter()
        .map(|((service, _), instance)| (*service, instance.is_present))
        .collect();
    assert_eq!(instances, [(Service::Ingest, false)]);
}

#[test]
fn a_structure_that_came_and_went_unheard_leaves_no_trace() {
    let mut heard = heard([present(&[(Service::Sensor, "floor-1")])]);
    heard.handle(present(&[]), &mut Vec::new());
    assert_eq!(heard.structures().len(), 0);
}

#[test]
fn events_are_newest_first_and_bounded() {
    let heard = heard((0..300).map(|number| Input::Event(event(&number.to_string(), ""))));
    assert_eq!(heard.events().len(), EVENTS_KEPT);
    assert_eq!(
        heard.events().next().map(|event| event.what.as_str()),
        Some("299")
    );
}

#[test]
fn changes_of_classes_do_not_push_the_event_of_a_sensor_out() {
    let change = |number: usize, kind| {
        let mut change = event(&format!("class {number} leads"), "");
        (change.kind, change.subject) = (kind, "identify".to_owned());
        Input::Event(change)
    };
    let changes = (0..300).flat_map(|number| {
        [
            change(number, EventKind::LeadingClass),
            change(number, EventKind::Calibration),
        ]
    });
    let heard =
        heard(std::iter::once(Input::Event(event("the sensor is faulty", ""))).chain(changes));
    let told: Vec<&str> = heard.events().map(|event| event.what.as_str()).collect();
    assert_eq!(
        told,
        ["class 299 leads", "class 299 leads", "the sensor is faulty"]
    );
}

#[test]
fn more_structures_than_there_is_room_for_are_counted() {
    let of = |number: usize| {
        let mut display = parameter("storey-1", 0, 1.0, 0.1);
        display.structure = name(&format!("s-{number}"));
        Input::Parameter(display)
    };
    let heard = heard((0..MOST_STRUCTURES + 7).map(of));
    assert_eq!(
        (heard.structures().len(), heard.left_out()),
        (MOST_STRUCTURES, 7)
    );
}

#[test]
fn misplaced_messages_and_unknown_services_are_counted() {
    let mut unknown = status(Service::Ingest, 0.1, &[]);
    unknown.service = name("nobody");
    let heard = heard([Input::Misplaced, Input::Status(unknown)]);
    assert_eq!(heard.left_out(), 2);
}
