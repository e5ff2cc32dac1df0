//! Distributed identification: a filter at each sensor node, and a station that fuses their
//! estimates.
//!
//! Each node filters its own channels. Once per fusion period it sends its density of the
//! parameters and, in compressed form, of the motion. The station multiplies the densities and
//! returns the result. Sources: Huang & Yuen (2023), chapter 6 (fusion of synchronous nodes) and
//! chapter 7 (asynchronous and faulty nodes).
//!
//! All nodes share the density that the station last returned to them. The published product counts
//! this density once per node. Here, a node names the density from which it started the period, and
//! the station adds only the information learnt since then. [`Sharing`] sets how far this
//! information is independent between nodes.
//!
//! - [`gaussian`]: densities, their information form, products
//! - [`compression`]: reduced forms of the state and covariance of a node
//! - [`samples`]: exchange of a few samples between nodes
//! - [`local`]: the filter of a node, and its use of feedback
//! - [`mean_limits`]: limits of the parameter means of a working filter
//! - [`station`]: fusion of the received estimates on the station's clock
//! - [`detector`]: detection of faulty nodes
//!
//! This module does not depend on message transport or clocks.

pub mod compression;
pub mod detector;
pub mod gaussian;
pub mod local;
pub mod mean_limits;
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
pub use mean_limits::MeanLimits;
pub use samples::{SampleExchange, unit_exponent};
pub use station::{
    Fused, FusionRule, NodeReport, Refusal, Sharing, Station, StationSettings, StationState,
};
