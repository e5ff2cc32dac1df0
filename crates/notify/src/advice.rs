//! The advice of a notice: the first action to take, in one or two sentences.

use crate::content::{Report, Scene};
use spandrel_bus::{
    AlertMessage, AlertState, FitVerdict, JudgementDisplay, MonitoringDisplay, MonitoringState,
    UndecidedBecause, fit_in_words,
};

/// Returns the advice for a report.
pub(crate) fn advice(report: &Report, scene: &Scene<'_>) -> String {
    match report {
        Report::Alert(alert) => of_alert(alert, scene),
        Report::Monitoring(display) => of_monitoring(display, scene),
        Report::Summary(_) => "Read the lines below. A separate notice follows for each state \
                               that lasts."
            .to_owned(),
        Report::Judgement(display) => of_judgement(display),
        Report::Earthquake(_) => {
            "Read the report. It says whether an inspector is needed.".to_owned()
        }
        Report::Clock(change) if change.is_wrong => format!(
            "Check the time synchronisation of {} (NTP, PTP or GPS). A difference of whole hours \
             means a wrong time zone.",
            change.node
        ),
        Report::Clock(_) => "No action is required.".to_owned(),
    }
}

fn of_judgement(display: &JudgementDisplay) -> String {
    let is_alarm = display.change.is_some_and(|change| change.kind.is_alarm());
    match is_alarm {
        true => format!(
            "Find out what has changed at {} since that day. Check its thermometers as well.",
            display.quantity
        ),
        false => "No action is required.".to_owned(),
    }
}

fn of_alert(alert: &AlertMessage, scene: &Scene<'_>) -> String {
    let part = &alert.parameter;
    match alert.state {
        AlertState::Cleared | AlertState::Normal | AlertState::Learning => {
            return "No action is required.".to_owned();
        }
        AlertState::Acknowledged => {
            let who = alert.acknowledged_by.as_deref().unwrap_or("Somebody");
            return format!("{who} has acknowledged the alert. Ask {who} for the present state.");
        }
        AlertState::SofteningInMotion => {
            return format!(
                "The report of the earthquake states how urgent an inspection is. {part} is judged \
                 again from weak motion."
            );
        }
        AlertState::Undecided => {
            let because = alert.undecided_because.map_or("", UndecidedBecause::words);
            return format!(
                "Remove the cause first, because no alert of {part} can be decided: {because}."
            );
        }
        AlertState::Pending | AlertState::Raised | AlertState::Unconfirmed => {}
    }
    if alert.fit == Some(FitVerdict::Contradicted) {
        let fit = fit_in_words(FitVerdict::Contradicted, alert.fit_reasons);
        return format!(
            "Check the model before the structure ({fit}). The loss may be an error of the model."
        );
    }
    if let Some(sensors) = scene.monitoring.and_then(|display| doubted(display, scene)) {
        return format!("Check the sensors first: {sensors}. Then inspect {part}.");
    }
    if alert.follows_jump {
        return format!(
            "The change is sudden and has not settled. Find out what happened to {part} at this \
             time, such as a collision or an earthquake."
        );
    }
    if alert.state == AlertState::Unconfirmed {
        return format!(
            "The present data do not confirm the loss of {part}. Look at the data quality first."
        );
    }
    if alert.fit == Some(FitVerdict::Doubtful) {
        let fit = fit_in_words(FitVerdict::Doubtful, alert.fit_reasons);
        return format!("Inspect {part}, and check the model ({fit}).");
    }
    let is_watched = |display: &MonitoringDisplay| display.state == MonitoringState::Watching;
    if !scene.monitoring.is_some_and(is_watched) {
        return format!("Inspect {part}, and check the data: not all of the structure is watched.");
    }
    format!("Inspect {part} first: the data are good, and nothing contradicts the loss.")
}

