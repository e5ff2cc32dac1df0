//! Joins the outbox to the bus and to the receivers.

use crate::error::NotifyError;
use crate::outbox::Outbox;
use crate::send::{Receiver, receivers};
use crate::settings::NotifySettings;
use spandrel_bus::{
    AlertMessage, Bus, BusError, DisplayPublisher, Keys, LiveToken, LiveWatch, Name, Service, Status, Subscription,
};
use std::collections::{BTreeMap, BTreeSet};
use std::future::Future;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};
use tokio::task::JoinSet;
use tracing::{info, warn};

/// How often it is looked what is due.
const LOOK_EVERY: Duration = Duration::from_millis(500);
/// How often the status is put.
const STATUS_EVERY: Duration = Duration::from_secs(1);
/// Alerts that wait to be taken.
const ALERTS_WAITING: usize = 4_096;
/// Time for the alert service to say how its alerts stand.
const ANSWER_WITHIN: Duration = Duration::from_secs(2);
/// Time for what is being sent to be sent after a stop.
const END_WITHIN: Duration = Duration::from_secs(5);

/// Tells of the alerts of one or more structures.
pub struct NotifyService {
    sources: Vec<Source>,
    receivers: Vec<Arc<Receiver>>,
    outbox: Outbox,
    bus: Bus,
    asked: JoinSet<Result<Vec<(String, AlertMessage)>, BusError>>,
    service: Name,
    id: Name,
}

struct Source {
    keys: Keys,
    alerts: Subscription<AlertMessage>,
    alert_services: LiveWatch,
    present: BTreeSet<String>,
    status: DisplayPublisher<Status>,
    token: LiveToken,
    taken: u64,
}

impl NotifyService {
    /// Checks the settings, listens to the bus and shows liveliness tokens; `id` names this instance.
    ///
    /// # Errors
    /// When a setting cannot be used, or the bus refuses a declaration.
    pub async fn start(
        structures: &[Keys],
        bus: &Bus,
        settings: &NotifySettings,
        id: Name,
    ) -> Result<Self, NotifyError> {
        settings.check()?;
        let receivers: Vec<Arc<Receiver>> = receivers(settings)?.into_iter().map(Arc::new).collect();
        let mut service = Self {
            outbox: Outbox::new(receivers.iter().map(|receiver| receiver.wish()).collect()),
            sources: Vec::new(),
            receivers,
            bus: bus.clone(),
            asked: JoinSet::new(),
            service: Name::new(Service::Notify.as_str())?,
            id,
        };
        for keys in structures {
            service.sources.push(Source {
                alerts: bus.subscribe(keys.all_alerts(), ALERTS_WAITING).await?,
                alert_services: bus.watch_live(keys.all_live(Service::Alert)).await?,
                present: BTreeSet::new(),
                status: bus.publish_display(keys.status(Service::Notify, &service.id)).await?,
                token: bus.announce(keys.live(Service::Notify, &service.id)).await?,
                keys: keys.clone(),
                taken: 0,
            });
        }
        let shown: Vec<String> = service.receivers.iter().map(|receiver| receiver.shown()).collect();
        info!(receivers = shown.join("; "), structures = structures.len(), "notices ready");
        Ok(service)
    }

    /// Runs until `stop`; what is being sent by then is given time.
    ///
    /// # Errors
    /// When the bus is closed underneath.
    pub async fn run(mut self, stop: impl Future<Output = ()>) -> Result<(), NotifyError> {
        let mut sending = JoinSet::new();
        let told = tokio::select! {
            told = self.tell(&mut sending) => told,
            () = stop => Ok(()),
        };
        let all = async { while sending.join_next().await.is_some() {} };
        let is_late = tokio::time::timeout(END_WITHIN, all).await.is_err();
        if is_late || self.outbox.waiting() > 0 {
            warn!(waiting = self.outbox.waiting(), "not all notices have been sent");
        }
        for source in self.sources {
            source.token.withdraw().await?;
        }
        told
    }

