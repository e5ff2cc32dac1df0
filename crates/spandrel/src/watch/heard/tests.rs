use super::super::testing::{alert, event, heard, lasting_loss, name, parameter, present};
use super::*;

#[test]
fn last_value_of_each_parameter_is_kept_in_natural_order() {
    let heard = heard([
        Input::Parameter(parameter("storey-10", 0, 1.0, 0.1)),
        Input::Parameter(parameter("storey-2", 0, 1.0, 0.1)),
        Input::Parameter(parameter("storey-2", 1, 0.9, 0.1)),
    ]);
    let means: Vec<(&str, f64)> = heard
        .parameters(&name("tower"))
        .iter()
        .map(|heard| (heard.display.parameter.as_str(), heard.display.mean))
        .collect();
    assert_eq!(means, [("storey-2", 0.9), ("storey-10", 1.0)]);
}

#[test]
fn initial_normal_state_is_stored_but_is_no_change() {
    let mut heard = Heard::default();
    let mut changes = Vec::new();
    let normal = alert("storey-1", 0, AlertState::Normal);
    heard.handle(Input::Alert(normal), &mut changes);
    assert_eq!(changes, []);
    let tower = heard.structure(&name("tower")).unwrap();
    assert_eq!(tower.alerts["storey-1"].state, AlertState::Normal);
}

#[test]
fn open_alerts_are_listed_newest_first() {
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
        .map(|alert| alert.part().as_str())
        .collect();
    assert_eq!(open, ["storey-3", "storey-5", "storey-2"]);
}

/// A quantity has the name of its parameter.
#[test]
fn a_lasting_loss_is_listed_beside_the_alert_of_its_parameter() {
    let mut heard = heard([
        present(&[(Service::Judge, "a")]),
        Input::Alert(alert("storey-2", 10, AlertState::Raised)),
    ]);
    let mut changes = Vec::new();
    for _ in 0..2 {
        let display = lasting_loss("storey-2");
        heard.handle(Input::Judgement(display), &mut changes);
    }
    assert_eq!(changes.len(), 1, "{changes:?}");
    let open = heard.open_alerts().into_iter();
    let ids: Vec<String> = open.map(|alert| alert.id().to_string()).collect();
    assert_eq!(ids, ["tower/storey-2", "tower/storey-2 (lasting loss)"]);
    let loss = changes[0].alert.clone();
    assert!(!heard.is_stale(heard.alert(&loss).unwrap()));
    heard.handle(present(&[]), &mut Vec::new());
    assert!(heard.is_stale(heard.alert(&loss).unwrap()));
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
fn class_changes_do_not_displace_sensor_events() {
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
