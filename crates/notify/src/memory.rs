//! Checkpoints of the notification service, one state per structure.

use crate::error::NotifyError;
use crate::outbox::{Remembered, version_1};
use serde::{Deserialize, Serialize};
use spandrel_bus::Name;
use spandrel_checkpoint::{CheckpointError, Checkpoints, Failures, Identity, Place};
use spandrel_service::Clock;
use std::path::Path;
use std::time::Duration;
use tracing::{info, warn};

/// Version of the layout of [`State`]. Every change of a field in it or in a nested type must
/// increase it.
const VERSION: u16 = 2;
/// Version of the layout of [`FormerState`].
const FORMER_VERSION: u16 = 1;

#[derive(Debug, Serialize, Deserialize)]
struct State {
    /// Time of writing, in s since the Unix epoch.
    written_s: u64,
    notices: Remembered,
}

/// [`State`] in the layout of Spandrel 0.1.0.
#[derive(Debug, Deserialize)]
struct FormerState {
    written_s: u64,
    notices: version_1::Remembered,
}

impl From<FormerState> for State {
    fn from(FormerState { written_s, notices }: FormerState) -> Self {
        Self {
            written_s,
            notices: notices.into(),
        }
    }
}

/// The checkpoints of the notices of one structure.
#[derive(Debug)]
pub(crate) struct Memory {
    checkpoints: Checkpoints,
    next: Place,
    failures: Failures,
}

impl Memory {
    /// Opens the checkpoint folder of a structure. Also returns the state of an earlier run, if
    /// any, with its age.
    pub(crate) fn open(
        folder: &Path,
        structure: &Name,
    ) -> Result<(Self, Option<(Remembered, Duration)>), NotifyError> {
        let identity = Identity {
            kind: "notify",
            version: VERSION,
            of: structure.to_string(),
            basis: String::new(),
        };
        let checkpoints = Checkpoints::open(folder, identity)?;
        let found = checkpoints
            .load_latest_or_former::<State, FormerState>(FORMER_VERSION)
            .found;
        let last = found.as_ref().map_or(0, |(place, _)| place.sequence);
        let memory = Self {
            checkpoints,
            next: Place {
                epoch: 0,
                sequence: last + 1,
            },
            failures: Failures::default(),
        };
        let recalled = found.map(|(_, State { written_s, notices })| {
            info!(
                structure = structure.as_str(),
                waiting = notices.waiting(),
                "resumed from its checkpoint"
            );
            (
                notices,
                Duration::from_secs(unix_s().saturating_sub(written_s)),
            )
        });
        Ok((memory, recalled))
    }

    /// Saves a checkpoint. On return it is on disk, or the failure is logged.
    ///
    /// Notices are sent in both cases. The call blocks the thread during the write, so the caller
    /// must use `block_in_place`.
    pub(crate) fn keep(&mut self, notices: Remembered) {
        let state = State {
            written_s: unix_s(),
            notices,
        };
        let kept = self
            .checkpoints
            .save(self.next, &state)
            .and_then(|()| self.checkpoints.forget_before(None));
        match kept {
            Ok(()) => {
                self.next.sequence += 1;
                if let Some(failures) = self.failures.succeeded() {
                    info!(failures, "notices are saved again");
                }
            }
            Err(error) => self.failed(&error),
        }
    }

    fn failed(&mut self, error: &CheckpointError) {
        if self.failures.failed() {
            let failures = self.failures.consecutive();
            warn!(%error, failures, "cannot save notices; after a crash, notices may be missing or be sent twice");
        }
    }

    /// Returns the count of failed writes.
    pub(crate) fn failures(&self) -> &Failures {
        &self.failures
    }
}

fn unix_s() -> u64 {
    Clock::of_machine().epoch() / 1_000_000_000
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::outbox::{Outbox, Wish};
    use spandrel_bus::{AlertMessage, AlertState};

    /// Returns the notices that Spandrel 0.1.0 left on disk for a webhook (receiver 0) and for
    /// e-mail (receiver 1).
    ///
    /// The webhook had received the raised alert of storey 1, but not the alert of storey 2. The
    /// e-mail receiver had received the acknowledged alert of storey 2.
    fn kept_by_0_1_0() -> Outbox {
        let folder = tempfile::tempdir().unwrap();
        let name = "notify-00000000000000000000-00000000000000000001.checkpoint";
        let kept = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("tests/kept/0.1.0")
            .join(name);
        std::fs::copy(kept, folder.path().join(name)).unwrap();
        let house = Name::new("house").unwrap();
        let (memory, recalled) = Memory::open(folder.path(), &house).unwrap();
        assert_eq!(memory.next.sequence, 2);
        let (notices, _) = recalled.expect("a checkpoint of version 1");
        let wish = |name: &str, states| Wish {
            name: name.to_owned(),
            states,
            repeats: false,
        };
        let mut outbox = Outbox::new(vec![
            wish("hook", vec![AlertState::Raised, AlertState::Cleared]),
            wish("mail", vec![AlertState::Acknowledged]),
        ]);
        assert_eq!(
            outbox.recall(&house, notices, Duration::ZERO, Duration::ZERO),
            0
        );
        outbox
    }

    /// Sends all notices that are due. Returns receiver, key and alert of each.
    fn send(outbox: &mut Outbox) -> Vec<(usize, String, AlertMessage)> {
        let mut sent = Vec::new();
        loop {
            let due = outbox.due(Duration::ZERO);
            if due.is_empty() {
                return sent;
            }
            for notice in due {
                outbox.done(notice.receiver, true, Duration::ZERO);
                sent.push((notice.receiver, notice.key, notice.alert));
            }
        }
    }

    #[test]
    fn notice_that_0_1_0_could_not_deliver_is_delivered_under_its_key() {
        let sent = send(&mut kept_by_0_1_0());
        let [(0, key, alert)] = &sent[..] else {
            panic!("{sent:?}")
        };
        assert_eq!(key, "house/storey-2/20000000000/raised");
        assert_eq!(
            (alert.state, alert.since_ns, alert.loss),
            (AlertState::Raised, Some(5_000_000_000), Some(0.124))
        );
        assert_eq!(alert.why, "storey-2 has lost 12.4 % of its stiffness");
    }

    #[test]
    fn alert_that_0_1_0_delivered_is_not_sent_again_and_its_end_is() {
        let mut outbox = kept_by_0_1_0();
        let (_, _, of_storey_2) = send(&mut outbox).remove(0);
        let of_storey_1 = AlertMessage {
            parameter: Name::new("storey-1").unwrap(),
            ..of_storey_2.clone()
        };
        let later = |alert: &AlertMessage, seconds: i64| AlertMessage {
            time_ns: seconds * 1_000_000_000,
            loss: Some(0.13),
            revision: 1,
            ..alert.clone()
        };
        let seen = AlertMessage {
            state: AlertState::Acknowledged,
            ..of_storey_2
        };
        let known = AlertMessage {
            time_ns: 10_000_000_000,
            ..of_storey_1.clone()
        };
        for alert in [known, later(&of_storey_1, 40), later(&seen, 40)] {
            outbox.take(&alert, Duration::ZERO);
        }
        assert_eq!(send(&mut outbox), []);
        let end = AlertMessage {
            state: AlertState::Cleared,
            ..later(&of_storey_1, 50)
        };
        outbox.take(&end, Duration::ZERO);
        assert_eq!(send(&mut outbox).len(), 1);
    }
}
