//! Checkpoints of the service.

use crate::cutting::{Cutting, CuttingState};
use crate::error::ReportsError;
use spandrel_bus::Keys;
use spandrel_checkpoint::{Checkpoints, Identity, Keeper, Remembering};
use spandrel_structure::EarthquakePlan;
use std::collections::BTreeMap;
use tracing::info;

/// The checkpoints of one structure.
#[derive(Debug)]
pub(crate) struct Memory {
    keeper: Keeper,
}

impl Memory {
    /// Opens the folder. Checkpoints of other channels or another trigger do not count.
    pub(crate) fn open(
        keys: &Keys,
        plan: &EarthquakePlan,
        remembering: &Remembering,
    ) -> Result<Self, ReportsError> {
        let identity = Identity {
            kind: "reports",
            version: CuttingState::VERSION,
            of: keys.structure().to_string(),
            basis: format!("{:?} {}", plan.channels, plan.trigger_m_per_s2),
        };
        let checkpoints = Checkpoints::open(&remembering.folder, identity)?;
        Ok(Self {
            keeper: Keeper::new(checkpoints, remembering.every),
        })
    }

    /// Restores the newest checkpoint, if there is one.
    pub(crate) fn recall(&self, cutting: &mut Cutting) {
        let restored = self
            .keeper
            .checkpoints()
            .recall(|state: CuttingState| cutting.restore(state));
        if let Some((position, ())) = restored {
            let (epoch, frame) = (position.epoch, position.sequence);
            info!(epoch, frame, "resumed from its checkpoint");
        }
    }

    /// Saves the state if that is due, or at once. While something is recorded, the last state
    /// remains: after a crash, its frames are read again.
    pub(crate) async fn keep(&mut self, cutting: &Cutting, is_due_now: bool) {
        let is_due = is_due_now || self.keeper.is_due();
        if !cutting.detection().is_watching() || !is_due {
            return;
        }
        if let Some(position) = cutting.needed_from() {
            self.keeper.keep(position, cutting.state(), None).await;
        }
    }

    /// Reports a folder that is gone.
    pub(crate) async fn look(&mut self) {
        self.keeper.look().await;
    }

    /// Returns the number of states that could not be saved.
    pub(crate) fn drops(&self) -> BTreeMap<String, u64> {
        self.keeper.failures().drops().into_iter().collect()
    }

    /// Waits until the last state is on disk.
    pub(crate) async fn close(mut self) {
        self.keeper.finish().await;
    }
}
