//! Says what is monitored: a structure, its uncertain parameters, its excitation and its sensors.
//!
//! A structure file (TOML, and the matrices it names) goes in; out come the model and the settings that `spandrel-filter`
//! runs on, simulated responses, and an analysis of what the sensors can tell before any of them is bought.
//!
//! ```
//! use spandrel_filter::{ExtendedKalmanFilter, Frame};
//! use spandrel_structure::{Structure, StructureError};
//! use std::path::Path;
//!
//! let text = include_str!("../../../docs/examples/demo.toml");
//! let structure = Structure::parse(text, Path::new("demo.toml"))?;
//! let settings = structure.filter_settings().expect("the half-life of the demo has a fading factor");
//! let mut filter = ExtendedKalmanFilter::new(structure.model(), settings).expect("settings fit their own model");
//! for frame in structure.simulator(1).take(100) {
//!     let (ground, floors) = (&frame.values[..1], &frame.values[1..]);
//!     filter.step(Frame { observations: floors, excitation: ground }).expect("the demo does not diverge");
//! }
//! # Ok::<(), StructureError>(())
//! ```
//!
//! Types:
//!
//! - [`Structure`]: all of it; valid, because it comes from a checked file only
//! - [`Node`], [`Channel`], [`Quantity`]: the sensors
//! - [`Parameter`], [`Excitation`], [`NoiseLevel`]: what is uncertain, what shakes, and how much
//! - [`EstimatedResponse`]: displacements and velocities that are asked for and that no sensor measures
//! - [`AlertRule`], [`BandLimit`], [`IngestSettings`], [`RecordMap`], [`SimulationPlan`]: what other rooms carry out
//! - [`StructureError`], [`Diagnostic`]: the mistakes of a file, all at once, each with its line
//!
//! Logic:
//!
//! - [`StructureModel`]: the traits of `spandrel-filter` for a structure, linear or hysteretic
//! - [`StructureClasses`]: the same for models that group its stiffness parameters, compared while they run
//! - [`Simulator`]: responses, damage, and faults of sensors
//! - [`Drawing`]: points, members and sensors for people to look at
//! - [`CheckReport`]: frequencies, damping, and what can be identified
//!
//! Not for systems that are no structures: implement the traits of `spandrel-filter` instead.

mod alert_rule;
mod error;
mod estimated_response;
mod excitation;
mod filter_plan;
mod fusion_plan;
mod hysteresis;
mod linear_system;
mod node;
mod noise_level;
mod parameter;
mod record_map;
mod settings;
mod simulation_plan;
mod structure;

mod diagnostics;
mod file;
mod finite_elements;
mod frame;
mod matrix_file;
mod mesh;
mod section;
mod shear_building;
mod skeleton;
mod tower;
mod truss;

mod assembly;
mod check;
mod classes;
mod drawing;
mod excitation_dependence;
mod filter_settings;
mod information;
mod linear_form;
mod model;
mod modes;
mod of_node;
mod simulator;
mod sparse_cholesky;
mod spectral_information;
mod spectrum;
mod steady_filter;
mod wrong_model;

pub use alert_rule::{AlertRule, Reference};
pub use check::{
    Assumption, CheckReport, Finding, IdentificationReport, ModeReport, NoiseLevelReport,
    ParameterReport, Severity, Shift, TimeStepReport,
};
pub use classes::StructureClasses;
pub use drawing::{Drawing, DrawingForm, DrawnMember, DrawnPoint, DrawnSensor};
pub use error::{Diagnostic, StructureError};
pub use estimated_response::EstimatedResponse;
pub use excitation::Excitation;
pub use fusion_plan::FusionPlan;
pub use model::StructureModel;
pub use node::{Channel, Node, Quantity};
pub use noise_level::{NoiseLevel, NoiseSource};
pub use parameter::Parameter;
pub use record_map::{ColumnMap, RecordMap};
pub use settings::{BandLimit, IngestSettings, ParticleKeys};
pub use simulation_plan::SimulationPlan;
pub use simulator::{SimulatedFrame, Simulator};
pub use structure::Structure;
