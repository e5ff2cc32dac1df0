//! Names: the variable chunks of a key expression, such as a structure, node or parameter.

use std::borrow::Borrow;
use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::keys::Service;

/// Maximum length of a name, in bytes. Every message carries its key expression.
pub const MAX_NAME_BYTES: usize = 64;

/// A validated name, one chunk of a key expression: 1 to 64 characters of `[a-z0-9-]`.
///
/// ```
/// use spandrel_bus::Name;
/// assert!("storey-2".parse::<Name>().is_ok());
/// assert!("Storey/2".parse::<Name>().is_err());
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Name(String);

/// Reason why a text is not a valid name.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NameError {
    /// The text is empty.
    #[error("a name is empty, must have 1 to {MAX_NAME_BYTES} characters of a-z, 0-9 and -")]
    Empty,
    /// The text has more than [`MAX_NAME_BYTES`] bytes.
    #[error("name {found:?} has {} bytes, must have at most {MAX_NAME_BYTES}", found.len())]
    TooLong {
        /// The rejected text.
        found: String,
    },
    /// The text contains a character that Zenoh or a file system could misinterpret.
    #[error("name {found:?} contains {character:?}, allowed are a-z, 0-9 and -")]
    Character {
        /// The rejected text.
        found: String,
        /// First invalid character of the text.
        character: char,
    },
}

impl Name {
    /// Returns the name of a service, which is always valid.
    pub(crate) fn of_service(service: Service) -> Self {
        Self(service.as_str().to_owned())
    }

    /// Creates a name from a valid text.
    ///
    /// # Errors
    /// Returns [`NameError`] if the text is empty, too long or contains an invalid character.
    pub fn new(text: impl Into<String>) -> Result<Self, NameError> {
        let text = text.into();
        if text.is_empty() {
            return Err(NameError::Empty);
        }
        if text.len() > MAX_NAME_BYTES {
            return Err(NameError::TooLong { found: text });
        }
        let refused = |c: &char| !(c.is_ascii_lowercase() || c.is_ascii_digit() || *c == '-');
        match text.chars().find(refused) {
            Some(character) => Err(NameError::Character {
                found: text,
                character,
            }),
            None => Ok(Self(text)),
        }
    }

    /// Returns the name as a text.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl Borrow<str> for Name {
    fn borrow(&self) -> &str {
        &self.0
    }
}

impl FromStr for Name {
    type Err = NameError;

    fn from_str(text: &str) -> Result<Self, NameError> {
        Self::new(text)
    }
}

impl TryFrom<String> for Name {
    type Error = NameError;

    fn try_from(text: String) -> Result<Self, NameError> {
        Self::new(text)
    }
}

impl From<Name> for String {
    fn from(name: Name) -> Self {
        name.0
    }
}

impl fmt::Display for Name {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl AsRef<str> for Name {
    fn as_ref(&self) -> &str {
        &self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_digits_and_hyphens_are_names() {
        for text in ["a", "storey-2", "0", "-"] {
            assert_eq!(Name::new(text).unwrap().as_str(), text);
        }
    }

    #[test]
    fn characters_of_zenoh_patterns_are_rejected() {
        for text in ["a/b", "*", "**", "@a", "a$*", "a?b", "a#", "A", "ä", "a b"] {
            assert!(matches!(Name::new(text), Err(NameError::Character { .. })));
        }
    }

    #[test]
    fn empty_and_long_names_are_refused() {
        assert_eq!(Name::new(""), Err(NameError::Empty));
        assert!(matches!(
            Name::new("a".repeat(65)),
            Err(NameError::TooLong { .. })
        ));
    }
}
