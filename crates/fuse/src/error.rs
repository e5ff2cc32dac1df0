//! Errors that prevent a station from starting or terminate the service.

use spandrel_bus::{BusError, NameError};
use spandrel_checkpoint::CheckpointError;
use spandrel_filter::FilterError;
use thiserror::Error;

/// An error that prevents the fusion service from starting or continuing.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum FuseError {
    /// The structure file does not specify distributed identification.
    #[error(
        "structure {structure} is not identified by its nodes; see identification = \"distributed\""
    )]
    NotDistributed {
        /// Name of the structure.
        structure: String,
    },
    /// The station rejected its settings.
    #[error("cannot create the station of structure {structure}")]
    Station {
        /// Name of the structure.
        structure: String,
        /// The cause.
        source: FilterError,
    },
    /// A name cannot be part of a key expression.
    #[error("a name in structure {structure} is not a valid key")]
    Name {
        /// Name of the structure.
        structure: String,
        /// The cause.
        source: NameError,
    },
    /// Checkpoints cannot be written.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The bus rejected a declaration or is closed.
    #[error(transparent)]
    Bus(#[from] BusError),
}

impl FuseError {
    /// Returns `true` if a file, an argument or a setting of the user is the cause.
    #[must_use]
    pub fn is_bad_input(&self) -> bool {
        match self {
            Self::NotDistributed { .. } | Self::Name { .. } | Self::Station { .. } => true,
            Self::Bus(error) => error.is_bad_input(),
            Self::Checkpoint(_) => false,
        }
    }
}
