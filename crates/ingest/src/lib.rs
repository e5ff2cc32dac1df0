//! Makes frames of the samples of many nodes, and keeps the latest for those who missed them.
//!
//! Blocks of samples go in, node by node, in whatever order they arrive; frames with a value or a missing sample per
//! channel come out, in order, none skipped.
//!
//! ```
//! use spandrel_bus::{Header, Pace, SampleBlock, StreamState};
//! use spandrel_ingest::{Alignment, Input, Layout, NodeLayout};
//!
//! let node = |name: &str| Ok::<_, spandrel_bus::NameError>(NodeLayout { name: name.parse()?, ranges: vec![20.0] });
//! let layout = Layout::new(vec![node("base")?, node("roof")?], 100.0, 0.005)?;
//! let mut alignment = Alignment::new(layout, "ingest-1".into(), 1);
//! let block = |name: &str, value: f64| SampleBlock {
//!     header: Header { source: name.into(), epoch: 1, sequence: 0, time_ns: 0 },
//!     sampling_rate_hz: 100.0,
//!     pace: Pace::Live,
//!     channels: 1,
//!     samples: vec![value],
//!     state: StreamState::Running,
//! };
//! let mut frames = Vec::new();
//! alignment.handle(Input::Samples { node: 1, block: block("roof", 0.2) }, &mut frames);
//! alignment.handle(Input::Samples { node: 0, block: block("base", 0.1) }, &mut frames);
//! assert_eq!(frames[0].values, [0.1, 0.2]);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! - [`Layout`]: nodes, channels and rate
//! - [`Alignment`]: samples to frames; no clock, no network
//! - [`Lateness`]: when a frame has waited long enough; its clock is an argument
//! - [`IngestService`]: joins both to the bus
//!
//! The wrong room for filtering or interpolating: a sample is in a frame as it was measured, or not at all.

mod counts;
mod layout;
mod node_queue;

mod align;
mod lateness;

mod disk;
mod error;
mod recorder;
mod shell;
mod waiting;

pub use align::{Alignment, Input, NodePlace};
pub use counts::Counts;
pub use error::IngestError;
pub use lateness::Lateness;
pub use layout::{Layout, LayoutError, NodeLayout};
pub use recorder::RecordingSettings;
pub use shell::{FRAMES_KEPT, IngestService, IngestSettings, Waiting};
