//! The layout of a frame: nodes, channels and sampling rate.

use spandrel_bus::{MAX_CHANNELS, Name, NameError, TimeGrid};
use spandrel_structure::Structure;
use spandrel_waveforms::NodeChannels;

/// A sensor node in a frame.
#[derive(Clone, Debug, PartialEq)]
pub struct NodeLayout {
    /// Name of the node.
    pub name: Name,
    /// Maximum plausible absolute value of each channel, unit of the channel. Values beyond it
    /// count as missing.
    pub ranges: Vec<f64>,
}

/// The nodes of a structure in frame order, the frame rate and the time tolerance.
#[derive(Clone, Debug, PartialEq)]
pub struct Layout {
    nodes: Vec<NodeLayout>,
    sampling_rate_hz: f64,
    tolerance_ns: i64,
}

/// An error in a frame layout.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum LayoutError {
    /// The name of a node is not a valid chunk of a key expression.
    #[error("node name is not a valid key")]
    Name(#[from] NameError),
    /// The sampling rate is outside the range for frames.
    #[error("sampling rate is {found} Hz, must lie between 0.001 and 1000000")]
    Rate {
        /// The rate found, Hz.
        found: f64,
    },
    /// A frame is empty or does not fit into a message.
    #[error("frame has {found} channels, must have 1 to {MAX_CHANNELS}")]
    Channels {
        /// The number of channels found.
        found: usize,
    },
}

impl Layout {
    /// Creates a layout.
    ///
    /// A sample may deviate by `tolerance_s` (s) from the time of its frame. Half a time step is
    /// the effective maximum.
    ///
    /// # Errors
    /// Returns an error if the sampling rate or the number of channels does not fit into a message.
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
        // `TimeGrid::nearest` allows half a step. Its rounding must not exclude a sample at the
        // edge.
        const ROUNDING_NS: i64 = 4;
        let tolerance_ns = (tolerance_s * 1e9) as i64 + ROUNDING_NS;
        Ok(Self {
            nodes,
            sampling_rate_hz,
            tolerance_ns,
        })
    }

    /// Returns the layout of a structure.
    ///
    /// # Errors
    /// Returns the same errors as [`Layout::new`], and an error if the name of a node is not a
    /// valid chunk of a key expression.
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

    /// Returns the channels of each node. `channels` contains their names in frame order.
    ///
    /// # Errors
    /// Returns an error if the name of a channel is not a valid chunk of a key expression.
    pub(crate) fn node_channels(
        &self,
        channels: &[String],
    ) -> Result<Vec<NodeChannels>, NameError> {
        let mut channels = channels.iter();
        let of_node = |node: &NodeLayout| {
            let names = channels.by_ref().take(node.ranges.len());
            Ok(NodeChannels {
                node: node.name.clone(),
                channels: names.map(Name::new).collect::<Result<_, _>>()?,
            })
        };
        self.nodes.iter().map(of_node).collect()
    }

    /// Returns the nodes in frame order.
    #[must_use]
    pub fn nodes(&self) -> &[NodeLayout] {
        &self.nodes
    }

    /// Returns the sampling rate of the frames, Hz.
    #[must_use]
    pub fn sampling_rate_hz(&self) -> f64 {
        self.sampling_rate_hz
    }

    /// Returns the maximum distance of a sample from its frame, ns.
    #[must_use]
    pub fn tolerance_ns(&self) -> i64 {
        self.tolerance_ns
    }

    /// Returns the number of channels of a frame.
    #[must_use]
    pub fn channel_count(&self) -> usize {
        self.nodes.iter().map(|node| node.ranges.len()).sum()
    }
}
