//! What the worker of a node takes over its own death.

use super::{NodeIdentification, Stream};
use crate::node_screening::NodeScreening;
use serde::{Deserialize, Serialize};
use spandrel_filter::fusion::LocalState;
use spandrel_filter::{BandLimit, FilterError};

/// What the worker of a node knows between two inputs: what a checkpoint holds. Samples that wait for an answer are not in it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NodeState {
    epoch: u64,
    filter: LocalState,
    band_limit: Option<BandLimit>,
    stream: Option<Stream>,
    screening: Vec<NodeScreening>,
    sampled: u64,
    sent: u64,
}

impl NodeState {
    /// Version of the layout: raised with every change of a field here or in the states below.
    pub const VERSION: u16 = 2;
}

impl NodeIdentification {
    /// Returns the state for a checkpoint.
    #[must_use]
    pub fn state(&self) -> NodeState {
        NodeState {
            epoch: self.epoch,
            filter: self.filter.state(),
            band_limit: self.band_limit.clone(),
            stream: self.stream,
            screening: self.screening.clone(),
            sampled: self.sampled,
            sent: self.sent,
        }
    }

    /// Goes on from a checkpoint of another life, before the first input.
    ///
    /// # Errors
    /// The state does not fit the node; the worker is then as it was.
    pub fn restore(&mut self, state: NodeState) -> Result<(), FilterError> {
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
        for (what, found, expected) in sizes {
            if found != expected {
                return Err(FilterError::Dimension {
                    what,
                    found,
                    expected,
                });
            }
        }
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
