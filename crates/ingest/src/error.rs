//! What can keep ingest from starting, or end it.

use spandrel_bus::{BusError, NameError};
use spandrel_record::RecordError;

use crate::layout::LayoutError;

/// Errors of ingest.
#[derive(Debug, thiserror::Error)]
pub enum IngestError {
    /// The structure cannot be made into frames.
    #[error("nodes of structure {structure} make no frames")]
    Layout {
        /// The structure.
        structure: String,
        /// Why.
        source: LayoutError,
    },
    /// A name is no chunk of a key expression.
    #[error("name is no key")]
    Name(#[from] NameError),
    /// The recording cannot be opened or ended.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// The system gives no thread to write recordings.
    #[error("no thread for the recording")]
    NoThread(#[source] std::io::Error),
    /// The thread that writes a recording has panicked with it.
    #[error("the recording of structure {structure} was lost with a panic of its thread")]
    RecordingLost {
        /// The structure.
        structure: String,
    },
    /// The bus refused a declaration or is closed.
    #[error(transparent)]
    Bus(#[from] BusError),
}
