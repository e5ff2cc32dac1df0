//! The station's assessment of a sensor node.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::{
    Format, Malformed, Message, bounded, check_count, check_finite, check_label, check_range,
};
use crate::name::Name;

/// Maximum number of reasons in one message. The reasons come from a closed set.
const MAX_REASONS: usize = 64;

/// The station's assessment of a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum NodeHealth {
    /// The fusion includes the node.
    Used,
    /// The node has sent nothing that the station can fuse, or only predictions without samples.
    Silent,
    /// The node disagrees with the others and is excluded.
    Excluded,
    /// The samples of the node have ended, or the node is offline.
    Ended,
}

/// State of one node, published after each fusion and once more when the node goes offline.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NodeDisplay {
    /// Name of the structure.
    pub structure: Name,
    /// Name of the node.
    pub node: Name,
    /// Time of the fusion, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// The station's assessment.
    pub state: NodeHealth,
    /// Mahalanobis distance from the other nodes. `None` if the station did not assess the node.
    pub distance: Option<f64>,
    /// Distance above which a node is suspicious.
    pub distance_limit: Option<f64>,
    /// Weight of the node's information in the fusion. It is 1 for a regular node, less for a
    /// discounted node, and 0 for an excluded node. `None` if the station did not assess the node.
    pub weight: Option<f64>,
    /// Time since which the node has been excluded without interruption, ns since the Unix epoch,
    /// UTC.
    pub excluded_since_ns: Option<i64>,
    /// Time of the first of the uninterrupted fusions without a usable message of the node, ns
    /// since the Unix epoch, UTC.
    pub silent_since_ns: Option<i64>,
    /// Time of the last message, ns since the Unix epoch, UTC. For live samples, this is the
    /// arrival time by the station's clock. For replayed samples, it is the time of the last sample
    /// in the message.
    pub heard_ns: Option<i64>,
    /// Share of the fusions that excluded the node.
    pub excluded_share: f64,
    /// Number of accepted messages.
    pub messages: u64,
    /// Bytes of payload received from the node.
    pub bytes_received: u64,
    /// Bytes of payload sent to the node.
    pub bytes_sent: u64,
    /// Number of rejected messages, by reason.
    #[serde(deserialize_with = "bounded::counts::<_, MAX_REASONS>")]
    pub refused: BTreeMap<String, u64>,
    /// Number of restarts of the node's filter.
    pub restarts: u64,
}

impl Message for NodeDisplay {
    const TYPE: &'static str = "node";
    const VERSION: u16 = 2;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        for (what, value) in [
            ("distance", self.distance),
            ("distance limit", self.distance_limit),
        ] {
            if let Some(value) = value {
                check_finite(what, value)?;
            }
        }
        if let Some(weight) = self.weight {
            check_range("weight", weight, 0.0, 1.0)?;
        }
        check_finite("excluded share", self.excluded_share)?;
        check_count("reasons", self.refused.len(), 0, MAX_REASONS)?;
        self.refused
            .keys()
            .try_for_each(|reason| check_label("reason", reason))
    }
}
