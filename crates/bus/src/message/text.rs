//! Limits of the length and the characters of texts in messages.

use super::Malformed;

/// Maximum length of prose, such as a note or a reason, in bytes.
const MAX_TEXT_BYTES: usize = 4096;
/// Maximum length of a label, such as a person's name or the subject of an event, in bytes.
/// Databases use labels as keys.
pub const MAX_LABEL_BYTES: usize = 512;

/// Checks prose, which may contain line breaks and tabs.
pub(super) fn check_text(what: &'static str, text: &str) -> Result<(), Malformed> {
    check_length(what, text, MAX_TEXT_BYTES)?;
    match text.chars().find(|c| !is_of_text(*c)) {
        Some(found) => Err(Malformed::Control {
            what,
            found,
            allowed: "none except line breaks and tabs",
        }),
        None => Ok(()),
    }
}

/// Checks a label, which must not contain control characters.
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

/// Makes prose from an earlier version valid: replaces control characters and cuts excessive
/// length.
pub(super) fn mend_text(text: &mut String) {
    mend(text, MAX_TEXT_BYTES, is_of_text);
}

/// Makes a label from an earlier version valid, as [`mend_text`] does for prose.
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
    fn notes_may_have_several_lines_and_names_may_not() {
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
    fn names_have_a_lower_limit_than_notes() {
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
    fn repaired_text_passes_the_check_and_valid_text_is_unchanged() {
        // A limit falls within one of these two-byte characters.
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
