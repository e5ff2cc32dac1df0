//! Progress of a service. Sources watch it to limit how far they run ahead.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::watch;
use tokio::task::JoinSet;
use tracing::{debug, warn};
use zenoh::pubsub::Subscriber;
use zenoh::sample::Sample;

use crate::BoxedFuture;
use crate::error::BusError;
use crate::message::{Header, Progress};
use crate::publish::DisplayPublisher;
use crate::receive::read;
use crate::session::Bus;

/// Interval at which the latest progress is repeated, because a message may be dropped. It also
/// limits the delay of small changes.
const REPEAT: Duration = Duration::from_millis(300);
/// Number of changes after which one is published at once. Sources run thousands of frames ahead,
/// so that this suffices.
const CHANGES: u32 = 4;
/// Number of frames after which a change is published at once, a small part of that lead.
const STEP: u64 = 256;

/// Publishes the progress of a service: soon after it changes, and repeatedly while it does not.
#[derive(Debug)]
pub struct ProgressPublisher {
    source: String,
    latest: watch::Sender<Latest>,
    _repeating: JoinSet<()>,
}

/// The latest progress of a service. Clones share the subscription.
#[derive(Clone, Debug)]
pub struct ProgressWatch {
    latest: watch::Receiver<Option<Progress>>,
    _subscriber: Arc<Subscriber<()>>,
}

impl Bus {
    /// Declares the progress of a service on its `progress` key. `source` is the id of the service.
    ///
    /// # Errors
    /// Fails if Zenoh rejects the key or the session is closed.
    pub fn publish_progress<'a>(
        &'a self,
        key: String,
        source: String,
    ) -> BoxedFuture<'a, Result<ProgressPublisher, BusError>> {
        Box::pin(async move {
            let publisher = self.publish_display(key).await?;
            let (latest, changes) = watch::channel(Latest::default());
            let mut repeating = JoinSet::new();
            repeating.spawn(repeat(publisher, changes));
            Ok(ProgressPublisher {
                source,
                latest,
                _repeating: repeating,
            })
        })
    }

    /// Watches the progress on a `progress` key.
    ///
    /// # Errors
    /// Fails if Zenoh rejects the key or the session is closed.
    pub fn watch_progress<'a>(
        &'a self,
        key: String,
    ) -> BoxedFuture<'a, Result<ProgressWatch, BusError>> {
        Box::pin(async move {
            let (changes, latest) = watch::channel(None);
            let declared = self.session().declare_subscriber(key.clone());
            let subscriber = declared
                .callback(move |sample: Sample| match read::<Progress>(&sample) {
                    Ok(progress) => drop(changes.send_replace(Some(progress))),
                    Err(error) => {
                        debug!(key = %sample.key_expr(), %error, "progress message rejected")
                    }
                })
                .await
                .map_err(|source| BusError::Declare { key, source })?;
            Ok(ProgressWatch {
                latest,
                _subscriber: Arc::new(subscriber),
            })
        })
    }
}

async fn repeat(publisher: DisplayPublisher<Progress>, mut changes: watch::Receiver<Latest>) {
    loop {
        let progress = changes.borrow_and_update().progress.clone();
        if let Some(progress) = progress
            && let Err(error) = publisher.put(&progress).await
        {
            warn!(%error, "progress not published");
            return;
        }
        tokio::select! {
            changed = changes.changed() => if changed.is_err() { return },
            () = tokio::time::sleep(REPEAT) => {}
        }
    }
}

/// Latest progress, and the last publication of a change.
#[derive(Debug, Default)]
struct Latest {
    progress: Option<Progress>,
    /// Epoch and processed frames of the last change that was published at once.
    told: Option<(u64, u64)>,
    /// Number of changes since then.
    untold: u32,
}

impl Latest {
    /// Records a change. Returns `true` if it must be published at once.
    fn take(&mut self, progress: Progress) -> bool {
        let (epoch, done) = (progress.header.epoch, progress.done);
        self.progress = Some(progress);
        self.untold += 1;
        let is_small = self.told.is_some_and(|(told, from)| {
            told == epoch && done.abs_diff(from) < STEP && self.untold < CHANGES
        });
        if !is_small {
            (self.told, self.untold) = (Some((epoch, done)), 0);
        }
        !is_small
    }
}

impl ProgressPublisher {
    /// Reports that all frames of `epoch` below number `done` are processed. Never waits.
    ///
    /// `time_ns` is the time of the last processed frame, ns since the Unix epoch, UTC.
    pub fn set(&self, epoch: u64, done: u64, time_ns: i64) {
        self.set_kept(epoch, done, time_ns, done);
    }

    /// Reports progress as [`ProgressPublisher::set`] does, with the number `kept` of the first
    /// frame that the service would need again after a crash.
    pub fn set_kept(&self, epoch: u64, done: u64, time_ns: i64, kept: u64) {
        let header = Header {
            source: self.source.clone(),
            epoch,
            sequence: done,
            time_ns,
        };
        self.latest
            .send_if_modified(|latest| latest.take(Progress { header, done, kept }));
    }
}

impl ProgressWatch {
    /// Returns the latest progress, or `None` if no message has arrived yet.
    #[must_use]
    pub fn latest(&self) -> Option<Progress> {
        self.latest.borrow().clone()
    }

    /// Waits until the latest progress fulfils a condition, and returns it. Waits forever if the
    /// session is closed.
    pub async fn wait_for(&mut self, mut reached: impl FnMut(&Progress) -> bool) -> Progress {
        let waited = self
            .latest
            .wait_for(|progress| progress.as_ref().is_some_and(&mut reached))
            .await;
        match waited.map(|progress| progress.clone()) {
            Ok(Some(progress)) => progress,
            // The session is closed, so that no message can arrive.
            Ok(None) | Err(_) => std::future::pending().await,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_fourth_change_and_every_large_step_is_published() {
        let progress = |epoch, done| Progress {
            header: Header {
                source: "ingest".into(),
                epoch,
                sequence: done,
                time_ns: 0,
            },
            done,
            kept: done,
        };
        let mut latest = Latest::default();
        let small: Vec<bool> = (1..=9)
            .map(|block| latest.take(progress(1, 5 * block)))
            .collect();
        assert_eq!(
            small,
            [true, false, false, false, true, false, false, false, true]
        );
        assert!(latest.take(progress(1, 45 + STEP)));
        assert!(!latest.take(progress(1, 50 + STEP)));
        assert!(latest.take(progress(2, 5)), "another epoch");
        assert_eq!(latest.progress, Some(progress(2, 5)));
    }
}
