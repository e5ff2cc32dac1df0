//! Errors of a structure file, with all details for the user.

use std::fmt;
use std::path::{Path, PathBuf};

/// Reason why a structure could not be read.
#[derive(Debug, thiserror::Error)]
pub enum StructureError {
    /// The file itself could not be read.
    #[error("{}: cannot be read", path.display())]
    Unreadable {
        /// Path of the requested file.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The path leads to a folder, a pipe, a device or a socket.
    #[error("{}: is a folder, a pipe, a device or a socket, must be a regular \
             file", path.display())]
    NotAFile {
        /// Path of the requested file.
        path: PathBuf,
    },
    /// The file exceeds the maximum size of a structure file.
    #[error("{}: has more than {most} bytes, must have at most {most}", path.display())]
    TooLarge {
        /// Path of the requested file.
        path: PathBuf,
        /// Maximum size (bytes).
        most: u64,
    },
    /// The file contains mistakes, listed in file order.
    #[error("{}", lines(diagnostics))]
    Invalid {
        /// One entry per mistake, at least one.
        diagnostics: Vec<Diagnostic>,
    },
}

impl StructureError {
    /// Returns the mistakes in the file; empty if the file could not be read.
    #[must_use]
    pub fn diagnostics(&self) -> &[Diagnostic] {
        match self {
            Self::Unreadable { .. } | Self::NotAFile { .. } | Self::TooLarge { .. } => &[],
            Self::Invalid { diagnostics } => diagnostics,
        }
    }
}

/// One mistake in a structure file: its position, the value found and the values allowed.
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

    /// Returns the path of the structure file.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the line number, counted from 1.
    #[must_use]
    pub fn line(&self) -> usize {
        self.line
    }

    /// Returns the key with its table, such as `filter.half-life-s`.
    #[must_use]
    pub fn key(&self) -> &str {
        &self.key
    }

    /// Returns the value found.
    #[must_use]
    pub fn found(&self) -> &str {
        &self.found
    }

    /// Returns the allowed values.
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

/// Maximum number of reported mistakes. Further mistakes mostly follow from the first ones; the
/// message only gives their number.
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
