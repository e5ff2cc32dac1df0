//! Errors of saving and reading checkpoints.

use std::path::PathBuf;

/// An error that prevents a checkpoint from being saved.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// A file system operation failed.
    #[error("{}: cannot {what}: {reason}", path.display())]
    Io {
        /// The failed operation.
        what: &'static str,
        /// The file or folder.
        path: PathBuf,
        /// The cause.
        reason: std::io::Error,
    },
    /// The state cannot be encoded.
    #[error("the state of {kind} cannot be written: {reason}")]
    Encode {
        /// The kind of checkpoint.
        kind: &'static str,
        /// The cause.
        reason: postcard::Error,
    },
}

/// The reason why a checkpoint file is not used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// The file is not a checkpoint of Spandrel.
    #[error("it is not a Spandrel checkpoint")]
    Foreign,
    /// The content has changed or is truncated.
    #[error("its checksum does not match: it is damaged")]
    Damaged,
    /// The checkpoint belongs to another service or structure.
    #[error("it belongs to {found}, expected {expected}")]
    OfAnother {
        /// Service and structure in the file.
        found: String,
        /// Service and structure of the reader.
        expected: String,
    },
    /// Another version of the program wrote the file.
    #[error("it has layout version {found}, this program reads version {expected}")]
    Version {
        /// The version in the file.
        found: u16,
        /// The version that this program reads.
        expected: u16,
    },
    /// The basis of the state has changed since the checkpoint was written.
    #[error("its basis (the structure file) has changed since it was written")]
    Basis,
    /// The checksum is correct, but the content is not a state of this service.
    #[error("its content cannot be read: {0}")]
    Content(String),
    /// The file cannot be read from disk.
    #[error("it cannot be read: {0}")]
    Unreadable(String),
}
