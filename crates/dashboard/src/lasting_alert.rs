//! Lasting losses as alerts: their state, and whether they can be acknowledged.

use crate::api::Mistake;
use crate::judgements::quantity;
use crate::store::Store;
use crate::view::{AlertKind, NoticeView, is_about_lasting_change, judgements, notices_since};
use axum::http::StatusCode;
use serde::Serialize;
use spandrel_bus::{
    AlertState, CredibleInterval, Event, EventKind, JudgementDisplay, LossChange, Name, Service,
};

/// A lasting loss, with those fields of an alert that it has.
#[derive(Debug, Serialize)]
pub(crate) struct LastingAlert<'s> {
    kind: AlertKind,
    structure: &'s str,
    /// The judged quantity. A stiffness has the name of its parameter.
    parameter: &'s Name,
    pub(crate) state: AlertState,
    /// Start of the last judged day, ns since the Unix epoch, UTC. For a past change, the time of the
    /// change.
    time_ns: i64,
    /// Start of the most credible first day of the loss, ns since the Unix epoch, UTC.
    since_ns: i64,
    /// Start of the day on which the loss was found, ns since the Unix epoch, UTC. For a past change,
    /// the time of the change.
    pub(crate) changed_ns: i64,
    /// Start of the day on which the loss was found, ns since the Unix epoch, UTC.
    found_ns: i64,
    /// Loss of stiffness as a share of the reference.
    loss: f64,
    loss_interval: CredibleInterval,
    acknowledged_by: Option<&'s str>,
    /// Wall-clock time of the acknowledgement, ns since the Unix epoch, UTC.
    acknowledged_ns: Option<i64>,
    note: Option<&'s str>,
    why: &'s str,
    /// Whether the service that judges has disappeared.
    stale: bool,
    /// Whom to call; may be empty.
    contact: &'s str,
    /// Address of the instructions.
    runbook: Option<&'s str>,
    /// The last notice to each receiver, newest first.
    notices: Vec<NoticeView<'s>>,
}

impl<'s> LastingAlert<'s> {
    fn of(store: &'s Store, display: &'s JudgementDisplay) -> Option<Self> {
        let (state, change) = (display.alert_state()?, display.change?);
        let seen = display.seen.as_ref();
        let mut services = store.state.seen.iter();
        let was_there = services.any(|(service, _)| *service == Service::Judge);
        // The reason of a failed notice does not state which alert it is about.
        let is_own =
            |event: &Event| event.kind != EventKind::NoticeSent || is_about_lasting_change(event);
        Some(Self {
            kind: AlertKind::LastingLoss,
            structure: display.structure.as_str(),
            parameter: &display.quantity,
            state,
            time_ns: display.day_ns.unwrap_or(change.found_ns),
            since_ns: change.since_ns,
            changed_ns: change.found_ns,
            found_ns: change.found_ns,
            loss: change.loss,
            loss_interval: change.interval,
            acknowledged_by: seen.map(|seen| seen.who.as_str()),
            acknowledged_ns: seen.map(|seen| seen.time_ns),
            note: seen.map(|seen| seen.text.as_str()),
            why: &display.sentence,
            stale: was_there && !store.state.has(Service::Judge),
            contact: &store.about.contact,
            runbook: store.about.runbook.as_deref(),
            notices: notices_since(store, &display.quantity, change.found_ns, is_own),
        })
    }

    /// Returns the view of a past change.
    pub(crate) fn past(store: &'s Store, past: &'s LossChange) -> Self {
        let seen = past.seen.as_ref();
        Self {
            kind: AlertKind::LastingLoss,
            structure: &store.about.name,
            parameter: &past.quantity,
            state: past.state,
            time_ns: past.time_ns,
            since_ns: past.change.since_ns,
            changed_ns: past.time_ns,
            found_ns: past.change.found_ns,
            loss: past.change.loss,
            loss_interval: past.change.interval,
            acknowledged_by: seen.map(|seen| seen.who.as_str()),
            acknowledged_ns: seen.map(|seen| seen.time_ns),
            note: seen.map(|seen| seen.text.as_str()),
            why: &past.sentence,
            stale: false,
            contact: "",
            runbook: None,
            notices: Vec::new(),
        }
    }
}

/// Returns the lasting losses that were found, in the order of the structure file.
pub(crate) fn lasting_alerts(store: &Store) -> impl Iterator<Item = LastingAlert<'_>> {
    judgements(store).filter_map(|view| LastingAlert::of(store, view.display))
}

