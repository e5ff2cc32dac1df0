//! What can keep sensor nodes from starting, or end them.

use spandrel_bus::{BusError, NameError};
use spandrel_record::RecordError;

/// Errors of simulated and replayed sensor nodes.
#[derive(Debug, thiserror::Error)]
pub enum SensorError {
    /// A node's name is no chunk of a key expression.
    #[error("name of a node is no key")]
    Name(#[from] NameError),
    /// The bus refused a declaration or is closed.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// The record cannot be read to its end.
    #[error(transparent)]
    Record(#[from] RecordError),
}

impl From<std::convert::Infallible> for SensorError {
    fn from(never: std::convert::Infallible) -> Self {
        match never {}
    }
}
