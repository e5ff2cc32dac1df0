//! The central station of distributed identification: fuses what sensor nodes have found for themselves, and answers them.
//!
//! What it publishes is what one worker with the samples of all nodes would publish, at the fusion rate, so that alert,
//! history and dashboards do not know the difference.
//!
//! - [`fusion`]: the core, one structure; no clock, no network
//! - [`shell`]: joins the station of a structure to the bus

mod error;
pub mod fusion;
mod node;
pub mod shell;

pub use error::FuseError;
pub use fusion::{Fusion, FusionState, Input, Output};
pub use shell::{ESTIMATES_KEPT, FuseService};
