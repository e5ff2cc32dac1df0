//! The content of notices in the formats of the receivers.

use crate::clocks::ClockChange;
use crate::content::{Content, Report, iso_8601};
use crate::state::NoticeState;
use crate::template::variables;
use serde_json::{Value, json};
use spandrel_bus::{
    AlertMessage, AlertState, Event, JudgementDisplay, MonitoringDisplay, MonitoringState,
    fit_in_words,
};

/// Default template of the subject of an e-mail.
pub(crate) const MAIL_SUBJECT: &str = include_str!("mail.subject.txt");
/// Default template of the text of an e-mail.
pub(crate) const MAIL_TEXT: &str = include_str!("mail.txt");

/// Variables that a webhook receives in addition to the message of the bus.
const ADDED: [&str; 15] = [
    "key",
    "kind",
    "time",
    "title",
    "place",
    "sentence",
    "quality",
    "others",
    "origin",
    "advice",
    "link",
    "contact",
    "runbook",
    "unanswered",
    "test",
];

/// Returns the message as on the bus, with its key, its time in ISO 8601 and the circumstances.
pub(crate) fn plain(content: &Content) -> Value {
    let mut value = match &content.report {
        Report::Alert(alert) => json!(alert),
        Report::Monitoring(display) => json!(display),
        Report::Summary(summary) => json!(summary),
        Report::Judgement(display) => json!(display),
        Report::Earthquake(event) => json!(event),
        Report::Clock(change) => {
            let ClockChange {
                structure,
                node,
                time_ns,
                what,
                why,
                ..
            } = change;
            let state = change.state().as_str();
            json!({
                "structure": structure, "node": node, "time_ns": time_ns,
                "state": state, "what": what, "why": why,
            })
        }
    };
    let variables = variables(content);
    for name in ADDED {
        value[name] = variables.get(name).cloned().unwrap_or_default();
    }
    value
}

/// Returns the body for Alertmanager's `POST /api/v2/alerts`.
///
/// Alertmanager resolves an alert when its end has passed or when it is not repeated.
pub(crate) fn for_alertmanager(content: &Content) -> Value {
    let mut alerts = match &content.report {
        Report::Alert(alert) => vec![of_alert(alert)],
        Report::Monitoring(display) => of_monitoring(display),
        Report::Summary(_) => Vec::new(), // Alertmanager summarises by itself
        Report::Judgement(display) => of_judgement(display).into_iter().collect(),
        Report::Earthquake(event) => vec![of_earthquake(event)],
        Report::Clock(change) => vec![of_clock(change)],
    };
    let circumstances = &content.circumstances;
    for alert in &mut alerts {
        let annotations = &mut alert["annotations"];
        annotations["key"] = json!(content.key);
        annotations["summary"] = json!(content.sentence());
        annotations["origin"] = json!(circumstances.origin.as_str());
        for (name, text) in [
            ("title", &circumstances.title),
            ("place", &circumstances.place),
            ("quality", &circumstances.quality),
            ("advice", &circumstances.advice),
            ("contact", &circumstances.contact),
            // The name that Alertmanager's users and dashboards expect.
            ("runbook_url", &circumstances.runbook),
        ] {
            if !text.is_empty() {
                annotations[name] = json!(text);
            }
        }
        if !circumstances.link.is_empty() {
            alert["generatorURL"] = json!(circumstances.link);
        }
        if content.is_test {
            alert["labels"]["test"] = json!("true");
        }
    }
    json!(alerts)
}

fn of_alert(alert: &AlertMessage) -> Value {
    let is_over = matches!(alert.state, AlertState::Cleared | AlertState::Normal);
    let severity = match alert.state {
        AlertState::SofteningInMotion => "info",
        AlertState::Pending | AlertState::Undecided => "warning",
        _ => "critical",
    };
    let mut value = json!({
        "labels": {
            "alertname": "SpandrelStiffnessLoss",
            "structure": alert.structure.as_str(),
            "parameter": alert.parameter.as_str(),
            "severity": severity,
        },
        "annotations": { "state": alert.state.as_str() },
    });
    if let Some(verdict) = alert.fit {
        value["annotations"]["fit"] = json!(fit_in_words(verdict, alert.fit_reasons));
    }
    // The start is the same in all states, so that Alertmanager treats them as one alert.
    value["startsAt"] = json!(iso_8601(alert.since_ns.unwrap_or(alert.time_ns)));
    if is_over {
        value["endsAt"] = json!(iso_8601(alert.time_ns));
    }
    value
}

