//! Real-time identification of a dynamical system: its state, parameters and noise levels, with
//! their uncertainty.
//!
//! Two traits describe a system: [`ProcessModel`] (how its state moves) and [`ObservationModel`]
//! (which quantities are observed). Their Jacobians are operators. A filter takes one frame of
//! samples per time step and returns estimates with their covariance.
//!
//! The method is that of Huang & Yuen, *Bayesian Real-Time System Identification* (2023). For a
//! linear model without parameters, the filter is a plain Kalman filter. Its noise levels can then
//! also be estimated with the two-stage rule of Yuen, Liang & Kuok (2013).
//!
//! - [`model`]: the two traits
//! - [`fading`]: forgetting of old data
//! - [`noise`]: noise levels and their identification
//! - [`fit`]: measures of how well the model explains the data
//! - [`misfit`]: effect of a wrong model on the parameters
//! - [`outlier`]: screening of outliers and faulty sensors
//! - [`discretise`]: one time step without inverting the Jacobian
//! - [`proportional`]: the same, several times faster, for linear structures with proportional
//!   damping
//! - [`update`]: forms of the measurement update
//! - [`extended`]: the adaptive extended Kalman filter, which combines these stages
//! - [`linear`]: linear models without parameters, also in modal coordinates
//! - [`constant`]: quantities that a linear model computes only once
//! - [`steady`]: stationary gain and error covariance of a linear filter, with a right or a wrong
//!   model
//! - [`kalman`]: the plain Kalman filter of a known linear system
//! - [`classes`]: comparison of several models of one system in real time
//! - [`fusion`]: filters of sensor nodes, and the station that fuses their results
//! - [`particle`]: the particle filter, for distributions that are not Gaussian
//! - [`band_limit`]: the low-pass that is the same on every channel
//!
//! This crate does not depend on structures or on the network. The crate `spandrel-structure`
//! creates filters for structures.

mod dense;
mod excitation_course;
mod product;

pub mod error;
pub mod model;

pub mod band_limit;
pub mod classes;
pub mod constant;
pub mod discretise;
pub mod extended;
pub mod fading;
pub mod fit;
pub mod fusion;
pub mod kalman;
pub mod linear;
pub mod misfit;
pub mod noise;
pub mod outlier;
pub mod particle;
pub mod proportional;
mod small;
pub mod steady;
pub mod update;

pub use band_limit::BandLimit;
pub use classes::{
    ClassBank, ClassBankState, ClassEvent, ClassId, ClassPlan, ClassSettings, ComponentSystem,
    Grouping, PersistenceRule, Plausibilities,
};
pub use constant::ConstantTransition;
pub use discretise::InputHold;
pub use error::FilterError;
pub use extended::{Annealing, ExtendedKalmanFilter, FilterSettings, FilterState, Frame, Step};
pub use fading::FadingFactor;
pub use fit::{ChannelFit, Fit, FitReason, FitVerdict};
pub use kalman::{KalmanFilter, LinearModel};
pub use linear::{DirectTerm, ModalModel, StateSpace};
pub use misfit::{MisfitSettings, MisfitState};
pub use model::{ObservationModel, ProcessModel};
pub use noise::{
    NoiseModel, NoiseParameter, NoisePhase, NoiseRule, NoiseSettings, NoiseState, NoiseTarget,
};
pub use outlier::{
    ChannelScreen, OutlierChange, OutlierSettings, OutlierState, OutlierTraining, Verdict,
};
pub use particle::{
    ContinuousSystem, DifferenceWorkspace, Drifting, ExcitedSystem, GaussianStart,
    ImportanceDensity, IncrementTime, Interval, ParticleFilter, ParticleModel, ParticleSettings,
    ParticleState, ParticleStep, Resampling, WarmStartState, WarmStartedParticleFilter,
};
pub use proportional::ProportionalForm;
pub use update::CovarianceForm;
