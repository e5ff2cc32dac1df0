//! The checkpoint state of a node's worker.

use super::{NodeIdentification, Stream};
use crate::node_screening::NodeScreening;
use serde::{Deserialize, Serialize};
use spandrel_filter::fusion::LocalState;
use spandrel_filter::{BandLimit, FilterError};

/// The state of a node's worker between two inputs, as stored in a checkpoint. It excludes samples
/// that wait for feedback.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NodeIdentificationState {
    epoch: u64,
    filter: LocalState,
    band_limit: Option<BandLimit>,
    stream: Option<Stream>,
    screening: Vec<NodeScreening>,
    sampled: u64,
    sent: u64,
}

impl NodeIdentificationState {
    /// Version of the layout. Every change of a field here or in the nested states must increase
    /// it.
    pub const VERSION: u16 = 3;
}

impl NodeIdentification {
    /// Returns the state for a checkpoint.
    #[must_use]
    pub fn state(&self) -> NodeIdentificationState {
        NodeIdentificationState {
            epoch: self.epoch,
            filter: self.filter.state(),
            band_limit: self.band_limit.clone(),
            stream: self.stream,
            screening: self.screening.clone(),
            sampled: self.sampled,
            sent: self.sent,
        }
    }

    /// Restores a checkpoint of an earlier run. This must precede the first input.
    ///
    /// # Errors
    /// Returns an error if the state does not match the node. The worker is then unchanged.
    pub fn restore(&mut self, state: NodeIdentificationState) -> Result<(), FilterError> {
        let sizes = [
            (
                "band limit of a checkpoint",
                usize::from(state.band_limit.is_some()),
                usize::from(self.band_limit.is_some()),
            ),
            (
                "screened channels of a checkpoint",
                state.screening.len(),
                self.screening.len(),
            ),
        ];
        FilterError::check_sizes(sizes)?;
        self.filter.restore(state.filter)?;
        self.epoch = self.epoch.max(state.epoch.saturating_add(1));
        self.band_limit = state.band_limit;
        self.stream = state.stream;
        self.screening = state.screening;
        (self.sampled, self.sent) = (state.sampled, state.sent);
        self.restarts = self.filter.restarts();
        Ok(())
    }
}
