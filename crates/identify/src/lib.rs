//! Identifies a structure from its motion, with one filter step per frame. Each structure has one
//! adaptive extended Kalman filter, or one per model class.
//!
//! The inputs are aligned frames. The outputs are estimates of the parameters and noise levels with
//! their uncertainty. Programs receive them at the sampling rate, and dashboards at the display
//! rate.
//!
//! - [`identification`]: the core for one structure, without clock or network
//! - [`estimator`]: the estimator of the core: one filter, a bank of model classes, or particles
//! - [`Particles`]: particles instead of a Kalman filter, and whether they still follow the data
//! - [`node`]: the core of a sensor node that runs its own identification from its own channels
//! - [`node_shell`]: the connection of such a node to the bus
//! - [`pool`]: the threads that run filters
//! - [`shell`]: the connection of a structure's identification to the bus
//! - [`SetAside`]: samples that caused a node's worker to panic
//! - [`Precedence`]: whether a process leads or stands by if several processes identify one
//!   structure
//!
//! To process a recording without a bus, call the core directly, as `spandrel estimate` does.

mod display;
mod displays;
mod error;
pub mod estimator;
pub mod identification;
mod load;
mod memory;
mod model_classes;
pub mod node;
mod node_frames;
mod node_screening;
pub mod node_shell;
mod particles;
mod pieces;
pub mod pool;
mod screening;
mod seat;
mod set_aside;
pub mod shell;
mod trouble;

pub use error::IdentifyError;
pub use estimator::{Estimator, EstimatorState};
pub use identification::{Identification, IdentificationInput, IdentificationState, Output};
pub use node::{NodeIdentification, NodeIdentificationState, NodeInput, NodeOutput};
pub use node_shell::{NodeService, NodeServicePlan};
pub use particles::{Health, ParticleMemory, ParticlePlan, Particles};
pub use pool::FilterPool;
pub use seat::Precedence;
pub use set_aside::SetAside;
pub use shell::{ESTIMATES_KEPT, IdentifyPlan, IdentifyService};
