//! The judgements of lasting change.

use super::wording::printable;
use ratatui::style::{Color, Style};
use ratatui::text::Span;
use spandrel_bus::JudgementDisplay;
use spandrel_listener::StructureState;

/// Returns a text for each judged quantity, such as `lasting change of pier-2: judged`.
pub fn judgement_texts(structure: &StructureState) -> impl Iterator<Item = String> {
    let words = |display: &JudgementDisplay| {
        format!("lasting change of {}: {}", display.quantity, display.word())
    };
    structure.judgements.values().map(words)
}

/// Returns word and sentence of each quantity for the panel. A lasting loss is red, and has its
/// sentence in the list of alerts. A lasting gain is yellow.
pub fn judgement_spans(structure: &StructureState) -> Vec<Span<'static>> {
    let span = |display: &JudgementDisplay| {
        let style = match &display.change {
            Some(_) if display.seen.is_some() => Style::new(),
            Some(change) if change.kind.is_alarm() => Style::new().fg(Color::Red),
            Some(_) => Style::new().fg(Color::Yellow),
            None => Style::new(),
        };
        let seen = display.seen.as_ref();
        let seen = seen.map_or_else(String::new, |seen| {
            format!(" Seen by {}.", printable(&seen.who))
        });
        let word = display.word();
        let text = match display.alert_state() {
            Some(state) => format!("{word}: {}, {}", display.quantity, state.as_str()),
            None => format!("{word}: {}{seen}", printable(&display.sentence)),
        };
        Span::styled(text, style)
    };
    structure.judgements.values().map(span).collect()
}

#[cfg(test)]
mod tests {
    use super::super::testing::{heard, lasting_loss, name};
    use super::*;
    use spandrel_listener::Input;

    #[test]
    fn a_lasting_loss_is_red_and_has_its_state_as_an_alert() {
        let heard = heard([Input::Judgement(lasting_loss("storey-2"))]);
        let structure = heard.structure(&name("tower")).unwrap();
        let texts: Vec<String> = judgement_texts(structure).collect();
        assert_eq!(texts, ["lasting change of storey-2: lasting-loss"]);
        let spans = judgement_spans(structure);
        assert_eq!(spans[0].content, "lasting-loss: storey-2, raised");
        assert_eq!(spans[0].style.fg, Some(Color::Red));
    }
}
