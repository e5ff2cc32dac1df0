//! Saves states in the background, so that a service never waits for the disk while it works.

use crate::error::CheckpointError;
use crate::failures::Failures;
use crate::series::{Checkpoints, Position};
use serde::Serialize;
use std::hash::{BuildHasher, RandomState};
use std::time::Duration;
use tokio::task::JoinHandle;
use tokio::time::Instant;
use tracing::{info, warn};

/// Returns a random instant within the last `period`, as the start of a periodic task.
///
/// The random phase spreads services that start together. Otherwise they would all wait for the
/// disk at the same moment, each on its own thread.
#[must_use]
pub fn moment_within(period: Duration) -> Instant {
    let share = RandomState::new().hash_one(()) as f64 / u64::MAX as f64;
    Instant::now()
        .checked_sub(period.mul_f64(share))
        .unwrap_or_else(Instant::now)
}

/// A background task that saves the states of a service, one at a time, on a blocking thread.
///
/// [`Failures`] limits how often failures are logged. After a failure, the next call of `keep`
/// tries again with a newer state.
#[derive(Debug)]
pub struct Keeper {
    checkpoints: Checkpoints,
    every: Duration,
    last: Instant,
    saving: Option<JoinHandle<Result<(), CheckpointError>>>,
    failures: Failures,
}

impl Keeper {
    /// Creates a keeper that saves to `checkpoints`, at most once per interval `every`.
    #[must_use]
    pub fn new(checkpoints: Checkpoints, every: Duration) -> Self {
        Self {
            checkpoints,
            every,
            last: moment_within(every),
            saving: None,
            failures: Failures::default(),
        }
    }

    /// Returns the checkpoints.
    #[must_use]
    pub fn checkpoints(&self) -> &Checkpoints {
        &self.checkpoints
    }

    /// Returns the failures so far.
    #[must_use]
    pub fn failures(&self) -> &Failures {
        &self.failures
    }

    /// Returns `true` if the interval has elapsed and no save is in progress.
    #[must_use]
    pub fn is_due(&self) -> bool {
        self.last.elapsed() >= self.every
            && self.saving.as_ref().is_none_or(JoinHandle::is_finished)
    }

