//! What can keep an identification from starting, or end the service.

use spandrel_bus::{BusError, NameError};
use spandrel_checkpoint::CheckpointError;
use spandrel_filter::FilterError;
use thiserror::Error;

/// Why the identification of a structure could not begin.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum IdentifyError {
    /// The filter refused its settings.
    #[error("filter of structure {structure} cannot be made")]
    Filter {
        /// The structure.
        structure: String,
        /// Why.
        source: FilterError,
    },
    /// Nodes do not identify for themselves, or there is no such node.
    #[error(
        "structure {structure} has no such node that identifies for itself; see identification = \"distributed\""
    )]
    NotDistributed {
        /// The structure.
        structure: String,
    },
    /// A name is no chunk of a key expression.
    #[error("name in structure {structure} cannot be a key")]
    Name {
        /// The structure.
        structure: String,
        /// Why.
        source: NameError,
    },
    /// Nobody could stand by: what is known cannot be handed over.
    #[error(
        "structure {structure} cannot have a standby: its state has {bytes} bytes, must have at most {most} to be handed over; \
         leave --standby out"
    )]
    StateTooLarge {
        /// The structure.
        structure: String,
        /// Size of the message with its state.
        bytes: usize,
        /// Size of the largest message.
        most: usize,
    },
    /// What the service remembers cannot be kept.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The bus refused a declaration or is closed.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// The thread that carried a filter is gone: the filter with it.
    #[error("filter of structure {structure} was lost with its thread")]
    ThreadLost {
        /// The structure.
        structure: String,
    },
}