/// A display without a lasting change is no alert.
fn of_judgement(display: &JudgementDisplay) -> Option<Value> {
    let change = display.change?;
    let (name, severity) = match change.kind.is_alarm() {
        true => ("SpandrelLastingLoss", "critical"),
        false => ("SpandrelStiffer", "info"),
    };
    Some(json!({
        "labels": {
            "alertname": name,
            "structure": display.structure.as_str(),
            "quantity": display.quantity.as_str(),
            "severity": severity,
        },
        "annotations": { "state": change.kind.as_str() },
        "startsAt": iso_8601(change.found_ns),
    }))
}

/// Each report is an alert of its own, which Alertmanager resolves after its timeout.
fn of_earthquake(event: &Event) -> Value {
    json!({
        "labels": {
            "alertname": "SpandrelEarthquakeReport",
            "structure": event.structure.as_str(),
            "report": event.subject,
            "severity": "info",
        },
        "annotations": { "state": NoticeState::EarthquakeReport.as_str() },
        "startsAt": iso_8601(event.time_ns),
    })
}

fn of_clock(change: &ClockChange) -> Value {
    let moment = match change.is_wrong {
        true => "startsAt",
        false => "endsAt",
    };
    json!({
        "labels": {
            "alertname": "SpandrelWrongClock",
            "structure": change.structure.as_str(),
            "node": change.node.as_str(),
            "severity": "warning",
        },
        "annotations": { "state": change.state().as_str() },
        moment: iso_8601(change.time_ns),
    })
}