fn of_monitoring(display: &MonitoringDisplay, scene: &Scene<'_>) -> String {
    if display.state == MonitoringState::Watching {
        return "No action is required.".to_owned();
    }
    if scene.monitoring.is_none() {
        return "Check the server first: the alert service does not run, or it has no connection. \
                `spandrel watch` shows the services that are present."
            .to_owned();
    }
    if let Some(sensors) = doubted(display, scene) {
        return format!("Check the sensors first: {sensors}. Look at power, clock and link.");
    }
    let is_contradicted =
        |alert: &AlertMessage| alert.undecided_because == Some(UndecidedBecause::FitContradicted);
    if scene.alerts.values().any(is_contradicted) {
        return "Check the model first: the data contradict it, so that no alert is decided."
            .to_owned();
    }
    "Check the sensors of the structure and their link to the server first. The page of the \
     structure shows which samples arrive."
        .to_owned()
}

/// Names the nodes that are absent, and the channels with lost samples. `None` if there are none.
fn doubted(display: &MonitoringDisplay, scene: &Scene<'_>) -> Option<String> {
    let is_absent = |node: &str| scene.absent.iter().any(|absent| absent.as_str() == node);
    let of_node = |(node, channels): &(String, Vec<String>)| {
        if is_absent(node) {
            return Some(format!("node {node} is absent ({})", channels.join(", ")));
        }
        let impaired = display.channels.iter().filter(|channel| {
            let is_own = channels.iter().any(|own| own == channel.channel.as_str());
            is_own && channel.state != MonitoringState::Watching
        });
        let shares: Vec<String> = impaired
            .map(|channel| format!("{} {:.0} %", channel.channel, 100.0 * channel.used_share))
            .collect();
        (!shares.is_empty()).then(|| format!("node {node} (samples used: {})", shares.join(", ")))
    };
    let nodes: Vec<String> = scene.facts.channels.iter().filter_map(of_node).collect();
    (!nodes.is_empty()).then(|| nodes.join("; "))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::content::Facts;
    use crate::origin::Origin;
    use crate::testing::{alert, monitoring, name};
    use std::collections::{BTreeMap, BTreeSet};

    fn given(report: Report, state: Option<MonitoringState>, absent: &[&str]) -> String {
        let facts = Facts {
            structure: name("house"),
            title: String::new(),
            place: String::new(),
            contact: String::new(),
            runbook: String::new(),
            parameters: Vec::new(),
            channels: vec![
                ("ground-node".to_owned(), vec!["ground".to_owned()]),
                ("roof-node".to_owned(), vec!["roof".to_owned()]),
            ],
            has_alert_service: true,
            public_url: None,
        };
        let display = state.map(|state| monitoring(9, state, 5, &["x"]));
        let scene = Scene {
            facts: &facts,
            alerts: &BTreeMap::new(),
            monitoring: display.as_ref(),
            origin: Origin::Measured,
            fit: None,
            absent: &absent
                .iter()
                .map(|node| name(node))
                .collect::<BTreeSet<_>>(),
            earthquake: None,
        };
        advice(&report, &scene)
    }

    #[test]
    fn advice_depends_on_the_evidence_against_the_loss() {
        let watching = Some(MonitoringState::Watching);
        let raised = |change: fn(&mut AlertMessage)| {
            let mut alert = alert(20, AlertState::Raised);
            change(&mut alert);
            Report::Alert(alert)
        };
        let contradicted = raised(|alert| alert.fit = Some(FitVerdict::Contradicted));
        assert!(given(contradicted, watching, &[]).starts_with("Check the model before"));
        let jump = raised(|alert| alert.follows_jump = true);
        assert!(given(jump, watching, &[]).starts_with("The change is sudden"));
        let clear = raised(|_| {});
        assert!(given(clear.clone(), watching, &[]).starts_with("Inspect storey-2 first"));
        let degraded = given(clear, Some(MonitoringState::Degraded), &[]);
        assert_eq!(
            degraded,
            "Check the sensors first: node roof-node (samples used: roof 33 %). Then inspect \
             storey-2."
        );
    }

    #[test]
    fn advice_for_a_blind_structure_names_the_node_or_the_server() {
        let blind = || Report::Monitoring(monitoring(9, MonitoringState::Blind, 5, &["x"]));
        let advice = given(blind(), Some(MonitoringState::Watching), &["ground-node"]);
        assert!(
            advice.contains("node ground-node is absent (ground)"),
            "{advice}"
        );
        assert!(given(blind(), None, &[]).starts_with("Check the server first"));
    }
}
