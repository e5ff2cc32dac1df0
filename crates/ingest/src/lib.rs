//! Builds frames from the samples of many nodes, and keeps recent frames for subscribers that
//! missed them.
//!
//! The input is blocks of samples per node, in any order of arrival. The output is frames in order,
//! without gaps. Each frame has a value or a missing sample for every channel.
//!
//! ```
//! use spandrel_bus::{Header, Pace, SampleBlock, StreamState};
//! use spandrel_ingest::{Alignment, AlignmentInput, Layout, NodeLayout};
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
//!     clock_quality: None,
//! };
//! let mut frames = Vec::new();
//! alignment.handle(AlignmentInput::Samples { node: 1, block: block("roof", 0.2) }, &mut frames);
//! alignment.handle(AlignmentInput::Samples { node: 0, block: block("base", 0.1) }, &mut frames);
//! assert_eq!(frames[0].values, [0.1, 0.2]);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! - [`Layout`]: nodes, channels and sampling rate
//! - [`Alignment`]: builds frames from samples, without a clock or network
//! - [`Lateness`]: decides when a frame has waited long enough; its clock is an argument
//! - [`ClockVote`]: decides by majority which clocks are wrong; its clock is an argument
//! - [`IngestService`]: connects them to the bus
//!
//! Beside the frames, ingest publishes the extremes and the spectra of the samples for display.
//!
//! Ingest does not filter. For each channel, a frame contains a sample or a missing value. The
//! sample is interpolated at the time of the frame if the node samples at another instant.

mod counts;
mod layout;
mod node_queue;
mod sampling_instants;

mod align;
mod block_watch;
mod clock_moves;
mod clock_vote;
mod clock_watch;
mod drop_watch;
mod lateness;
mod missing_share;
mod quality_watch;
mod timekeeping;

mod disk;
mod error;
mod recorder;
mod shell;
mod unrecorded;

pub use align::{Alignment, AlignmentInput, NodePlace};
pub use clock_vote::{ClockVerdict, ClockVote, Tally};
pub use counts::{Counts, NodeCounts};
pub use error::IngestError;
pub use lateness::Lateness;
pub use layout::{Layout, LayoutError, NodeLayout};
pub use recorder::RecordingSettings;
pub use shell::{FRAMES_KEPT, FrameWait, IngestPlan, IngestService, IngestSettings};
