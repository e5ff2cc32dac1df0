//! Decides from estimates whether a part of a structure has lost stiffness, and explains why.
//!
//! The inputs are estimates with their covariance. The output is an alert whenever the state of a
//! parameter changes.
//!
//! ```
//! use spandrel_alert::{Decision, DecisionInput, ParameterEstimate, Rule, Subject};
//! use spandrel_bus::{AlertState, EstimateFlags};
//!
//! let subject = Subject { parameter: 0, name: "storey-2".into(), quantity: "stiffness".into(), prior_std: 0.3, bounds: (0.1, 2.0) };
//! let mut decision = Decision::new(0, Rule::new(0.05, 0.95, 0.5, 10.0)?, subject);
//! let mut alerts = Vec::new();
//! for second in 0..=10 {
//!     let estimate = ParameterEstimate { time_ns: second * 1_000_000_000, mean: 0.86, std: 0.01 };
//!     decision.handle(DecisionInput::Estimate(estimate, EstimateFlags::working()), &mut alerts);
//! }
//! assert_eq!(alerts[0].state, AlertState::Pending);
//! assert_eq!(alerts[1].state, AlertState::Raised);
//! assert!(alerts[1].why.starts_with("storey-2 has lost 14.0 % of its stiffness"));
//! # Ok::<(), spandrel_alert::AlertError>(())
//! ```
//!
//! - [`mod@reference`]: the reference of a loss
//! - [`rule`]: the owner's rule: loss, credibility and sustain time
//! - [`credibility`], `scatter`: the probability of a loss, even if few records determine the
//!   scatter
//! - [`support`]: whether the data support a decision
//! - `motion`: strong motion, in which a loss alone shows no damage
//! - [`learning`], [`baseline`]: the reference value, learnt from a time span or from several
//!   records
//! - [`alert`], `wording`: the content and the words of an alert
//! - [`decision`]: the state machine of one parameter, without clock or network
//! - [`watch`]: all parameters of one structure
//! - `model_check`: whether the natural frequencies of the model agree with the measured ones
//! - `monitoring`: whether the present data would reveal damage
//! - [`shell`]: the connection to the bus
//!
//! Programs that need only the estimates at display rate can subscribe to the parameters without
//! this crate.

pub mod error;

pub mod reference;
pub mod rule;

pub mod credibility;
pub mod learning;
mod memory;
mod motion;
mod scatter;
pub mod support;

pub mod baseline;

pub mod alert;
mod wording;

pub mod decision;
mod model_check;
mod monitoring;
pub mod watch;

pub mod shell;

pub use alert::{Acknowledged, Alert};
pub use baseline::{Baseline, BetweenRecords, ParameterBaseline, RecordSummary, WithoutSensor};
pub use credibility::{
    LossEstimate, ParameterEstimate, ParameterLoss, loss_estimate, probability_of_loss,
};
pub use decision::{Decision, DecisionInput, Model, Subject};
pub use error::AlertError;
pub use learning::{Learning, SpanSummary};
pub use reference::{Reference, Scatter};
pub use rule::{ReferenceRule, Rule};
pub use shell::{AlertPlan, AlertService};
pub use support::DecidedFrames;
pub use watch::Watch;
