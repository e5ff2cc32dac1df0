//! Describes a monitored structure: its uncertain parameters, its excitation and its sensors.
//!
//! The input is a structure file (TOML) with the matrices that it names. The outputs are the model
//! and the settings for `spandrel-filter`, simulated responses, and an analysis of the information
//! that the sensors will provide.
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
//! - [`Structure`]: the complete structure, valid because it always comes from a checked file
//! - [`Node`], [`Channel`], [`Quantity`]: the sensors
//! - [`Parameter`], [`Excitation`], [`NoiseLevel`]: uncertain properties, excitation, and their
//!   levels
//! - [`Condition`]: slow quantities, such as temperatures, that no model contains
//! - [`EstimatedResponse`]: requested displacements and velocities that no sensor measures
//! - [`AlertRule`], [`BandLimit`], [`IngestSettings`], [`RecordMap`], [`SimulationPlan`]: settings
//!   for other crates
//! - [`EarthquakePlan`]: what counts as an earthquake
//! - [`JudgedStructure`], [`JudgePlan`]: what is judged, with or without a model
//! - [`ModalPlan`]: how natural frequencies are followed, and which modes have a name
//! - [`StructureError`], [`Diagnostic`]: all mistakes in a file, each with its line
//! - [`text_encoding`]: decodes the text of a file, and names an encoding other than UTF-8
//!
//! Logic:
//!
//! - [`StructureModel`]: the traits of `spandrel-filter` for a structure, linear or hysteretic
//! - [`StructureClasses`]: the same for models that group the stiffness parameters and are compared
//!   online
//! - [`Simulator`]: responses, damage, and sensor faults
//! - [`Drawing`]: points, members and sensors for display
//! - [`CheckReport`]: frequencies, damping, and the identifiable quantities
//!
//! For other systems, implement the traits of `spandrel-filter` directly.

mod alert_rule;
mod condition;
mod coordinates;
mod earthquake_plan;
mod error;
mod estimated_response;
mod excitation;
mod filter_plan;
mod fusion_plan;
mod hysteresis;
mod judge_plan;
mod linear_system;
mod modal_plan;
mod node;
mod noise_level;
mod parameter;
mod part_model;
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
pub mod text_encoding;
mod tower;
mod truss;

mod assembly;
mod check;
mod check_cost;
mod classes;
mod common_motion;
mod computed;
mod drawing;
mod excitation_dependence;
mod filter_settings;
mod information;
mod linear_form;
mod model;
mod modes;
mod of_node;
mod ritz_basis;
mod simulator;
mod sparse_cholesky;
mod spectral_information;
mod spectrum;
mod steady_filter;
mod wrong_model;

pub use alert_rule::{AlertRule, Reference};
pub use check::{
    Assumption, CheckReport, Finding, IdentificationReport, MOST_PARTICLE_STATES, ModeReport,
    NoiseLevelReport, ParameterReport, Severity, Shift, TimeStepReport,
};
pub use classes::StructureClasses;
pub use common_motion::CommonMotion;
pub use condition::Condition;
pub use coordinates::Coordinates;
pub use drawing::{Drawing, DrawingForm, DrawnMember, DrawnPoint, DrawnSensor};
pub use earthquake_plan::EarthquakePlan;
pub use error::{Diagnostic, StructureError};
pub use estimated_response::EstimatedResponse;
pub use excitation::Excitation;
pub use fusion_plan::{FusionPlan, PeriodNumbers, SentModes};
pub use judge_plan::{JudgePlan, JudgedStructure};
pub use modal_plan::{DeclaredMode, ModalPlan, UpdatePlan};
pub use model::StructureModel;
pub use node::{Channel, Direction, Node, Quantity};
pub use noise_level::{NoiseLevel, NoiseSource};
pub use parameter::Parameter;
pub use record_map::{ColumnMap, RecordMap};
pub use settings::{BandLimit, IngestSettings, ParticleKeys};
pub use simulation_plan::SimulationPlan;
pub use simulator::{SimulatedFrame, Simulator};
pub use structure::Structure;
