//! What a frame is made of: nodes, channels, rate.

use spandrel_bus::{MAX_CHANNELS, Name, NameError, TimeGrid};
use spandrel_structure::Structure;

/// One sensor node.
#[derive(Clone, Debug, PartialEq)]
pub struct NodeLayout {
    /// Its name.
    pub name: Name,
    /// Per channel, the absolute value beyond which a sample is absurd, unit of the channel.
    pub ranges: Vec<f64>,
}

/// The nodes of a structure in the order of its frames, and when the frames are.
#[derive(Clone, Debug, PartialEq)]
pub struct Layout {
    nodes: Vec<NodeLayout>,
    sampling_rate_hz: f64,
    tolerance_ns: i64,
}

/// A layout that no frame can have.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum LayoutError {
    /// A node's name is no chunk of a key expression.
    #[error("node name is no key")]
    Name(#[from] NameError),
    /// The rate cannot number frames.
    #[error("sampling rate is {found} Hz, must lie between 0.001 and 1000000")]
    Rate {
        /// The rate found, Hz.
        found: f64,
    },
    /// A frame is empty or does not fit a message.
    #[error("frame has {found} channels, must have 1 to {MAX_CHANNELS}")]
    Channels {
        /// The channels found.
        found: usize,
    },
}

impl Layout {
    /// A layout; a sample may be `tolerance_s` (s) from its frame, at most half a step.
    ///
    /// # Errors
    /// A rate or a number of channels that no message carries.
    pub fn new(
        nodes: Vec<NodeLayout>,
        sampling_rate_hz: f64,
        tolerance_s: f64,
    ) -> Result<Self, LayoutError> {
        if TimeGrid::new(0, sampling_rate_hz).is_none() {
            return Err(LayoutError::Rate {
                found: sampling_rate_hz,
            });
        }
        let found = nodes.iter().map(|node| node.ranges.len()).sum();
        if !(1..=MAX_CHANNELS).contains(&found) {
            return Err(LayoutError::Channels { found });
        }
        // Half a step is what `TimeGrid::nearest` gives; its rounding must not make an edge sample homeless.
        const ROUNDING_NS: i64 = 4;
        let tolerance_ns = (tolerance_s * 1e9) as i64 + ROUNDING_NS;
        Ok(Self {
            nodes,
            sampling_rate_hz,
            tolerance_ns,
        })
    }

    /// The layout of a structure.
    ///
    /// # Errors
    /// As [`Layout::new`].
    pub fn of(structure: &Structure) -> Result<Self, LayoutError> {
        let mut nodes = Vec::new();
        for node in structure.nodes() {
            let ranges = node
                .channels()
                .iter()
                .map(|channel| channel.range())
                .collect();
            nodes.push(NodeLayout {
                name: Name::new(node.name())?,
                ranges,
            });
        }
        Self::new(
            nodes,
            structure.sampling_rate_hz(),
            structure.ingest().tolerance_s,
        )
    }

    /// The nodes in frame order.
    #[must_use]
    pub fn nodes(&self) -> &[NodeLayout] {
        &self.nodes
    }

    /// Rate of the frames, Hz.
    #[must_use]
    pub fn sampling_rate_hz(&self) -> f64 {
        self.sampling_rate_hz
    }

    /// How far a sample may be from its frame, ns.
    #[must_use]
    pub fn tolerance_ns(&self) -> i64 {
        self.tolerance_ns
    }

    /// Channels of a frame.
    #[must_use]
    pub fn channel_count(&self) -> usize {
        self.nodes.iter().map(|node| node.ranges.len()).sum()
    }
}