    /// Starts to save a state, after waiting for the previous save to finish.
    ///
    /// Afterwards, [`Checkpoints::forget_before`] removes old checkpoints, with `needed` as its
    /// argument.
    pub async fn keep<T: Serialize + Send + 'static>(
        &mut self,
        position: Position,
        state: T,
        needed: Option<Position>,
    ) {
        self.finish().await;
        self.last = Instant::now();
        let checkpoints = self.checkpoints.clone();
        self.saving = Some(tokio::task::spawn_blocking(move || {
            checkpoints.save(position, &state)?;
            checkpoints.forget_before(needed)
        }));
    }

    /// Reports the result of a finished save, and a missing folder. Call it once per second, so
    /// that a failure is reported before the next save.
    pub async fn look(&mut self) {
        if self.saving.as_ref().is_some_and(JoinHandle::is_finished) {
            self.finish().await;
        }
        let is_new = self.saving.is_none() && self.failures.consecutive() == 0;
        if is_new && !self.checkpoints.has_folder() && self.failures.failed() {
            warn!("the folder of the checkpoints is gone; a crash now would lose more results");
        }
    }

    /// Waits until the current save has finished, and logs its result.
    pub async fn finish(&mut self) {
        let Some(saving) = self.saving.take() else {
            return;
        };
        let why = match saving.await {
            Ok(Ok(())) => {
                if let Some(failures) = self.failures.succeeded() {
                    info!(failures, "checkpoint save succeeded again");
                }
                return;
            }
            Ok(Err(error)) => error.to_string(),
            Err(error) => error.to_string(),
        };
        if self.failures.failed() {
            warn!(
                error = why,
                failures = self.failures.consecutive(),
                "checkpoint save failed; a crash now would lose more results"
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::envelope::Identity;
    use std::path::Path;

    fn keeper(folder: &Path, every: Duration) -> Keeper {
        let identity = Identity {
            kind: "fuse",
            version: 1,
            of: "tower".into(),
            basis: String::new(),
        };
        Keeper::new(Checkpoints::open(folder, identity).unwrap(), every)
    }

    fn at(sequence: u64) -> Position {
        Position { epoch: 1, sequence }
    }

    #[tokio::test]
    async fn last_two_states_are_on_disk() {
        let folder = tempfile::tempdir().unwrap();
        let mut keeper = keeper(folder.path(), Duration::ZERO);
        for sequence in 1..=3_u64 {
            keeper.keep(at(sequence), sequence, None).await;
        }
        keeper.finish().await;
        assert!(keeper.is_due());
        assert_eq!(keeper.checkpoints().positions().unwrap(), [at(2), at(3)]);
        assert_eq!(
            keeper.checkpoints().load_latest::<u64>().found,
            Some((at(3), 3))
        );
    }

    #[tokio::test]
    async fn no_checkpoint_is_due_before_its_interval() {
        let folder = tempfile::tempdir().unwrap();
        let mut keeper = keeper(folder.path(), Duration::from_secs(3600));
        assert!(!keeper.is_due());
        keeper.keep(at(1), 1_u64, None).await;
        keeper.finish().await;
        assert!(!keeper.is_due());
    }

    /// Regression: a service that had nothing to save did not notice that its folder was gone.
    #[tokio::test]
    async fn a_folder_that_is_gone_is_noticed_without_a_save_and_used_again_when_it_is_back() {
        let state = tempfile::tempdir().unwrap();
        let folder = state.path().join("spandrel/tower/checkpoints");
        let mut keeper = keeper(&folder, Duration::ZERO);
        keeper.keep(at(1), 1_u64, None).await;
        keeper.finish().await;
        keeper.look().await;
        assert_eq!(keeper.failures().consecutive(), 0);
        let away = state.path().join("away");
        std::fs::rename(state.path().join("spandrel"), &away).unwrap();
        for _ in 0..3 {
            keeper.look().await;
        }
        assert_eq!(keeper.failures().consecutive(), 1);
        keeper.keep(at(2), 2_u64, None).await;
        keeper.finish().await;
        assert_eq!(keeper.failures().consecutive(), 2);
        assert!(!folder.exists(), "a new folder would hide the former one");
        std::fs::rename(&away, state.path().join("spandrel")).unwrap();
        keeper.keep(at(3), 3_u64, None).await;
        keeper.finish().await;
        assert_eq!(keeper.failures().consecutive(), 0);
        assert_eq!(keeper.checkpoints().positions().unwrap(), [at(1), at(3)]);
    }

    #[tokio::test]
    async fn folder_and_checkpoint_are_for_their_owner_alone() {
        use std::os::unix::fs::MetadataExt as _;
        let state = tempfile::tempdir().unwrap();
        let folder = state.path().join("checkpoints");
        let mut keeper = keeper(&folder, Duration::ZERO);
        keeper.keep(at(1), 1_u64, None).await;
        keeper.finish().await;
        let mode = |path: &Path| std::fs::metadata(path).unwrap().mode() & 0o777;
        assert_eq!(mode(&folder), 0o700);
        let file = std::fs::read_dir(&folder).unwrap().next().unwrap().unwrap();
        assert_eq!(mode(&file.path()), 0o600);
    }

    #[tokio::test]
    async fn failed_save_keeps_the_previous_state() {
        let folder = tempfile::tempdir().unwrap();
        let mut keeper = keeper(&folder.path().join("below"), Duration::ZERO);
        keeper.keep(at(1), 1_u64, None).await;
        keeper.finish().await;
        // A folder with the final name prevents the rename.
        std::fs::create_dir(
            folder
                .path()
                .join("below")
                .join(format!("fuse-{:020}-{:020}.checkpoint", 1, 2)),
        )
        .unwrap();
        keeper.keep(at(2), 2_u64, None).await;
        keeper.finish().await;
        assert_eq!(keeper.failures().consecutive(), 1);
        assert_eq!(
            keeper.checkpoints().recall::<u64, _, CheckpointError>(Ok),
            Some((at(1), 1))
        );
        keeper.keep(at(3), 1_u64, None).await;
        keeper.finish().await;
        assert_eq!(keeper.failures().consecutive(), 0);
        assert_eq!(
            keeper.failures().drops(),
            Some(("checkpoints-not-kept".to_owned(), 1))
        );
    }
}
