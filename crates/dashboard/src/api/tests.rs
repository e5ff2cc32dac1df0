use super::*;
use serde_json::Value;
use std::collections::BTreeSet;

#[test]
fn description_lists_exactly_the_served_routes() {
    let description: Value = serde_json::from_str(OPENAPI).unwrap();
    let described: BTreeSet<(String, String)> = description["paths"]
        .as_object()
        .unwrap()
        .iter()
        .flat_map(|(path, methods)| {
            methods
                .as_object()
                .unwrap()
                .keys()
                .map(|method| (path.clone(), method.to_uppercase()))
        })
        .collect();
    let served: BTreeSet<(String, String)> = routes()
        .into_iter()
        .map(|(path, method, _)| (path.to_owned(), method.to_string()))
        .collect();
    assert_eq!(described, served);
}

#[test]
fn every_reference_of_the_description_has_a_target() {
    fn check(value: &Value, whole: &Value) {
        match value {
            Value::Object(fields) => {
                if let Some(Value::String(reference)) = fields.get("$ref") {
                    let pointer = reference.strip_prefix('#').unwrap();
                    assert!(
                        whole.pointer(pointer).is_some(),
                        "{reference} leads nowhere"
                    );
                }
                fields.values().for_each(|value| check(value, whole));
            }
            Value::Array(values) => values.iter().for_each(|value| check(value, whole)),
            _ => {}
        }
    }
    let description: Value = serde_json::from_str(OPENAPI).unwrap();
    check(&description, &description);
}

#[test]
fn unconfirmed_alert_can_be_acknowledged_once() {
    use crate::testing::{alert, demo, undecided};
    use spandrel_listener::Input;
    let mut store = demo();
    store.handle(undecided(
        "storey-2",
        AlertState::Unconfirmed,
        spandrel_bus::UndecidedBecause::FitContradicted,
    ));
    assert_eq!(
        check_acknowledgeable(&store, "storey-2").ok(),
        Some(AlertState::Unconfirmed)
    );
    let seen = spandrel_bus::AlertMessage {
        acknowledged_by: Some("Ada".into()),
        ..alert("storey-2", 6, AlertState::Unconfirmed)
    };
    store.handle(Input::Alert(seen));
    assert_eq!(
        check_acknowledgeable(&store, "storey-2")
            .unwrap_err()
            .status,
        StatusCode::CONFLICT
    );
    store.handle(undecided(
        "storey-1",
        AlertState::Undecided,
        spandrel_bus::UndecidedBecause::FitContradicted,
    ));
    assert_eq!(
        check_acknowledgeable(&store, "storey-1")
            .unwrap_err()
            .status,
        StatusCode::CONFLICT
    );
}
