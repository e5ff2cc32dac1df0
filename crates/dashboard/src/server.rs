//! State shared by all requests: the stores of the structures, and access to the bus.

use crate::gate::Gate;
use crate::history::Earlier;
use crate::overview::{Overview, overview};
use crate::places::{Place, Places};
use crate::store::Store;
use crate::stretch::{Stretch, Unreadable};
use spandrel_bus::{
    Acknowledgement, AlertMessage, AlertState, Annotation, Bus, BusError, Event, FrameBlock,
    HistoryLog, HistorySpan, JudgementCourse, Keys, Name, ReportPage, Service, SpanQuery,
};
use spandrel_listener::Input;
use spandrel_service::Clock;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};
use tokio::task::JoinSet;
use tracing::warn;

/// Time limit for a message of the service judge, which may be learning a reference.
const JUDGE_WITHIN: Duration = Duration::from_secs(10);

/// Time limit for a reply of the service reports.
const REPORT_WITHIN: Duration = Duration::from_secs(5);

/// Time limit for a reply of the history service.
const HISTORY_WITHIN: Duration = Duration::from_secs(3);

/// Time limit for the start of the last of several queries to the history service.
const ALL_HISTORY_WITHIN: Duration = Duration::from_secs(12);

/// Maximum number of concurrent queries of one request to the history service. It replies to one
/// query at a time, and drops those that exceed its queue.
const MOST_QUERIES: usize = 8;

/// Time limit for a reply of ingest with some frames.
const FRAMES_WITHIN: Duration = Duration::from_secs(3);

/// Maximum number of concurrent exports of samples, because each one takes much memory.
const MOST_EXPORTS: usize = 1;

/// Time limit for the alert service to confirm an acknowledgement.
const ANSWER_WITHIN: Duration = Duration::from_secs(2);

/// Queue length for changes of an alert while waiting for the confirmation.
const CHANGES_WAITING: usize = 64;

/// Queue length for events while waiting for the confirmation of an annotation.
const EVENTS_WAITING: usize = 256;

/// Replies of the history services to the queries of one request.
#[derive(Debug, Default)]
pub(crate) struct HistoryReplies {
    pub(crate) spans: Vec<(Earlier, HistorySpan)>,
    /// Whether a service has not replied to each query in time, so that data can be missing.
    pub(crate) is_incomplete: bool,
}

/// State shared by the requests and the subscriber to the bus.
#[derive(Debug)]
pub(crate) struct Server {
    bus: Bus,
    structures: Vec<(Keys, Mutex<Store>)>,
    sockets: Places,
    exports: Arc<Semaphore>,
    stopped: watch::Sender<bool>,
    gate: Gate,
    cannot_acknowledge: Option<String>,
    started: Instant,
}

