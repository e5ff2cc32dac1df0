//! Weak motion in sentences: what was predicted, and what was found.

use super::super::report::{EventReport, ParameterReport};
use super::percent;
use spandrel_earthquake::{FEWEST_EVENTS, Interval};

/// The open alerts of the running services and the alerts of the record, one sentence each.
pub fn alerts(report: &EventReport) -> Vec<String> {
    let open = report.open_alerts.iter();
    let open = open.map(|why| format!("An alert of the running services is open: {why}."));
    let raised = report.alerts.iter();
    let raised = raised.map(|why| format!("An alert is raised: {why}."));
    open.chain(raised).collect()
}

/// The first alert, and how many there are.
pub(super) fn alert_headline(report: &EventReport) -> Option<String> {
    let alerts = alerts(report);
    let first = alerts.first()?;
    match alerts.len() {
        1 => Some(first.clone()),
        count => Some(format!("{first} In total, {count} alerts are open.")),
    }
}

/// A stiffness in weak motion that is not as predicted.
pub(super) fn unpredicted_headline(report: &EventReport) -> Option<String> {
    let (parameter, stiffness, interval) = report.unpredicted()?;
    Some(format!(
        "In weak motion, the stiffness of {} is {stiffness:.2} of nominal, {} the {} that the \
         earlier events predict. A further record of weak motion can confirm it.",
        parameter.name,
        if stiffness < interval.low {
            "below"
        } else {
            "above"
        },
        ratios(interval)
    ))
}

/// Formats an interval of ratios: `0.87 to 1.21`.
pub fn ratios(interval: Interval) -> String {
    format!("{:.2} to {:.2}", interval.low, interval.high)
}

/// The result of weak motion without a conspicuous value. Only a stiffness with a prediction can
/// show no sign of change.
pub(super) fn weak_headline(report: &EventReport) -> String {
    let names = |parameters: &[&ParameterReport]| {
        let names = parameters.iter().map(|parameter| parameter.name.as_str());
        names.collect::<Vec<_>>().join(", ")
    };
    let (judged, unjudged): (Vec<_>, Vec<_>) = report
        .parameters
        .iter()
        .partition(|parameter| is_predicted(parameter, report));
    match (judged.is_empty(), unjudged.first()) {
        (true, None) => "Weak motion. Nothing is judged, because the structure file has no \
                         [[parameter]] that scales a stiffness."
            .to_owned(),
        (true, Some(first)) => format!(
            "Weak motion. Nothing is judged: {}.",
            unpredictable(first, report)
        ),
        (false, None) => {
            "Weak motion, no sign of change: the stiffness is as the earlier events predict."
                .to_owned()
        }
        (false, Some(_)) => format!(
            "Weak motion, no sign of change of {}. Not judged: {}.",
            names(&judged),
            names(&unjudged)
        ),
    }
}

/// Returns `true` if the weak motion of the record can be compared with a prediction that reveals
/// twice the loss of the report.
pub(super) fn is_predicted(parameter: &ParameterReport, report: &EventReport) -> bool {
    let weak = parameter.judgement.weak;
    weak.and_then(|weak| weak.predicted)
        .is_some_and(|predicted| reveals_loss(predicted, report))
}

fn reveals_loss(predicted: Interval, report: &EventReport) -> bool {
    let middle = 0.5 * (predicted.low + predicted.high);
    predicted.low > (1.0 - 2.0 * report.settings.loss) * middle
}

/// Why the weak motion of a record cannot be compared with a prediction.
pub(super) fn unpredictable(parameter: &ParameterReport, report: &EventReport) -> String {
    let Some(weak) = parameter.judgement.weak else {
        return "the record shows no stiffness in weak motion".to_owned();
    };
    if let Some(predicted) = weak.predicted {
        let hidden = percent(2.0 * report.settings.loss);
        let range = ratios(predicted);
        return format!(
            "the earlier events predict {range}, which is too wide to reveal a loss of {hidden}"
        );
    }
    let found = parameter.judgement.earlier();
    format!(
        "the records contain {found} earlier event{} with weak motion, and {FEWEST_EVENTS} are \
         required",
        if found == 1 { "" } else { "s" }
    )
}
