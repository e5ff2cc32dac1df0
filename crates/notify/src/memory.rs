//! What the notices remember over the death of their process, for each structure.

use crate::error::NotifyError;
use crate::outbox::Remembered;
use serde::{Deserialize, Serialize};
use spandrel_bus::Name;
use spandrel_checkpoint::{CheckpointError, Checkpoints, Failures, Identity, Place};
use std::path::Path;
use std::time::{Duration, SystemTime, UNIX_EPOCH};
use tracing::{info, warn};

/// Version of the layout of [`State`]: raised with every change of a field in it or below.
const VERSION: u16 = 2;

#[derive(Debug, Serialize, Deserialize)]
struct State {
    /// When it was written, s since the Unix epoch.
    written_s: u64,
    notices: Remembered,
}

/// The checkpoints of the notices of one structure.
#[derive(Debug)]
pub(crate) struct Memory {
    checkpoints: Checkpoints,
    next: Place,
    failures: Failures,
}

impl Memory {
    /// Opens the folder of the checkpoints of a structure, and reads what an earlier life has left there, and for how long it was away.
    pub(crate) fn open(folder: &Path, structure: &Name) -> Result<(Self, Option<(Remembered, Duration)>), NotifyError> {
        let identity = Identity { kind: "notify", version: VERSION, of: structure.to_string(), basis: String::new() };
        let checkpoints = Checkpoints::open(folder, identity)?;
        let found = checkpoints.load_latest::<State>().found;
        let last = found.as_ref().map_or(0, |(place, _)| place.sequence);
        let memory = Self { checkpoints, next: Place { epoch: 0, sequence: last + 1 }, failures: Failures::default() };
        let recalled = found.map(|(_, State { written_s, notices })| {
            info!(structure = structure.as_str(), waiting = notices.waiting(), "goes on from its checkpoint");
            (notices, Duration::from_secs(unix_s().saturating_sub(written_s)))
        });
        Ok((memory, recalled))
    }

    /// Keeps what is to be remembered: on return it is on the disk, or its failure has been told. Notices are sent all the same then.
    ///
    /// Blocks the thread for the time of a write: called where the runtime knows.
    pub(crate) fn keep(&mut self, notices: Remembered) {
        let state = State { written_s: unix_s(), notices };
        let kept = self.checkpoints.save(self.next, &state).and_then(|()| self.checkpoints.forget_before(None));
        match kept {
            Ok(()) => {
                self.next.sequence += 1;
                if let Some(failures) = self.failures.succeeded() {
                    info!(failures, "notices are kept again");
                }
            }
            Err(error) => self.failed(&error),
        }
    }

    fn failed(&mut self, error: &CheckpointError) {
        if self.failures.failed() {
            let failures = self.failures.in_a_row();
            warn!(%error, failures, "notices not kept: after a crash some may be missing, or come twice");
        }
    }

    /// What could not be kept so far.
    pub(crate) fn failures(&self) -> &Failures {
        &self.failures
    }
}

fn unix_s() -> u64 {
    #[expect(clippy::disallowed_methods, reason = "how long a process was away goes by the clock of the machine")]
    let now = SystemTime::now();
    now.duration_since(UNIX_EPOCH).map_or(0, |elapsed| elapsed.as_secs())
}
