//! Texts in messages: how long they may be, and of which characters.

use super::Malformed;

/// Longest text that is read as one, in bytes: a note, a reason.
const MAX_TEXT_BYTES: usize = 4096;
/// Longest text that stands for one thing, in bytes: who acknowledges, what an event is about. Databases find rows by it.
pub const MAX_LABEL_BYTES: usize = 512;

/// Checks a text that is read as one: it may have line breaks and tabs.
pub(super) fn check_text(what: &'static str, text: &str) -> Result<(), Malformed> {
    check_length(what, text, MAX_TEXT_BYTES)?;
    match text.chars().find(|c| !is_of_text(*c)) {
        Some(found) => Err(Malformed::Control {
            what,
            found,
            allowed: "none but line breaks and tabs",
        }),
        None => Ok(()),
    }
}

/// Checks a text that stands for one thing.
pub(super) fn check_label(what: &'static str, text: &str) -> Result<(), Malformed> {
    check_length(what, text, MAX_LABEL_BYTES)?;
    match text.chars().find(|c| c.is_control()) {
        Some(found) => Err(Malformed::Control {
            what,
            found,
            allowed: "none",
        }),
        None => Ok(()),
    }
}

fn check_length(what: &'static str, text: &str, most: usize) -> Result<(), Malformed> {
    if text.len() <= most {
        return Ok(());
    }
    Err(Malformed::Text {
        what,
        found: text.len(),
        most,
    })
}

fn is_of_text(c: char) -> bool {
    !c.is_control() || matches!(c, '\n' | '\r' | '\t')
}

/// Makes a text that was kept by an earlier version one that may be sent: other characters are replaced, and what is too long is cut.
pub(super) fn mend_text(text: &mut String) {
    mend(text, MAX_TEXT_BYTES, is_of_text);
}

/// The same for a text that stands for one thing.
pub(super) fn mend_label(text: &mut String) {
    mend(text, MAX_LABEL_BYTES, |c| !c.is_control());
}

fn mend(text: &mut String, most: usize, is_allowed: impl Fn(char) -> bool) {
    if !text.chars().all(&is_allowed) {
        *text = text
            .chars()
            .map(|c| {
                if is_allowed(c) {
                    c
                } else {
                    char::REPLACEMENT_CHARACTER
                }
            })
            .collect();
    }
    text.truncate(text.floor_char_boundary(most));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_note_may_have_lines_and_a_name_may_not() {
        assert_eq!(check_text("note", "first\r\n\tsecond"), Ok(()));
        for (text, found) in [
            ("Ada\0", '\0'),
            ("Ada\u{1b}[2J", '\u{1b}'),
            ("Ada\u{85}", '\u{85}'),
        ] {
            assert!(
                matches!(check_text("note", text), Err(Malformed::Control { found: is, .. }) if is == found)
            );
            assert!(
                matches!(check_label("who", text), Err(Malformed::Control { found: is, .. }) if is == found)
            );
        }
        let told = check_label("who", "Ada\0").unwrap_err().to_string();
        assert_eq!(told, r"who has the control character '\0', must have none");
        assert!(matches!(
            check_label("who", "Ada\nBob"),
            Err(Malformed::Control { found: '\n', .. })
        ));
    }

    #[test]
    fn names_are_shorter_than_notes() {
        let long = "x".repeat(MAX_LABEL_BYTES + 1);
        assert_eq!(check_text("note", &long), Ok(()));
        assert!(matches!(
            check_label("who", &long),
            Err(Malformed::Text {
                most: MAX_LABEL_BYTES,
                ..
            })
        ));
    }

    #[test]
    fn what_is_mended_passes_and_what_passes_stays() {
        // two bytes each, so that the limit falls within a character
        for text in [
            "Ada\0",
            "Bob\nCäcilia",
            &format!("x{}", "ä".repeat(MAX_TEXT_BYTES)),
            "plain",
        ] {
            let (mut label, mut prose) = (text.to_owned(), text.to_owned());
            mend_label(&mut label);
            mend_text(&mut prose);
            assert_eq!(
                (check_label("who", &label), check_text("note", &prose)),
                (Ok(()), Ok(())),
                "{text:?}"
            );
        }
        let mut note = "first\nsecond".to_owned();
        mend_text(&mut note);
        assert_eq!(note, "first\nsecond");
    }
}
