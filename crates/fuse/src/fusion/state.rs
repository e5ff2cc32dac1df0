//! The checkpoint state of a station.

use super::Fusion;
use crate::node::Node;
use serde::{Deserialize, Serialize};
use spandrel_filter::FilterError;
use spandrel_filter::fusion::StationState;

/// The state of a station after a fusion, as stored in a checkpoint.
///
/// It excludes the clock and the sequence numbers of the estimates. Both restart in each run, under
/// a higher epoch.
///
/// The wall clock does not show how long fusion was interrupted, because it may have been adjusted.
/// The interruption therefore counts as half a fusion period, the time from the first message to
/// the first fusion.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FusionState {
    epoch: u64,
    station: StationState,
    nodes: Vec<Node>,
}

impl FusionState {
    /// Version of the layout. Every change of a field here or in the nested states must increase
    /// it.
    pub const VERSION: u16 = 1;
}

impl Fusion {
    /// Returns the state for a checkpoint, preferably after a fusion.
    #[must_use]
    pub fn state(&self) -> FusionState {
        FusionState {
            epoch: self.epoch,
            station: self.station.state(),
            nodes: self.nodes.clone(),
        }
    }

    /// Restores a checkpoint of an earlier run. This must precede the first input.
    ///
    /// # Errors
    /// Returns an error if the state does not match the structure. The station is then unchanged.
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
