//! Inputs and outputs of the core.

use spandrel_bus::{InstrumentState, SampleBlock, TimeGrid};

use crate::gap::GapReport;
use crate::packet::Packet;

/// A reading of two clocks. The core has none.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Moment {
    /// Wall-clock time, ns since the Unix epoch, UTC. It dates the samples of sources without
    /// times.
    pub wall_ns: i64,
    /// Reading of a monotonic clock, ns. It measures waiting times.
    pub elapsed_ns: i64,
}

/// State of the connection of a source.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Link {
    /// The connection is being established.
    Connecting,
    /// The connection exists.
    Open,
    /// The connection is lost or was rejected.
    Failed {
        /// The reason.
        why: String,
    },
    /// The source has ended.
    Ended,
}

/// The frames that ingest has recorded before the feed started.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Recorded {
    /// Times of the frames.
    pub frames: TimeGrid,
    /// Number of the first frame that does not exist yet.
    pub next: u64,
}

/// An input of the core. `source` and `structure` are indices into the configuration.
#[derive(Clone, Debug)]
pub enum FeedInput {
    /// Samples of a source.
    Packets {
        /// The source.
        source: usize,
        /// The samples, in the order of arrival.
        packets: Vec<Packet>,
    },
    /// Data of a source that cannot be read.
    Malformed {
        /// The source.
        source: usize,
        /// The fault.
        fault: String,
    },
    /// Messages that were dropped before the core could read them.
    Dropped {
        /// The source.
        source: usize,
        /// Number of messages.
        messages: u64,
    },
    /// A change of the connection of a source.
    Link {
        /// The source.
        source: usize,
        /// The new state.
        link: Link,
    },
    /// The frames of a structure that exist already.
    Recorded {
        /// The structure.
        structure: usize,
        /// Its frames.
        recorded: Recorded,
    },
    /// The history has the values of a condition of a source up to a time.
    Stored {
        /// The source.
        source: usize,
        /// Index of the condition in the plan of the source.
        condition: usize,
        /// Time of its newest value, ns since the Unix epoch.
        newest_ns: i64,
    },
    /// Time has passed.
    Tick,
    /// The feed stops. All waiting samples are returned.
    Stop,
}

/// An output of the core.
#[derive(Clone, Debug, PartialEq)]
pub enum Output {
    /// The next block of a node.
    Block {
        /// Index of the node in the configuration.
        node: usize,
        /// The block.
        block: SampleBlock,
    },
    /// A value of a condition.
    Condition {
        /// Index of the source in the configuration.
        source: usize,
        /// Index of the condition in the plan of the source.
        condition: usize,
        /// Time of the measurement, ns since the Unix epoch.
        time_ns: i64,
        /// Value, in the unit of the condition.
        value: f64,
    },
    /// Samples are permanently lost.
    Lost(GapReport),
    /// The clock of a node went back. Its blocks have a new epoch.
    SetBack {
        /// Index of the node in the configuration.
        node: usize,
        /// Time of the last sample before the step, ns since the Unix epoch.
        from_ns: i64,
        /// Time of the first sample after the step, ns since the Unix epoch.
        to_ns: i64,
    },
    /// The state of a source has changed.
    State {
        /// Index of the source in the configuration.
        source: usize,
        /// The new state.
        state: InstrumentState,
        /// The last error, if the source has failed.
        why: Option<String>,
    },
    /// An error of a source. Its count has doubled since the last such output.
    Error {
        /// Index of the source in the configuration.
        source: usize,
        /// The error.
        why: String,
        /// Number of errors so far.
        count: u64,
    },
}
