//! Sensor nodes without hardware: simulated nodes and replayed recordings.
//!
//! The input is rows with all channels of a structure. The output is the samples of each node,
//! published in blocks at the requested speed. A flow-control window limits how far the output can
//! be ahead of the downstream services.
//!
//! ```
//! use spandrel_sensor::{Cutter, NodePace, NodePlan};
//!
//! let node = NodePlan {
//!     name: "roof".parse()?,
//!     channels: 2,
//!     sampling_rate_hz: 200.0,
//!     pace: NodePace::EveryRow,
//!     clock_offset_ns: 0,
//!     clock_drift_ppm: 0.0,
//! };
//! let mut cutter = Cutter::new(vec![node], 1, 100);
//! let mut blocks = Vec::new();
//! cutter.push(0, &[0.1, 0.2], &mut blocks);
//! cutter.end(&mut blocks);
//! assert_eq!(blocks[0].1.samples, [0.1, 0.2]);
//! # Ok::<(), spandrel_bus::NameError>(())
//! ```
//!
//! - [`open_record`], [`column_mapping`]: a recording, read as the structure file describes it
//! - [`Row`], [`simulated_rows`], [`recorded_rows`]: sources of samples
//! - [`Cutter`]: converts rows to one stream of blocks per node, without a clock or network
//! - [`Speed`], [`Window`]: control how fast rows are published
//! - [`SensorService`]: publishes the blocks on the bus
//!
//! A driver for real hardware does not belong here. It publishes its own sample blocks.

mod record_source;
mod rows;

mod cut;
mod pace;

mod error;
mod shell;

pub use cut::{Clocks, Cutter, NodePace, NodePlan};
pub use error::SensorError;
pub use pace::{Speed, Window};
pub use record_source::{column_mapping, open_record};
pub use rows::{Row, recorded_rows, simulated_rows};
pub use shell::{Origin, SAMPLES_KEPT, SensorService, SensorSettings, WINDOW_FRAMES};
