//! Checkpoints of the alert service.

use std::collections::VecDeque;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use spandrel_checkpoint::{
    CheckpointError, Checkpoints, Failures, Identity, Position, Remembering, fingerprint,
    moment_within,
};
use spandrel_structure::Structure;
use tokio::time::Instant;
use tracing::{info, warn};

use crate::{Alert, AlertError, Baseline, Model, Watch};

/// The meaning of the parameter indices in a state.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Basis {
    /// Names of the parameters by index: those of the structure in state order, then former
    /// parameters that alerts still mention.
    pub(crate) parameters: Vec<String>,
    /// Fingerprint of the settings that determine the estimates.
    model: [u8; 32],
}

impl Basis {
    pub(crate) fn of(structure: &Structure) -> Self {
        let parameters = structure
            .parameters()
            .iter()
            .map(|parameter| parameter.name().to_owned())
            .collect();
        Self {
            parameters,
            model: fingerprint(&structure.identification_basis()),
        }
    }
}

/// The whole state of the service between two blocks of estimates.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct AlertState {
    pub(crate) basis: Basis,
    pub(crate) watch: Watch,
    /// Alerts of the last block, which might not have been published.
    pub(crate) unsent: Vec<Alert>,
    /// The last changes, oldest first, for subscribers that missed them.
    pub(crate) log: VecDeque<Alert>,
    /// Time of the last estimate with a decision, ns.
    pub(crate) last_time_ns: Option<i64>,
}

/// Version of the layout of [`AlertState`]. Every change of a field in it or in a nested type must
/// increase it. [`version_2`] and [`version_4`] read former layouts.
const VERSION: u16 = 5;
/// Versions of the layouts that are still read.
const FORMER_VERSIONS: [u16; 2] = [version_4::VERSION, version_2::VERSION];

impl AlertState {
    /// Returns the state of a service without any decisions.
    pub(crate) fn new(
        structure: &Structure,
        baseline: Option<&Baseline>,
    ) -> Result<Self, AlertError> {
        Ok(Self {
            basis: Basis::of(structure),
            watch: Watch::new(structure, baseline)?,
            unsent: Vec::new(),
            log: VecDeque::new(),
            last_time_ns: None,
        })
    }

    /// Continues from `former`, which may be the state under another structure file. If the new
    /// file ends an alert, the end is added to [`Self::unsent`].
    pub(crate) fn succeed(mut self, former: Self) -> Self {
        let names = &mut self.basis.parameters;
        let told = former
            .unsent
            .iter()
            .chain(&former.log)
            .map(|alert| alert.parameter);
        let watched = former
            .watch
            .decisions()
            .iter()
            .map(|decision| decision.subject().parameter);
        for former in told
            .chain(watched)
            .filter_map(|number| former.basis.parameters.get(number))
        {
            if !names.contains(former) {
                names.push(former.clone());
            }
        }
        let renumbered = |alert: Alert| {
            let name = former.basis.parameters.get(alert.parameter)?;
            let parameter = names.iter().position(|known| known == name)?;
            Some(Alert { parameter, ..alert })
        };
        self.log = former.log.into_iter().filter_map(renumbered).collect();
        self.unsent = former.unsent.into_iter().filter_map(renumbered).collect();
        self.last_time_ns = former.last_time_ns;
        let model = if former.basis.model == self.basis.model {
            Model::Same
        } else {
            Model::Changed
        };
        let mut changes = Vec::new();
        self.watch
            .succeed(&former.watch, names, model, &mut changes);
        changes
            .iter()
            .for_each(|change| note(&mut self.log, change));
        self.unsent.extend(changes);
        self
    }

    /// Returns `true` if a checkpoint of this state equals one of `other`.
    pub(crate) fn is_stored_like(&self, other: &Self) -> bool {
        let stored = |state: &Self| {
            let mut stored = state.clone();
            stored.watch.forget_unstored();
            stored
        };
        stored(self) == stored(other)
    }

