//! Sensor nodes that are not hardware: simulated ones, and a replayed record.
//!
//! Rows of all channels of a structure go in; each node's samples come out on the bus in blocks, at the speed asked for,
//! never further ahead than the services downstream can follow.
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
//! - [`open_record`], [`column_mapping`]: a recording as the structure file describes it
//! - [`Row`], [`simulated_rows`], [`recorded_rows`]: where samples come from
//! - [`Cutter`]: rows to blocks per node; no clock, no network
//! - [`Speed`], [`Window`]: how fast rows may be put
//! - [`SensorService`]: joins them to the bus
//!
//! The wrong room for a driver of real hardware: that puts its own sample blocks.

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
pub use shell::{SAMPLES_KEPT, SensorService, SensorSettings, WINDOW_FRAMES};
