//! The judgement of an event in sentences.

mod weak;

use super::report::{EventName, EventReport, ParameterReport, Source};
use spandrel_earthquake::motion::GRAVITY;
use spandrel_earthquake::{LastingLoss, ReferenceKind, Softening, Urgency, Waiting};
use weak::alert_headline;
pub use weak::{alerts, ratios};
use weak::{is_predicted, unpredictable, unpredicted_headline, weak_headline};

/// Formats a share in per cent without decimals, with the typographic minus sign.
pub fn percent(share: f64) -> String {
    format!("{:.0} %", 100.0 * share)
        .replace("-0 %", "0 %")
        .replace('-', "−")
}

/// Formats an interval of shares: `35 to 57 %`.
pub fn percent_range(low: f64, high: f64) -> String {
    let text = format!("{:.0} to {:.0} %", 100.0 * low, 100.0 * high);
    text.replace("-0 ", "0 ").replace('-', "−")
}

/// Formats a probability so that it never reads as impossible or certain.
pub fn probability(value: f64) -> String {
    match value {
        small if small < 0.001 => "below 0.001".to_owned(),
        large if large > 0.999 => "above 0.999".to_owned(),
        other => format!("{other:.3}"),
    }
}

/// Formats an acceleration with two significant decimals in m/s² and in g.
pub fn acceleration(m_per_s2: f64) -> String {
    format!("{m_per_s2:.2} m/s² ({:.2} g)", m_per_s2 / GRAVITY)
}

/// What happened.
pub fn happened(report: &EventReport) -> Vec<String> {
    let mut sentences = Vec::new();
    let peak = |is_excitation: bool| {
        let all = report.sensors.iter().filter(|sensor| {
            sensor.figures.is_excitation == is_excitation && sensor.figures.intensity.is_some()
        });
        let peaks = all.filter_map(|sensor| Some((&sensor.figures, sensor.figures.motion?)));
        peaks.max_by(|a, b| a.1.peak.total_cmp(&b.1.peak))
    };
    if let Some((figures, motion)) = peak(false) {
        let kind = if report.shook() {
            "Strong shaking"
        } else {
            "Weak motion"
        };
        sentences.push(format!(
            "{kind}: the structure reached {} at {}, {:.1} s after the start of the record.",
            acceleration(motion.peak),
            figures.channel,
            motion.peak_at_s
        ));
    }
    if let Some((figures, motion)) = peak(true) {
        let duration = figures
            .intensity
            .map_or(0.0, |one| one.significant_duration_s);
        sentences.push(format!(
            "The ground reached {} at {}. The significant part of its motion (D5-95) lasted \
             {duration:.1} s.",
            acceleration(motion.peak),
            figures.channel
        ));
    }
    sentences
}

/// What is judged.
pub fn judged(report: &EventReport) -> Vec<String> {
    let mut sentences = alerts(report);
    for parameter in &report.parameters {
        let name = &parameter.name;
        if let Some(softening) = &parameter.judgement.softening {
            sentences.push(softened(name, softening, report));
            sentences.extend(compared_with(parameter).map(|text| format!("It is {text}")));
            sentences.extend(regained(parameter));
        }
        if let Some(weak) = &parameter.judgement.weak {
            let where_ = match parameter.course.has_shaking {
                true => "In weak motion after the shaking",
                false => "In the weak motion of this record",
            };
            let mut text = format!(
                "{where_}, the stiffness of {name} is {:.2} of nominal ({:.2} to {:.2} within this \
                 record)",
                weak.motion.y.exp(),
                weak.within.low,
                weak.within.high
            );
            text += &match weak.predicted {
                Some(interval) => format!(
                    "; for this structure, the earlier events predict {}, and it lies {}.",
                    ratios(interval),
                    if interval.contains(weak.motion.y.exp()) {
                        "inside"
                    } else {
                        "outside"
                    }
                ),
                None => ".".to_owned(),
            };
            sentences.push(text);
        }
        for (loss, since) in told_losses(parameter) {
            sentences.push(lasting(name, loss, since, report));
        }
    }
    sentences
}

