//! What all services share: how they start and stop, their clock, status and events.
//!
//! A service implements [`Service`]. Its plan contains a [`ServiceInstance`] and the [`Monitored`]
//! structures. The program starts the service from the plan, restarts it after a panic, and stops
//! it.
//!
//! ```
//! use spandrel_service::{Clock, Report};
//!
//! let clock = Clock::fixed(5_000_000_000);
//! let report = Report { done: 12, processed_ns: Some(4_500_000_000), ..Report::default() };
//! assert_eq!(report.lag_s(&clock), Some(0.5));
//! ```
//!
//! - [`Service`], [`Stop`]: how a service starts and runs
//! - [`ServiceInstance`], [`Monitored`]: what a plan contains
//! - [`Clock`]: the wall clock
//! - [`StatusPublisher`], [`Report`]: the status, once per second
//! - [`EventPublisher`], [`log_event`]: events, on the bus and in the log
//! - [`Audit`], [`AuditLog`]: what was refused to clients, in the log and as counts
//!
//! Decisions and maths do not belong in this crate. They are in the core of each service.

mod audit;
mod clock;
mod events;
mod plan;
mod service;
mod status;

pub use audit::{Audit, AuditLine, AuditLog, LostReader, Refused};
pub use clock::Clock;
pub use events::{EventPublisher, log_event};
pub use plan::{Monitored, ServiceInstance};
pub use service::{LAST_FRAMES, LAST_FRAMES_IN_ALL, Service, Stop};
pub use status::{Report, STATUS_EVERY, StatusPublisher};
