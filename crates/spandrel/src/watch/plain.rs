//! The view as plain lines, for pipes, scripts and logs.
//!
//! There is one line per change of an alert, which [`Change`](super::open_alert::Change) writes, and
//! one line per second and structure. Each distributed node has a line from
//! [`plain_line`](super::nodes::plain_line).

use super::conditions::condition_texts;
use super::heard::Origin;
use super::judgements::judgement_texts;
use super::modes::mode_texts;
use super::natural_name::in_order;
use super::structure_panel::{fit_words, leading_class};
use super::wording::{NO_MODEL, duration, estimate, lag, nothing_measured, time};
use spandrel_bus::{Load, Name, Service};
use spandrel_listener::StructureState;
use std::fmt::Write as _;

/// Returns the line of a structure: `TIME STRUCTURE PARAMETER MEAN ± STD STATE, …; SERVICE lag LAG,
/// …`.
pub fn structure_line(name: &Name, structure: &StructureState) -> String {
    let conditions: Vec<String> = condition_texts(structure)
        .chain(mode_texts(structure))
        .chain(judgement_texts(structure))
        .collect();
    let conditions = match conditions.is_empty() {
        true => String::new(),
        false => format!("; {}", conditions.join(", ")),
    };
    let Some(time_ns) = structure.time_ns else {
        return format!(
            "{name} {}{}{conditions}{}",
            nothing_measured(structure),
            alerts(structure),
            services(structure)
        );
    };
    let parameters = in_order(&structure.parameters).into_iter();
    let parameters = parameters.map(|(parameter, display)| {
        let state = structure
            .alerts
            .get(parameter)
            .map_or("", |alert| alert.state.as_str());
        let stale = if structure.is_alert_stale(parameter) {
            " (stale)"
        } else {
            ""
        };
        format!(
            "{} {} {state}{stale}",
            parameter,
            estimate(display.mean, display.std)
        )
        .trim_end()
        .to_owned()
    });
    let mut parameters: Vec<String> = parameters.collect();
    if structure.has_only_modes() {
        parameters.push(NO_MODEL.to_owned());
    }
    let stale = structure
        .stale_for()
        .map(|silence| format!("stale {}: ", duration(silence)));
    let fit = structure
        .fit
        .as_ref()
        .map(|fit| format!("; fit {}", fit_words(fit)));
    let monitoring = structure
        .monitoring()
        .map(|display| format!("; {}", display.words()));
    let class = structure
        .classes
        .as_ref()
        .map(|classes| format!("; class {}", leading_class(classes)));
    format!(
        "{}{} {name} {}{}{}{}{}{conditions}{}",
        time(time_ns),
        match Origin::of(structure) {
            Origin::Measured => "",
            Origin::Replayed => " of a record or simulation",
            Origin::ReadAgain => " read again from the recording",
        },
        stale.unwrap_or_default(),
        parameters.join(", "),
        monitoring.unwrap_or_default(),
        fit.unwrap_or_default(),
        class.unwrap_or_default(),
        services(structure)
    )
}

/// Returns the states of alerts for which no value has arrived: `: PARAMETER STATE, …`.
fn alerts(structure: &StructureState) -> String {
    let alerts = in_order(&structure.alerts).into_iter();
    let states = alerts.map(|(parameter, alert)| {
        let stale = if structure.is_alert_stale(parameter) {
            " (stale)"
        } else {
            ""
        };
        format!("{parameter} {}{stale}", alert.state.as_str())
    });
    match &states.collect::<Vec<_>>()[..] {
        [] => String::new(),
        states => format!(": {}", states.join(", ")),
    }
}