/// Returns the lasting losses that a report states of a stiffness: the one since its own event, and
/// the worst one. Each has the event since which it lasts.
pub fn told_losses(parameter: &ParameterReport) -> Vec<(&LastingLoss, &EventName)> {
    let judgement = &parameter.judgement;
    let worst = judgement.raised().or_else(|| judgement.most_probable());
    let is_told =
        |since: usize| since == judgement.event || worst.is_some_and(|(worst, _)| worst == since);
    let told = judgement.lasting.iter();
    told.filter(|candidate| is_told(candidate.since))
        .filter_map(|candidate| {
            let since = parameter.events.get(candidate.since)?;
            Some((candidate.loss.as_ref()?, &since.name))
        })
        .collect()
}

/// What is not judged, and why.
pub fn not_judged(report: &EventReport) -> Vec<String> {
    let mut sentences = Vec::new();
    if report.parameters.is_empty() {
        sentences.push(
            "No stiffness is judged, because the structure file has no [[parameter]] that scales a \
             stiffness."
                .to_owned(),
        );
    }
    sentences.extend(merged(&unjudged_parts(report)));
    sentences.extend(unjudged_record(report));
    sentences
}

/// A stiffness, and a sentence about it.
struct Told<'r> {
    name: &'r str,
    text: String,
}

/// Returns one sentence for each text, with the names of all stiffnesses that it is about.
fn merged(all: &[Told]) -> Vec<String> {
    let is_first = |index: usize| all[..index].iter().all(|one| one.text != all[index].text);
    let firsts = all.iter().enumerate().filter(|(index, _)| is_first(*index));
    firsts
        .map(|(_, first)| {
            let same = all.iter().filter(|one| one.text == first.text);
            let names: Vec<&str> = same.map(|one| one.name).collect();
            capitalised(&format!("{}: {}", names.join(", "), first.text))
        })
        .collect()
}

fn unjudged_parts(report: &EventReport) -> Vec<Told<'_>> {
    let mut all = Vec::new();
    for parameter in &report.parameters {
        let mut tell = |text: String| {
            all.push(Told {
                name: &parameter.name,
                text,
            });
        };
        let judgement = &parameter.judgement;
        if parameter.course.points.is_empty() {
            tell(
                "the record contains no information about this stiffness. The motion is too weak, \
                 or the data cannot be used."
                    .to_owned(),
            );
        }
        if !report.shook()
            && !parameter.course.points.is_empty()
            && !is_predicted(parameter, report)
        {
            tell(format!(
                "a change in weak motion is not judged, because {}.",
                unpredictable(parameter, report)
            ));
        }
        if parameter.course.has_shaking && judgement.softening.is_none() {
            tell(
                "the softening during the shaking is not known. No window of the shaking contains \
                 enough information, or the sound stiffness is unknown."
                    .to_owned(),
            );
        }
        if judgement
            .softening
            .is_some_and(|softening| softening.is_contradicted)
        {
            tell(
                "in the strongest motion the data contradict the linear model. The softening \
                 is therefore a rough figure, and its interval too narrow."
                    .to_owned(),
            );
        }
        if let Some(waiting) = judgement.own().and_then(|own| own.waiting) {
            tell(waits(waiting));
        }
        if let Some((_, loss)) = judgement.most_probable()
            && !loss.is_raised
        {
            tell(format!(
                "with {} events before and {} since, a lasting loss below {} cannot be raised.",
                loss.earlier,
                loss.later,
                percent(loss.smallest)
            ));
        }
    }
    all
}

