//! Identifies a structure while it moves: one adaptive extended Kalman filter per structure, or one per
//! model class, one step per frame.
//!
//! Aligned frames go in; estimates of the parameters and the noise levels with their uncertainty come out, at the sampling
//! rate for programs and at display rate for people.
//!
//! - [`identification`]: the core, one structure; no clock, no network
//! - [`estimator`]: what it runs, one filter, a bank of model classes, or particles
//! - [`Particles`]: particles in place of a Kalman filter, and whether they still follow the data
//! - [`node`]: the core of a sensor node that identifies for itself, from its own channels alone
//! - [`node_shell`]: joins such a node to the bus
//! - [`pool`]: the threads that filters run on
//! - [`shell`]: joins the identification of a structure to the bus
//! - [`SetAside`]: samples that the worker of a node has died of
//! - [`Precedence`]: whether it leads or stands by where several processes identify one structure
//!
//! For a recording without a bus, drive the core directly, as `spandrel estimate` does.

mod display;
mod displays;
mod error;
pub mod estimator;
pub mod identification;
mod load;
mod memory;
mod model_classes;
pub mod node;
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
pub use identification::{Identification, IdentificationState, Input, Output};
pub use node::{NodeIdentification, NodeInput, NodeOutput, NodeState};
pub use node_shell::NodeService;
pub use particles::{Health, ParticleMemory, ParticlePlan, Particles};
pub use pool::FilterPool;
pub use seat::Precedence;
pub use set_aside::SetAside;
pub use shell::{ESTIMATES_KEPT, IdentifyService, log_event};
