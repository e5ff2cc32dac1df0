//! Errors that prevent an identification from starting or terminate the service.

use spandrel_bus::{BusError, Name, NameError};
use spandrel_checkpoint::CheckpointError;
use spandrel_earthquake::EarthquakeError;
use spandrel_filter::FilterError;
use thiserror::Error;

/// An error that prevents the identification service from starting or continuing.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum IdentifyError {
    /// The filter rejected its settings.
    #[error("cannot create the filter of structure {structure}")]
    Filter {
        /// Name of the structure.
        structure: String,
        /// The cause.
        source: FilterError,
    },
    /// Strong motion cannot be distinguished from weak motion.
    #[error("cannot find strong motion of structure {structure}")]
    Earthquakes {
        /// Name of the structure.
        structure: String,
        /// The cause.
        source: EarthquakeError,
    },
    /// The nodes do not run their own identification, or there is no such node.
    #[error(
        "structure {structure} has no such node with its own identification; see identification \
         = \"distributed\""
    )]
    NotDistributed {
        /// Name of the structure.
        structure: String,
    },
    /// A name cannot be part of a key expression.
    #[error("a name in structure {structure} is not a valid key")]
    Name {
        /// Name of the structure.
        structure: String,
        /// The cause.
        source: NameError,
    },
    /// The state is too large to be transferred to a standby.
    #[error(
        "structure {structure} cannot have a standby: its state has {bytes} bytes, must have at \
         most {most} to be transferred; omit --standby"
    )]
    StateTooLarge {
        /// Name of the structure.
        structure: String,
        /// Size of the message with the state, in bytes.
        bytes: usize,
        /// Maximum size of a message, in bytes.
        most: usize,
    },
    /// A checkpoint cannot be written.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The bus rejected a declaration or is closed.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// The thread that ran a filter panicked, and the filter was lost with it.
    #[error("filter thread of structure {structure} panicked")]
    ThreadLost {
        /// Name of the structure.
        structure: String,
    },
}

impl IdentifyError {
    /// Returns `true` if a file, an argument or a setting of the user is the cause.
    #[must_use]
    pub fn is_bad_input(&self) -> bool {
        matches!(self, Self::StateTooLarge { .. })
    }
}

/// Converts a name in the file of `structure` to a chunk of a key expression.
pub(crate) fn key_name(structure: &str, name: &str) -> Result<Name, IdentifyError> {
    Name::new(name).map_err(|source| IdentifyError::Name {
        structure: structure.to_owned(),
        source,
    })
}
