//! How far a service has come: put by the service, watched by sources that must not run ahead.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::timeout;
use tracing::{debug, warn};
use zenoh::pubsub::Subscriber;
use zenoh::sample::Sample;

use crate::BoxedFuture;
use crate::error::BusError;
use crate::message::{Header, Progress};
use crate::publish::DisplayPublisher;
use crate::receive::read;
use crate::session::Bus;

/// A progress message may be dropped, so the last one is repeated.
const REPEAT: Duration = Duration::from_millis(500);
/// At least so long between two of them, but for great steps: sources look a window of thousands of frames ahead.
const PAUSE: Duration = Duration::from_millis(200);
/// Frames that make a great step: many of them fit into the window of a source.
const STEP: u64 = 256;

/// Puts the progress of a service: soon after it changes, and again while it does not.
#[derive(Debug)]
pub struct ProgressPublisher {
    source: String,
    latest: watch::Sender<Option<Progress>>,
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
            let (latest, changes) = watch::channel(None);
            let mut repeating = JoinSet::new();
            repeating.spawn(repeat(publisher, changes));
            Ok(ProgressPublisher { source, latest, _repeating: repeating })
        })
    }

    /// Watches the progress put on a `progress` key.
    ///
    /// # Errors
    /// Zenoh refuses the key, or the session is closed.
    pub fn watch_progress<'a>(&'a self, key: String) -> BoxedFuture<'a, Result<ProgressWatch, BusError>> {
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
            Ok(ProgressWatch { latest, _subscriber: Arc::new(subscriber) })
        })
    }
}

async fn repeat(publisher: DisplayPublisher<Progress>, mut changes: watch::Receiver<Option<Progress>>) {
    loop {
        let progress = changes.borrow_and_update().clone();
        if let Some(progress) = &progress
            && let Err(error) = publisher.put(progress).await
        {
            warn!(%error, "progress not put");
            return;
        }
        let great_step = changes.wait_for(|now| is_great_step(progress.as_ref(), now.as_ref()));
        match timeout(PAUSE, great_step).await {
            Ok(Ok(_)) => continue,
            Ok(Err(_nobody_sets_it)) => return,
            Err(_elapsed) => {}
        }
        let is_told = *changes.borrow() == progress;
        if is_told && let Ok(Err(_nobody_sets_it)) = timeout(REPEAT - PAUSE, changes.changed()).await {
            return;
        }
    }
}

fn is_great_step(from: Option<&Progress>, to: Option<&Progress>) -> bool {
    match (from, to) {
        (_, None) => false,
        (None, Some(_)) => true,
        (Some(from), Some(to)) => from.header.epoch != to.header.epoch || to.done.abs_diff(from.done) >= STEP,
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
        self.latest.send_replace(Some(Progress {
            header: Header { source: self.source.clone(), epoch, sequence: done, time_ns },
            done,
            kept,
        }));
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
        let waited = self.latest.wait_for(|progress| progress.as_ref().is_some_and(&mut reached)).await;
        match waited.map(|progress| progress.clone()) {
            Ok(Some(progress)) => progress,
            Ok(None) | Err(_) => std::future::pending().await, // the session is closed: nothing arrives any more
        }
    }
}
