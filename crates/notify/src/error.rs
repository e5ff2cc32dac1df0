//! What can go wrong with notices.

use spandrel_bus::{BusError, NameError};
use std::path::PathBuf;

/// Errors of the notices.
#[derive(Debug, thiserror::Error)]
pub enum NotifyError {
    /// The configuration cannot be used; the text never holds a secret.
    #[error("notify.{place} is {found}, must be {allowed}")]
    Setting {
        /// Which setting, such as `webhook[0].url`.
        place: String,
        /// What was found, without secrets.
        found: String,
        /// What is allowed.
        allowed: &'static str,
    },
    /// A file with a secret cannot be read.
    #[error("{}: cannot read the secret of notify.{place}", path.display())]
    Secret {
        /// Which setting.
        place: String,
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// What is to be remembered cannot be kept.
    #[error(transparent)]
    Checkpoint(#[from] spandrel_checkpoint::CheckpointError),
    /// The bus refuses.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// A name is none.
    #[error(transparent)]
    Name(#[from] NameError),
}