impl Server {
    pub(crate) fn new(
        bus: Bus,
        structures: Vec<(Keys, Store)>,
        gate: Gate,
        cannot_acknowledge: Option<String>,
    ) -> Self {
        let structures = structures
            .into_iter()
            .map(|(keys, store)| (keys, Mutex::new(store)))
            .collect();
        #[expect(
            clippy::disallowed_methods,
            reason = "sessions of browsers end by the monotonic clock"
        )]
        let started = Instant::now();
        Self {
            bus,
            structures,
            sockets: Places::of_sockets(),
            exports: Arc::new(Semaphore::new(MOST_EXPORTS)),
            stopped: watch::Sender::new(false),
            gate,
            cannot_acknowledge,
            started,
        }
    }

    /// Returns the gate, which admits visitors.
    pub(crate) fn gate(&self) -> &Gate {
        &self.gate
    }

    /// Returns the reason why the router would drop acknowledgements, or `None` if it would not.
    pub(crate) fn cannot_acknowledge(&self) -> Option<&str> {
        self.cannot_acknowledge.as_deref()
    }

    /// Returns the time since the start of the page.
    pub(crate) fn since_start(&self) -> Duration {
        self.started.elapsed()
    }

    /// Returns the store of one structure.
    pub(crate) fn store(&self, name: &str) -> Option<MutexGuard<'_, Store>> {
        let (_, store) = self
            .structures
            .iter()
            .find(|(keys, _)| keys.structure().as_str() == name)?;
        Some(lock(store))
    }

    /// Returns the stores of all structures in sequence.
    pub(crate) fn stores(&self) -> impl Iterator<Item = MutexGuard<'_, Store>> {
        self.structures.iter().map(|(_, store)| lock(store))
    }

    /// Returns the overviews of all structures, the most urgent first.
    pub(crate) fn overviews(&self) -> Vec<Overview> {
        let mut all: Vec<Overview> = self.stores().map(|store| overview(&store)).collect();
        all.sort_by(|a, b| a.level.cmp(&b.level).then(a.name.cmp(&b.name)));
        all
    }

    /// Returns the names of the structures.
    pub(crate) fn names(&self) -> Vec<&str> {
        self.structures
            .iter()
            .map(|(keys, _)| keys.structure().as_str())
            .collect()
    }

    /// Publishes an acknowledgement of an alert with state `before` and returns the new state.
    ///
    /// Returns `None` if the alert service does not confirm in time. Later requests see the
    /// acknowledgement.
    pub(crate) async fn acknowledge(
        &self,
        acknowledgement: &Acknowledgement,
        before: AlertState,
    ) -> Result<Option<AlertState>, BusError> {
        let Acknowledgement {
            structure,
            parameter,
            who,
            ..
        } = acknowledgement;
        let Some((keys, store)) = self
            .structures
            .iter()
            .find(|(keys, _)| keys.structure() == structure)
        else {
            return Ok(None);
        };
        // Before publishing, because the confirmation may arrive at once.
        let alerts = self
            .bus
            .subscribe::<AlertMessage>(keys.alert(parameter), CHANGES_WAITING)
            .await?;
        let publisher = self
            .bus
            .publish_display(keys.acknowledge(parameter))
            .await?;
        publisher.put(acknowledgement).await?;
        let is_answer = |alert: &AlertMessage| {
            let is_taken = match before {
                AlertState::Raised | AlertState::Unconfirmed => {
                    alert.acknowledged_by.as_ref() == Some(who)
                }
                _ => !alert.is_unseen(), // a cleared or pending alert has no name of a person
            };
            is_taken && alert.structure == *structure && alert.parameter == *parameter
        };
        let answered = async {
            while let Ok((_, alert)) = alerts.messages().recv_async().await {
                if is_answer(&alert) {
                    return Some(alert);
                }
            }
            None
        };
        let Ok(Some(alert)) = tokio::time::timeout(ANSWER_WITHIN, answered).await else {
            return Ok(None);
        };
        let state = alert.state;
        // The regular subscription delivers these messages a little later.
        let mut store = lock(store);
        store.handle(Input::Acknowledgement(acknowledgement.clone()));
        store.handle(Input::Alert(alert));
        Ok(Some(state))
    }

    /// Publishes an annotation. Returns whether the service `judge` confirms in time that it has
    /// kept the annotation.
    pub(crate) async fn annotate(&self, annotation: &Annotation) -> Result<bool, BusError> {
        let mut structures = self.structures.iter();
        let Some((keys, _)) =
            structures.find(|(keys, _)| *keys.structure() == annotation.structure)
        else {
            return Ok(false);
        };
        // Before publishing, because the confirmation may arrive at once.
        let events = self
            .bus
            .subscribe::<Event>(keys.event(), EVENTS_WAITING)
            .await?;
        let publisher = self.bus.publish_display(keys.annotation()).await?;
        publisher.put(annotation).await?;
        let confirmed = async {
            while let Ok((_, event)) = events.messages().recv_async().await {
                if annotation.is_confirmed_by(&event) {
                    return true;
                }
            }
            false
        };
        let confirmed = tokio::time::timeout(JUDGE_WITHIN, confirmed).await;
        Ok(confirmed.unwrap_or(false))
    }

    /// Queries the history services for data from before the stored data. The replies state whether
    /// one is missing.
    pub(crate) async fn ask_history(&self, structure: &str, all: Vec<Earlier>) -> HistoryReplies {
        let mut structures = self.structures.iter();
        let Some((keys, store)) =
            structures.find(|(keys, _)| keys.structure().as_str() == structure)
        else {
            return HistoryReplies::default();
        };
        let services = {
            let store = lock(store);
            let present = store.state.present();
            present.filter(|of| of.0 == Service::History).count()
        };
        let places = Arc::new(Semaphore::new(MOST_QUERIES));
        let end = tokio::time::Instant::now() + ALL_HISTORY_WITHIN;
        let mut asked = JoinSet::new();
        for earlier in all {
            let selector = format!("{}?{}", keys.history(&earlier.name), earlier.query);
            let (bus, places) = (self.bus.clone(), places.clone());
            asked.spawn(async move {
                let place = tokio::time::timeout_at(end, places.acquire_owned()).await;
                let Ok(Ok(_place)) = place else {
                    return (earlier, Vec::new());
                };
                let answers = bus.ask::<HistorySpan>(&selector, HISTORY_WITHIN).await;
                let answers = answers.unwrap_or_else(|error| {
                    warn!(%error, "cannot query the history");
                    Vec::new()
                });
                (earlier, answers)
            });
        }
        let mut replies = HistoryReplies::default();
        for (earlier, answers) in asked.join_all().await {
            // A service that has disappeared since the request was read counts as late.
            replies.is_incomplete |= answers.len() < services.max(1);
            let spans = answers.into_iter().map(|(_, span)| span);
            // If several services reply, take the reply with the most rows.
            let most = spans.max_by_key(|span| span.rows.time_s.len());
            replies.spans.extend(most.map(|most| (earlier, most)));
        }
        replies
    }

    /// Queries the history service for the alerts, acknowledgements and events of a period. Returns
    /// `None` without a reply in time.
    pub(crate) async fn ask_log(&self, structure: &str, query: &SpanQuery) -> Option<HistoryLog> {
        let mut structures = self.structures.iter();
        let (keys, _) = structures.find(|(keys, _)| keys.structure().as_str() == structure)?;
        let selector = format!("{}?{query}", keys.history_log());
        let answers = self.bus.ask::<HistoryLog>(&selector, HISTORY_WITHIN);
        let answers = answers
            .await
            .inspect_err(|error| warn!(%error, "cannot query the log of the history"))
            .ok()?;
        // If several services reply, take the reply with the most messages.
        let logs = answers.into_iter().map(|(_, log)| log);
        logs.max_by_key(|log| log.alerts.len() + log.acknowledgements.len() + log.events.len())
    }

    /// Queries the service `judge` for the history of a quantity. Returns `None` without a reply in
    /// time.
    pub(crate) async fn ask_course(
        &self,
        structure: &str,
        quantity: &Name,
        query: &SpanQuery,
    ) -> Option<JudgementCourse> {
        let mut structures = self.structures.iter();
        let (keys, _) = structures.find(|(keys, _)| keys.structure().as_str() == structure)?;
        let selector = format!("{}?{query}", keys.judgement_course(quantity));
        let answers = self.bus.ask::<JudgementCourse>(&selector, JUDGE_WITHIN);
        let answers = answers
            .await
            .inspect_err(|error| warn!(%error, "cannot query the service judge"))
            .ok()?;
        // If several services reply, take the reply with the most days.
        let courses = answers.into_iter().map(|(_, course)| course);
        courses.max_by_key(|course| course.rows.len())
    }

    /// Queries the service reports for a report of an earthquake, or for the list of all. Returns
    /// `None` without a reply in time, as for a report that does not exist.
    pub(crate) async fn ask_report(&self, structure: &str, report: &Name) -> Option<ReportPage> {
        let mut structures = self.structures.iter();
        let (keys, _) = structures.find(|(keys, _)| keys.structure().as_str() == structure)?;
        let key = keys.report(report);
        let answers = self.bus.ask::<ReportPage>(&key, REPORT_WITHIN);
        let answers = answers
            .await
            .inspect_err(|error| warn!(%error, "cannot query the service reports"))
            .ok()?;
        answers.into_iter().map(|(_, page)| page).next()
    }

    /// Reads the frames of a stretch from the recording of ingest. Returns `None` if ingest does
    /// not reply in time.
    pub(crate) async fn read_stretch(
        &self,
        structure: &str,
        mut stretch: Stretch,
    ) -> Result<Option<Stretch>, Unreadable> {
        let mut structures = self.structures.iter();
        let Some((keys, _)) = structures.find(|(keys, _)| keys.structure().as_str() == structure)
        else {
            return Ok(None);
        };
        let key = keys.recording();
        while let Some(range) = stretch.next() {
            let answer = self.bus.ask_past::<FrameBlock>(&key, range, FRAMES_WITHIN);
            let answer = answer.await.inspect_err(|error| {
                warn!(%error, "cannot query the recording");
            });
            match answer.ok().flatten() {
                Some(answer) => stretch.take(&answer)?,
                None => return Ok(None),
            }
        }
        Ok(Some(stretch))
    }

    /// Reserves the place for an export of samples. Returns `None` if another one is running.
    pub(crate) fn admit_export(&self) -> Option<OwnedSemaphorePermit> {
        self.exports.clone().try_acquire_owned().ok()
    }

    /// Reserves a place for one more WebSocket. Returns `None` if all places are taken by clients
    /// that answer.
    pub(crate) fn admit(&self, address: IpAddr) -> Option<Place> {
        let now = tokio::time::Instant::now();
        let place = self.sockets.take(address, now)?;
        place.note_answer(now);
        Some(place)
    }

    /// Requests the end of all connections.
    pub(crate) fn stop(&self) {
        self.stopped.send_replace(true);
    }

    /// Returns a receiver that becomes `true` when all connections must end.
    pub(crate) fn stopped(&self) -> watch::Receiver<bool> {
        self.stopped.subscribe()
    }
}

/// Locks a store. After a panic the store is still consistent, because each input is processed in
/// one call.
fn lock(store: &Mutex<Store>) -> MutexGuard<'_, Store> {
    store.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Returns the wall clock time (ns since the Unix epoch, UTC).
pub(crate) fn now_ns() -> i64 {
    Clock::of_machine().now_ns()
}

/// Returns the wall clock time (s since the Unix epoch, UTC).
pub(crate) fn now_s() -> f64 {
    now_ns() as f64 / 1e9
}
