//! What can keep a station from starting, or end the service.

use spandrel_bus::{BusError, NameError};
use spandrel_checkpoint::CheckpointError;
use spandrel_filter::FilterError;
use thiserror::Error;

/// Why the station of a structure could not begin.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum FuseError {
    /// The structure file does not ask for distributed identification.
    #[error(
        "structure {structure} is not identified by its nodes; see identification = \"distributed\""
    )]
    NotDistributed {
        /// The structure.
        structure: String,
    },
    /// The station refused its settings.
    #[error("station of structure {structure} cannot be made")]
    Station {
        /// The structure.
        structure: String,
        /// Why.
        source: FilterError,
    },
    /// A name is no chunk of a key expression.
    #[error("name in structure {structure} cannot be a key")]
    Name {
        /// The structure.
        structure: String,
        /// Why.
        source: NameError,
    },
    /// What the station knows cannot be kept.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The bus refused a declaration or is closed.
    #[error(transparent)]
    Bus(#[from] BusError),
}
