//! What the identification service remembers over its own death.

use crate::error::IdentifyError;
use crate::identification::{Identification, IdentificationState};
use spandrel_bus::{Progress, ProgressWatch};
use spandrel_checkpoint::{Checkpoints, Failures, Identity, Keeper, Loaded, Place, Remembering};
use spandrel_structure::Structure;
use tokio::task::block_in_place;
use tracing::{info, warn};

/// What the state of the identification of a structure is of.
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
/// One checkpoint is kept at or before what the alert service would need again, so that whoever restarts, one or both, finds
/// every estimate that has not been decided on.
#[derive(Debug)]
pub(crate) struct Memory {
    keeper: Keeper,
    /// The terms in which this service has led, as epochs of files that hold nothing else.
    terms: Checkpoints,
    /// whether the structure has alert rules
    is_decided_on: bool,
    alert: ProgressWatch,
}

impl Memory {
    /// Opens the folder; `alert` tells what the alert service has done.
    pub(crate) fn open(
        structure: &Structure,
        remembering: &Remembering,
        alert: ProgressWatch,
    ) -> Result<Self, IdentifyError> {
        // a term outlives every change of the structure file
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
            .places()
            .ok()
            .and_then(|terms| terms.last().map(|term| term.epoch))
            .unwrap_or(0)
    }

    /// Keeps the term in which the service is about to lead: on return it is on the disk, or its failure has been told.
    pub(crate) fn keep_term(&self, term: u64) {
        let keep = || {
            self.terms.save(
                Place {
                    epoch: term,
                    sequence: 0,
                },
                &(),
            )?;
            self.terms.forget_before(None)
        };
        if let Err(error) = block_in_place(keep) {
            warn!(%error, term, "term not kept: if the clock is set back before the next start, readers will prefer this life to that one");
        }
    }

    /// Returns the identification as it was at the oldest checkpoint that may still be needed, or `new` where there is none.
    pub(crate) fn recall(
        &self,
        new: impl FnMut() -> Result<Identification, IdentifyError>,
    ) -> Result<Identification, IdentifyError> {
        self.restore(new, Checkpoints::load_oldest)
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
            let Some((place, state)) = loaded.found else {
                if refused > 0 {
                    warn!(
                        refused,
                        "no checkpoint fits: starts from the prior and identifies the recorded frames again"
                    );
                }
                return Ok(core);
            };
            match core.restore(state) {
                Ok(()) => {
                    info!(
                        epoch = place.epoch,
                        frame = place.sequence,
                        "goes on from its checkpoint"
                    );
                    return Ok(core);
                }
                Err(error) => {
                    self.keeper.checkpoints().refuse(place, error.to_string());
                    refused += 1;
                }
            }
        }
    }

    /// As [`Memory::recall`], within the life of the service: from the newest checkpoint.
    pub(crate) async fn recall_last(
        &mut self,
        new: impl FnMut() -> Result<Identification, IdentifyError>,
    ) -> Result<Identification, IdentifyError> {
        self.keeper.finish().await;
        self.restore(new, Checkpoints::load_latest)
    }

    /// What could not be kept so far.
    pub(crate) fn failures(&self) -> &Failures {
        self.keeper.failures()
    }

    /// Keeps the state when it is time to.
    pub(crate) async fn keep_if_due(&mut self, core: &Identification) {
        if self.keeper.is_due() {
            self.keep(core).await;
        }
    }

    /// Keeps the last state, and waits until it is on the disk.
    pub(crate) async fn close(mut self, core: &Identification) {
        self.keep(core).await;
        self.keeper.finish().await;
    }

    async fn keep(&mut self, core: &Identification) {
        let Some((epoch, sequence)) = core.position() else {
            return;
        };
        let heard = self
            .alert
            .latest()
            .map(|Progress { header, kept, .. }| Place {
                epoch: header.epoch,
                sequence: kept,
            });
        // An alert service that has not been heard of may need everything; without rules there is none.
        let needed = if self.is_decided_on {
            heard.or(Some(Place {
                epoch: 0,
                sequence: 0,
            }))
        } else {
            None
        };
        self.keeper
            .keep(Place { epoch, sequence }, core.state(), needed)
            .await;
    }
}
