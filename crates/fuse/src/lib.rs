//! The central station of distributed identification: fuses the estimates of sensor nodes and
//! returns feedback to them.
//!
//! At the fusion rate, the station publishes the same messages as a single worker with the samples
//! of all nodes. Alert, history and dashboards therefore need no special cases.
//!
//! - [`fusion`]: the core for one structure, without clock or network
//! - [`shell`]: connects the station of a structure to the bus

mod error;
pub mod fusion;
mod node;
pub mod shell;

pub use error::FuseError;
pub use fusion::{Fusion, FusionState, Input, Output};
pub use shell::{ESTIMATES_KEPT, FusePlan, FuseService};
