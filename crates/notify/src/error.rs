//! Errors of the notification service.

use spandrel_bus::{BusError, NameError};
use std::path::PathBuf;

/// An error that prevents the notification service from starting or continuing.
#[derive(Debug, thiserror::Error)]
pub enum NotifyError {
    /// A setting is invalid. The error text contains no secrets.
    #[error("notify.{place} is {found}, must be {allowed}")]
    Setting {
        /// The setting, such as `webhook[0].url`.
        place: String,
        /// The invalid value, without secrets.
        found: String,
        /// The allowed values.
        allowed: &'static str,
    },
    /// A file with a secret cannot be read.
    #[error("{}: cannot read the secret of notify.{place}", path.display())]
    Secret {
        /// The setting.
        place: String,
        /// Path of the file.
        path: PathBuf,
        /// The error of the operating system.
        source: std::io::Error,
    },
    /// A template cannot be read.
    #[error("{}: cannot read the template of notify.{place}", path.display())]
    TemplateFile {
        /// The setting.
        place: String,
        /// Path of the file.
        path: PathBuf,
        /// The error of the operating system.
        source: std::io::Error,
    },
    /// A template has an error.
    #[error("{file}:{line}: template of notify.{place}: {found}, must be {allowed}")]
    Template {
        /// The setting.
        place: String,
        /// Path of the file, or the name of the setting with the template.
        file: String,
        /// Line, from 1.
        line: usize,
        /// What is wrong.
        found: String,
        /// What is allowed.
        allowed: String,
    },
    /// A checkpoint cannot be written.
    #[error(transparent)]
    Checkpoint(#[from] spandrel_checkpoint::CheckpointError),
    /// The bus rejected a declaration or is closed.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// A name cannot be part of a key expression.
    #[error(transparent)]
    Name(#[from] NameError),
}

impl NotifyError {
    /// Returns `true` if a file, an argument or a setting of the user is the cause.
    #[must_use]
    pub fn is_bad_input(&self) -> bool {
        matches!(
            self,
            Self::Setting { .. }
                | Self::Secret { .. }
                | Self::TemplateFile { .. }
                | Self::Template { .. }
        )
    }
}
