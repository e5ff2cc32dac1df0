//! Text and JSON of the judgements of a series.

use serde_json::json;
use spandrel_bus::CourseRow;
use spandrel_judge::{
    Delay, Expectation, Judgement, Quantity, QuantityReport, ReferenceReport, Settings, Spent,
    State, date, season_warning,
};
use spandrel_judging::{LEAST_LN_EVIDENCE, course_row};
use spandrel_structure::JudgedStructure;
use std::fmt::{self, Write as _};

/// A judgement with its structure and date.
pub struct DayLine<'j> {
    structure: &'j str,
    judgement: &'j Judgement,
}

impl<'j> DayLine<'j> {
    pub fn new(structure: &'j str, judgement: &'j Judgement) -> Self {
        Self {
            structure,
            judgement,
        }
    }

    /// Returns one line of JSON.
    pub fn json(&self) -> String {
        let Judgement {
            day,
            quantity,
            state,
            means,
            expectation,
            finding,
            raised,
        } = self.judgement;
        let expectation = expectation.map(|of_day| Expectation {
            ln_evidence: of_day.ln_evidence.max(LEAST_LN_EVIDENCE),
            ..of_day
        });
        let finding = finding.map(|finding| {
            let change = finding.change();
            json!({
                "kind": finding.name(),
                "found": date(change.found_day).to_string(),
                "since": date(change.since_day).to_string(),
                "loss": change.loss,
                "interval": change.interval,
            })
        });
        json!({
            "structure": self.structure,
            "quantity": quantity,
            "date": date(*day).to_string(),
            "state": state.name(),
            "sentence": self.judgement.sentence(),
            "means": means,
            "expectation": expectation,
            "finding": finding,
            "raised": raised,
        })
        .to_string()
    }
}

/// What a structure file without a model declares for judgement.
pub struct JudgedPage<'s>(pub &'s JudgedStructure);

impl JudgedPage<'_> {
    /// Returns the page as JSON.
    pub fn json(&self) -> String {
        let JudgedStructure { name, plan } = self.0;
        let page = json!({
            "structure": name,
            "quantities": names(&plan.settings.quantities, |quantity| &quantity.name),
            "conditions": names(&plan.settings.conditions, |condition| &condition.name),
        });
        format!("{page:#}\n")
    }
}

impl fmt::Display for JudgedPage<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let JudgedStructure { name, plan } = self.0;
        let listed = |names: Vec<&str>| match names.is_empty() {
            true => "none".to_owned(),
            false => names.join(", "),
        };
        let quantities = names(&plan.settings.quantities, |quantity| &quantity.name);
        let conditions = names(&plan.settings.conditions, |condition| &condition.name);
        writeln!(f, "{name}: no model, for judgement only")?;
        writeln!(f, "  quantities: {}", listed(quantities))?;
        writeln!(f, "  conditions: {}", listed(conditions))?;
        writeln!(f, "judge a series with spandrel judge --series")
    }
}

fn names<T>(of: &[T], name: fn(&T) -> &String) -> Vec<&str> {
    of.iter().map(|one| name(one).as_str()).collect()
}

/// Summary of a series: its judgements, and its final state.
pub struct Summary<'j> {
    structure: &'j str,
    epochs: usize,
    judgements: &'j [Judgement],
}

impl<'j> Summary<'j> {
    /// Creates the report of `judgements`, which must be in the order of the days.
    pub fn new(structure: &'j str, epochs: usize, judgements: &'j [Judgement]) -> Self {
        Self {
            structure,
            epochs,
            judgements,
        }
    }

    /// Returns the judgements of each quantity, in the order of the settings.
    fn courses(&self) -> Vec<Vec<&'j Judgement>> {
        let mut courses: Vec<Vec<&Judgement>> = Vec::new();
        for judgement in self.judgements {
            let same = |course: &&mut Vec<&Judgement>| {
                course
                    .first()
                    .is_some_and(|first| first.quantity == judgement.quantity)
            };
            match courses.iter_mut().find(same) {
                Some(course) => course.push(judgement),
                None => courses.push(vec![judgement]),
            }
        }
        courses
    }
}

impl fmt::Display for Summary<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let courses = self.courses();
        writeln!(f, "{}: {} epochs", self.structure, self.epochs)?;
        for course in &courses {
            let count = |is: fn(&State) -> bool| course.iter().filter(|j| is(&j.state)).count();
            let (Some(first), Some(last)) = (course.first(), course.last()) else {
                continue;
            };
            writeln!(
                f,
                "{}: {} to {}, {} days judged, {} outside experience, {} without statement",
                first.quantity,
                date(first.day),
                date(last.day),
                count(|state| *state == State::Judged),
                count(|state| matches!(state, State::OutsideExperience { .. })),
                count(|state| matches!(state, State::NoStatement { .. })),
            )?;
            write_late_reference(f, course)?;
            for judgement in course.iter().filter(|judgement| judgement.raised) {
                let kind = judgement.finding.map_or("", |finding| finding.name());
                writeln!(
                    f,
                    "  {} {kind}: {}",
                    date(judgement.day),
                    judgement.sentence()
                )?;
            }
            writeln!(f, "  {} {}", date(last.day), last.sentence())?;
            let learns =
                |judgement: &&&Judgement| matches!(judgement.state, State::Learning { .. });
            let learnt = course
                .iter()
                .rfind(learns)
                .map_or(first.day, |learnt| learnt.day);
            let commissioning_days = learnt - first.day + 1;
            if last.finding.is_some()
                && let Some(warning) = season_warning(commissioning_days)
            {
                writeln!(f, "  {warning}")?;
            }
        }
        Ok(())
    }
}