/// Returns the quantity of a lasting loss that can be acknowledged.
pub(crate) fn check_loss_acknowledgeable(store: &Store, name: &str) -> Result<Name, Mistake> {
    let quantity = quantity(store, name)?;
    let judgement = store.state.judgements.get(&quantity);
    let state = judgement.and_then(JudgementDisplay::alert_state);
    if state == Some(AlertState::Raised) {
        return Ok(quantity);
    }
    let what = match state {
        Some(state) => format!("the lasting loss of {name} is {}", state.as_str()),
        None => format!("no lasting loss of {name} is known"),
    };
    let allowed = "must be a lasting loss that nobody has acknowledged";
    Err(Mistake::new(StatusCode::CONFLICT, what, allowed))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{alert, demo_with_air, lasting_loss, name};
    use crate::view::changes;
    use serde_json::{Value, json};
    use spandrel_bus::ChangeSeen;
    use spandrel_listener::Input;

    fn seen() -> JudgementDisplay {
        JudgementDisplay {
            seen: Some(ChangeSeen {
                who: "Ada".to_owned(),
                text: "on my way".to_owned(),
                time_ns: 7,
            }),
            ..lasting_loss("storey-2")
        }
    }

    fn listed(store: &Store) -> Vec<Value> {
        lasting_alerts(store).map(|alert| json!(alert)).collect()
    }

    #[test]
    fn a_lasting_loss_is_an_alert_that_can_be_acknowledged_once() {
        let mut store = demo_with_air();
        let checked = |store: &Store, quantity: &str| {
            let checked = check_loss_acknowledgeable(store, quantity);
            checked.map_err(|mistake| mistake.what().to_owned())
        };
        assert!(listed(&store).is_empty());
        let unknown = Err("no lasting loss of storey-2 is known".to_owned());
        assert_eq!(checked(&store, "storey-2"), unknown);
        store.handle(Input::Judgement(lasting_loss("storey-2")));
        let alert = &listed(&store)[0];
        for (field, expected) in [
            ("kind", json!("lasting-loss")),
            ("structure", json!("demo")),
            ("parameter", json!("storey-2")),
            ("state", json!("raised")),
            ("loss", json!(0.05)),
            ("acknowledged_by", Value::Null),
            (
                "why",
                json!("storey-2 has lost 5.0 % of stiffness (95 % interval 4.0 to 6.0 %)."),
            ),
        ] {
            assert_eq!(alert[field], expected, "{field}");
        }
        assert_eq!(checked(&store, "storey-2"), Ok(name("storey-2")));
        store.handle(Input::Judgement(seen()));
        let alert = &listed(&store)[0];
        assert_eq!(alert["state"], "acknowledged");
        assert_eq!(
            (&alert["acknowledged_by"], &alert["note"]),
            (&json!("Ada"), &json!("on my way"))
        );
        let again = Err("the lasting loss of storey-2 is acknowledged".to_owned());
        assert_eq!(checked(&store, "storey-2"), again);
        store.handle(Input::Judgement(JudgementDisplay {
            change: None,
            ..lasting_loss("storey-2")
        }));
        assert!(listed(&store).is_empty());
        let unjudged = Err("quantity `storey-1` is not judged".to_owned());
        assert_eq!(checked(&store, "storey-1"), unjudged);
    }

    #[test]
    fn changes_of_lasting_losses_and_of_rules_are_one_list() {
        let mut store = demo_with_air();
        store.handle(Input::Judgement(lasting_loss("storey-2")));
        store.handle(Input::Alert(alert("storey-1", 5, AlertState::Raised)));
        store.handle(Input::Judgement(seen()));
        store.handle(Input::Judgement(seen()));
        store.handle(Input::Judgement(JudgementDisplay {
            change: None,
            ..lasting_loss("storey-2")
        }));
        let listed = |store: &Store| -> Vec<String> {
            let all = changes(store, 9).into_iter().map(|change| json!(change));
            let words = all.map(|of| {
                let [kind, part, state] = ["kind", "parameter", "state"].map(|field| &of[field]);
                format!("{kind} {part} {state} {}", of["changed_ns"]).replace('"', "")
            });
            words.collect()
        };
        let expected = [
            "lasting-loss storey-2 cleared 900000000000",
            "lasting-loss storey-2 acknowledged 7",
            "rule storey-1 raised 5",
            "lasting-loss storey-2 raised 0",
        ];
        assert_eq!(listed(&store), expected);
        assert_eq!(listed(&store.past()), expected);
        let newest = changes(&store, 2);
        assert_eq!(newest.len(), 2);
        assert_eq!(json!(newest[1])["acknowledged_by"], "Ada");
    }

    #[test]
    fn a_lasting_loss_names_its_own_notices() {
        let mut store = demo_with_air();
        store.handle(Input::Judgement(lasting_loss("storey-2")));
        for (time_ns, why) in [
            (1, "lasting-loss at 1970-01-01T00:00:00Z"),
            (2, "raised at 1970-01-01T00:00:00Z"),
        ] {
            store.handle(Input::Event(Event {
                structure: name("demo"),
                time_ns,
                kind: EventKind::NoticeSent,
                subject: "storey-2".to_owned(),
                what: "notice sent to ada.example".to_owned(),
                why: why.to_owned(),
            }));
        }
        let notices = &listed(&store)[0]["notices"];
        assert_eq!(notices.as_array().map(Vec::len), Some(1));
        assert_eq!(notices[0]["time_ns"], 1);
    }
}