/// Blind and degraded are separate alerts. The inactive alert ends.
fn of_monitoring(display: &MonitoringDisplay) -> Vec<Value> {
    let states = [
        (MonitoringState::Blind, "SpandrelBlind", "critical"),
        (MonitoringState::Degraded, "SpandrelDegraded", "warning"),
    ];
    let alert = |(state, name, severity): (MonitoringState, &str, &str)| {
        let mut value = json!({
            "labels": { "alertname": name, "structure": display.structure.as_str(), "severity": severity },
            "annotations": { "state": display.state.as_str() },
        });
        if display.state == state {
            value["startsAt"] = json!(iso_8601(display.since_ns));
        } else {
            value["endsAt"] = json!(iso_8601(display.time_ns));
        }
        value
    };
    states.map(alert).into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::origin::Origin;
    use crate::samples::samples;
    use crate::template::Template;
    use crate::testing::{alert, content, monitoring, name, of_alert};

    fn mail(content: &Content) -> (String, String) {
        let render = |source| {
            let template = Template::parse(source, "mail", &samples("house")).unwrap();
            template.render(content).unwrap()
        };
        (render(MAIL_SUBJECT).trim().to_owned(), render(MAIL_TEXT))
    }

    #[test]
    fn webhook_receives_the_alert_with_key_and_circumstances() {
        let value = plain(&of_alert(&alert(20, AlertState::Raised)));
        assert_eq!(value["state"], "raised");
        assert_eq!(value["key"], "house/storey-2/20000000000/raised");
        assert_eq!(value["time"], "1970-01-01T00:00:20Z");
        assert_eq!(value["why"], "storey-2 has lost 12.4 % of its stiffness");
        assert_eq!(
            (&value["kind"], &value["origin"]),
            (&json!("alert"), &json!("measured"))
        );
        assert_eq!(value["others"][0], "storey-1 pending: it has lost 6 %");
        let blind = monitoring(20, MonitoringState::Blind, 5, &["no samples"]);
        let value = plain(&content(Report::Monitoring(blind)));
        assert_eq!(
            (&value["kind"], &value["state"]),
            (&json!("monitoring"), &json!("blind"))
        );
        assert_eq!(value["reasons"][0], "no samples");
    }

    #[test]
    fn alertmanager_receives_start_and_end_of_one_alert() {
        let raised = for_alertmanager(&of_alert(&alert(20, AlertState::Raised)));
        assert_eq!(raised[0]["labels"]["parameter"], "storey-2");
        assert_eq!(raised[0]["startsAt"], "1970-01-01T00:00:15Z");
        assert!(raised[0].get("endsAt").is_none());
        assert_eq!(
            raised[0]["generatorURL"],
            "https://site.example/#/structure/house"
        );
        let annotations = &raised[0]["annotations"];
        assert_eq!(annotations["contact"], "Ada, +41 44 123 45 67");
        assert_eq!(annotations["runbook_url"], "https://site.example/alarm");
        let cleared = for_alertmanager(&of_alert(&alert(20, AlertState::Cleared)));
        assert_eq!(cleared[0]["labels"], raised[0]["labels"]);
        assert_eq!(cleared[0]["endsAt"], "1970-01-01T00:00:20Z");
    }

    #[test]
    fn alertmanager_receives_start_and_end_of_blindness() {
        let body = |state| {
            let display = monitoring(20, state, 5, &["x"]);
            for_alertmanager(&content(Report::Monitoring(display)))
        };
        let (blind, watching) = (
            body(MonitoringState::Blind),
            body(MonitoringState::Watching),
        );
        assert_eq!(blind[0]["labels"]["alertname"], "SpandrelBlind");
        assert!(blind[0].get("endsAt").is_none() && blind[1].get("endsAt").is_some());
        assert_eq!(watching[0]["labels"], blind[0]["labels"]);
        for alert in watching.as_array().unwrap() {
            assert_eq!(alert["endsAt"], "1970-01-01T00:00:20Z");
        }
    }

    #[test]
    fn mail_contains_the_sentence_and_its_figures() {
        let (subject, text) = mail(&of_alert(&alert(20, AlertState::Raised)));
        assert_eq!(subject, "house: alert of storey-2 raised");
        for part in [
            "storey-2 has lost 12.4 % of its stiffness.\n",
            "What to look at first: Inspect storey-2.\nhttps://site.example/#/structure/house\n\
             Whom to call: Ada, +41 44 123 45 67\nWhat to do: https://site.example/alarm\n\n",
            "Structure:   house, House by the lake\nPlace:       Lake Road 4\n",
            "Measured at: 1970-01-01T00:00:20Z",
            "0.8760 of nominal, standard deviation 0.0123",
            "12.4 %, between 9.0 % and 15.0 % with 99.0 % credibility\nRule:",
            "more than 5.0 % lost with 99.0 % credibility; found 99.7 %\nFit:         supported\n\
             Data:        watching\n",
            "Samples:     measured\nAlso:        storey-1 pending: it has lost 6 %\n",
        ] {
            assert!(text.contains(part), "{part}\n{text}");
        }
    }

    #[test]
    fn subject_marks_simulations_tests_and_blindness() {
        let mut simulated = of_alert(&alert(20, AlertState::Raised));
        simulated.circumstances.origin = Origin::Simulated;
        simulated.unanswered_s = Some(1800);
        let (subject, text) = mail(&simulated);
        assert_eq!(subject, "[SIMULATED] house: alert of storey-2 raised");
        assert!(
            text.starts_with(
                "The samples are simulated, not measured.\n\nNobody has reacted for 30 min.\n\n"
            ),
            "{text}"
        );
        let blind = monitoring(
            20,
            MonitoringState::Blind,
            5,
            &["no samples of roof are used"],
        );
        let (subject, text) = mail(&content(Report::Monitoring(blind)));
        assert_eq!(subject, "house: monitoring blind");
        assert!(
            text.contains(
                "State:       blind since 1970-01-01T00:00:05Z\n\
                               Reason:      no samples of roof are used\n"
            ),
            "{text}"
        );
        for sample in samples("house") {
            let (subject, text) = mail(&sample);
            assert!(subject.starts_with("[TEST] house: "), "{subject}");
            assert!(text.starts_with("This is a test of the notices."), "{text}");
        }
    }

    #[test]
    fn notice_of_a_wrong_clock_names_node_difference_and_structure() {
        let change = |is_wrong| ClockChange {
            structure: name("house"),
            node: name("roof"),
            time_ns: 20_000_000_000,
            is_wrong,
            what: "the clock of the node is 3600.0 s ahead of most nodes".to_owned(),
            why: "2 of 3 nodes agree on another time".to_owned(),
        };
        let wrong = content(Report::Clock(change(true)));
        let value = plain(&wrong);
        assert_eq!(value["key"], "house/roof/20000000000/clock-wrong");
        assert_eq!(
            (&value["kind"], &value["state"], &value["node"]),
            (&json!("clock"), &json!("clock-wrong"), &json!("roof"))
        );
        let sentence = "node roof of house: the clock of the node is 3600.0 s ahead of most nodes";
        assert_eq!(value["sentence"], sentence);
        let (subject, text) = mail(&wrong);
        assert_eq!(subject, "house: clock-wrong, roof");
        for part in [
            "Node:        roof\nState:       clock-wrong\nFound at:    1970-01-01T00:00:20Z\n",
            "Reason:      2 of 3 nodes agree on another time\n",
            sentence,
        ] {
            assert!(text.contains(part), "{part}\n{text}");
        }
        let managed = for_alertmanager(&wrong);
        assert_eq!(managed[0]["labels"]["node"], "roof");
        assert_eq!(managed[0]["startsAt"], "1970-01-01T00:00:20Z");
        let over = for_alertmanager(&content(Report::Clock(change(false))));
        assert_eq!(over[0]["labels"], managed[0]["labels"]);
        assert_eq!(over[0]["endsAt"], "1970-01-01T00:00:20Z");
    }
}