/// What is not judged of the whole record.
fn unjudged_record(report: &EventReport) -> Vec<String> {
    let mut sentences = Vec::new();
    if report.fit.is_none() {
        sentences.push(
            "Whether the model fits the data is not judged with this kind of filter, or the record \
             is too short for a verdict."
                .to_owned(),
        );
    }
    if let Some(why) = report.no_responses {
        sentences.push(format!("Displacements and drifts are not stated: {why}."));
    }
    let suspected: Vec<&str> = report
        .sensors
        .iter()
        .filter(|sensor| sensor.health.is_suspected())
        .map(|sensor| sensor.figures.channel.as_str())
        .collect();
    if !suspected.is_empty() {
        sentences.push(format!(
            "The figures of {} are doubtful, because the sensor disagrees with the others.",
            suspected.join(", ")
        ));
    }
    sentences
}

/// The result in one or two sentences.
pub fn headline(report: &EventReport) -> String {
    let parts = [
        softening_headline(report),
        alert_headline(report),
        unpredicted_headline(report),
        lasting_headline(report),
    ];
    let told: Vec<String> = parts.into_iter().flatten().collect();
    let told = if told.is_empty() {
        match report.shook() {
            true => "Strong shaking whose effect on the stiffness is not known.".to_owned(),
            false => weak_headline(report),
        }
    } else {
        told.join(" ")
    };
    let action = match report.urgency {
        Urgency::InspectFirst => " Inspect this structure first.",
        Urgency::Inspect => " Inspect this structure.",
        Urgency::Watch | Urgency::NoAction => "",
    };
    told + action
}

/// The softening in strong motion. `None` if the structure did not shake strongly.
fn softening_headline(report: &EventReport) -> Option<String> {
    if !report.shook() {
        return None;
    }
    let all = report
        .parameters
        .iter()
        .filter_map(|parameter| Some((parameter, parameter.judgement.softening?)));
    // The filter lags behind a sudden softening, so that the whole structure goes first.
    let order = |parameter: &ParameterReport| parameter.source == Source::Parameter;
    let (parameter, softening) = all.min_by(|a, b| {
        let by_source = order(a.0).cmp(&order(b.0));
        by_source.then(a.1.change.total_cmp(&b.1.change))
    })?;
    if !softening.is_raised {
        return Some(format!(
            "Strong shaking without a certain softening of more than {}.",
            percent(report.settings.loss)
        ));
    }
    let expected = match softening.expected {
        None => ", for the first time in these records",
        Some(expected) if expected.is_as_expected => ", as expected at this amplitude",
        Some(expected) if expected.deviations < 0.0 => ", more than expected at this amplitude",
        Some(_) => ", less than expected at this amplitude",
    };
    Some(format!(
        "Strong shaking softened {} by {} while it lasted{expected}.",
        parameter.name,
        percent(-softening.change)
    ))
}

fn lasting_headline(report: &EventReport) -> Option<String> {
    let waits = (report.shook() && !report.own_is_judged())
        .then(|| "Whether a loss remains cannot be judged yet.".to_owned());
    let Some((parameter, since, loss)) = report.worst_loss() else {
        return waits;
    };
    let (name, since) = (&parameter.name, since.title());
    let range = percent_range(loss.interval.low, loss.interval.high);
    let found = match loss {
        loss if loss.is_raised => format!(
            "{} has permanently lost {} of its stiffness since {since} ({range}).",
            capitalised(name),
            percent(loss.loss)
        ),
        loss if loss.probability >= 0.5 => format!(
            "A lasting loss of {} of {name} since {since} ({range}) is probable, but not certain \
             (P = {}).",
            percent(loss.loss),
            probability(loss.probability)
        ),
        // What other records show says nothing of a record that is not as predicted or shows
        // nothing.
        _ if report.unpredicted().is_some()
            || !(report.shook() || is_predicted(parameter, report)) =>
        {
            return waits;
        }
        loss => match waits {
            Some(waits) => return Some(waits),
            None => format!(
                "Weak motion shows no lasting loss of more than {} of {name} since {since} (P = \
                 {}).",
                percent(report.settings.loss),
                probability(loss.probability)
            ),
        },
    };
    Some(match waits {
        Some(waits) => format!("{waits} {found}"),
        None => found,
    })
}

