//! Errors of the service.

use spandrel_bus::BusError;
use spandrel_checkpoint::CheckpointError;
use spandrel_earthquake::EarthquakeError;
use std::path::PathBuf;

/// Reason why the service cannot start or continue.
#[derive(Debug, thiserror::Error)]
pub enum ReportsError {
    /// The structure file has no table `[earthquakes]`.
    #[error("{structure}: has no table [earthquakes]")]
    NotReported {
        /// Name of the structure.
        structure: String,
    },
    /// The folder of the reports cannot be created.
    #[error("cannot create {}", folder.display())]
    Folder {
        /// The folder.
        folder: PathBuf,
        /// The reason.
        source: std::io::Error,
    },
    /// A setting is out of range.
    #[error(transparent)]
    Earthquake(#[from] EarthquakeError),
    /// Checkpoints cannot be written.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The bus has rejected a declaration or message.
    #[error(transparent)]
    Bus(#[from] BusError),
}

impl ReportsError {
    /// Returns `true` if a file, an argument or a setting of the user is the cause.
    #[must_use]
    pub fn is_bad_input(&self) -> bool {
        match self {
            Self::NotReported { .. } | Self::Earthquake(_) => true,
            Self::Bus(error) => error.is_bad_input(),
            Self::Folder { .. } | Self::Checkpoint(_) => false,
        }
    }
}
