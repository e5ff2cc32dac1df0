//! Checkpoints of the service.

use crate::error::ModesError;
use crate::following::{Following, FollowingState};
use spandrel_bus::Keys;
use spandrel_checkpoint::{Checkpoints, Identity, Keeper, Remembering};
use std::collections::BTreeMap;
use tracing::info;

/// The checkpoints of one structure.
#[derive(Debug)]
pub(crate) struct Memory {
    keeper: Keeper,
}

impl Memory {
    /// Opens the folder. Checkpoints of another `basis` do not count.
    pub(crate) fn open(
        keys: &Keys,
        basis: String,
        remembering: &Remembering,
    ) -> Result<Self, ModesError> {
        let identity = Identity {
            kind: "modes",
            version: FollowingState::VERSION,
            of: keys.structure().to_string(),
            basis,
        };
        let checkpoints = Checkpoints::open(&remembering.folder, identity)?;
        Ok(Self {
            keeper: Keeper::new(checkpoints, remembering.every),
        })
    }

    /// Restores the newest checkpoint, if there is one.
    pub(crate) fn recall(&self, core: &mut Following) {
        let restored = self
            .keeper
            .checkpoints()
            .recall(|state: FollowingState| core.restore(state));
        if let Some((position, ())) = restored {
            let (epoch, frame) = (position.epoch, position.sequence);
            info!(epoch, frame, "resumed from its checkpoint");
        }
    }

    /// Saves the state if that is due, or at once after an epoch.
    pub(crate) async fn keep(&mut self, core: &Following, is_epoch_over: bool) {
        if !is_epoch_over && !self.keeper.is_due() {
            return;
        }
        if let Some(position) = core.position() {
            self.keeper.keep(position, core.state(), None).await;
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

    /// Saves the last state and waits until it is on disk.
    pub(crate) async fn close(mut self, core: &Following) {
        self.keep(core, true).await;
        self.keeper.finish().await;
    }
}