/// Returns a text that begins with a capital letter.
fn capitalised(text: &str) -> String {
    let mut letters = text.chars();
    let first = letters.next().map(char::to_uppercase);
    first.into_iter().flatten().chain(letters).collect()
}

fn softened(name: &str, softening: &Softening, report: &EventReport) -> String {
    let size = format!(
        "{} ({}) at {:.0} s",
        percent(-softening.change),
        percent_range(-softening.interval.high, -softening.interval.low),
        softening.at_s
    );
    let mut text = match softening.is_raised {
        _ if softening.change >= 0.0 => format!(
            "During the shaking, {name} did not soften: its softest window was stiffer by {}",
            percent(softening.change)
        ),
        true => format!("During the shaking, {name} was softer by {size}"),
        false => format!(
            "During the shaking, {name} was softer by {size}, but by more than {} only with \
             probability {}",
            percent(report.settings.loss),
            probability(softening.probability)
        ),
    };
    text += &match softening.expected {
        Some(expected) => format!(
            "; at this amplitude, {} {} ({:.1} standard deviations {}).",
            match expected.events {
                1 => "the only earlier event predicts".to_owned(),
                events => format!("{events} earlier events predict"),
            },
            percent(-expected.change),
            expected.deviations.abs(),
            if expected.deviations < 0.0 {
                "softer"
            } else {
                "stiffer"
            }
        ),
        None => "; no earlier record shows what to expect at this amplitude.".to_owned(),
    };
    text
}

/// What the softening is compared with, unless several earlier events show it.
fn compared_with(parameter: &ParameterReport) -> Option<String> {
    let reference = parameter.judgement.reference?;
    match reference.kind {
        ReferenceKind::Events => None,
        ReferenceKind::FewEvents => Some(format!(
            "compared with {} earlier event{}, and with an assumed scatter of 10 % between \
             events.",
            reference.events,
            if reference.events == 1 { "" } else { "s" }
        )),
        ReferenceKind::OwnWeakMotion => Some(
            "compared with the weak motion of the same record, because no earlier record shows \
             weak motion."
                .to_owned(),
        ),
        ReferenceKind::OwnRecovery => Some(
            "compared with the end of the same record, because no earlier record shows weak \
             motion. It is therefore a lower bound."
                .to_owned(),
        ),
    }
}

/// Returns with what the softening of each stiffness is compared, one sentence for equal ones.
pub fn comparisons(report: &EventReport) -> Vec<String> {
    let softened = report
        .parameters
        .iter()
        .filter(|parameter| parameter.judgement.softening.is_some());
    let all: Vec<Told> = softened
        .filter_map(|parameter| {
            Some(Told {
                name: &parameter.name,
                text: compared_with(parameter)?,
            })
        })
        .collect();
    merged(&all)
}

/// How much of the stiffness was back at the end of the record.
fn regained(parameter: &ParameterReport) -> Option<String> {
    let (last, reference) = (parameter.course.last()?, parameter.judgement.reference?);
    Some(format!(
        "At {:.0} s, when the record last showed {}, its stiffness was {} of the sound value (rms \
         {:.2} m/s²).",
        0.5 * (last.start_s + last.end_s),
        parameter.name,
        percent((last.y - reference.y).exp()),
        10.0_f64.powf(last.amplitude)
    ))
}

/// The judgement of a lasting loss.
fn lasting(name: &str, loss: &LastingLoss, since: &EventName, report: &EventReport) -> String {
    format!(
        "Lasting loss of {name} since {}: {} ({}), from {} event{} before and {} since. P(any \
         loss) = {}, P(more than {}) = {}: {}.",
        since.title(),
        percent(loss.loss),
        percent_range(loss.interval.low, loss.interval.high),
        loss.earlier,
        if loss.earlier == 1 { "" } else { "s" },
        loss.later,
        probability(loss.probability_of_any),
        percent(report.settings.loss),
        probability(loss.probability),
        verdict(loss)
    )
}

/// The verdict on a lasting loss.
pub fn verdict(loss: &LastingLoss) -> &'static str {
    match loss {
        loss if loss.is_raised => "raised",
        loss if loss.probability >= 0.5 => "probable, not certain",
        _ => "not shown",
    }
}

