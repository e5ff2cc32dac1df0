//! Shows control characters of names and texts instead of sending them to the terminal.

use std::borrow::Cow;

/// Returns a text in which control characters except line breaks and tabs are escaped, such as
/// `\u{1b}`.
///
/// Files and messages can come from anyone, and an escape sequence can move the cursor, hide text
/// or change the title of the window.
pub fn escaped(text: &str) -> Cow<'_, str> {
    let is_harmful = |letter: char| letter.is_control() && letter != '\n' && letter != '\t';
    if !text.contains(is_harmful) {
        return Cow::Borrowed(text);
    }
    let mut escaped = String::with_capacity(text.len());
    for letter in text.chars() {
        match is_harmful(letter) {
            true => escaped.extend(letter.escape_default()),
            false => escaped.push(letter),
        }
    }
    Cow::Owned(escaped)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_control_characters_that_a_terminal_obeys_are_escaped() {
        assert_eq!(
            escaped("a\u{1b}]0;b\u{7}\u{9b}2J\r\n\tµ"),
            "a\\u{1b}]0;b\\u{7}\\u{9b}2J\\r\n\tµ"
        );
        assert!(matches!(escaped("plain\n"), Cow::Borrowed("plain\n")));
    }
}
