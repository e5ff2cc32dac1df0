//! Checkpoints of the notification service, one state per structure.

use crate::error::NotifyError;
use crate::origin::Origins;
use crate::outbox::{Remembered, version_1, version_2};
use crate::sight::Told;
use serde::{Deserialize, Serialize};
use spandrel_bus::{AlertMessage, Name};
use spandrel_checkpoint::{CheckpointError, Checkpoints, Failures, Identity, Position};
use spandrel_service::Clock;
use std::path::Path;
use std::time::Duration;
use tracing::{info, warn};

/// Version of the layout of [`State`]. Every change of a field in it or in a nested type must
/// increase it. A new last variant of an enum does not, because former files remain readable.
const VERSION: u16 = 3;
/// Versions of the layouts of [`State2`] and [`State1`].
const FORMER_VERSIONS: [u16; 2] = [2, 1];

#[derive(Debug, Serialize, Deserialize)]
struct State {
    /// Time of writing, in s since the Unix epoch.
    written_s: u64,
    notices: Remembered,
    situation: Situation,
}

/// The known state of a structure, apart from its notices.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Situation {
    /// Changes of alerts whose notices are not composed yet.
    pub(crate) fresh: Vec<AlertMessage>,
    pub(crate) origins: Origins,
    pub(crate) told: Told,
}

/// [`State`] in version 2, before notices about the monitoring.
#[derive(Debug, Deserialize)]
struct State2 {
    written_s: u64,
    notices: version_2::Remembered,
}

impl From<State2> for State {
    fn from(State2 { written_s, notices }: State2) -> Self {
        Self {
            written_s,
            notices: notices.into(),
            situation: Situation::default(),
        }
    }
}

/// [`State`] in the layout of Spandrel 0.1.0.
#[derive(Debug, Deserialize)]
struct State1 {
    written_s: u64,
    notices: version_1::Remembered,
}

impl From<State1> for State {
    fn from(State1 { written_s, notices }: State1) -> Self {
        let notices = notices.into();
        State2 { written_s, notices }.into()
    }
}

/// The state of an earlier run.
#[derive(Debug)]
pub(crate) struct Recalled {
    pub(crate) notices: Remembered,
    pub(crate) situation: Situation,
    /// Time since the state was written.
    pub(crate) away: Duration,
}

/// The checkpoints of the notices of one structure.
#[derive(Debug)]
pub(crate) struct Memory {
    checkpoints: Checkpoints,
    next: Position,
    failures: Failures,
}

impl Memory {
    /// Opens the checkpoint folder of a structure. Also returns the state of an earlier run, if
    /// any.
    pub(crate) fn open(
        folder: &Path,
        structure: &Name,
    ) -> Result<(Self, Option<Recalled>), NotifyError> {
        let identity = Identity {
            kind: "notify",
            version: VERSION,
            of: structure.to_string(),
            basis: String::new(),
        };
        let checkpoints = Checkpoints::open(folder, identity)?;
        let found = checkpoints
            .load_latest_or_formers::<State, State2, State1>(FORMER_VERSIONS)
            .found;
        let last = found.as_ref().map_or(0, |(position, _)| position.sequence);
        let memory = Self {
            checkpoints,
            next: Position {
                epoch: 0,
                sequence: last + 1,
            },
            failures: Failures::default(),
        };
        let recalled = found.map(|(_, state)| {
            let State {
                written_s,
                notices,
                situation,
            } = state;
            info!(
                structure = structure.as_str(),
                waiting = notices.waiting(),
                "resumed from its checkpoint"
            );
            Recalled {
                notices,
                situation,
                away: Duration::from_secs(unix_s().saturating_sub(written_s)),
            }
        });
        Ok((memory, recalled))
    }