/// States how long a commissioning was extended, and why, if its reference is ready now.
fn write_late_reference(f: &mut fmt::Formatter<'_>, course: &[&Judgement]) -> fmt::Result {
    let is_late = |judgement: &&&Judgement| matches!(judgement.state, State::NotReady { .. });
    let learns = |judgement: &&&Judgement| matches!(judgement.state, State::Learning { .. });
    let (Some(first), Some(learnt)) = (course.iter().find(is_late), course.iter().rfind(learns))
    else {
        return Ok(());
    };
    match &first.state {
        State::NotReady { missing } if learnt.day > first.day => writeln!(
            f,
            "  reference not ready on {}: {missing}; the commissioning was extended by {} days, \
             to {}",
            date(first.day),
            learnt.day - first.day,
            date(learnt.day)
        ),
        _ => Ok(()),
    }
}

/// Returns the history of each quantity, day by day, as the service judge states it.
pub fn course_csv(settings: &Settings, judgements: &[Judgement]) -> String {
    let conditions = settings.conditions.iter();
    let names: Vec<&str> = conditions
        .map(|condition| condition.name.as_str())
        .collect();
    let mut text = CourseRow::csv_header(&names);
    for Quantity { name, .. } in &settings.quantities {
        let days = judgements.iter().filter(|day| day.quantity == *name);
        days.for_each(|day| text += &course_row(day).csv_line(name, names.len()));
    }
    text
}

/// Returns what has been spent of the budget, and what each quantity promises, achieves, finds and
/// misses.
pub fn report_text(settings: &Settings, spent: &Spent, reports: &[QuantityReport]) -> String {
    let mut text = format!(
        "\nbudget: {} false alarms per year for {} quantities; loss that matters: {:.1} %\n\
         alarms: {} in {} days judged, {} of them in the last year; false alarms promised for \
         these days: {}\n",
        settings.false_alarms_per_year,
        settings.quantities.len(),
        100.0 * settings.loss,
        spent.alarms,
        spent.judged_days,
        spent.alarms_in_last_year,
        rate(spent.promised)
    );
    for report in reports {
        // Writing to a string cannot fail.
        let _ = match (&report.reference, &report.missing) {
            (Some(reference), _) => {
                writeln!(text, "{}", reference_text(&report.quantity, reference))
            }
            (None, Some(missing)) => writeln!(text, "{}: not ready: {missing}", report.quantity),
            (None, None) => writeln!(text, "{}: the commissioning is not over", report.quantity),
        };
    }
    text
}

fn reference_text(quantity: &str, reference: &ReferenceReport) -> String {
    let performance = &reference.performance;
    let mut text = format!(
        "{quantity}: reference of {} to {}, scatter {:.2} % a day, correlation {:.2} between \
         days\n  coverage of the 95 % interval in the commissioning: {:.0} %\n",
        date(reference.from_day),
        date(reference.to_day),
        100.0 * reference.scatter,
        reference.correlation,
        100.0 * reference.coverage
    );
    match (reference.frost_knot, reference.knows_frost) {
        (Some(knot), Some(true)) => {
            let _ = writeln!(text, "  frost begins at {knot} °C");
        }
        (Some(_), _) => text.push_str("  the commissioning has fewer than five days of frost\n"),
        (None, _) => {}
    }
    for hinge in &reference.amplitude_hinges {
        let _ = writeln!(text, "  the amplitude has an effect above {hinge:.2e}");
    }
    let _ = writeln!(
        text,
        "  false alarms per year: {} promised, {} in simulated years",
        rate(performance.promised_per_year),
        rate(performance.achieved_per_year)
    );
    if let Some(warning) = season_warning(reference.commissioning_days()) {
        let _ = writeln!(text, "  {warning}");
    }
    for delay in &performance.delays {
        let _ = writeln!(text, "  {}", delay_text(delay));
    }
    text.trim_end().to_owned()
}

fn delay_text(delay: &Delay) -> String {
    let loss = format!("loss of {:.0} %", 100.0 * delay.loss);
    let share = 100.0 * delay.found_in_a_month;
    match delay.median_days {
        Some(days) => {
            format!("{loss}: found after {days} days (median), {share:.0} % within 30 days")
        }
        None => format!("{loss}: mostly missed, {share:.0} % found within 30 days"),
    }
}

fn rate(per_year: f64) -> String {
    format!("{per_year:.3}")
}
