//! Connects the outbox to the bus and to the receivers.

use crate::clocks::{ClockChange, Clocks};
use crate::content::{Earthquake, Facts, Report, Scene, alert_key, iso_8601};
use crate::error::NotifyError;
use crate::lasting::LastingChanges;
use crate::memory::{Memory, Recalled, Situation};
use crate::muting::Change;
use crate::origin::{Origins, Signs};
use crate::outbox::{GIVE_UP_AFTER, Moment, Notice, Outbox, Wish};
use crate::send::{Receiver, receivers};
use crate::settings::NotifySettings;
use crate::sight::Sight;
use spandrel_bus::{
    AlertMessage, BoxedFuture, Event, EventKind, FitVerdict, JudgementDisplay, Keys, LiveToken,
    LiveWatch, Maintenance, Name, Service, Subscription, parse_key, reported_pace,
};
use spandrel_listener::{DisplayTopic, Input, Listener, Needs, StructureState};
use spandrel_service::{
    Clock, EventPublisher, Monitored, Report as StatusReport, STATUS_EVERY, ServiceInstance,
    StatusPublisher, Stop,
};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::task::{JoinError, JoinSet};
use tracing::{error, info, warn};

/// The alerts, the monitoring and the clocks, and what shows whether the samples are measured. An
/// event precedes the status with its consequences. A new alert service reports changes that were
/// decided while no link existed.
const NEEDS: Needs = Needs {
    topics: &[
        DisplayTopic::Events,
        DisplayTopic::Statuses,
        DisplayTopic::Monitoring,
        DisplayTopic::Judgements,
        DisplayTopic::Alerts,
    ],
    services: &[Service::Alert, Service::Sensor],
    logs: &[Service::Alert],
};
/// Interval between checks for notices that are due.
const LOOK_EVERY: Duration = Duration::from_millis(500);
/// Time between a change of an alert and its notice. Meanwhile, the pace of the samples and other
/// changes of the same moment arrive, which the notice states.
const SETTLES_AFTER: Duration = Duration::from_millis(2500);
/// Queue length for maintenance. People send it.
const MAINTENANCE_WAITING: usize = 64;
/// Time limit after a stop for the notices that are being sent.
const END_WITHIN: Duration = Duration::from_secs(5);

/// Start-up settings of the notification service.
#[derive(Clone, Debug)]
pub struct NotifyPlan {
    /// Session, id and clock of the service.
    pub instance: ServiceInstance,
    /// The structures whose changes cause notices.
    pub structures: Vec<Monitored>,
    /// The receivers of the notices, and when they are notified.
    pub settings: NotifySettings,
}

/// The notification service of one or more structures.
pub struct NotifyService {
    sources: Vec<Source>,
    receivers: Vec<Arc<Receiver>>,
    outbox: Outbox,
    clock: Monotonic,
    wall: Clock,
}

/// An attempt to send a notice.
struct Attempt {
    notice: Notice,
    /// The reason of a failure, without secrets.
    result: Result<(), String>,
}

/// The reply of an alert service.
#[derive(Default)]
struct Told {
    /// Its last changes, oldest first.
    log: Vec<AlertMessage>,
    /// The current state of each alert, and whether it differs from the known one. The same reply
    /// arrives every half minute.
    standing: Vec<(AlertMessage, bool)>,
}

/// The monotonic time used by the outbox.
///
/// It starts at [`GIVE_UP_AFTER`], so that the age of restored notices can be subtracted.
struct Monotonic(Instant);

impl Monotonic {
    fn new() -> Self {
        #[expect(
            clippy::disallowed_methods,
            reason = "the time of the next attempt is measured with the monotonic clock"
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
    facts: Facts,
    state: StructureState,
    sight: Sight,
    origins: Origins,
    /// Changes of alerts whose notices are not composed yet, with the time for it. The queue of the
    /// listener bounds it.
    fresh: VecDeque<(AlertMessage, Duration)>,
    /// Lasting changes whose notices are not composed yet, with the time for it.
    changes: VecDeque<(JudgementDisplay, Duration)>,
    judged: LastingChanges,
    /// The latest earthquake since the start of the service.
    earthquake: Option<Earthquake>,
    /// Reports of earthquakes whose notices are not composed yet. The queue of the listener bounds
    /// it.
    reported: Vec<Event>,
    clocks: Clocks,
    /// Changes of clocks whose notices are not composed yet. The nodes of the structure bound it.
    clock_changes: Vec<ClockChange>,
    /// Number of alerts received.
    taken: u64,
    simulated: LiveWatch,
    maintenance: Subscription<Maintenance>,
    events: EventPublisher,
}

impl spandrel_service::Service for NotifyService {
    type Plan = NotifyPlan;
    type Error = NotifyError;

