//! How a sensor node does in the eyes of the station.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::{
    Format, Malformed, Message, bounded, check_count, check_finite, check_label, check_range,
};
use crate::name::Name;

/// Most reasons in one message: they come from a closed set.
const MAX_REASONS: usize = 64;

/// What the station makes of a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum NodeHealth {
    /// It is part of the fusion.
    Used,
    /// It has sent nothing that could be fused, or only what it predicts without samples.
    Silent,
    /// It disagrees with the others and is left out.
    Excluded,
    /// Its samples have ended, or no node is there any more.
    Ended,
}

/// Put after each fusion, for each node, and once more when no node is there any more.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NodeDisplay {
    /// The structure.
    pub structure: Name,
    /// The node.
    pub node: Name,
    /// Time of the fusion, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// What the station makes of it.
    pub state: NodeHealth,
    /// Mahalanobis distance from the others; none where it was not judged.
    pub distance: Option<f64>,
    /// Distance from which on a node is suspicious.
    pub distance_limit: Option<f64>,
    /// How far what it has learnt was counted: 1 of a regular node, less of one that was discounted, 0 of one that was left out; none
    /// where it was not judged.
    pub weight: Option<f64>,
    /// Time since which it has been left out without a break, ns.
    pub excluded_since_ns: Option<i64>,
    /// Time of the first fusion of those without a break for which it had sent nothing that could be fused, ns.
    pub silent_since_ns: Option<i64>,
    /// Time of its last message, ns: when it came, by the station's clock, or of its last sample where samples are replayed.
    pub heard_ns: Option<i64>,
    /// Share of the fusions in which it was left out.
    pub excluded_share: f64,
    /// Messages taken.
    pub messages: u64,
    /// Bytes of payload received from it.
    pub bytes_received: u64,
    /// Bytes of payload sent to it.
    pub bytes_sent: u64,
    /// Messages refused, by reason.
    #[serde(deserialize_with = "bounded::counts::<_, MAX_REASONS>")]
    pub refused: BTreeMap<String, u64>,
    /// Times its filter has started anew.
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
