//! Stores identification results in a SQLite file or on a PostgreSQL server.
//!
//! It keeps display values for an hour, then aggregates per minute, hour and day. It also keeps all
//! alerts, acknowledgements and events. It treats conditions, such as temperatures, like display
//! values.
//!
//! Messages are collected (`batch`) in batches of about one second. The batches wait in a bounded
//! `backlog` until the `database` has stored them. Replies to queries come from the database. An
//! unavailable or full database stops no other service. The backlog is bounded, and the status
//! reports dropped rows.
//!
//! This crate does not store measurements: `ingest` records samples and frames.

mod backlog;
mod batch;
mod database;
mod error;
mod service;
mod settings;
mod sums;
mod trouble;

pub use error::HistoryError;
pub use service::{HistoryPlan, HistoryService};
pub use settings::{Address, Keep};
