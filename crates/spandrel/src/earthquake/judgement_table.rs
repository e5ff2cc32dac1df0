//! What a report judges, as a table with one row per stiffness.

use super::page::{escape, list};
use super::report::{EventReport, ParameterReport};
use super::wording::{
    alerts, comparisons, percent, percent_range, probability, ratios, told_losses,
};
use spandrel_earthquake::{LastingLoss, Softening};

/// Returns the alerts, the table, and with what the softening is compared.
pub fn html(report: &EventReport) -> String {
    let open = alerts(report);
    let judged: Vec<&ParameterReport> = report
        .parameters
        .iter()
        .filter(|parameter| {
            let judgement = &parameter.judgement;
            judgement.softening.is_some()
                || judgement.weak.is_some()
                || !told_losses(parameter).is_empty()
        })
        .collect();
    let title = "What is judged";
    if judged.is_empty() {
        return list(title, &open);
    }
    let rows: String = judged
        .iter()
        .map(|parameter| row(report, parameter))
        .collect();
    let notes: String = comparisons(report)
        .iter()
        .map(|note| format!("<p class=\"note\">{}</p>\n", escape(note)))
        .collect();
    let head = match open.is_empty() {
        true => format!("<h2>{title}</h2>\n"),
        false => list(title, &open),
    };
    format!(
        "{head}<table class=\"judged\">\n<thead><tr><th scope=\"col\">stiffness</th>\
         <th scope=\"col\">softest during the shaking</th>\
         <th scope=\"col\">earlier events predict</th>\
         <th scope=\"col\">at the end</th>\
         <th scope=\"col\">weak motion</th>\
         <th scope=\"col\">lasting loss</th></tr></thead>\n<tbody>\n{rows}</tbody>\n</table>\n\
         <p class=\"note\">Softest: change against the sound stiffness, with its 95 % interval. \
         At the end: share of the sound stiffness when the record last showed it. Weak motion: \
         ratio to nominal, and what the earlier events predict.</p>\n{notes}"
    )
}

fn row(report: &EventReport, parameter: &ParameterReport) -> String {
    let judgement = &parameter.judgement;
    let dash = || "–".to_owned();
    let softening = judgement.softening.as_ref();
    let softest = softening.map_or_else(dash, |one| softest(one, report));
    let predicted = softening.map_or_else(dash, |one| match one.expected {
        Some(expected) => format!(
            "{} ({:.1} standard deviations {})",
            percent(expected.change),
            expected.deviations.abs(),
            match expected.deviations < 0.0 {
                true => "softer",
                false => "stiffer",
            }
        ),
        None => "no earlier event".to_owned(),
    });
    let last = softening.and(parameter.course.last());
    let end = last.zip(judgement.reference).map(|(last, reference)| {
        format!(
            "{} at {:.0} s",
            percent((last.y - reference.y).exp()),
            0.5 * (last.start_s + last.end_s)
        )
    });
    let weak = judgement.weak.map(|weak| {
        let stiffness = weak.motion.y.exp();
        match weak.predicted {
            Some(interval) => format!(
                "{stiffness:.2}, {} {}",
                match interval.contains(stiffness) {
                    true => "inside",
                    false => "outside",
                },
                ratios(interval)
            ),
            None => format!("{stiffness:.2}"),
        }
    });
    let lost: Vec<String> = told_losses(parameter)
        .into_iter()
        .map(|(loss, since)| format!("since {}: {}", since.title(), lost(loss, report)))
        .collect();
    let lost = match lost.is_empty() {
        true => dash(),
        false => lost.join("; "),
    };
    let cells = [
        softest,
        predicted,
        end.unwrap_or_else(dash),
        weak.unwrap_or_else(dash),
        lost,
    ];
    let cells: String = cells
        .iter()
        .map(|cell| format!("<td>{}</td>", escape(cell)))
        .collect();
    format!(
        "<tr><th scope=\"row\">{}</th>{cells}</tr>\n",
        escape(&parameter.name)
    )
}

fn softest(softening: &Softening, report: &EventReport) -> String {
    let interval = softening.interval;
    let size = format!(
        "{} ({}) at {:.0} s",
        percent(softening.change),
        percent_range(interval.low, interval.high),
        softening.at_s
    );
    match softening.is_raised || softening.change >= 0.0 {
        true => size,
        false => format!(
            "{size}; more than {} with probability {} only",
            percent(report.settings.loss),
            probability(softening.probability)
        ),
    }
}

fn lost(loss: &LastingLoss, report: &EventReport) -> String {
    format!(
        "{} ({}), P(more than {}) = {}: {}",
        percent(loss.loss),
        percent_range(loss.interval.low, loss.interval.high),
        percent(report.settings.loss),
        probability(loss.probability),
        super::wording::verdict(loss)
    )
}
