//! Connects the outbox to the bus and to the receivers.

use crate::error::NotifyError;
use crate::memory::Memory;
use crate::outbox::{GIVE_UP_AFTER, Outbox, Remembered, Wish};
use crate::send::{Receiver, receivers};
use crate::settings::NotifySettings;
use spandrel_bus::{AlertMessage, BoxedFuture, Keys, LiveToken, Name, Service};
use spandrel_listener::{DisplayTopic, Input, Listener, Needs};
use spandrel_service::{Monitored, Report, STATUS_EVERY, ServiceInstance, StatusPublisher, Stop};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::task::{JoinError, JoinSet};
use tracing::{info, warn};

/// The alerts. A new alert service reports changes that were decided while no link existed.
const NEEDS: Needs = Needs {
    topics: &[DisplayTopic::Alerts],
    services: &[Service::Alert],
    logs: &[Service::Alert],
};
/// Interval between checks for notices that are due.
const LOOK_EVERY: Duration = Duration::from_millis(500);
/// Time limit after a stop for the notices that are being sent.
const END_WITHIN: Duration = Duration::from_secs(5);

/// What the notifications need to start.
#[derive(Clone, Debug)]
pub struct NotifyPlan {
    /// The instance.
    pub instance: ServiceInstance,
    /// The structures.
    pub structures: Vec<Monitored>,
    /// The receivers.
    pub settings: NotifySettings,
}

/// The notification service of one or more structures.
pub struct NotifyService {
    sources: Vec<Source>,
    receivers: Vec<Arc<Receiver>>,
    outbox: Outbox,
    clock: Monotonic,
}

/// The reply of an alert service.
#[derive(Default)]
struct Told {
    /// Its last changes, oldest first.
    log: Vec<AlertMessage>,
    /// The current state of each alert.
    standing: Vec<AlertMessage>,
}

/// The monotonic time used by the outbox.
///
/// It starts at [`GIVE_UP_AFTER`], so that the age of restored notices can be subtracted.
struct Monotonic(Instant);

impl Monotonic {
    fn new() -> Self {
        #[expect(
            clippy::disallowed_methods,
            reason = "when a notice is sent again goes by the clock of the machine"
        )]
        let start = Instant::now();
        Self(start)
    }

    fn now(&self) -> Duration {
        GIVE_UP_AFTER + self.0.elapsed()
    }
}

struct Source {
    keys: Keys,
    listener: Listener,
    status: StatusPublisher,
    token: LiveToken,
    memory: Option<Memory>,
    /// Whether a checkpoint or an earlier reply has supplied the state of the alerts.
    has_heard: bool,
}

impl spandrel_service::Service for NotifyService {
    type Plan = NotifyPlan;
    type Error = NotifyError;

    /// Validates the settings, restores checkpoints, subscribes to alerts and announces liveliness
    /// tokens.
    ///
    /// # Errors
    /// Fails if a setting is invalid, a folder cannot be written, or the bus rejects a declaration.
    fn start(plan: &NotifyPlan) -> BoxedFuture<'_, Result<Self, NotifyError>> {
        Self::start_from(plan)
    }

    /// Runs until `stop`. Notices that are being sent may finish within 5 s.
    ///
    /// # Errors
    /// Fails if the bus is closed.
    fn run<'a>(self, stop: Stop<'a>) -> BoxedFuture<'a, Result<(), NotifyError>> {
        self.run_until(stop)
    }
}

