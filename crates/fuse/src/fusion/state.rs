//! What a station takes over its own death.

use super::Fusion;
use crate::node::Node;
use serde::{Deserialize, Serialize};
use spandrel_filter::FilterError;
use spandrel_filter::fusion::StationState;

/// What a station knows after a fusion: what a checkpoint holds.
///
/// Clock and numbers are not in it. They begin anew in each life, as do the estimates, under a higher epoch: how long nobody fused cannot
/// be told from a clock that was set, and counts as the half period up to the first fusion.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FusionState {
    epoch: u64,
    station: StationState,
    nodes: Vec<Node>,
}

impl FusionState {
    /// Version of the layout: raised with every change of a field here or in the states below.
    pub const VERSION: u16 = 1;
}

impl Fusion {
    /// Returns the state for a checkpoint, best after a fusion.
    #[must_use]
    pub fn state(&self) -> FusionState {
        FusionState {
            epoch: self.epoch,
            station: self.station.state(),
            nodes: self.nodes.clone(),
        }
    }

    /// Goes on from a checkpoint of another life, before the first input.
    ///
    /// # Errors
    /// The state does not fit the structure; the station is then as it was.
    pub fn restore(&mut self, state: FusionState) -> Result<(), FilterError> {
        let FusionState {
            epoch,
            station,
            nodes,
        } = state;
        let known = self
            .nodes
            .iter()
            .zip(&nodes)
            .filter(|(own, kept)| own.is_as(kept))
            .count();
        if (known, nodes.len()) != (self.nodes.len(), self.nodes.len()) {
            return Err(FilterError::Dimension {
                what: "nodes of a checkpoint",
                found: known,
                expected: self.nodes.len(),
            });
        }
        self.station.restore(station)?;
        self.epoch = self.epoch.max(epoch.saturating_add(1));
        self.nodes = nodes;
        Ok(())
    }
}
