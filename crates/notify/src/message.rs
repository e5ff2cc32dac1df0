//! The content of notices in the formats of the receivers.

use crate::outbox::Notice;
use serde_json::{Value, json};
use spandrel_bus::{AlertMessage, AlertState, fit_in_words};

/// Returns the alert as on the bus, with its key and its time in ISO 8601.
pub(crate) fn plain(notice: &Notice) -> Value {
    let alert = &notice.alert;
    let mut value = json!(alert);
    value["key"] = json!(notice.key);
    value["time"] = json!(iso_8601(alert.time_ns));
    value
}

/// Returns the body for Alertmanager's `POST /api/v2/alerts`.
///
/// Alertmanager resolves an alert when its end has passed or when it is not repeated.
pub(crate) fn for_alertmanager(notice: &Notice) -> Value {
    let alert = &notice.alert;
    let is_over = matches!(alert.state, AlertState::Cleared | AlertState::Normal);
    let mut value = json!({
        "labels": {
            "alertname": "SpandrelStiffnessLoss",
            "structure": alert.structure.as_str(),
            "parameter": alert.parameter.as_str(),
            "severity": if matches!(alert.state, AlertState::Pending | AlertState::Undecided) { "warning" } else { "critical" },
        },
        "annotations": { "summary": alert.why, "state": alert.state.as_str(), "key": notice.key },
    });
    if let Some(verdict) = alert.fit {
        value["annotations"]["fit"] = json!(fit_in_words(verdict, alert.fit_reasons));
    }
    // The start is the same in all states, so that Alertmanager treats them as one alert.
    value["startsAt"] = json!(iso_8601(alert.since_ns.unwrap_or(alert.time_ns)));
    if is_over {
        value["endsAt"] = json!(iso_8601(alert.time_ns));
    }
    json!([value])
}

/// Returns the subject and the text of an e-mail.
pub(crate) fn mail(notice: &Notice) -> (String, String) {
    let alert = &notice.alert;
    let subject = format!(
        "{}: alert of {} {}",
        alert.structure,
        alert.parameter,
        alert.state.as_str()
    );
    (
        subject,
        format!(
            "{}.\n\n{}\nKey: {}\n",
            alert.why,
            figures(alert),
            notice.key
        ),
    )
}

fn figures(alert: &AlertMessage) -> String {
    let percent = |share: f64| format!("{:.1} %", 100.0 * share);
    let mut lines = vec![
        format!("Structure:   {}", alert.structure),
        format!("Parameter:   {}", alert.parameter),
        format!("State:       {}", alert.state.as_str()),
        format!("Measured at: {}", iso_8601(alert.time_ns)),
        format!(
            "Estimate:    {:.4} of nominal, standard deviation {:.4}",
            alert.mean, alert.std
        ),
    ];
    if let Some(reference) = alert.reference {
        lines.push(format!("Reference:   {reference:.4} of nominal"));
    }
    if let (Some(loss), Some(interval)) = (alert.loss, alert.loss_interval) {
        let (low, high, level) = (
            percent(interval.low),
            percent(interval.high),
            percent(interval.level),
        );
        lines.push(format!(
            "Loss:        {}, between {low} and {high} with {level} credibility",
            percent(loss)
        ));
        if let Some(within) = alert
            .loss_interval_within_record
            .filter(|within| *within != interval)
        {
            let (low, high) = (percent(within.low), percent(within.high));
            lines.push(format!(
                "             within this record between {low} and {high}"
            ));
        }
    }
    let (loss, asked) = (percent(alert.rule_loss), percent(alert.rule_credibility));
    lines.push(format!(
        "Rule:        more than {loss} lost with {asked} credibility; found {}",
        percent(alert.credibility)
    ));
    if let Some(verdict) = alert.fit {
        lines.push(format!(
            "Fit:         {}",
            fit_in_words(verdict, alert.fit_reasons)
        ));
    }
    if let Some(because) = alert.undecided_because {
        lines.push(format!("Undecided:   {}", because.words()));
    }
    if let Some(who) = &alert.acknowledged_by {
        lines.push(format!("Seen by:     {who}"));
    }
    lines.join("\n") + "\n"
}

fn iso_8601(time_ns: i64) -> String {
    let time = jiff::Timestamp::from_nanosecond(i128::from(time_ns));
    // The calendar of `jiff` includes every time of 64 bits in nanoseconds.
    time.map_or_else(|_| time_ns.to_string(), |time| time.to_string())
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use spandrel_bus::{CredibleInterval, Name};

    pub(crate) fn alert(seconds: i64, state: AlertState) -> AlertMessage {
        AlertMessage {
            structure: Name::new("house").unwrap(),
            parameter: Name::new("storey-2").unwrap(),
            time_ns: seconds * 1_000_000_000,
            state,
            since_ns: Some(15_000_000_000),
            rule_loss: 0.05,
            rule_credibility: 0.99,
            credibility: 0.997,
            loss: Some(0.124),
            loss_interval: Some(CredibleInterval {
                level: 0.99,
                low: 0.09,
                high: 0.15,
            }),
            loss_interval_within_record: None,
            mean: 0.876,
            std: 0.0123,
            reference: Some(1.0),
            reference_std: Some(0.0),
            acknowledged_by: None,
            why: "storey-2 has lost 12.4 % of its stiffness".to_owned(),
            fit: None,
            fit_reasons: spandrel_bus::FitReasons::default(),
            follows_jump: false,
            undecided_because: None,
            revision: 0,
        }
    }

    fn notice(state: AlertState) -> Notice {
        Notice {
            receiver: 0,
            key: "house/storey-2/20/raised".to_owned(),
            alert: alert(20, state),
        }
    }

    #[test]
    fn a_program_gets_the_alert_as_on_the_bus_with_its_key() {
        let value = plain(&notice(AlertState::Raised));
        assert_eq!(value["state"], "raised");
        assert_eq!(value["key"], "house/storey-2/20/raised");
        assert_eq!(value["time"], "1970-01-01T00:00:20Z");
        assert_eq!(value["why"], "storey-2 has lost 12.4 % of its stiffness");
    }

    #[test]
    fn alertmanager_gets_one_alert_that_begins_and_ends() {
        let raised = for_alertmanager(&notice(AlertState::Raised));
        assert_eq!(raised[0]["labels"]["parameter"], "storey-2");
        assert_eq!(raised[0]["startsAt"], "1970-01-01T00:00:15Z");
        assert!(raised[0].get("endsAt").is_none());
        let cleared = for_alertmanager(&notice(AlertState::Cleared));
        assert_eq!(cleared[0]["labels"], raised[0]["labels"]);
        assert_eq!(cleared[0]["endsAt"], "1970-01-01T00:00:20Z");
    }

    #[test]
    fn people_get_the_sentence_and_the_figures_behind_it() {
        let (subject, text) = mail(&notice(AlertState::Raised));
        assert_eq!(subject, "house: alert of storey-2 raised");
        for part in [
            "storey-2 has lost 12.4 % of its stiffness.",
            "1970-01-01T00:00:20Z",
            "0.8760 of nominal, standard deviation 0.0123",
            "12.4 %, between 9.0 % and 15.0 % with 99.0 % credibility",
            "more than 5.0 % lost with 99.0 % credibility; found 99.7 %",
        ] {
            assert!(text.contains(part), "{part}\n{text}");
        }
    }
}
