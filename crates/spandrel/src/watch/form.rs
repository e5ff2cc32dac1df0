//! The input line for acknowledging an alert, with a name and a note.

use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyModifiers};

/// Maximum lengths of the name and the note (characters).
const LONGEST_NAME: usize = 100;
const LONGEST_NOTE: usize = 200;

/// The two fields and the selected field.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Form {
    pub who: String,
    pub note: String,
    pub field: Field,
}

/// A field of the form.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Field {
    #[default]
    Who,
    Note,
}

/// Effect of a key on the form.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Typed {
    /// Input continues.
    On,
    /// The form is complete; `who` is not empty.
    Done,
    /// The user cancelled.
    Cancelled,
}

impl Form {
    /// Creates a form with a name. The note is selected unless the name is empty.
    pub fn new(who: String) -> Self {
        let field = if who.is_empty() {
            Field::Who
        } else {
            Field::Note
        };
        Self {
            who,
            note: String::new(),
            field,
        }
    }

    /// Processes a key.
    pub fn key(&mut self, key: KeyEvent) -> Typed {
        let is_control = key.modifiers.contains(KeyModifiers::CONTROL);
        match key.code {
            KeyCode::Esc => return Typed::Cancelled,
            KeyCode::Enter if self.who.trim().is_empty() => self.field = Field::Who,
            KeyCode::Enter => return Typed::Done,
            KeyCode::Tab | KeyCode::BackTab | KeyCode::Up | KeyCode::Down => {
                self.field = match self.field {
                    Field::Who => Field::Note,
                    Field::Note => Field::Who,
                };
            }
            KeyCode::Backspace => drop(self.text().pop()),
            KeyCode::Char('u') if is_control => self.text().clear(),
            KeyCode::Char(letter) if !is_control && !letter.is_control() => {
                let longest = match self.field {
                    Field::Who => LONGEST_NAME,
                    Field::Note => LONGEST_NOTE,
                };
                let text = self.text();
                if text.chars().count() < longest {
                    text.push(letter);
                }
            }
            _ => {}
        }
        Typed::On
    }

    /// Returns the text of the selected field.
    fn text(&mut self) -> &mut String {
        match self.field {
            Field::Who => &mut self.who,
            Field::Note => &mut self.note,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn typed(form: &mut Form, keys: &[KeyCode]) -> Typed {
        keys.iter()
            .map(|code| form.key(KeyEvent::from(*code)))
            .last()
            .unwrap_or(Typed::On)
    }

    fn letters(text: &str) -> Vec<KeyCode> {
        text.chars().map(KeyCode::Char).collect()
    }

    #[test]
    fn name_and_note_are_typed_one_after_the_other() {
        let mut form = Form::new(String::new());
        typed(&mut form, &letters("anna"));
        typed(&mut form, &[KeyCode::Tab]);
        typed(&mut form, &letters("seen on sitee"));
        assert_eq!(
            typed(&mut form, &[KeyCode::Backspace, KeyCode::Enter]),
            Typed::Done
        );
        assert_eq!(
            (form.who.as_str(), form.note.as_str()),
            ("anna", "seen on site")
        );
    }

    #[test]
    fn acknowledgement_requires_a_name() {
        let mut form = Form::new(String::new());
        assert_eq!(
            typed(
                &mut form,
                &[KeyCode::Char(' '), KeyCode::Tab, KeyCode::Enter]
            ),
            Typed::On
        );
        assert_eq!(form.field, Field::Who);
    }

    #[test]
    fn form_with_a_known_name_starts_at_the_note() {
        assert_eq!(Form::new("anna".to_owned()).field, Field::Note);
    }

    #[test]
    fn fields_are_bounded_and_free_of_control_characters() {
        let mut form = Form::default();
        typed(&mut form, &letters(&"a".repeat(LONGEST_NAME + 1)));
        assert_eq!(form.who.len(), LONGEST_NAME);
        form.key(KeyEvent::new(KeyCode::Char('u'), KeyModifiers::CONTROL));
        typed(&mut form, &[KeyCode::Char('\u{1b}')]);
        assert_eq!(form.who, "");
    }
}
