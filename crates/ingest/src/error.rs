//! Errors that prevent ingest from starting or terminate it.

use spandrel_bus::{BusError, NameError};
use spandrel_record::RecordError;

use crate::layout::LayoutError;

/// An error that prevents ingest from starting or continuing.
#[derive(Debug, thiserror::Error)]
pub enum IngestError {
    /// The structure has no valid frame layout.
    #[error("cannot form frames from the nodes of structure {structure}")]
    Layout {
        /// Name of the structure.
        structure: String,
        /// The cause.
        source: LayoutError,
    },
    /// A name is not a valid chunk of a key expression.
    #[error("name is not a valid key")]
    Name(#[from] NameError),
    /// The recording cannot be opened or closed.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// The operating system cannot start a thread to write recordings.
    #[error("cannot start the recording thread")]
    NoThread(#[source] std::io::Error),
    /// The thread that writes recordings panicked and lost the recording.
    #[error("the recording thread of structure {structure} panicked")]
    RecordingLost {
        /// Name of the structure.
        structure: String,
    },
    /// The bus rejected a declaration or is closed.
    #[error(transparent)]
    Bus(#[from] BusError),
}

impl IngestError {
    /// Returns `true` if a file, an argument or a setting of the user is the cause.
    #[must_use]
    pub fn is_bad_input(&self) -> bool {
        matches!(self, Self::Record(RecordError::OtherLog { .. }))
    }
}