impl NotifyService {
    fn start_from(plan: &NotifyPlan) -> BoxedFuture<'_, Result<Self, NotifyError>> {
        Box::pin(async move {
            let NotifyPlan {
                instance,
                structures,
                settings,
            } = plan;
            let bus = &instance.bus;
            settings.check()?;
            let receivers: Vec<Arc<Receiver>> =
                receivers(settings)?.into_iter().map(Arc::new).collect();
            let mut service = Self {
                outbox: Outbox::new(wishes(&receivers)),
                sources: Vec::new(),
                receivers,
                clock: Monotonic::new(),
            };
            for Monitored {
                keys, remembering, ..
            } in structures
            {
                let memory = remembering
                    .as_ref()
                    .map(|remembering| Memory::open(&remembering.folder, keys.structure()))
                    .transpose()?;
                let (memory, recalled) =
                    memory.map_or((None, None), |(memory, recalled)| (Some(memory), recalled));
                let has_heard = recalled.is_some();
                if let Some((remembered, away)) = recalled {
                    service.recall(keys.structure(), remembered, away);
                }
                service.sources.push(Source {
                    listener: Listener::start(bus, keys.root(), Some(keys.structure()), NEEDS)
                        .await?,
                    status: instance.publish_status(Service::Notify, keys).await?,
                    token: instance.announce(Service::Notify, keys).await?,
                    keys: keys.clone(),
                    memory,
                    has_heard,
                });
            }
            let shown: Vec<String> = service
                .receivers
                .iter()
                .map(|receiver| receiver.shown())
                .collect();
            info!(
                receivers = shown.join("; "),
                structures = structures.len(),
                "notices ready"
            );
            Ok(service)
        })
    }

    fn recall(&mut self, structure: &Name, remembered: Remembered, away: Duration) {
        let lost = self
            .outbox
            .recall(structure, remembered, self.clock.now(), away);
        if lost > 0 {
            let structure = structure.as_str();
            warn!(
                structure,
                notices = lost,
                "dropped notices whose receivers are no longer in the configuration"
            );
        }
    }

    fn run_until(mut self, stop: BoxedFuture<'_, ()>) -> BoxedFuture<'_, Result<(), NotifyError>> {
        Box::pin(async move {
            let mut sending = JoinSet::new();
            let told = tokio::select! {
                told = self.tell(&mut sending) => told,
                () = stop => Ok(()),
            };
            let all = async {
                while let Some(ended) = sending.join_next().await {
                    self.ended(ended);
                }
            };
            let is_late = tokio::time::timeout(END_WITHIN, all).await.is_err();
            self.keep();
            if is_late || self.outbox.waiting() > 0 {
                warn!(
                    waiting = self.outbox.waiting(),
                    "some notices were not sent; saved notices will be sent after the next start"
                );
            }
            for source in self.sources {
                source.token.withdraw().await?;
            }
            told
        })
    }

    async fn tell(
        &mut self,
        sending: &mut JoinSet<(usize, Result<(), String>)>,
    ) -> Result<(), NotifyError> {
        let mut look = tokio::time::interval(LOOK_EVERY);
        let mut status = tokio::time::interval(STATUS_EVERY);
        loop {
            tokio::select! {
                _ = look.tick() => {}
                _ = status.tick() => self.put_status().await?,
                Some(ended) = sending.join_next() => self.ended(ended),
            }
            self.take();
            // The checkpoint precedes the first attempt, so that a retry after a crash has the same
            // key.
            self.keep();
            for notice in self.outbox.due(self.clock.now()) {
                let Some(receiver) = self.receivers.get(notice.receiver).cloned() else {
                    continue;
                };
                sending.spawn(async move {
                    let number = notice.receiver;
                    let sent = tokio::task::spawn_blocking(move || receiver.send(&notice)).await;
                    (number, sent.unwrap_or_else(|error| Err(error.to_string())))
                });
            }
        }
    }

    /// Records the result of an attempt. Ignores an attempt whose task has panicked.
    fn ended(&mut self, ended: Result<(usize, Result<(), String>), JoinError>) {
        let Ok((receiver, result)) = ended else {
            return;
        };
        let shown = self
            .receivers
            .get(receiver)
            .map(|receiver| receiver.shown())
            .unwrap_or_default();
        match &result {
            Ok(()) => info!(receiver = shown, "notice sent"),
            Err(reason) if (self.outbox.failures + 1).is_power_of_two() => {
                warn!(receiver = shown, reason, "notice not sent; retrying");
            }
            Err(_) => {}
        }
        self.outbox.done(receiver, result.is_ok(), self.clock.now());
    }

    fn take(&mut self) {
        let now = self.clock.now();
        for source in &mut self.sources {
            let mut told = Told::default();
            for input in source.listener.gather() {
                match input {
                    Input::Alert(alert) => self.outbox.take(&alert, now),
                    Input::LoggedAlert(alert) => told.log.push(alert),
                    Input::StandingAlert(alert) => told.standing.push(alert),
                    _ => {}
                }
            }
            source.catch_up(&told, &mut self.outbox, now);
        }
    }

    /// Saves checkpoints of all structures that have changed.
    fn keep(&mut self) {
        let now = self.clock.now();
        for structure in self.outbox.take_changed() {
            let of_structure = |source: &&mut Source| *source.keys.structure() == structure;
            let memory = self
                .sources
                .iter_mut()
                .find(of_structure)
                .and_then(|source| source.memory.as_mut());
            if let Some(memory) = memory {
                let remembered = self.outbox.remembered(&structure, now);
                tokio::task::block_in_place(|| memory.keep(remembered));
            }
        }
    }

    async fn put_status(&self) -> Result<(), NotifyError> {
        let counts = [
            ("failed-notices", self.outbox.failures),
            ("given-up-notices", self.outbox.given_up),
        ];
        for source in &self.sources {
            let counts = counts
                .iter()
                .filter(|(_, count)| *count > 0)
                .map(|(name, count)| ((*name).to_owned(), *count));
            let unkept = source
                .memory
                .as_ref()
                .and_then(|memory| memory.failures().drops());
            let refused = source.listener.refused().into_iter();
            let drops: BTreeMap<String, u64> = refused.chain(counts).chain(unkept).collect();
            let report = Report {
                done: source.listener.taken(),
                drops,
                ..Report::default()
            };
            source.status.put(report).await?;
        }
        Ok(())
    }
}

impl Source {
    /// Processes the reply of an alert service.
    ///
    /// The first reply ever received supplies only the current alerts: older changes are recorded
    /// without sending them.
    fn catch_up(&mut self, told: &Told, outbox: &mut Outbox, now: Duration) {
        let Told { log, standing } = told;
        if self.has_heard {
            log.iter().for_each(|alert| outbox.take(alert, now));
        } else {
            let is_past = |alert: &&AlertMessage| !standing.contains(alert);
            log.iter()
                .filter(is_past)
                .for_each(|alert| drop(outbox.learn(alert)));
        }
        standing.iter().for_each(|alert| outbox.take(alert, now));
        // An empty reply means that the service did not answer in time.
        self.has_heard |= !standing.is_empty();
    }
}

/// Returns the request of each receiver under a name that is the same after a restart.
///
/// The name is the logged address, with a number to distinguish receivers at the same address.
fn wishes(receivers: &[Arc<Receiver>]) -> Vec<Wish> {
    let mut seen: BTreeMap<String, usize> = BTreeMap::new();
    let named = |receiver: &Arc<Receiver>| {
        let shown = receiver.shown();
        let number = seen.entry(shown.clone()).or_default();
        *number += 1;
        receiver.wish(format!("{shown} {number}"))
    };
    receivers.iter().map(named).collect()
}