    async fn tell(&mut self, sending: &mut JoinSet<(usize, Result<(), String>)>) -> Result<(), NotifyError> {
        #[expect(clippy::disallowed_methods, reason = "when a notice is sent again goes by the clock of the machine")]
        let start = Instant::now();
        let mut look = tokio::time::interval(LOOK_EVERY);
        let mut status = tokio::time::interval(STATUS_EVERY);
        loop {
            tokio::select! {
                _ = look.tick() => {}
                _ = status.tick() => self.put_status().await?,
                Some(ended) = sending.join_next() => {
                    // a notice whose sending panicked counts as failed
                    if let Ok((receiver, result)) = ended {
                        self.ended(receiver, result, start.elapsed());
                    }
                }
            }
            self.take(start.elapsed());
            for notice in self.outbox.due(start.elapsed()) {
                let Some(receiver) = self.receivers.get(notice.receiver).cloned() else { continue };
                sending.spawn(async move {
                    let number = notice.receiver;
                    let sent = tokio::task::spawn_blocking(move || receiver.send(&notice)).await;
                    (number, sent.unwrap_or_else(|error| Err(error.to_string())))
                });
            }
        }
    }

    fn ended(&mut self, receiver: usize, result: Result<(), String>, now: Duration) {
        let shown = self.receivers.get(receiver).map(|receiver| receiver.shown()).unwrap_or_default();
        match &result {
            Ok(()) => info!(receiver = shown, "alert told"),
            Err(reason) if (self.outbox.failures + 1).is_power_of_two() => {
                warn!(receiver = shown, reason, "alert not told, it is tried again");
            }
            Err(_) => {}
        }
        self.outbox.done(receiver, result.is_ok(), now);
    }

    fn take(&mut self, now: Duration) {
        for source in &mut self.sources {
            let root = source.keys.root();
            let in_place = source
                .alerts
                .gather(root, |alert| Some((&alert.structure, spandrel_bus::Topic::Alert(alert.parameter.clone()))));
            for alert in in_place {
                source.taken += 1;
                self.outbox.take(&alert, now);
            }
            // an alert that was raised while nobody listened is told by whoever decided it
            let present = source.alert_services.present();
            if present.difference(&source.present).next().is_some() {
                let (bus, alerts) = (self.bus.clone(), source.keys.all_alerts());
                self.asked.spawn(async move { bus.ask(&alerts, ANSWER_WITHIN).await });
            }
            source.present = present;
        }
        while let Some(answer) = self.asked.try_join_next() {
            match answer {
                Ok(Ok(alerts)) => alerts.iter().for_each(|(_, alert)| self.outbox.take(alert, now)),
                Ok(Err(error)) => warn!(%error, "cannot ask how the alerts stand"),
                Err(error) => warn!(%error, "question how the alerts stand is lost"),
            }
        }
    }

    async fn put_status(&self) -> Result<(), NotifyError> {
        #[expect(clippy::disallowed_methods, reason = "a status tells when it was put")]
        let now = SystemTime::now();
        let time_ns = now.duration_since(UNIX_EPOCH).map_or(0, |elapsed| elapsed.as_nanos() as i64);
        let counts = [("failed-notices", self.outbox.failures), ("given-up-notices", self.outbox.given_up)];
        for source in &self.sources {
            let refused =
                source.alerts.refused().into_iter().map(|(reason, count)| (format!("refused-{reason}"), count));
            let counts =
                counts.iter().filter(|(_, count)| *count > 0).map(|(name, count)| ((*name).to_owned(), *count));
            let drops: BTreeMap<String, u64> = refused.chain(counts).collect();
            let status = Status {
                structure: source.keys.structure().clone(),
                service: self.service.clone(),
                id: self.id.clone(),
                time_ns,
                lag_s: None,
                pace: None,
                state: None,
                done: source.taken,
                drops,
                restarts: 0,
                version: env!("CARGO_PKG_VERSION").to_owned(),
            };
            source.status.put(&status).await?;
        }
        Ok(())
    }
}
