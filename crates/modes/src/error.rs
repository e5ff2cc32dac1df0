//! Errors of the service.

use spandrel_bus::{BusError, NameError};
use spandrel_checkpoint::CheckpointError;
use spandrel_modal::ModalError;

/// Reason why the service cannot start or continue.
#[derive(Debug, thiserror::Error)]
pub enum ModesError {
    /// The structure file has no table `[modal]`.
    #[error("{structure}: has no table [modal]")]
    NotFollowed {
        /// Name of the structure.
        structure: String,
    },
    /// The name of a mode cannot be a key.
    #[error("{found}")]
    Name {
        /// The name.
        found: String,
        /// The reason.
        source: NameError,
    },
    /// The settings of the identification do not fit each other.
    #[error(transparent)]
    Modal(#[from] ModalError),
    /// Checkpoints cannot be written.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The bus has rejected a declaration or message.
    #[error(transparent)]
    Bus(#[from] BusError),
}

impl ModesError {
    /// Returns `true` if a file, an argument or a setting of the user is the cause.
    #[must_use]
    pub fn is_bad_input(&self) -> bool {
        match self {
            Self::NotFollowed { .. } | Self::Name { .. } | Self::Modal(_) => true,
            Self::Bus(error) => error.is_bad_input(),
            Self::Checkpoint(_) => false,
        }
    }
}