/// What a judgement waits for.
pub fn waits(waiting: Waiting) -> String {
    match waiting {
        Waiting::EarlierEvents { found, required } => format!(
            "a lasting loss since this event cannot be judged, because the records contain {found} \
             earlier event{} with weak motion and {required} are required.",
            if found == 1 { "" } else { "s" }
        ),
        Waiting::WeakMotion { found, required } => format!(
            "a lasting loss since this event is not judged yet. The record has {found} window{} \
             of weak motion after the shaking, and {required} are required. The judgement waits \
             for an aftershock or another record of weak motion.",
            if found == 1 { "" } else { "s" }
        ),
    }
}

/// Returns the line of an event on standard output.
pub fn line(report: &EventReport) -> String {
    let softening = report.parameters.iter().filter_map(|parameter| {
        let softening = parameter.judgement.softening?;
        if softening.change >= 0.0 {
            return None;
        }
        let word = if softening.is_raised { "" } else { "perhaps " };
        Some(format!(
            "{word}{} −{}",
            parameter.name,
            percent(-softening.change)
        ))
    });
    let softening: Vec<String> = softening.collect();
    let waits = report.shook() && !report.own_is_judged();
    let unpredicted = report.unpredicted();
    let told = report.worst_loss().filter(|(parameter, _, loss)| {
        let is_silent = waits || unpredicted.is_some();
        let is_shown = report.shook() || is_predicted(parameter, report);
        (!is_silent && is_shown) || loss.is_raised || loss.probability >= 0.5
    });
    let mut lasting = Vec::new();
    if report.has_alert() {
        lasting.push("an alert is open".to_owned());
    }
    if let Some((parameter, stiffness, interval)) = unpredicted {
        lasting.push(format!(
            "weak motion: {} {stiffness:.2}, outside the predicted {}",
            parameter.name,
            ratios(interval)
        ));
    }
    if waits {
        lasting.push("lasting loss: not judged yet".to_owned());
    }
    if let Some((_, _, loss)) = told.filter(|(_, _, loss)| loss.probability < 0.5) {
        lasting.push(format!(
            "no lasting loss shown, P(>{}) {}",
            percent(report.settings.loss),
            probability(loss.probability)
        ));
    } else if let Some((parameter, since, loss)) = told {
        let date = since.start.as_deref().and_then(|start| start.get(..10));
        lasting.push(format!(
            "lasting loss of {} since {}: {} ({}), P(>0) {}, P(>{}) {}{}",
            parameter.name,
            date.unwrap_or(&since.record),
            percent(loss.loss),
            percent_range(loss.interval.low, loss.interval.high),
            probability(loss.probability_of_any),
            percent(report.settings.loss),
            probability(loss.probability),
            if loss.is_raised { ", raised" } else { "" }
        ));
    }
    if lasting.is_empty() {
        let is_judged = report
            .parameters
            .iter()
            .any(|parameter| is_predicted(parameter, report));
        lasting.push(match is_judged {
            true => "weak motion as predicted".to_owned(),
            false => "nothing judged".to_owned(),
        });
    }
    let lasting = lasting.join("; ");
    format!(
        "{}  {:<13}  peak {:.2} m/s2{}{}; {lasting}",
        report.name.start.as_deref().unwrap_or(&report.name.record),
        report.urgency.words(),
        report.peak_m_per_s2,
        if softening.is_empty() {
            ""
        } else {
            "; in motion "
        },
        softening.join(", "),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_reasons_are_one_sentence_with_all_names() {
        let told = |name, text: &str| Told {
            name,
            text: text.to_owned(),
        };
        let all = [
            told("storey-1", "too short."),
            told("storey-2", "too weak."),
            told("storey-3", "too short."),
        ];
        assert_eq!(
            merged(&all),
            ["Storey-1, storey-3: too short.", "Storey-2: too weak."]
        );
    }
}
