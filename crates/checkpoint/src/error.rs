//! What can be wrong with a checkpoint.

use std::path::PathBuf;

/// A checkpoint cannot be kept.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// The file system refuses.
    #[error("{}: cannot {what}: {source}", path.display())]
    Io {
        /// What was tried.
        what: &'static str,
        /// File or folder.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The state cannot be written.
    #[error("the state of {kind} cannot be written: {source}")]
    Encode {
        /// Kind of checkpoint.
        kind: &'static str,
        /// Why.
        source: postcard::Error,
    },
}

/// Why a file is not read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// It is none.
    #[error("it is no checkpoint of Spandrel")]
    Foreign,
    /// Bits have changed, or some are missing.
    #[error("its checksum does not hold: it is damaged")]
    Damaged,
    /// Of something else.
    #[error("it is of {found}, expected {expected}")]
    OfAnother {
        /// What it says.
        found: String,
        /// What is wanted.
        expected: String,
    },
    /// Written by another version of the program.
    #[error("it has version {found} of its layout, this program reads {expected}")]
    Version {
        /// What it says.
        found: u16,
        /// What is wanted.
        expected: u16,
    },
    /// What it rests on has changed.
    #[error("what it rests on has changed since it was written (the structure file)")]
    Basis,
    /// The checksum holds, but the content is no state of this service.
    #[error("its content cannot be read: {0}")]
    Content(String),
    /// It cannot be read at all.
    #[error("it cannot be read: {0}")]
    Unreadable(String),
}
