//! What people enter on the page: their name, and a text.

use crate::api::Mistake;
use axum::http::StatusCode;

/// Maximum length of a person's name, and of a text (characters).
const LONGEST_NAME: usize = 100;
const LONGEST_TEXT: usize = 1_000;

/// Returns the name of a person without the spaces around it. `must` states what `who` must be.
pub(crate) fn person(who: &str, must: &str) -> Result<String, Mistake> {
    let who = who.trim();
    if who.is_empty() {
        return Err(wrong("who is empty", must));
    }
    if who.chars().count() > LONGEST_NAME {
        let allowed = format!("must have at most {LONGEST_NAME} characters");
        return Err(wrong("who is too long", allowed));
    }
    if who.chars().any(char::is_control) {
        return Err(wrong(
            "who has control characters",
            "must be a line of text",
        ));
    }
    Ok(who.to_owned())
}

/// Returns a text without the spaces around it. It may be empty. `name` is that of its field.
pub(crate) fn text(name: &str, text: &str) -> Result<String, Mistake> {
    let text = text.trim();
    let is_foreign = |c: char| c.is_control() && !matches!(c, '\n' | '\r' | '\t');
    if text.chars().any(is_foreign) {
        let allowed = "must be text, in one or more lines";
        return Err(wrong(format!("{name} has control characters"), allowed));
    }
    if text.chars().count() > LONGEST_TEXT {
        let allowed = format!("must have at most {LONGEST_TEXT} characters");
        return Err(wrong(format!("{name} is too long"), allowed));
    }
    Ok(text.to_owned())
}

/// Returns the mistake of a request with a wrong field.
pub(crate) fn wrong(what: impl Into<String>, allowed: impl Into<String>) -> Mistake {
    Mistake::new(StatusCode::BAD_REQUEST, what, allowed)
}
