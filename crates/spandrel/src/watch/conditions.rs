//! The latest values of the conditions, such as temperatures.

use super::wording::{duration, printable, significant};
use ratatui::style::{Color, Style};
use ratatui::text::Span;
use spandrel_listener::{ConditionState, StructureState};
use std::time::Duration;

/// Age below which a value is shown without its age.
const RECENT: Duration = Duration::from_secs(10);

/// Returns a text for each condition, such as `air 21.5 degC, 3 min ago`.
pub fn condition_texts(structure: &StructureState) -> impl Iterator<Item = String> {
    let now = structure.now();
    structure
        .conditions
        .values()
        .map(move |condition| text(condition, now))
}

/// Returns the same for the panel. An overdue condition is yellow.
pub fn condition_spans(structure: &StructureState) -> Vec<Span<'static>> {
    let now = structure.now();
    let span = |condition: &ConditionState| {
        let style = match condition.is_stale(now) {
            true => Style::new().fg(Color::Yellow),
            false => Style::new(),
        };
        Span::styled(text(condition, now), style)
    };
    structure.conditions.values().map(span).collect()
}

fn text(condition: &ConditionState, now: Duration) -> String {
    let display = &condition.display;
    let age = condition.age(now);
    let when = match condition.is_stale(now) {
        true => format!(", stale {}", duration(age)),
        false if age < RECENT => String::new(),
        false => format!(", {} ago", duration(age)),
    };
    format!(
        "{} {} {}{when}",
        display.name,
        significant(display.value),
        printable(&display.unit)
    )
}

#[cfg(test)]
mod tests {
    use super::super::testing::{at, condition, heard, name};
    use super::*;
    use spandrel_listener::Input;

    #[test]
    fn a_condition_has_its_value_unit_and_age_and_is_stale_after_two_intervals() {
        let mut heard = heard([at(0), Input::Condition(condition("air", 21.46))]);
        let mut told_after = |seconds: u64| {
            heard.handle(at(seconds), &mut Vec::new());
            let tower = name("tower");
            let texts: Vec<String> = condition_texts(heard.structure(&tower).unwrap()).collect();
            texts.join("|")
        };
        assert_eq!(told_after(0), "air 21.5 degC");
        assert_eq!(told_after(1200), "air 21.5 degC, 20 min ago");
        assert_eq!(told_after(1201), "air 21.5 degC, stale 20 min");
    }

    #[test]
    fn a_value_from_before_the_view_has_its_age() {
        let age = Duration::from_secs(300);
        let standing = Input::StandingCondition(condition("air", 21.46), age);
        let heard = heard([at(0), standing]);
        let tower = name("tower");
        let texts: Vec<String> = condition_texts(heard.structure(&tower).unwrap()).collect();
        assert_eq!(texts, ["air 21.5 degC, 5 min ago"]);
    }
}
