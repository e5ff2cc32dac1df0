//! Shows structures, estimates and alerts on a web page.
//!
//! What people look at on the bus goes in; out come a page, an HTTP interface described at `/api/openapi.json`, and a
//! WebSocket. An acknowledgement of an alert is the only thing that goes back.
//!
//! ```no_run
//! use spandrel_bus::{Bus, BusConfig, Name};
//! use spandrel_dashboard::{DashboardService, Listen};
//! use spandrel_structure::Structure;
//! # async fn example() -> Result<(), Box<dyn std::error::Error>> {
//! let structure = Structure::read("demo.toml".as_ref())?;
//! let config = BusConfig::default();
//! let (bus, keys) = (Bus::open(&config).await?, config.keys(structure.name())?);
//! let id = Name::new("dashboard")?;
//! let dashboard = DashboardService::start(&[(&structure, keys)], &bus, &Listen::Default.into(), id).await?;
//! dashboard.run(std::future::pending()).await?;
//! # Ok(())
//! # }
//! ```
//!
//! Types: `topic`, `series` (what is kept over time, and no more), `about` (what the structure file says).
//!
//! Logic: `store` (messages in, a picture out), `innovations` (to the display rate), `sensors` and `overview` (who needs
//! attention, and why), `view` (what is shown), `history` (spans of time).
//!
//! Shell: `listen` (the bus), `api`, `live`, `page` and `server` (browsers), [`DashboardService`] (all of it).
//!
//! The wrong room for deciding on anything, and for keeping more than the last hours: nothing is on disk here.

mod error;

mod gate;
mod tokens;

mod series;
mod topic;

mod about;
mod innovations;
mod store;

mod overview;
mod sensors;
mod view;

mod history;

mod listen;
mod server;

mod door;
mod places;
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
pub use service::{DEFAULT_ADDRESS, DashboardService, Listen, PageSettings};
pub use tokens::{PageRole, Token, Tokens};
