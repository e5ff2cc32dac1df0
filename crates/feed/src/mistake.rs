//! A mistake in the configuration.

use std::fmt;

/// A mistake in the configuration: the key, the value found and the allowed values.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Mistake {
    /// Key, such as `feed.source[0].channel[2].sensitivity`.
    pub key: String,
    /// Value found, such as `is 0`.
    pub found: String,
    /// Allowed values, such as `must be a finite number except 0`.
    pub allowed: String,
}

impl fmt::Display for Mistake {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}, {}", self.key, self.found, self.allowed)
    }
}

/// Returns the mistakes of a file, one per line.
pub(crate) fn in_lines(file: &str, mistakes: &[Mistake]) -> String {
    let lines: Vec<String> = mistakes
        .iter()
        .map(|mistake| format!("{file}: {mistake}"))
        .collect();
    lines.join("\n")
}