    /// Saves a checkpoint. On return it is on disk, or the failure is logged.
    ///
    /// Notices are sent in both cases. The call blocks the thread during the write, so the caller
    /// must use `block_in_place`.
    pub(crate) fn keep(&mut self, notices: Remembered, situation: Situation) {
        let state = State {
            written_s: unix_s(),
            notices,
            situation,
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

    /// Reports a missing folder at once, even if there is nothing to save.
    pub(crate) fn look(&mut self) {
        let is_new = self.failures.consecutive() == 0 && !self.checkpoints.has_folder();
        if is_new && self.failures.failed() {
            warn!(
                "the folder of the checkpoints is gone; after a crash, notices may be missing or \
                 be sent twice"
            );
        }
    }

    /// Returns `true` if the last save failed and the folder is back.
    pub(crate) fn is_back(&self) -> bool {
        self.failures.consecutive() > 0 && self.checkpoints.has_folder()
    }

    fn failed(&mut self, error: &CheckpointError) {
        if self.failures.failed() {
            let failures = self.failures.consecutive();
            warn!(%error, failures, "cannot save notices; after a crash, notices may be missing \
                                     or be sent twice");
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
    use crate::content::Report;
    use crate::outbox::{Moment, Outbox, Wish};
    use crate::state::NoticeState;
    use crate::testing::{maintenance, name, of_alert};
    use spandrel_bus::AlertState;

    const START: Moment = Moment {
        now: Duration::ZERO,
        wall_ns: 0,
    };

    fn outbox() -> Outbox {
        let wish = |name: &str, states| Wish {
            name: name.to_owned(),
            states,
            ..Wish::default()
        };
        Outbox::new(vec![
            wish("hook", vec![NoticeState::Raised, NoticeState::Cleared]),
            wish("mail", vec![NoticeState::Acknowledged]),
        ])
    }

    /// Returns the notices that a former version left on disk for a webhook (receiver 0) and for
    /// e-mail (receiver 1).
    ///
    /// The webhook had received the raised alert of storey 1, but not the alert of storey 2. The
    /// e-mail receiver had received the acknowledged alert of storey 2.
    fn kept_by(version: &str) -> Outbox {
        let folder = tempfile::tempdir().unwrap();
        let file = "notify-00000000000000000000-00000000000000000001.checkpoint";
        let kept = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("tests/kept")
            .join(version)
            .join(file);
        std::fs::copy(kept, folder.path().join(file)).unwrap();
        let (memory, recalled) = Memory::open(folder.path(), &name("house")).unwrap();
        assert_eq!(memory.next.sequence, 2);
        let recalled = recalled.expect("a former checkpoint");
        assert_eq!(recalled.situation, Situation::default());
        let mut outbox = outbox();
        let lost = outbox.recall(
            &name("house"),
            recalled.notices,
            Duration::ZERO,
            Duration::ZERO,
        );
        assert_eq!(lost, 0);
        outbox
    }

    const FORMER: [&str; 2] = ["0.1.0", "version-2"];

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
                let Report::Alert(alert) = notice.content.report else {
                    panic!("{:?}", notice.content)
                };
                sent.push((notice.receiver, notice.content.key, alert));
            }
        }
    }

    #[test]
    fn undelivered_notice_of_a_former_version_is_delivered_under_its_key() {
        for version in FORMER {
            let sent = send(&mut kept_by(version));
            let [(0, key, alert)] = &sent[..] else {
                panic!("{version}: {sent:?}")
            };
            assert_eq!(key, "house/storey-2/20000000000/raised");
            assert_eq!((alert.state, alert.loss), (AlertState::Raised, Some(0.124)));
            assert_eq!(alert.why, "storey-2 has lost 12.4 % of its stiffness");
        }
    }

    #[test]
    fn only_the_end_of_an_alert_delivered_by_a_former_version_is_sent() {
        for version in FORMER {
            let mut outbox = kept_by(version);
            let (_, _, of_storey_2) = send(&mut outbox).remove(0);
            let of_storey_1 = AlertMessage {
                parameter: name("storey-1"),
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
                outbox.take(&of_alert(&alert), START);
            }
            assert_eq!(send(&mut outbox), [], "{version}");
            let end = AlertMessage {
                state: AlertState::Cleared,
                ..later(&of_storey_1, 50)
            };
            outbox.take(&of_alert(&end), START);
            assert_eq!(send(&mut outbox).len(), 1, "{version}");
        }
    }

    #[test]
    fn maintenance_and_situation_survive_a_restart() {
        let folder = tempfile::tempdir().unwrap();
        let house = name("house");
        let mut first = outbox();
        let period = maintenance(None, 10, 100);
        first.maintain(period.clone(), 10);
        let situation = Situation {
            fresh: vec![crate::testing::alert(20, AlertState::Raised)],
            ..Situation::default()
        };
        let (mut memory, _) = Memory::open(folder.path(), &house).unwrap();
        memory.keep(first.remembered(&house, Duration::ZERO), situation.clone());
        let (_, recalled) = Memory::open(folder.path(), &house).unwrap();
        let recalled = recalled.unwrap();
        assert_eq!(recalled.situation, situation);
        let mut second = outbox();
        second.recall(&house, recalled.notices, Duration::ZERO, Duration::ZERO);
        assert_eq!(second.maintenance(&house), [period]);
    }
}
