//! Supervision of services: restarts after a panic, and notifications to systemd.

use crate::error::AppError;
use crate::state::State;
use sd_notify::NotifyState;
use spandrel_bus::{Bus, BusError, Event, EventKind, Keys};
use spandrel_identify::FilterPool;
use spandrel_service::{Audit, Clock, EventPublisher, LostReader};
use std::collections::VecDeque;
use std::future::Future;
use std::time::Duration;
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::task::JoinSet;
use tokio::time::{Instant, MissedTickBehavior};
use tracing::{debug, error, info, warn};

/// Number of panics of one service of one structure within [`PANICS_WITHIN`] that ends the process.
/// Its supervisor can then restart it.
const MOST_PANICS: usize = 5;
const PANICS_WITHIN: Duration = Duration::from_secs(60);
/// Pause before a restart.
const PAUSE: Duration = Duration::from_millis(200);
/// Interval between checks of the state folder.
const LOOK_EVERY: Duration = Duration::from_secs(1);

/// Runs one service of one structure and restarts it after a panic.
///
/// The restarted service resumes from its checkpoint. Other structures and services are not
/// affected.
///
/// # Errors
/// Returns an error if the service fails, or if it panics too often.
pub async fn supervise<First, Next, Life>(
    service: &'static str,
    structure: String,
    first: First,
    mut next: Next,
) -> Result<(), AppError>
where
    First: Future<Output = Result<(), AppError>> + Send + 'static,
    Next: FnMut() -> Life,
    Life: Future<Output = Result<(), AppError>> + Send + 'static,
{
    // The set aborts its task when dropped, so that a run of the service cannot outlast this
    // future.
    let mut life = JoinSet::new();
    life.spawn(first);
    let mut panics = VecDeque::new();
    loop {
        let panicked = match life.join_next().await {
            Some(Ok(Err(error))) if error.is_of_a_panic() => error,
            Some(Ok(result)) => return result,
            Some(Err(source)) if source.is_cancelled() => {
                return Err(AppError::Panicked { service, source });
            }
            Some(Err(source)) => AppError::Panicked { service, source },
            None => return Ok(()), // the set always contains one task
        };
        let now = Instant::now();
        panics.push_back(now);
        while panics
            .front()
            .is_some_and(|earlier| now.duration_since(*earlier) > PANICS_WITHIN)
        {
            panics.pop_front();
        }
        if panics.len() >= MOST_PANICS {
            return Err(panicked);
        }
        error!(
            service,
            structure, "panicked; restarting from the last checkpoint"
        );
        tokio::time::sleep(PAUSE).await;
        life.spawn(next());
    }
}

/// The signal SIGHUP, which requests a reload of the configuration.
pub struct Hangups(Option<Signal>);

impl Hangups {
    /// Installs the signal handler.
    pub fn new() -> Self {
        match signal(SignalKind::hangup()) {
            Ok(signal) => Self(Some(signal)),
            Err(error) => {
                warn!(%error, "cannot handle SIGHUP");
                Self(None)
            }
        }
    }

    /// Waits for a SIGHUP after which `read` succeeds, and returns the result. A failed attempt is
    /// logged and changes nothing.
    pub async fn read<T>(&mut self, read: impl Fn() -> Result<T, AppError>) -> T {
        loop {
            let asked = match &mut self.0 {
                Some(signal) => signal.recv().await.is_some(),
                None => false,
            };
            if !asked {
                std::future::pending::<()>().await;
            }
            match read() {
                Ok(read) => {
                    info!("configuration and structure files reloaded; restarting the services");
                    return read;
                }
                Err(error) => error!(
                    "configuration reload failed; nothing changed: {}",
                    error.report()
                ),
            }
        }
    }
}

/// Reports the state of the process to systemd, if systemd requests it.
pub fn tell_systemd(state: NotifyState<'_>) {
    if let Err(error) = sd_notify::notify(&[state]) {
        debug!(%error, "cannot notify systemd");
    }
}

/// Notifies the watchdog of systemd twice per watchdog period, as long as the runtime and the
/// filter threads respond.
///
/// Never returns.
pub async fn feed_watchdog<T>(pool: Option<FilterPool>) -> T {
    let Some(within) = sd_notify::watchdog_enabled() else {
        return std::future::pending().await;
    };
    let mut feed = tokio::time::interval(within / 2);
    loop {
        feed.tick().await;
        let works = match &pool {
            Some(pool) => tokio::time::timeout(within / 2, pool.responds())
                .await
                .unwrap_or(false),
            None => true,
        };
        match works {
            true => tell_systemd(NotifyState::Watchdog),
            false => warn!("the filter threads do not respond"),
        }
    }
}

