//! Keeps what was identified: estimates as displayed for an hour, then by minute, hour and day; alerts, acknowledgements and
//! events in all their changes. In a file of SQLite, or on a PostgreSQL server.
//!
//! Messages go in (`batch`), batches of about a second wait in a bounded `backlog` until the `database` has taken them, and
//! queries are answered from there. A database that is away or full stops nothing: what waits is bounded, what had to go is
//! counted and said in the status.
//!
//! The wrong room for measurements: samples and frames are recorded by ingest.

mod backlog;
mod batch;
mod database;
mod error;
mod service;
mod settings;
mod sums;

pub use error::HistoryError;
pub use service::HistoryService;
pub use settings::{Address, Keep};