fn services(structure: &StructureState) -> String {
    let mut text = String::new();
    for ((service, id), instance) in &structure.instances {
        if *service == Service::Sensor {
            continue;
        }
        let separator = if text.is_empty() { "; " } else { ", " };
        // Writing to a string cannot fail.
        let _ = write!(text, "{separator}{}/{id}", service.as_str());
        let Some(status) = &instance.status else {
            continue;
        };
        if let Some(lag_s) = status.lag_s.filter(|_| structure.has_lag()) {
            let _ = write!(text, " {}", lag(lag_s));
        }
        if let Some(load) = status.load.filter(|load| *load != Load::Normal) {
            let _ = write!(text, " {}", load.as_str());
        }
        let dropped: u64 = status.drops.values().sum();
        if dropped > 0 {
            let _ = write!(text, " drops {dropped}");
        }
        if !instance.is_present {
            text.push_str(" gone");
        } else if let Some(silence) = structure.status_stale_for(instance) {
            let _ = write!(text, " stale {}", duration(silence));
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::super::heard::Heard;
    use super::super::testing::{
        alert, at, classes, damaged_tower, heard, name, parameter, present, progress, status,
    };
    use super::*;
    use spandrel_bus::{AlertState, Pace, Status};
    use spandrel_listener::Input;

    fn line(heard: &Heard) -> String {
        let tower = name("tower");
        structure_line(&tower, heard.structure(&tower).unwrap())
    }

    #[test]
    fn a_structure_is_one_line() {
        assert_eq!(
            line(&damaged_tower()),
            "2024-02-29 12:00:59 UTC tower storey-1 1.002 ± 0.011 normal, storey-2 0.858 ± 0.011 \
             raised, storey-3 1.002 ± 0.011 normal, storey-4 1.002 ± 0.011 normal, storey-5 1.002 \
             ± 0.011 normal; ingest/a lag 0.12 s, identify/a lag 0.21 s drops 3, alert/a lag 0.25 s"
        );
    }

    #[test]
    fn stale_data_and_ended_services_are_marked() {
        let mut heard = heard([
            Input::Parameter(parameter("storey-1", 0, 1.0, 0.1)),
            present(&[(Service::Ingest, "a")]),
        ]);
        heard.handle(at(12), &mut Vec::new());
        assert_eq!(
            line(&heard),
            "2024-02-29 12:00:00 UTC tower stale 12 s: storey-1 1.000 ± 0.100; ingest/a"
        );
        let mut tower = damaged_tower();
        tower.handle(present(&[]), &mut Vec::new());
        assert!(
            line(&tower).contains("storey-2 0.858 ± 0.011 raised (stale), storey-3 "),
            "{}",
            line(&tower)
        );
        assert!(line(&tower).ends_with(
            "ingest/a lag 0.12 s gone, identify/a lag 0.21 s drops 3 gone, alert/a lag 0.25 s gone"
        ));
    }

    #[test]
    fn replayed_data_have_their_own_time_and_no_lag() {
        let mut tower = damaged_tower();
        let ingest = Status {
            pace: Some(Pace::Replayed),
            ..status(Service::Ingest, -27.0, &[])
        };
        tower.handle(Input::Status(ingest), &mut Vec::new());
        let told = line(&tower);
        assert!(
            told.starts_with("2024-02-29 12:00:59 UTC of a record or simulation tower storey-1"),
            "{told}"
        );
        assert!(
            told.ends_with("; ingest/a, identify/a drops 3, alert/a"),
            "{told}"
        );
    }

    /// Regression test: for some seconds after a restart, these values counted as newly measured.
    #[test]
    fn reread_values_are_marked() {
        let known = Input::Ingested(name("tower"), progress(7, 60));
        let mut heard = heard([known, Input::Parameter(parameter("storey-1", 58, 1.0, 0.1))]);
        let told =
            "2024-02-29 12:00:58 UTC read again from the recording tower storey-1 1.000 ± 0.100";
        assert_eq!(line(&heard), told);
        heard.handle(
            Input::Parameter(parameter("storey-1", 61, 1.0, 0.1)),
            &mut Vec::new(),
        );
        assert_eq!(
            line(&heard),
            "2024-02-29 12:01:01 UTC tower storey-1 1.000 ± 0.100"
        );
    }

    /// Before the first epoch is over, only the frames show that data arrive.
    #[test]
    fn structure_without_a_model_does_not_lack_data() {
        let services = [(Service::Ingest, "a"), (Service::Modes, "a")];
        let frames = [60, 61].map(|second| Input::Ingested(name("tower"), progress(7, second)));
        let heard = heard([present(&services)].into_iter().chain(frames));
        assert_eq!(
            line(&heard),
            "2024-02-29 12:01:01 UTC tower no model: natural frequencies only; ingest/a, modes/a"
        );
    }

    #[test]
    fn line_states_that_no_data_have_arrived() {
        assert_eq!(
            line(&heard([present(&[(Service::Ingest, "a")])])),
            "tower no data yet; ingest/a"
        );
    }

    #[test]
    fn active_alerts_are_shown_without_data() {
        let raised = Input::StandingAlert(alert("storey-2", 45, AlertState::Raised));
        let told = line(&heard([present(&[(Service::Alert, "a")]), raised]));
        assert_eq!(
            told,
            "tower no data since this view was started: storey-2 raised; alert/a"
        );
    }

    #[test]
    fn leading_class_is_shown_with_its_plausibility() {
        let mut tower = damaged_tower();
        tower.handle(
            Input::Classes(classes("storey-2", 0.982, 3)),
            &mut Vec::new(),
        );
        let told = line(&tower);
        assert!(
            told.contains(
                "; class storey-2 leads with 98.2 %, previously baseline, 3 calibrations; ingest/a"
            ),
            "{told}"
        );
    }
}