/// Creates the folders of the structures again if the state folder has come back without them.
///
/// Never returns.
pub async fn keep_folders<T>(state: Option<&State>, keys: Vec<Keys>) -> T {
    let Some(state) = state else {
        return std::future::pending().await;
    };
    let mut look = tokio::time::interval(LOOK_EVERY);
    look.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        look.tick().await;
        let (state, keys) = (state.clone(), keys.clone());
        // A disk that hangs must not stop the runtime.
        let looked =
            tokio::task::spawn_blocking(move || keys.iter().for_each(|k| state.restore_folders(k)));
        if let Err(error) = looked.await {
            warn!(%error, "cannot access the state folder");
        }
    }
}

/// Publishes an event for every structure when this process has disconnected readers of the bus.
pub async fn report_lost_readers<T>(bus: &Bus, keys: Vec<Keys>) -> T {
    let mut look = tokio::time::interval(LOOK_EVERY);
    look.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        look.tick().await;
        let lost = Audit::of_process().take_lost_readers();
        let Some(last) = lost.last() else {
            continue;
        };
        for keys in &keys {
            if let Err(error) = put_lost_readers(bus, keys, last, lost.len()).await {
                warn!(%error, "cannot report that readers were disconnected");
            }
        }
    }
}

async fn put_lost_readers(
    bus: &Bus,
    keys: &Keys,
    last: &LostReader,
    count: usize,
) -> Result<(), BusError> {
    let what = match count {
        1 => "a connection of the bus was closed".to_owned(),
        _ => format!("{count} connections of the bus were closed"),
    };
    let event = Event {
        structure: keys.structure().clone(),
        time_ns: Clock::of_machine().now_ns(),
        kind: EventKind::ReaderDisconnected,
        subject: last.who.clone(),
        what,
        why: last.why.clone(),
    };
    let events = EventPublisher::declare(bus, keys).await?;
    events.put(&event.legible()).await
}

#[cfg(test)]
mod tests {
    use super::*;
    use spandrel_identify::IdentifyError;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU32, Ordering};

    async fn panics_before(lives: u32, counted: Arc<AtomicU32>) -> Result<(), AppError> {
        let life = counted.fetch_add(1, Ordering::Relaxed);
        assert!(life >= lives, "as it should");
        Ok(())
    }

    #[tokio::test]
    async fn service_restarts_after_a_panic_and_repeated_panics_end_the_process() {
        let counted = Arc::new(AtomicU32::new(0));
        let life = |lives| {
            let counted = counted.clone();
            move || panics_before(lives, counted.clone())
        };
        supervise("alert", "tower".to_owned(), life(2)(), life(2))
            .await
            .unwrap();
        assert_eq!(counted.swap(0, Ordering::Relaxed), 3);
        let error = supervise("alert", "tower".to_owned(), life(99)(), life(99))
            .await
            .unwrap_err();
        assert!(matches!(
            error,
            AppError::Panicked {
                service: "alert",
                ..
            }
        ));
        assert_eq!(counted.load(Ordering::Relaxed) as usize, MOST_PANICS);
    }

    /// Regression test: an aborted service kept running next to its successor, and led.
    #[tokio::test]
    async fn service_ends_when_its_supervisor_is_aborted() {
        let (alive, ended) = tokio::sync::oneshot::channel::<()>();
        let (begun, has_begun) = tokio::sync::oneshot::channel();
        let first = async move {
            let _alive = alive;
            begun.send(()).unwrap();
            std::future::pending().await
        };
        let supervised = tokio::spawn(supervise(
            "alert",
            "tower".to_owned(),
            first,
            std::future::pending,
        ));
        has_begun.await.unwrap();
        supervised.abort();
        let ended = tokio::time::timeout(Duration::from_secs(30), ended).await;
        assert!(ended.expect("the life goes on").is_err());
    }

    /// Regression test: a panic of a filter on its own thread, which its service reports as an
    /// error, ended the process.
    #[tokio::test]
    async fn service_restarts_after_the_loss_of_its_filter_thread() {
        let lost = || {
            AppError::Identify(IdentifyError::ThreadLost {
                structure: "tower".to_owned(),
            })
        };
        let first = async move { Err(lost()) };
        let mut lives = 1;
        let next = || {
            lives += 1;
            async { Ok(()) }
        };
        supervise("identify", "tower".to_owned(), first, next)
            .await
            .unwrap();
        assert_eq!(lives, 2);
    }

    #[tokio::test]
    async fn an_error_ends_a_service_at_once() {
        let fails = || async { Err(AppError::NoStructure) };
        let error = supervise("alert", "tower".to_owned(), fails(), fails)
            .await
            .unwrap_err();
        assert!(matches!(error, AppError::NoStructure));
    }
}
