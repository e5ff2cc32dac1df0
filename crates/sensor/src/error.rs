//! Errors that prevent sensor nodes from starting or terminate them.

use spandrel_bus::{BusError, NameError};
use spandrel_record::RecordError;

/// An error of simulated or replayed sensor nodes.
#[derive(Debug, thiserror::Error)]
pub enum SensorError {
    /// The name of a node is not a valid chunk of a key expression.
    #[error("name of a node is not a valid key")]
    Name(#[from] NameError),
    /// The bus rejected a declaration or is closed.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// The record cannot be read to its end.
    #[error(transparent)]
    Record(#[from] RecordError),
}

impl SensorError {
    /// Returns `true` if a file, an argument or a setting of the user is the cause.
    #[must_use]
    pub fn is_bad_input(&self) -> bool {
        matches!(self, Self::Record(_))
    }
}

impl From<std::convert::Infallible> for SensorError {
    fn from(never: std::convert::Infallible) -> Self {
        match never {}
    }
}
