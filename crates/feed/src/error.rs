//! Errors of the feed.

use spandrel_bus::BusError;

use crate::mistake::{Mistake, in_lines};

/// An error that prevents or ends the feed.
#[derive(Debug, thiserror::Error)]
pub enum FeedError {
    /// The bus rejects a declaration, or is closed.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// The configuration has mistakes.
    #[error("{}", in_lines(file, mistakes))]
    Settings {
        /// Configuration file.
        file: String,
        /// All mistakes.
        mistakes: Vec<Mistake>,
    },
    /// The configuration has no source.
    #[error("no source: the configuration must have at least one [[feed.source]]")]
    NoSource,
    /// The name of a node is not a valid chunk of a key expression.
    #[error("node name is not a valid key")]
    Name(#[from] spandrel_bus::NameError),
}

impl FeedError {
    /// Returns `true` if the configuration is the cause.
    #[must_use]
    pub fn is_bad_input(&self) -> bool {
        match self {
            Self::Bus(error) => error.is_bad_input(),
            Self::Settings { .. } | Self::NoSource | Self::Name(_) => true,
        }
    }
}