    /// Validates the settings, restores checkpoints, subscribes to alerts and announces liveliness
    /// tokens.
    ///
    /// # Errors
    /// Returns an error if a setting is invalid, a folder cannot be written, or the bus rejects a
    /// declaration.
    fn start(plan: &NotifyPlan) -> BoxedFuture<'_, Result<Self, NotifyError>> {
        Self::start_from(plan)
    }

    /// Runs until `stop`. Notices that are being sent may finish within 5 s.
    ///
    /// # Errors
    /// Returns an error if the bus is closed.
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
            settings.check()?;
            let receivers: Vec<Arc<Receiver>> =
                receivers(settings)?.into_iter().map(Arc::new).collect();
            let mut service = Self {
                outbox: Outbox::new(wishes(&receivers)),
                sources: Vec::new(),
                receivers,
                clock: Monotonic::new(),
                wall: instance.clock,
            };
            for monitored in structures {
                service.add_source(monitored, plan).await?;
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

    /// Subscribes to one more structure, and restores its notices of an earlier run.
    async fn add_source(
        &mut self,
        monitored: &Monitored,
        plan: &NotifyPlan,
    ) -> Result<(), NotifyError> {
        let NotifyPlan {
            instance, settings, ..
        } = plan;
        let bus = &instance.bus;
        let Monitored {
            structure,
            keys,
            remembering,
        } = monitored;
        let memory = remembering
            .as_ref()
            .map(|remembering| Memory::open(&remembering.folder, keys.structure()))
            .transpose()?;
        let (memory, recalled) =
            memory.map_or((None, None), |(memory, recalled)| (Some(memory), recalled));
        let has_heard = recalled.is_some();
        let situation = recalled
            .map(|recalled| self.recall(keys.structure(), recalled))
            .unwrap_or_default();
        let now = self.clock.now();
        let mut sight = Sight::new(keys.structure().clone(), settings.delays(), now);
        sight.told = situation.told;
        let due = now + SETTLES_AFTER;
        let fresh = situation.fresh.into_iter().map(|alert| (alert, due));
        self.sources.push(Source {
            facts: facts(monitored, settings),
            state: StructureState::default(),
            sight,
            origins: situation.origins,
            fresh: fresh.collect(),
            changes: VecDeque::new(),
            judged: LastingChanges::default(),
            earthquake: None,
            reported: Vec::new(),
            clocks: Clocks::new(
                keys.structure().clone(),
                structure
                    .nodes()
                    .iter()
                    .filter_map(|node| Name::new(node.name()).ok())
                    .collect(),
                self.outbox.wrong_clocks(keys.structure()),
            ),
            clock_changes: Vec::new(),
            taken: 0,
            simulated: bus.watch_live(keys.all_simulated()).await?,
            maintenance: bus
                .subscribe(keys.maintenance(), MAINTENANCE_WAITING)
                .await?,
            events: EventPublisher::declare(bus, keys).await?,
            listener: Listener::start(bus, keys.root(), Some(keys.structure()), NEEDS).await?,
            status: instance.publish_status(Service::Notify, keys).await?,
            token: instance.announce(Service::Notify, keys).await?,
            keys: keys.clone(),
            memory,
            has_heard,
        });
        Ok(())
    }

    /// Restores the notices of an earlier run. Returns what else was known.
    fn recall(&mut self, structure: &Name, recalled: Recalled) -> Situation {
        let Recalled {
            notices,
            situation,
            away,
        } = recalled;
        let lost = self
            .outbox
            .recall(structure, notices, self.clock.now(), away);
        if lost > 0 {
            let structure = structure.as_str();
            warn!(
                structure,
                notices = lost,
                "dropped notices whose receivers are no longer in the configuration"
            );
        }
        situation
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
                    // After a failure of the bus, the notices are still sent.
                    let _ = self.ended(ended).await;
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

    async fn tell(&mut self, sending: &mut JoinSet<Attempt>) -> Result<(), NotifyError> {
        let mut look = tokio::time::interval(LOOK_EVERY);
        let mut status = tokio::time::interval(STATUS_EVERY);
        loop {
            tokio::select! {
                _ = look.tick() => {}
                _ = status.tick() => {
                    let memories = self.sources.iter_mut().filter_map(|s| s.memory.as_mut());
                    memories.for_each(Memory::look);
                    self.put_status().await?;
                }
                Some(ended) = sending.join_next() => self.ended(ended).await?,
            }
            self.take().await?;
            self.log_lost();
            // The checkpoint precedes the first attempt, so that a retry after a crash has the same
            // key.
            self.keep();
            for mut notice in self.outbox.due(self.clock.now()) {
                let Some(receiver) = self.receivers.get(notice.receiver).cloned() else {
                    continue;
                };
                if let Some(source) = self.source(notice.content.structure()) {
                    let circumstances = &mut notice.content.circumstances;
                    circumstances.contact.clone_from(&source.facts.contact);
                    circumstances.runbook.clone_from(&source.facts.runbook);
                }
                sending.spawn(async move {
                    let content = notice.content.clone();
                    let sent = tokio::task::spawn_blocking(move || receiver.send(&content)).await;
                    let result = sent.unwrap_or_else(|error| Err(error.to_string()));
                    Attempt { notice, result }
                });
            }
        }
    }

    /// Records and publishes the result of an attempt. Ignores an attempt whose task has panicked.
    async fn ended(&mut self, ended: Result<Attempt, JoinError>) -> Result<(), NotifyError> {
        let Ok(Attempt { notice, result }) = ended else {
            return Ok(());
        };
        let number = notice.receiver;
        let is_logged = self.outbox.done(number, result.is_ok(), self.clock.now());
        let receiver = self.shown(number);
        let (kind, what, why) = match &result {
            Ok(()) => {
                info!(receiver, "notice sent");
                if notice.is_repeated {
                    return Ok(());
                }
                let what = format!("{}{receiver}", Event::NOTICE_SENT);
                (EventKind::NoticeSent, what, notice.content.end())
            }
            Err(reason) if is_logged => {
                warn!(receiver, reason, "notice not sent; retrying");
                let what = format!("{}{receiver}", Event::NOTICE_FAILED);
                (EventKind::NoticeFailed, what, format!("{reason}; retrying"))
            }
            Err(_) => return Ok(()),
        };
        let structure = notice.content.structure();
        let subject = notice.content.part().unwrap_or(structure).to_string();
        let event = Event {
            structure: structure.clone(),
            time_ns: self.wall.now_ns(),
            kind,
            subject,
            what,
            why,
        };
        if let Some(source) = self.source(structure) {
            source.events.put(&event.legible()).await?;
        }
        Ok(())
    }

    /// Returns the source of a structure.
    fn source(&self, structure: &Name) -> Option<&Source> {
        let mut sources = self.sources.iter();
        sources.find(|source| source.keys.structure() == structure)
    }

    /// Logs the notices that no receiver gets any more.
    fn log_lost(&mut self) {
        for (receiver, notices) in self.outbox.take_lost() {
            let receiver = self.shown(receiver);
            error!(
                receiver,
                notices, "notices lost: not delivered within a day, or too many waited"
            );
        }
    }

    /// Returns the address of a receiver for the log, without secrets.
    fn shown(&self, receiver: usize) -> String {
        let receiver = self.receivers.get(receiver);
        receiver
            .map(|receiver| receiver.shown())
            .unwrap_or_default()
    }

    fn moment(&self) -> Moment {
        Moment {
            now: self.clock.now(),
            wall_ns: self.wall.now_ns(),
        }
    }

    async fn take(&mut self) -> Result<(), NotifyError> {
        let moment = self.moment();
        for source in &mut self.sources {
            source.gather(&mut self.outbox, moment);
            source.maintain(&mut self.outbox, moment.wall_ns).await?;
            source.compose(&mut self.outbox, moment);
        }
        for change in self.outbox.release(moment) {
            let of_change =
                |source: &&Source| change.period().structure == *source.keys.structure();
            if let Some(source) = self.sources.iter().find(of_change) {
                source.put_event(&change, moment.wall_ns).await?;
            }
        }
        Ok(())
    }

    /// Saves checkpoints of all structures that have changed.
    fn keep(&mut self) {
        let now = self.clock.now();
        let is_back = |source: &&Source| source.memory.as_ref().is_some_and(Memory::is_back);
        let again = self.sources.iter().filter(is_back);
        let again: BTreeSet<Name> = again.map(|s| s.keys.structure().clone()).collect();
        for structure in self.outbox.take_changed().into_iter().chain(again) {
            let of_structure = |source: &&mut Source| *source.keys.structure() == structure;
            let Some(source) = self.sources.iter_mut().find(of_structure) else {
                continue;
            };
            let situation = source.situation();
            if let Some(memory) = &mut source.memory {
                let remembered = self.outbox.remembered(&structure, now);
                tokio::task::block_in_place(|| memory.keep(remembered, situation));
            }
        }
    }

    async fn put_status(&self) -> Result<(), NotifyError> {
        let counts = [
            ("failed-notices", self.outbox.failures),
            ("given-up-notices", self.outbox.given_up),
            ("muted-notices", self.outbox.muted),
            ("simulated-notices", self.outbox.simulated),
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
            let report = StatusReport {
                done: source.taken,
                drops,
                maintenance: self.outbox.maintenance(source.keys.structure()),
                ..StatusReport::default()
            };
            source.status.put(report).await?;
        }
        Ok(())
    }
}

impl Source {
    /// Processes what has arrived since the last call.
    fn gather(&mut self, outbox: &mut Outbox, moment: Moment) {
        let Moment { now, wall_ns } = moment;
        let mut told = Told::default();
        self.state.handle(Input::Now(now), &mut Vec::new());
        for input in self.listener.gather() {
            match &input {
                Input::Alert(alert) => {
                    self.taken += 1;
                    self.push(alert, outbox, now);
                }
                Input::LoggedAlert(alert) => told.log.push(alert.clone()),
                Input::StandingAlert(alert) => {
                    let known = self.state.alerts.get(&alert.parameter);
                    told.standing.push((alert.clone(), known != Some(alert)));
                }
                Input::Judgement(display) => {
                    let is_new = self.judged.take(display, outbox);
                    let change = is_new.then(|| (display.clone(), now + SETTLES_AFTER));
                    self.changes.extend(change);
                }
                Input::Monitoring(display) => self.sight.take(display.clone(), now),
                Input::Event(event) if event.kind == EventKind::Earthquake => {
                    self.earthquake = Some(Earthquake {
                        report: event.subject.clone(),
                        time_ns: event.time_ns,
                    });
                }
                Input::Event(event) if event.kind == EventKind::EarthquakeReport => {
                    self.reported.push(event.clone());
                }
                Input::Event(event) => {
                    let change = self.clocks.take_event(event, now, wall_ns);
                    self.clock_changes.extend(change);
                }
                Input::Status(status) if status.service.as_str() == Service::Ingest.as_str() => {
                    let missed = self.clocks.take_status(status, now, wall_ns);
                    self.clock_changes.extend(missed);
                }
                _ => {}
            }
            self.state.handle(input, &mut Vec::new());
        }
        self.clock_changes.extend(self.clocks.look(now, wall_ns));
        self.catch_up(&told, outbox, now);
    }

    /// Queues a change of an alert until its notice can be composed.
    fn push(&mut self, alert: &AlertMessage, outbox: &mut Outbox, now: Duration) {
        outbox.mark_changed(&alert.structure);
        self.fresh.push_back((alert.clone(), now + SETTLES_AFTER));
    }

    /// Processes the reply of an alert service.
    ///
    /// The first reply ever received supplies only the current alerts: older changes are recorded
    /// without sending them.
    fn catch_up(&mut self, told: &Told, outbox: &mut Outbox, now: Duration) {
        let Told { log, standing } = told;
        for alert in log {
            if self.has_heard {
                self.push(alert, outbox, now);
            } else if !standing.iter().any(|(current, _)| current == alert) {
                outbox.learn(&alert.structure, &alert_key(alert));
            }
        }
        for (alert, _) in standing.iter().filter(|(_, is_new)| *is_new) {
            self.push(alert, outbox, now);
        }
        // An empty reply means that the service did not answer in time.
        self.has_heard |= !standing.is_empty();
    }

    /// Begins and ends maintenance, as people have requested.
    async fn maintain(&mut self, outbox: &mut Outbox, wall_ns: i64) -> Result<(), NotifyError> {
        let requests: Vec<_> = self.maintenance.messages().try_iter().collect();
        for (_, request) in requests {
            let mut parameters = self.facts.parameters.iter();
            let is_known = |part: &Name| parameters.any(|known| known == part.as_str());
            let is_own = request.structure == *self.keys.structure()
                && request.parameter.as_ref().is_none_or(is_known);
            if !is_own {
                let (structure, parameter) = (&request.structure, &request.parameter);
                warn!(%structure, ?parameter, "maintenance of an unknown parameter or structure \
                                               rejected");
            }
            let change = is_own.then(|| outbox.maintain(request, wall_ns)).flatten();
            if let Some(change) = change {
                self.put_event(&change, wall_ns).await?;
            }
        }
        Ok(())
    }

    async fn put_event(&self, change: &Change, wall_ns: i64) -> Result<(), NotifyError> {
        let period = change.period();
        let until = iso_8601(period.until_ns);
        let what = match change {
            Change::Begins(_) => format!("maintenance until {until}; notices are muted"),
            Change::Ended(_, who) => format!("{who} ended maintenance; notices are active"),
            Change::Expired(_) => "maintenance ended; notices are active".to_owned(),
        };
        let subject = period.parameter.as_ref().unwrap_or(&period.structure);
        let event = Event {
            structure: period.structure.clone(),
            time_ns: wall_ns,
            kind: EventKind::Maintenance,
            subject: subject.to_string(),
            what,
            why: format!("{}: {}", period.who, period.reason),
        };
        Ok(self.events.put(&event).await?)
    }

    /// Composes the notices that are due.
    fn compose(&mut self, outbox: &mut Outbox, moment: Moment) {
        let Moment { now, wall_ns } = moment;
        let root = self.keys.root();
        let node = |key: &String| parse_key(root, key).and_then(|(_, topic)| topic.of);
        let simulated = self.simulated.present().iter().filter_map(node).collect();
        let nodes = self
            .state
            .present()
            .filter(|(service, _)| *service == Service::Sensor);
        let present: BTreeSet<Name> = nodes.map(|(_, node)| node.clone()).collect();
        let has_changed = self.origins.look(Signs {
            present: &present,
            simulated: &simulated,
            pace: reported_pace(self.state.statuses().map(|(_, status)| status)),
            measured_ns: self.sight.measured_ns(),
            wall_ns,
        });
        if has_changed {
            self.sight.told.change_origin();
        }
        let mut reports = Vec::new();
        while let Some((alert, _)) = self.fresh.pop_front_if(|(_, due)| *due <= now) {
            reports.push(Report::Alert(alert));
        }
        while let Some((display, _)) = self.changes.pop_front_if(|(_, due)| *due <= now) {
            reports.push(Report::Judgement(display));
        }
        reports.extend(self.reported.drain(..).map(Report::Earthquake));
        reports.extend(self.clock_changes.drain(..).map(Report::Clock));
        // Without an alert service, its silence means nothing.
        let sight = self.facts.has_alert_service.then_some(&mut self.sight);
        reports.extend(
            sight
                .and_then(|sight| sight.look(self.origins.origin(), now, wall_ns))
                .map(Report::Monitoring),
        );
        if has_changed || !reports.is_empty() {
            outbox.mark_changed(self.keys.structure());
        }
        let seen = self.state.seen.iter();
        let sensors = seen.filter(|(service, _)| *service == Service::Sensor);
        let absent = sensors.map(|(_, node)| node.clone());
        let scene = Scene {
            facts: &self.facts,
            alerts: &self.state.alerts,
            monitoring: self.sight.report(now),
            origin: self.origins.origin(),
            fit: newest_fit(&self.state),
            absent: &absent.filter(|node| !present.contains(node)).collect(),
            earthquake: self.earthquake.as_ref(),
        };
        for report in reports {
            outbox.take(&scene.compose(report), moment);
        }
    }

    /// Returns what a checkpoint contains besides the notices.
    fn situation(&self) -> Situation {
        Situation {
            fresh: self.fresh.iter().map(|(alert, _)| alert.clone()).collect(),
            origins: self.origins.clone(),
            told: self.sight.told,
        }
    }
}

/// Returns the newest verdict on the fit that a status reports.
fn newest_fit(state: &StructureState) -> Option<FitVerdict> {
    let statuses = state.statuses().map(|(_, status)| status);
    let assessed = statuses.filter(|status| status.fit.is_some());
    assessed.max_by_key(|status| status.time_ns)?.fit
}

fn facts(monitored: &Monitored, settings: &NotifySettings) -> Facts {
    let structure = &monitored.structure;
    let parameters = structure.parameters().iter();
    let channels = structure.nodes().iter().map(|node| {
        let channels = node.channels().iter();
        let names = channels.map(|channel| channel.name().to_owned()).collect();
        (node.name().to_owned(), names)
    });
    Facts {
        structure: monitored.keys.structure().clone(),
        title: structure.description().trim().to_owned(),
        place: structure.location().trim().to_owned(),
        contact: structure.contact().trim().to_owned(),
        runbook: structure.runbook().unwrap_or_default().to_owned(),
        parameters: parameters
            .map(|parameter| parameter.name().to_owned())
            .collect(),
        channels: channels.collect(),
        has_alert_service: structure.is_filtered(),
        public_url: settings.base_url(),
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
