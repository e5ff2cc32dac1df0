//! Errors of the service.

use spandrel_bus::{BusError, NameError};
use spandrel_judge::JudgeError;
use spandrel_record::RecordError;
use std::path::PathBuf;

/// Reason why the service cannot start or continue.
#[derive(Debug, thiserror::Error)]
pub enum JudgingError {
    /// The structure file has no table `[judge]`.
    #[error("{structure}: has no table [judge]")]
    NotJudged {
        /// Name of the structure.
        structure: String,
    },
    /// The name of a quantity or condition cannot be a key.
    #[error("{found}")]
    Name {
        /// The name.
        found: String,
        /// The reason.
        source: NameError,
    },
    /// A setting of the judgement is out of range.
    #[error(transparent)]
    Judge(#[from] JudgeError),
    /// The file of the epochs cannot be read or written.
    #[error("{}: cannot {what} the epochs", path.display())]
    File {
        /// `read`, `write` or `set aside`.
        what: &'static str,
        /// The file.
        path: PathBuf,
        /// The reason.
        source: std::io::Error,
    },
    /// The file of the annotations cannot be read.
    #[error("{}: cannot read the annotations", path.display())]
    Annotations {
        /// The file.
        path: PathBuf,
        /// The reason.
        source: std::io::Error,
    },
    /// A line of the file passes its check and is not an epoch.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// The bus has rejected a declaration or message.
    #[error(transparent)]
    Bus(#[from] BusError),
}

impl JudgingError {
    /// Returns `true` if a file, an argument or a setting of the user is the cause.
    #[must_use]
    pub fn is_bad_input(&self) -> bool {
        match self {
            Self::NotJudged { .. } | Self::Name { .. } | Self::Judge(_) => true,
            Self::Bus(error) => error.is_bad_input(),
            Self::File { .. } | Self::Annotations { .. } | Self::Record(_) => false,
        }
    }
}
