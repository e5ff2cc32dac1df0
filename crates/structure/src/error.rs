//! What can be wrong with a structure file, with all that a message for people needs.

use std::fmt;
use std::path::{Path, PathBuf};

/// Says why a structure could not be read.
#[derive(Debug, thiserror::Error)]
pub enum StructureError {
    /// The file itself could not be read.
    #[error("{}: cannot be read", path.display())]
    Unreadable {
        /// The file that was asked for.
        path: PathBuf,
        /// The cause, from the operating system.
        source: std::io::Error,
    },
    /// The file is longer than any structure file.
    #[error("{}: has more than {most} bytes, must have at most {most}", path.display())]
    TooLarge {
        /// The file that was asked for.
        path: PathBuf,
        /// What is allowed.
        most: u64,
    },
    /// The file was read and has mistakes; all of them are listed, in the order of the file.
    #[error("{}", lines(diagnostics))]
    Invalid {
        /// One entry per mistake, at least one.
        diagnostics: Vec<Diagnostic>,
    },
}

impl StructureError {
    /// Returns the mistakes of the file; empty if it could not even be read.
    #[must_use]
    pub fn diagnostics(&self) -> &[Diagnostic] {
        match self {
            Self::Unreadable { .. } | Self::TooLarge { .. } => &[],
            Self::Invalid { diagnostics } => diagnostics,
        }
    }
}

/// Describes one mistake of a structure file: where it is, what was found, what is allowed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Diagnostic {
    path: PathBuf,
    line: usize,
    key: String,
    found: String,
    allowed: String,
}

impl Diagnostic {
    pub(crate) fn new(
        path: &Path,
        line: usize,
        key: impl Into<String>,
        found: impl Into<String>,
        allowed: impl Into<String>,
    ) -> Self {
        Self {
            path: path.to_owned(),
            line,
            key: key.into(),
            found: found.into(),
            allowed: allowed.into(),
        }
    }

    /// Returns the structure file.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the line, counted from 1.
    #[must_use]
    pub fn line(&self) -> usize {
        self.line
    }

    /// Returns the key with its table, as in `filter.half-life-s`.
    #[must_use]
    pub fn key(&self) -> &str {
        &self.key
    }

    /// Returns what was found there.
    #[must_use]
    pub fn found(&self) -> &str {
        &self.found
    }

    /// Returns what is allowed there.
    #[must_use]
    pub fn allowed(&self) -> &str {
        &self.allowed
    }
}

impl fmt::Display for Diagnostic {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            path,
            line,
            key,
            found,
            allowed,
        } = self;
        write!(f, "{}:{line}: {key}: {found}, {allowed}", path.display())
    }
}

/// More mistakes than this are counted, not told: they mostly follow from the first ones.
const MOST_TOLD: usize = 30;

fn lines(diagnostics: &[Diagnostic]) -> String {
    let mut lines: Vec<String> = diagnostics
        .iter()
        .take(MOST_TOLD)
        .map(ToString::to_string)
        .collect();
    if let Some(more) = diagnostics
        .len()
        .checked_sub(MOST_TOLD)
        .filter(|more| *more > 0)
    {
        lines.push(format!("and {more} more"));
    }
    lines.join("\n")
}
