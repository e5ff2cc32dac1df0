//! Distributed identification: filters at the sensor nodes, and a station that fuses what they have found.
//!
//! Every node runs a filter of its own on its own channels. Once in a fusion period it sends what it knows of the parameters,
//! and of the motion in compressed form; the station multiplies the densities and sends the result back. Sources: Huang &
//! Yuen (2023), chapter 6 (fusion of synchronous nodes) and chapter 7 (nodes out of step, wrong nodes).
//!
//! The published product counts what all nodes share, the density that was sent back to them, once for every node. Here a
//! node says which density it started the period from, and the station adds only what the node has learnt since; how far
//! these gains are independent of one another is the [`Sharing`] of the excitation.
//!
//! - [`gaussian`]: densities, their information form, products
//! - [`compression`]: what a node sends in place of its whole state and covariance
//! - [`samples`]: nodes that tell one another a few of their samples
//! - [`local`]: the filter of a node, and how it takes feedback
//! - [`station`]: fuses on its own clock with what has arrived
//! - [`detector`]: which nodes are wrong
//!
//! Nothing here knows of messages or clocks.

pub mod compression;
pub mod detector;
pub mod gaussian;
pub mod local;
pub mod samples;
pub mod station;

pub use compression::{
    CompressedMotion, CovarianceScheme, ModalBasis, MotionExchange, Responses, Weights,
};
pub use detector::{GlobalDetector, NodeDistance, Weighting};
pub use gaussian::{Gaussian, Information, product};
pub use local::{
    Feedback, FeedbackRule, Lineage, LocalEstimate, LocalFilter, LocalState, NodeSettings, Taken,
};
pub use samples::{SampleExchange, unit_exponent};
pub use station::{
    Fused, FusionRule, NodeReport, Refusal, Sharing, Station, StationSettings, StationState,
};
