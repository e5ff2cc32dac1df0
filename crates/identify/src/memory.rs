//! Checkpoints of the identification service.

use crate::error::IdentifyError;
use crate::identification::{Identification, IdentificationState};
use spandrel_bus::{Progress, ProgressWatch};
use spandrel_checkpoint::{Checkpoints, Failures, Identity, Keeper, Loaded, Position, Remembering};
use spandrel_structure::Structure;
use tokio::task::block_in_place;
use tracing::{info, warn};

/// Position of the state before the first frame, ahead of all others.
const FIRST: Position = Position {
    epoch: 0,
    sequence: 0,
};

/// Returns the checkpoint identity of a structure's identification.
pub(crate) fn identity(structure: &Structure) -> Identity {
    Identity {
        kind: "identify",
        version: IdentificationState::VERSION,
        of: structure.name().to_owned(),
        basis: structure.identification_basis(),
    }
}

/// The checkpoints of one identification.
///
/// One of them is at or before the position from which the alert service would restart. After a
/// restart of either service or both, every undecided estimate is therefore available.
#[derive(Debug)]
pub(crate) struct Memory {
    keeper: Keeper,
    /// The terms in which this service has led, as epochs of otherwise empty files.
    terms: Checkpoints,
    /// Whether the structure has alert rules.
    is_decided_on: bool,
    alert: ProgressWatch,
}

impl Memory {
    /// Opens the folder. `alert` reports the progress of the alert service.
    pub(crate) fn open(
        structure: &Structure,
        remembering: &Remembering,
        alert: ProgressWatch,
    ) -> Result<Self, IdentifyError> {
        // A term must survive every change of the structure file.
        let of_term = Identity {
            kind: "term",
            version: 1,
            of: structure.name().to_owned(),
            basis: String::new(),
        };
        let checkpoints = Checkpoints::open(&remembering.folder, identity(structure))?;
        Ok(Self {
            keeper: Keeper::new(checkpoints, remembering.every),
            terms: Checkpoints::open(&remembering.folder, of_term)?,
            is_decided_on: !structure.alert_rules().is_empty(),
            alert,
        })
    }

    /// Returns the highest term in which this service has led, 0 before the first.
    pub(crate) fn last_term(&self) -> u64 {
        self.terms
            .positions()
            .ok()
            .and_then(|terms| terms.last().map(|term| term.epoch))
            .unwrap_or(0)
    }

    /// Saves the term in which the service will lead. On return it is on disk, or the failure is
    /// logged.
    pub(crate) fn keep_term(&self, term: u64) {
        let keep = || {
            self.terms.save(
                Position {
                    epoch: term,
                    sequence: 0,
                },
                &(),
            )?;
            self.terms.forget_before(None)
        };
        if let Err(error) = block_in_place(keep) {
            warn!(%error, term, "term not saved; if the clock is set back before the next start, \
                subscribers will prefer this run to the next one");
        }
    }

    /// Restores the oldest checkpoint that may still be needed. Returns `new` if there is none.
    ///
    /// The new state then becomes the first checkpoint. It is needed until alert has saved a
    /// decision, because a later checkpoint would skip the estimates before it.
    pub(crate) fn recall(
        &self,
        new: impl FnMut() -> Result<Identification, IdentifyError>,
    ) -> Result<Identification, IdentifyError> {
        let core = self.restore(new, Checkpoints::load_oldest)?;
        if self.is_decided_on && core.position().is_none() {
            self.keep_first(&core);
        }
        Ok(core)
    }

    fn keep_first(&self, core: &Identification) {
        let checkpoints = self.keeper.checkpoints();
        if let Err(error) = block_in_place(|| checkpoints.save(FIRST, &core.state())) {
            warn!(%error, "first state not saved; after a crash, alert may miss the first \
                estimates");
        }
    }

    fn restore(
        &self,
        mut new: impl FnMut() -> Result<Identification, IdentifyError>,
        load: impl Fn(&Checkpoints) -> Loaded<IdentificationState>,
    ) -> Result<Identification, IdentifyError> {
        let mut refused = 0;
        loop {
            let mut core = new()?;
            let loaded = load(self.keeper.checkpoints());
            refused += loaded.refused.len();
            let Some((position, state)) = loaded.found else {
                if refused > 0 {
                    warn!(
                        refused,
                        "no usable checkpoint; starting from the prior and identifying the \
                         recorded frames again"
                    );
                }
                return Ok(core);
            };
            match core.restore(state) {
                Ok(()) => {
                    info!(
                        epoch = position.epoch,
                        frame = position.sequence,
                        "resumed from its checkpoint"
                    );
                    return Ok(core);
                }
                Err(error) => {
                    self.keeper
                        .checkpoints()
                        .refuse(position, error.to_string());
                    refused += 1;
                }
            }
        }
    }

    /// Restores the newest checkpoint, within a run of the service.
    pub(crate) async fn recall_last(
        &mut self,
        new: impl FnMut() -> Result<Identification, IdentifyError>,
    ) -> Result<Identification, IdentifyError> {
        self.keeper.finish().await;
        self.restore(new, Checkpoints::load_latest)
    }

    /// Returns the count of failed writes.
    pub(crate) fn failures(&self) -> &Failures {
        self.keeper.failures()
    }

    /// Saves a checkpoint if one is due.
    pub(crate) async fn keep_if_due(&mut self, core: &Identification) {
        if self.keeper.is_due() {
            self.keep(core).await;
        }
    }

    /// Reports a folder that is gone.
    pub(crate) async fn look(&mut self) {
        self.keeper.look().await;
    }

    /// Saves the last state and waits until it is on disk.
    pub(crate) async fn close(mut self, core: &Identification) {
        self.keep(core).await;
        self.keeper.finish().await;
    }

    async fn keep(&mut self, core: &Identification) {
        let Some(position) = core.position() else {
            return;
        };
        let heard = self
            .alert
            .latest()
            .map(|Progress { header, kept, .. }| Position {
                epoch: header.epoch,
                sequence: kept,
            });
        // An alert service without known progress may need every estimate. Without rules there is
        // none.
        let needed = if self.is_decided_on {
            heard.or(Some(FIRST))
        } else {
            None
        };
        self.keeper.keep(position, core.state(), needed).await;
    }
}
