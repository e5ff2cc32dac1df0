//! What the identification service remembers over its own death.

use crate::error::IdentifyError;
use crate::identification::{Identification, IdentificationState};
use spandrel_bus::{Progress, ProgressWatch};
use spandrel_checkpoint::{CheckpointError, Checkpoints, Identity, Loaded, Place, Remembering};
use spandrel_structure::Structure;
use std::time::Duration;
use tokio::task::{JoinHandle, block_in_place};
use tokio::time::Instant;
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
    checkpoints: Checkpoints,
    /// The terms in which this service has led, as epochs of files that hold nothing else.
    terms: Checkpoints,
    every: Duration,
    last: Instant,
    /// one at a time, on a thread that may wait for the disk
    saving: Option<JoinHandle<Result<(), CheckpointError>>>,
    /// whether the structure has alert rules
    is_decided_on: bool,
    alert: ProgressWatch,
    failures: u64,
}

impl Memory {
    /// Opens the folder; `alert` tells what the alert service has done.
    pub(crate) fn open(
        structure: &Structure,
        remembering: &Remembering,
        alert: ProgressWatch,
    ) -> Result<Self, IdentifyError> {
        // a term outlives every change of the structure file
        let of_term = Identity { kind: "term", version: 1, of: structure.name().to_owned(), basis: String::new() };
        Ok(Self {
            checkpoints: Checkpoints::open(&remembering.folder, identity(structure))?,
            terms: Checkpoints::open(&remembering.folder, of_term)?,
            every: remembering.every,
            last: Instant::now(),
            saving: None,
            is_decided_on: !structure.alert_rules().is_empty(),
            alert,
            failures: 0,
        })
    }

    /// Returns the highest term in which this service has led, 0 before the first.
    pub(crate) fn last_term(&self) -> u64 {
        self.terms.places().ok().and_then(|terms| terms.last().map(|term| term.epoch)).unwrap_or(0)
    }

    /// Keeps the term in which the service is about to lead: on return it is on the disk, or its failure has been told.
    pub(crate) fn keep_term(&self, term: u64) {
        let keep = || {
            self.terms.save(Place { epoch: term, sequence: 0 }, &())?;
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
        loop {
            let mut core = new()?;
            let Some((place, state)) = load(&self.checkpoints).found else {
                return Ok(core);
            };
            match core.restore(state) {
                Ok(()) => {
                    info!(epoch = place.epoch, frame = place.sequence, "goes on from its checkpoint");
                    return Ok(core);
                }
                Err(error) => drop(self.checkpoints.refuse(place, error.to_string())),
            }
        }
    }

    /// As [`Memory::recall`], within the life of the service: from the newest checkpoint.
    pub(crate) async fn recall_last(
        &mut self,
        new: impl FnMut() -> Result<Identification, IdentifyError>,
    ) -> Result<Identification, IdentifyError> {
        self.saved().await;
        self.restore(new, Checkpoints::load_latest)
    }

    /// Keeps the state when it is time to.
    pub(crate) async fn keep_if_due(&mut self, core: &Identification) {
        if self.last.elapsed() >= self.every && self.saving.as_ref().is_none_or(JoinHandle::is_finished) {
            self.keep(core).await;
        }
    }

    /// Keeps the last state, and waits until it is on the disk.
    pub(crate) async fn close(mut self, core: &Identification) {
        self.keep(core).await;
        self.saved().await;
    }

    async fn keep(&mut self, core: &Identification) {
        self.saved().await;
        let Some((epoch, sequence)) = core.position() else {
            return;
        };
        self.last = Instant::now();
        let (checkpoints, state) = (self.checkpoints.clone(), core.state());
        let heard =
            self.alert.latest().map(|Progress { header, kept, .. }| Place { epoch: header.epoch, sequence: kept });
        // An alert service that has not been heard of may need everything; without rules there is none.
        let needed = if self.is_decided_on { heard.or(Some(Place { epoch: 0, sequence: 0 })) } else { None };
        self.saving = Some(tokio::task::spawn_blocking(move || {
            checkpoints.save(Place { epoch, sequence }, &state)?;
            checkpoints.forget_before(needed)
        }));
    }

    /// Waits for what is being saved; a failure is told each time their count has doubled, and tried again when it is time to.
    async fn saved(&mut self) {
        let Some(saving) = self.saving.take() else {
            return;
        };
        if let Ok(Err(error)) = saving.await {
            self.failures += 1;
            if self.failures.is_power_of_two() {
                warn!(%error, failures = self.failures, "checkpoint not kept: a crash now would cost more frames");
            }
        }
    }
}
