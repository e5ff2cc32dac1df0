//! Errors of the service.

use jiff::Timestamp;
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
    /// The file of the configurations cannot be read or set aside.
    #[error("{}: cannot {what} the configurations of the judgement", path.display())]
    Configurations {
        /// `read` or `set aside`.
        what: &'static str,
        /// The file.
        path: PathBuf,
        /// The reason.
        source: std::io::Error,
    },
    /// No configuration has been recorded.
    #[error(
        "{}: contains no configuration; the service judge records it at its start",
        path.display()
    )]
    NoConfiguration {
        /// The file.
        path: PathBuf,
    },
    /// A line of the file of the configurations is damaged, or one is missing before it.
    #[error(
        "{}:{line}: is damaged, or the line before it is missing, so the configuration in force is \
         unknown; the next start of the service judge keeps the lines before it",
        path.display()
    )]
    DamagedConfiguration {
        /// The file.
        path: PathBuf,
        /// Number of the line, from 1.
        line: usize,
    },
    /// A past judgement cannot be repeated.
    #[error("no judgement of {structure} at {} can be repeated: {why}", utc(*at_ns))]
    NoPast {
        /// Name of the structure.
        structure: String,
        /// Time of the judgement (ns since 1970-01-01 UTC).
        at_ns: i64,
        /// The reason.
        why: NoPast,
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
            Self::NotJudged { .. }
            | Self::Name { .. }
            | Self::Judge(_)
            | Self::NoConfiguration { .. }
            | Self::NoPast { .. } => true,
            Self::Bus(error) => error.is_bad_input(),
            Self::File { .. }
            | Self::Annotations { .. }
            | Self::Configurations { .. }
            | Self::DamagedConfiguration { .. }
            | Self::Record(_) => false,
        }
    }
}

/// Reason why a past judgement cannot be repeated.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NoPast {
    /// No epoch is saved.
    #[error("no epoch is saved")]
    NoEpochs,
    /// The time precedes all saved epochs.
    #[error("the first saved epoch is that of {}", utc(*first_ns))]
    BeforeEpochs {
        /// Middle of the first epoch (ns since 1970-01-01 UTC).
        first_ns: i64,
    },
    /// The time precedes all recorded configurations.
    #[error(
        "the epochs of that time were judged before the first recorded configuration, which is in \
         force since {}",
        utc(*from_ns)
    )]
    BeforeConfigurations {
        /// Wall-clock time of the first record (ns since 1970-01-01 UTC).
        from_ns: i64,
    },
    /// The epochs of that time are in a damaged part of their file.
    #[error("{} is damaged after the epoch of {}", path.display(), utc(*last_ns))]
    DamagedEpochs {
        /// The file.
        path: PathBuf,
        /// Middle of the last epoch before the damage (ns since 1970-01-01 UTC).
        last_ns: i64,
    },
    /// The file has other epochs than those that were judged.
    #[error("{} does not contain the epochs that were judged at that time", path.display())]
    OtherEpochs {
        /// The file.
        path: PathBuf,
    },
    /// Not all epochs were saved.
    #[error("not all epochs that were judged at that time could be saved")]
    UnsavedEpochs,
    /// Another configuration was in force.
    #[error("configuration {found} was not in force; {in_force} was")]
    NotInForce {
        /// Name of the given configuration.
        found: String,
        /// Name of the configuration in force.
        in_force: String,
    },
}

/// Returns a time (ns since 1970-01-01 UTC) in ISO 8601.
pub(crate) fn utc(time_ns: i64) -> Timestamp {
    // The calendar of `jiff` includes every time of 64 bits in nanoseconds.
    Timestamp::from_nanosecond(time_ns.into()).unwrap_or_default()
}
