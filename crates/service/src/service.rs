//! How a service starts and runs.

use std::fmt::Display;
use std::time::Duration;

use spandrel_bus::BoxedFuture;

/// Completes when a service must stop.
pub type Stop<'a> = BoxedFuture<'a, ()>;

/// After a stop, a service that reads frames waits until none has arrived for this long.
pub const LAST_FRAMES: Duration = Duration::from_millis(100);
/// Maximum total wait for frames after a stop, because an ingest in another process continues to
/// send.
pub const LAST_FRAMES_IN_ALL: Duration = Duration::from_secs(1);

/// A service that has been started.
pub trait Service: Sized + Send + 'static {
    /// What the service needs to start. The program keeps it for a start after a panic.
    type Plan: Send + Sync + 'static;
    /// The reason why the service cannot start, or why it ended early.
    type Error: Display + Send + 'static;

    /// Checks the plan and connects to the bus.
    ///
    /// # Errors
    /// Returns an error if the plan is invalid, or if the bus rejects a declaration.
    fn start(plan: &Self::Plan) -> BoxedFuture<'_, Result<Self, Self::Error>>;

    /// Runs until `stop` completes. Data that has arrived by then is still processed.
    ///
    /// # Errors
    /// Returns an error if the service cannot continue.
    fn run<'a>(self, stop: Stop<'a>) -> BoxedFuture<'a, Result<(), Self::Error>>;
}
