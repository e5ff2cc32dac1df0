//! A web page that shows structures, estimates and alerts.
//!
//! The dashboard subscribes to the topics for display. It serves a page, an HTTP interface that
//! `/api/openapi.json` describes, and a WebSocket. For a user, it publishes the acknowledgement of
//! an alert, and an annotation of a judged structure.
//!
//! ```no_run
//! use spandrel_bus::{Bus, BusConfig, Name};
//! use spandrel_dashboard::{DashboardPlan, DashboardService, Listen};
//! use spandrel_service::{ServiceInstance, Monitored, Service};
//! use spandrel_structure::Structure;
//! # async fn example() -> Result<(), Box<dyn std::error::Error>> {
//! let structure = Structure::read("demo.toml".as_ref())?;
//! let config = BusConfig::default();
//! let (bus, keys) = (Bus::open(&config).await?, config.keys(structure.name())?);
//! let plan = DashboardPlan {
//!     instance: ServiceInstance::new(&bus, Name::new("dashboard")?),
//!     structures: vec![Monitored::new(&structure, keys)],
//!     page: Listen::Default.into(),
//! };
//! let dashboard = DashboardService::start(&plan).await?;
//! dashboard.run(Box::pin(std::future::pending())).await?;
//! # Ok(())
//! # }
//! ```
//!
//! Types: `topic`, `series` (bounded data over time), `about` (data from the structure file).
//!
//! Logic of the present:
//!
//! - `store`: present state and past
//! - `innovations`: reduced to the display rate
//! - `sensors`, `overview`: what needs attention, and why
//! - `frequencies`: the same without a model
//! - `levels`: samples of the last minute
//! - `conditions`: temperatures and the like
//! - `view`: data for the page
//! - `lasting_alert`: lasting losses as alerts
//!
//! Logic of the past, and of what people enter:
//!
//! - `history`: spans of time
//! - `log`: changes and events of a period
//! - `judgements`: years of a judged quantity
//! - `reports`: reports of earthquakes
//! - `stretch`, `samples`: samples of a range as a file
//! - `recorded`: waveforms of a range from its samples
//! - `entries`, `annotations`: what people enter
//!
//! Transport: `door` and `places` (connections and their limits), `request_lines` (well-formed
//! heads), `gate` and `entrance` (who may do what).
//!
//! Shell: `api`, `live`, `page` and `server` (browsers), [`DashboardService`] (the whole service).
//!
//! The dashboard makes no decisions. It keeps the last hours in memory only and writes nothing to
//! disk.

mod error;

mod gate;
mod tokens;

mod series;
mod topic;

mod about;
mod innovations;
mod store;

mod conditions;
mod frequencies;
mod lasting_alert;
mod levels;
mod overview;
mod sensors;
mod view;

mod annotations;
mod entries;
mod history;
mod judgements;
mod log;
mod recorded;
mod reports;
mod samples;
mod stretch;

mod server;

mod door;
mod places;
mod request_lines;
mod serving;

mod api;
mod entrance;
mod health;
mod live;
mod metrics;
mod page;

mod service;

#[cfg(test)]
mod testing;

pub use door::PageCertificate;
pub use error::DashboardError;
pub use service::{DEFAULT_ADDRESS, DashboardPlan, DashboardService, Listen, PageSettings};
pub use tokens::{PageRole, Token, Tokens};
