//! Identifies a dynamical system while it runs: its state, its parameters and the levels of its noises, each with its
//! uncertainty.
//!
//! A system is described by two traits, [`ProcessModel`] (how its state moves) and [`ObservationModel`] (what is observed
//! of it), whose Jacobians are operators. Frames of samples go in, one call a time step; estimates with covariance come
//! out. The method is that of Huang & Yuen, *Bayesian Real-Time System Identification* (2023). A linear model without
//! parameters makes the filter a plain Kalman filter, whose noise levels can also be estimated by the two-stage rule of
//! Yuen, Liang & Kuok (2013).
//!
//! - [`model`]: the two traits
//! - [`fading`]: how old data are forgotten
//! - [`noise`]: the noise levels and how they are identified
//! - [`fit`]: how well the model explains the data
//! - [`outlier`]: which samples are too far off to be used
//! - [`discretise`]: one time step without inverting the Jacobian
//! - [`proportional`]: the same, several times faster, for linear structures with proportional damping
//! - [`update`]: the forms of the measurement update
//! - [`extended`]: the adaptive extended Kalman filter, the chain of these stages
//! - [`linear`]: linear models without parameters, also in modal coordinates
//! - [`constant`]: what such a model computes only once
//! - [`steady`]: stationary gain and error covariance of a linear filter, right or wrong
//! - [`kalman`]: the plain Kalman filter of a known linear system
//! - [`classes`]: several models of one system compared while they run
//! - [`fusion`]: filters of sensor nodes, and the station that fuses what they find
//! - [`particle`]: the particle filter, for distributions that are not Gaussian
//! - [`band_limit`]: the low-pass that is the same on every channel
//!
//! This room knows nothing of structures or of the network; for a filter of a structure see `spandrel-structure`.

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