    /// Returns `true` if every parameter index is valid.
    fn is_consistent(&self) -> bool {
        let parameters = self.basis.parameters.len();
        let told = self
            .unsent
            .iter()
            .chain(&self.log)
            .map(|alert| alert.parameter);
        let watched = self
            .watch
            .decisions()
            .iter()
            .map(|decision| decision.subject().parameter);
        self.watch.parameter_count() <= parameters
            && told.chain(watched).all(|number| number < parameters)
    }
}

/// Number of changes kept in the log.
const CHANGES_KEPT: usize = 256;

/// Adds a change to the log. A revision replaces the message that it revises, so that it displaces
/// no other change.
pub(crate) fn note(log: &mut VecDeque<Alert>, alert: &Alert) {
    let of_rule = |kept: &&mut Alert| (kept.rule, kept.parameter) == (alert.rule, alert.parameter);
    match log.iter_mut().rev().find(of_rule) {
        Some(last) if alert.revision > 0 && alert.is_same_state(last) => last.clone_from(alert),
        Some(_) | None => log.push_back(alert.clone()),
    }
    log.drain(..log.len().saturating_sub(CHANGES_KEPT));
}

/// The checkpoints of the decisions on one structure.
#[derive(Debug)]
pub(crate) struct Memory {
    checkpoints: Checkpoints,
    every: Duration,
    last: Instant,
    kept: Option<Position>,
    failures: Failures,
}

impl Memory {
    pub(crate) fn open(
        structure: &Structure,
        remembering: &Remembering,
    ) -> Result<Self, AlertError> {
        // The identity has no basis, because the state itself contains it. A new structure file
        // keeps the parts that are still valid.
        let basis = String::new();
        let identity = Identity {
            kind: "alert",
            version: VERSION,
            of: structure.name().to_owned(),
            basis,
        };
        Ok(Self {
            checkpoints: Checkpoints::open(&remembering.folder, identity)?,
            every: remembering.every,
            last: moment_within(remembering.every),
            kept: None,
            failures: Failures::default(),
        })
    }

    /// Returns the newest readable state, if any.
    pub(crate) fn recall(&mut self) -> Option<AlertState> {
        loop {
            let loaded = self
                .checkpoints
                .load_latest_or_formers::<AlertState, version_4::AlertState, version_2::AlertState>(
                    FORMER_VERSIONS,
                );
            let (position, state) = loaded.found?;
            if state.is_consistent() {
                info!(
                    epoch = position.epoch,
                    estimate = position.sequence,
                    "resumed from its checkpoint"
                );
                self.kept = Some(position);
                return Some(state);
            }
            drop(self.checkpoints.refuse(
                position,
                "it contains decisions on parameters that it does not name".to_owned(),
            ));
        }
    }

    /// Returns the number of the first estimate of an epoch that a restart would need again.
    pub(crate) fn kept(&self, epoch: u64) -> u64 {
        self.kept
            .filter(|position| position.epoch == epoch)
            .map_or(0, |position| position.sequence)
    }

    pub(crate) fn is_due(&self) -> bool {
        self.last.elapsed() >= self.every
    }

    /// Saves a checkpoint. On return it is on disk, or the failure is logged. Alerts are published
    /// in both cases.
    pub(crate) fn keep(&mut self, state: &AlertState) {
        let Some(position) = state.watch.position() else {
            return;
        };
        self.last = Instant::now();
        // This call blocks the thread during the write, so callers use `block_in_place`.
        let kept = self
            .checkpoints
            .save(position, state)
            .and_then(|()| self.checkpoints.forget_before(Some(position)));
        match kept {
            Ok(()) => {
                self.kept = Some(position);
                if let Some(failures) = self.failures.succeeded() {
                    info!(failures, "decisions are saved again");
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
                "the folder of the checkpoints is gone; alerts may be published again after a crash"
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
            warn!(%error, failures, "cannot save decisions; alerts may be published again after a \
                                     crash");
        }
    }

    /// Returns the count of failed writes.
    pub(crate) fn failures(&self) -> &Failures {
        &self.failures
    }
}

mod version_2;
mod version_4;

#[cfg(test)]
mod tests;
