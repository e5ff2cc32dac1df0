//! The declared modes with their natural frequencies.

use ratatui::style::{Color, Style};
use ratatui::text::Span;
use spandrel_bus::{ModeDisplay, ModeState};
use spandrel_listener::StructureState;

/// Returns a text for each declared mode, such as `bending-1 2.9158 ± 0.0084 Hz`.
pub fn mode_texts(structure: &StructureState) -> impl Iterator<Item = String> {
    structure.modes.values().map(text)
}

/// Returns the same for the panel. A mode without a statement is yellow.
pub fn mode_spans(structure: &StructureState) -> Vec<Span<'static>> {
    let span = |display: &ModeDisplay| {
        let style = match display.state {
            ModeState::Tracked if !display.machine => Style::new(),
            ModeState::Tracked | ModeState::Missing | ModeState::Lost | ModeState::Paired => {
                Style::new().fg(Color::Yellow)
            }
        };
        Span::styled(text(display), style)
    };
    structure.modes.values().map(span).collect()
}

fn text(display: &ModeDisplay) -> String {
    let mut text = display.mode.to_string();
    if let Some(estimate) = &display.estimate {
        let (hz, std_hz) = (estimate.frequency_hz, estimate.frequency_std_hz);
        text += &format!(" {hz:.4} ± {std_hz:.4} Hz");
        text += &format!(", damping {:.1} %", 100.0 * estimate.damping);
    }
    match display.state {
        ModeState::Tracked => {}
        state @ (ModeState::Missing | ModeState::Lost | ModeState::Paired) => {
            text += &format!(" {}", state.as_str());
        }
    }
    if let Some(partner) = &display.partner {
        text += &format!(" with {partner}");
    }
    if display.machine {
        text += ", a machine runs here";
    }
    text
}

#[cfg(test)]
mod tests {
    use super::super::testing::{heard, mode, name};
    use super::*;
    use spandrel_listener::Input;

    #[test]
    fn a_mode_has_its_frequency_and_what_makes_it_doubtful() {
        let told = |display: ModeDisplay| {
            let heard = heard([Input::Mode(Box::new(display))]);
            let structure = heard.structure(&name("tower")).unwrap();
            let spans = mode_spans(structure);
            assert_eq!(
                mode_texts(structure).collect::<Vec<_>>(),
                [spans[0].content.as_ref()]
            );
            (spans[0].content.to_string(), spans[0].style.fg)
        };
        let tracked = mode("bending-1", 2.9158);
        assert_eq!(
            told(tracked.clone()),
            (
                "bending-1 2.9158 ± 0.0084 Hz, damping 2.1 %".to_owned(),
                None
            )
        );
        let paired = ModeDisplay {
            state: ModeState::Paired,
            partner: Some(name("torsion")),
            machine: true,
            ..tracked.clone()
        };
        let expected = "bending-1 2.9158 ± 0.0084 Hz, damping 2.1 % paired with torsion, a machine \
                        runs here";
        assert_eq!(told(paired), (expected.to_owned(), Some(Color::Yellow)));
        let lost = ModeDisplay {
            state: ModeState::Lost,
            estimate: None,
            ..tracked
        };
        assert_eq!(
            told(lost),
            ("bending-1 lost".to_owned(), Some(Color::Yellow))
        );
    }
}
