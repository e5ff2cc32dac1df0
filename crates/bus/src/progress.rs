//! How far a service has come: put by the service, watched by sources that must not run ahead.

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

/// A progress message may be dropped, so the last one is repeated; what has not been told is told then at the latest.
const REPEAT: Duration = Duration::from_millis(300);
/// Every so many changes are told: sources look a window of thousands of frames ahead.
const CHANGES: u32 = 4;
/// And each one by so many frames: a part of such a window.
const STEP: u64 = 256;

/// Puts the progress of a service: soon after it changes, and again while it does not.
#[derive(Debug)]
pub struct ProgressPublisher {
    source: String,
    latest: watch::Sender<Latest>,
    _repeating: JoinSet<()>,
}

/// The last progress of a service; clones watch the same.
#[derive(Clone, Debug)]
pub struct ProgressWatch {
    latest: watch::Receiver<Option<Progress>>,
    _subscriber: Arc<Subscriber<()>>,
}

impl Bus {
    /// Declares the progress of a service on its `progress` key; `source` is the id of the service.
    ///
    /// # Errors
    /// Zenoh refuses the key, or the session is closed.
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

    /// Watches the progress put on a `progress` key.
    ///
    /// # Errors
    /// Zenoh refuses the key, or the session is closed.
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
                    Err(error) => debug!(key = %sample.key_expr(), %error, "progress refused"),
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
            warn!(%error, "progress not put");
            return;
        }
        tokio::select! {
            changed = changes.changed() => if changed.is_err() { return },
            () = tokio::time::sleep(REPEAT) => {}
        }
    }
}

/// The last progress, and when one was told.
#[derive(Debug, Default)]
struct Latest {
    progress: Option<Progress>,
    /// Epoch and frames done of the last one that was told at once.
    told: Option<(u64, u64)>,
    /// Changes since.
    untold: u32,
}

impl Latest {
    /// Takes a change; returns whether it is to be told at once.
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
    /// Says that all frames of `epoch` below number `done` are done; `time_ns` is the time of the last one,
    /// ns since the Unix epoch. Never waits.
    pub fn set(&self, epoch: u64, done: u64, time_ns: i64) {
        self.set_kept(epoch, done, time_ns, done);
    }

    /// As [`ProgressPublisher::set`], of a service that would need the frames from number `kept` on again if it were killed.
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
    /// The last progress heard of.
    #[must_use]
    pub fn latest(&self) -> Option<Progress> {
        self.latest.borrow().clone()
    }

    /// Waits until a progress message arrives that fulfils a condition, and returns it; the last one counts.
    pub async fn wait_for(&mut self, mut reached: impl FnMut(&Progress) -> bool) -> Progress {
        let waited = self
            .latest
            .wait_for(|progress| progress.as_ref().is_some_and(&mut reached))
            .await;
        match waited.map(|progress| progress.clone()) {
            Ok(Some(progress)) => progress,
            Ok(None) | Err(_) => std::future::pending().await, // the session is closed: nothing arrives any more
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_change_in_four_is_told_and_every_great_step() {
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
