//! Connects the reports of one structure to the bus.

use crate::cutting::{CutOutput, Cutting, Recorded};
use crate::desk::{Desk, Work, occasion};
use crate::error::ReportsError;
use crate::maker::{MadeReport, ReportMaker};
use crate::memory::Memory;
use crate::name::{date, duration, stem, waiting_for_samples};
use crate::records::{Kept, Records};
use spandrel_bus::{
    BoxedFuture, Delivery, Event, EventKind, FrameBlock, KeyFamily, Keys, LiveToken, Question,
    Questions, ReportPage, Service, Stream, is_without_date, parse_key,
};
use spandrel_earthquake::{Detection, DetectionSettings};
use spandrel_listener::{DisplayTopic, Listener, Needs, StructureState};
use spandrel_service::{
    Clock, EventPublisher, Monitored, Report, STATUS_EVERY, ServiceInstance, StatusPublisher, Stop,
};
use spandrel_structure::{EarthquakePlan, Structure};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::task::{JoinError, JoinHandle};
use tokio::time::Instant;
use tracing::{info, warn};

/// The open alerts and the lasting losses, which each report states.
const NEEDS: Needs = Needs {
    topics: &[DisplayTopic::Alerts, DisplayTopic::Judgements],
    services: &[Service::Alert],
    logs: &[],
};
/// Pause after the start, in which the alert service states the open alerts. The service judge
/// repeats its judgements every 5 s.
const ALERTS_WITHIN: Duration = Duration::from_secs(6);
/// Maximum number of values for which the calling thread processes a block. They take less than
/// 500 µs.
const BRIEF: usize = 10_000;
/// Memory for the frames of one recording (bytes).
const MOST_BYTES: usize = 64 << 20;
/// Time without frames after which the recording of an earthquake ends.
const SILENT_AFTER: Duration = Duration::from_secs(30);
/// Pause after a failed attempt to keep a recording.
const RETRY_AFTER: Duration = Duration::from_secs(5);
/// Pause after a failed report. The next attempt computes all earlier events again.
const REPORT_RETRY_AFTER: Duration = Duration::from_secs(20);
/// Time after which a report that waits for samples is announced (ns).
const LATE_NS: i64 = 600_000_000_000;
/// Maximum number of recordings that wait for the disk. Each takes up to [`MOST_BYTES`].
const MOST_WAITING: usize = 4;
/// Capacity of the queue for queries.
const QUESTIONS_WAITING: usize = 64;
/// Maximum number of queries that are answered at once. Each reads the files of a report.
const REPLIES_AT_ONCE: usize = 4;

/// Start-up settings of the report service of one structure.
#[derive(Clone, Debug)]
pub struct ReportsPlan {
    /// Session, id and clock of the service.
    pub instance: ServiceInstance,
    /// The structure to report on. The service does not start if the structure file has no table
    /// `[earthquakes]`.
    pub monitored: Monitored,
    /// Folder of the recordings and reports.
    pub folder: PathBuf,
    /// Maker of the reports, one for all recordings of the structure.
    pub maker: Arc<dyn ReportMaker>,
}

/// The service that reports the earthquakes of one structure.
#[derive(Debug)]
pub struct ReportsService {
    keys: Keys,
    clock: Clock,
    cutting: Cutting,
    frames: Stream<FrameBlock>,
    records: Records,
    maker: Arc<dyn ReportMaker>,
    listener: Listener,
    /// State of the structure, of which only the alerts are known.
    state: StructureState,
    /// `None` while a report is made.
    desk: Option<Desk>,
    making: Option<JoinHandle<(Desk, Work)>>,
    /// Earliest time of the next attempt to make a report. `None` if nothing is left to do.
    make_at: Option<Instant>,
    /// Earliest time of a report, when the open alerts are known.
    make_from: Instant,
    /// Recordings that wait for the disk.
    waiting: VecDeque<Recorded>,
    keeping: Option<JoinHandle<(Recorded, Result<Kept, String>)>>,
    keep_at: Instant,
    /// Why the disk does not keep recordings.
    trouble: Option<String>,
    /// Why recordings are not reported, by their names.
    unreported: BTreeMap<String, String>,
    /// Reports that wait for samples and have been announced: the earthquake and the time after it.
    announced: BTreeSet<(i64, u64)>,
    /// Number of recordings that were given up, because too many waited for the disk.
    lost: u64,
    last_frames: Instant,
    questions: Questions,
    replies: Arc<Semaphore>,
    events: EventPublisher,
    status: StatusPublisher,
    token: LiveToken,
    memory: Option<Memory>,
}

impl spandrel_service::Service for ReportsService {
    type Plan = ReportsPlan;
    type Error = ReportsError;

    /// Resumes from the last checkpoint, and joins the bus.
    ///
    /// # Errors
    /// Returns an error if the structure has no table `[earthquakes]`, a folder cannot be written,
    /// or the bus rejects a declaration.
    fn start(plan: &ReportsPlan) -> BoxedFuture<'_, Result<Self, ReportsError>> {
        Self::start_from(plan)
    }

    /// Runs until `stop`. A report that is being made is made again after the next start.
    ///
    /// # Errors
    /// Returns an error if the bus is closed.
    fn run<'a>(self, stop: Stop<'a>) -> BoxedFuture<'a, Result<(), ReportsError>> {
        self.run_until(stop)
    }
}

impl ReportsService {
    fn start_from(plan: &ReportsPlan) -> BoxedFuture<'_, Result<Self, ReportsError>> {
        Box::pin(async move {
            let ReportsPlan {
                instance,
                monitored,
                folder,
                maker,
            } = plan;
            let Monitored {
                structure,
                keys,
                remembering,
            } = monitored;
            let plan = structure
                .earthquakes()
                .ok_or_else(|| ReportsError::NotReported {
                    structure: structure.name().to_owned(),
                })?;
            let detection = Detection::new(detection_settings(structure, plan))?;
            let rate_hz = structure.sampling_rate_hz();
            let mut cutting = Cutting::new(detection, plan.channels.clone(), rate_hz);
            let memory = match remembering {
                Some(remembering) => {
                    let memory = Memory::open(keys, plan, remembering)?;
                    tokio::task::block_in_place(|| memory.recall(&mut cutting));
                    Some(memory)
                }
                None => None,
            };
            let channels = structure.channels().map(|one| one.name().to_owned());
            let records = Records::open(folder, keys.structure(), channels.collect());
            let records = records.map_err(|source| ReportsError::Folder {
                folder: folder.clone(),
                source,
            })?;
            let count = structure.channel_count();
            let is_of_structure = move |block: &FrameBlock| match usize::from(block.channels)
                == count
                && block.sampling_rate_hz == rate_hz
            {
                true => Ok(()),
                false => Err("frames-of-another-structure"),
            };
            let bus = &instance.bus;
            let reading = bus.reading(cutting.start()).patient();
            info!(
                structure = keys.structure().as_str(),
                trigger_m_per_s2 = plan.trigger_m_per_s2,
                recordings = records.list().map_or(0, |all| all.len()),
                "reports of earthquakes ready"
            );
            let now = Instant::now();
            Ok(Self {
                clock: instance.clock,
                frames: bus
                    .follow_fit(keys.frames(), keys.recording(), reading, is_of_structure)
                    .await?,
                cutting,
                listener: Listener::start(bus, keys.root(), Some(keys.structure()), NEEDS).await?,
                state: StructureState::default(),
                desk: Some(Desk::new(records.clone(), maker.clone(), plan.keep)),
                records,
                maker: maker.clone(),
                making: None,
                // A report may have been due while the service did not run.
                make_at: Some(now + ALERTS_WITHIN),
                make_from: now + ALERTS_WITHIN,
                waiting: VecDeque::new(),
                keeping: None,
                keep_at: now,
                trouble: None,
                unreported: BTreeMap::new(),
                announced: BTreeSet::new(),
                lost: 0,
                last_frames: now,
                questions: bus.questions(keys.all_reports(), QUESTIONS_WAITING).await?,
                replies: Arc::new(Semaphore::new(REPLIES_AT_ONCE)),
                events: EventPublisher::declare(bus, keys).await?,
                status: instance.publish_status(Service::Reports, keys).await?,
                token: instance.announce(Service::Reports, keys).await?,
                keys: keys.clone(),
                memory,
            })
        })
    }

    fn run_until(
        mut self,
        mut stop: BoxedFuture<'_, ()>,
    ) -> BoxedFuture<'_, Result<(), ReportsError>> {
        Box::pin(async move {
            let mut status = tokio::time::interval(STATUS_EVERY);
            let deliveries = self.frames.deliveries().clone();
            loop {
                // The selection is not biased. At full speed there are always frames, and the
                // others still need their turn.
                tokio::select! {
                    delivery = deliveries.recv_async() => match delivery {
                        Ok(delivery) => self.take(&delivery).await?,
                        Err(_) => break, // the session is closed
                    },
                    made = finished(&mut self.making) => self.made(made).await?,
                    kept = finished(&mut self.keeping) => self.kept(kept).await?,
                    Some((question, permit)) = next_question(&self.questions, &self.replies) => self.answer(question, permit),
                    _ = status.tick() => self.put_status().await?,
                    () = &mut stop => break,
                }
                self.work();
            }
            // What is not on disk yet is read again after the next start, because the last
            // checkpoint precedes it.
            if let Some(memory) = self.memory.take() {
                memory.close().await;
            }
            self.token.withdraw().await?;
            Ok(())
        })
    }

    async fn take(&mut self, delivery: &Delivery<FrameBlock>) -> Result<(), ReportsError> {
        self.last_frames = Instant::now();
        let mut outputs = Vec::new();
        let is_brief = match delivery {
            Delivery::Block(block) => block.values.len() <= BRIEF,
            Delivery::Gap(_) => true,
        };
        match is_brief {
            true => self.cutting.handle(delivery, &mut outputs),
            false => tokio::task::block_in_place(|| self.cutting.handle(delivery, &mut outputs)),
        }
        self.handle(outputs).await?;
        self.keep_state(false).await;
        Ok(())
    }

    async fn handle(&mut self, outputs: Vec<CutOutput>) -> Result<(), ReportsError> {
        for output in outputs {
            match output {
                CutOutput::Began { start_ns, time_ns } => {
                    let stem = stem(start_ns);
                    let report = stem.to_lowercase();
                    // Only the complete recording of a record without dates shows whether it is
                    // new.
                    let path = match is_without_date(start_ns) && self.records.has(&stem) {
                        true => String::new(),
                        false => {
                            let structure = self.keys.structure().as_str();
                            format!(": {}", ReportPage::path(structure, &report))
                        }
                    };
                    let event = Event {
                        kind: EventKind::Earthquake,
                        time_ns,
                        subject: report,
                        what: "earthquake begins".to_owned(),
                        why: format!("a report follows within a minute after it{path}"),
                        structure: self.keys.structure().clone(),
                    };
                    self.events.put(&event).await?;
                }
                CutOutput::Record(recorded) => {
                    self.waiting.push_back(recorded);
                    if self.waiting.len() > MOST_WAITING {
                        self.waiting.pop_front();
                        self.lost += 1;
                    }
                }
                CutOutput::TooFew {
                    due,
                    found,
                    required,
                } => {
                    let why = format!(
                        "only {found} frames have samples, at least {required} are required; the \
                         next ones are tried"
                    );
                    for due in due {
                        self.announce_late(due.of_ns, due.after_s, &why).await?;
                    }
                }
            }
        }
        Ok(())
    }

    /// Announces once that a report of an earthquake waits.
    async fn announce_late(
        &mut self,
        of_ns: i64,
        after_s: f64,
        why: &str,
    ) -> Result<(), ReportsError> {
        if !self.announced.insert((of_ns, after_s.to_bits())) {
            return Ok(());
        }
        let (after, of) = (duration(after_s), date(of_ns));
        let event = self.unreported(
            stem(of_ns).to_lowercase(),
            format!("the report {after} after the earthquake of {of} waits"),
            why,
        );
        Ok(self.events.put(&event).await?)
    }

    fn unreported(&self, subject: String, what: String, why: &str) -> Event {
        Event {
            structure: self.keys.structure().clone(),
            time_ns: self.clock.now_ns(),
            kind: EventKind::EarthquakeUnreported,
            subject,
            what,
            why: why.to_owned(),
        }
        .legible()
    }

    /// Saves the state if everything before it is on disk.
    async fn keep_state(&mut self, is_due_now: bool) {
        if self.keeping.is_some() || !self.waiting.is_empty() {
            return;
        }
        if let Some(memory) = &mut self.memory {
            memory.keep(&self.cutting, is_due_now).await;
        }
    }

    /// Begins to keep a recording and to make a report, on threads of their own.
    fn work(&mut self) {
        let now = Instant::now();
        if self.keeping.is_none()
            && self.keep_at <= now
            && let Some(recorded) = self.waiting.pop_front()
        {
            let records = self.records.clone();
            self.keeping = Some(tokio::task::spawn_blocking(move || {
                let kept = records.keep(&recorded).map_err(|error| error.to_string());
                (recorded, kept)
            }));
        }
        if self.make_at.is_some_and(|at| at <= now)
            && let Some(mut desk) = self.desk.take()
        {
            self.make_at = None;
            self.hear_alerts();
            let standing = open_alerts(&self.state);
            self.making = Some(tokio::task::spawn_blocking(move || {
                let work = desk.work(&standing);
                (desk, work)
            }));
        }
    }

    async fn kept(
        &mut self,
        kept: Result<(Recorded, Result<Kept, String>), JoinError>,
    ) -> Result<(), ReportsError> {
        let Some((recorded, kept)) = of_thread(kept) else {
            return Ok(());
        };
        match kept {
            Ok(kept) => {
                info!(recording = kept.stem, "recording of an earthquake kept");
                self.trouble = None;
                self.make_at = Some(Instant::now().max(self.make_from));
                self.keep_state(true).await;
            }
            Err(why) => {
                self.keep_at = Instant::now() + RETRY_AFTER;
                if self.trouble.as_ref() != Some(&why) {
                    let what = "the recording of an earthquake is not kept".to_owned();
                    let subject = stem(recorded.about.start_ns).to_lowercase();
                    let event = self.unreported(subject, what, &why);
                    self.events.put(&event).await?;
                }
                self.trouble = Some(why);
                self.waiting.push_front(recorded);
            }
        }
        Ok(())
    }

    async fn made(&mut self, made: Result<(Desk, Work), JoinError>) -> Result<(), ReportsError> {
        let Some((desk, work)) = of_thread(made) else {
            return Ok(());
        };
        self.desk = Some(desk);
        let now = Instant::now();
        match work {
            Work::Reported(kept, made) => {
                self.make_at = Some(now);
                self.unreported.remove(&kept.stem);
                self.events.put(&self.reported(&kept, &made)).await?;
            }
            Work::Known => self.make_at = Some(now),
            Work::Failed(kept, why) => {
                self.make_at = Some(now + REPORT_RETRY_AFTER);
                if self.unreported.get(&kept.stem) != Some(&why) {
                    let what = "an earthquake is not reported".to_owned();
                    let event = self.unreported(kept.stem.to_lowercase(), what, &why);
                    self.events.put(&event).await?;
                }
                self.unreported.insert(kept.stem, why);
            }
            // A recording that came meanwhile has set the time.
            Work::Nothing => {}
        }
        Ok(())
    }

    fn reported(&self, kept: &Kept, made: &MadeReport) -> Event {
        let report = kept.stem.to_lowercase();
        let path = ReportPage::path(self.keys.structure().as_str(), &report);
        let occasion = occasion(kept);
        let space = if occasion.is_empty() { "" } else { " " };
        Event {
            structure: self.keys.structure().clone(),
            time_ns: kept.about.end_ns,
            kind: EventKind::EarthquakeReport,
            subject: report,
            what: format!("{}{}", ReportPage::EVENT, made.urgency),
            why: format!("{occasion}{space}{} {path}", made.headline),
        }
        .legible()
    }

    /// Replies to a query on a thread of its own, which reads the files.
    fn answer(&self, question: Question, permit: OwnedSemaphorePermit) {
        let topic = parse_key(self.keys.root(), question.key_expression());
        let asked = topic.and_then(|(_, topic)| {
            let is_report = topic.family == KeyFamily::Report;
            topic.of.filter(|_| is_report)
        });
        let (keys, records, maker) = (self.keys.clone(), self.records.clone(), self.maker.clone());
        let waiting = self.what_waits();
        tokio::spawn(async move {
            let _until_answered = permit;
            let Some(report) = asked else {
                let why = "must be for one report, or for index";
                return question.reject(why).await;
            };
            let of = report.clone();
            let read = tokio::task::spawn_blocking(move || match of.as_str() {
                ReportPage::INDEX => {
                    let index = maker.index(records.folder(), &waiting);
                    index.map(|index| (index.html, index.json))
                }
                _ => records
                    .page(&of)
                    .ok_or_else(|| format!("there is no report {of}")),
            });
            let read = read.await.unwrap_or_else(|error| Err(error.to_string()));
            let answered = match read {
                Ok((html, json)) => {
                    let page = ReportPage {
                        structure: keys.structure().clone(),
                        report: report.clone(),
                        html,
                        json,
                    };
                    question.answer(&keys.report(&report), &page).await
                }
                Err(why) => return question.reject(&why).await,
            };
            if let Err(error) = answered {
                question.refuse(&error.to_string()).await;
            }
        });
    }

    /// Returns sentences about what is not reported yet.
    fn what_waits(&self) -> Vec<String> {
        let mut all = Vec::new();
        let detection = self.cutting.detection();
        if detection.is_shaking() {
            all.push(
                "An earthquake is being recorded. Its report follows within a minute.".to_owned(),
            );
        }
        if let Some(why) = &self.trouble {
            all.push(format!("A recording waits for the disk: {why}."));
        }
        for (stem, why) in &self.unreported {
            all.push(format!("The recording {stem} is not reported: {why}."));
        }
        let last_ns = self.cutting.last_time_ns().unwrap_or(i64::MIN);
        if self.is_silent() {
            all.extend(waiting_for_samples(detection.due()));
            return all;
        }
        for due in detection.due() {
            let (of, after) = (date(due.of_ns), duration(due.after_s));
            let at = date(due.at_ns);
            all.push(if due.at_ns > last_ns {
                format!("The earthquake of {of} is judged again {after} after it, at {at}.")
            } else {
                format!(
                    "The earthquake of {of} is judged again now, {after} after it, from weak \
                     motion."
                )
            });
        }
        all
    }

    fn is_silent(&self) -> bool {
        self.last_frames.elapsed() >= SILENT_AFTER
    }

    fn hear_alerts(&mut self) {
        for input in self.listener.gather() {
            self.state.handle(input, &mut Vec::new());
        }
    }

    async fn put_status(&mut self) -> Result<(), ReportsError> {
        self.hear_alerts();
        if self.is_silent() {
            let mut outputs = Vec::new();
            if self.cutting.detection().is_shaking() {
                self.cutting.interrupt(&mut outputs);
                self.handle(outputs).await?;
            }
            let now_ns = self.clock.now_ns();
            let due = self.cutting.detection().due().iter();
            let is_late = |at_ns: i64| now_ns.saturating_sub(at_ns) > LATE_NS;
            let late: Vec<(i64, f64)> = due
                .filter(|due| is_late(due.at_ns))
                .map(|due| (due.of_ns, due.after_s))
                .collect();
            for (of_ns, after_s) in late {
                self.announce_late(of_ns, after_s, "no samples arrive")
                    .await?;
            }
        }
        let mut drops = self.frames.counts().drops();
        drops.extend(self.listener.refused());
        if let Some(memory) = &mut self.memory {
            memory.look().await;
            drops.extend(memory.drops());
        }
        let unkept = self.lost + u64::from(self.trouble.is_some()) * self.waiting.len() as u64;
        let counts = [
            ("unkept-recordings", unkept),
            ("unreported-recordings", self.unreported.len() as u64),
        ];
        let counts = counts.iter().filter(|(_, count)| *count > 0);
        drops.extend(counts.map(|(name, count)| ((*name).to_owned(), *count)));
        let report = Report {
            done: self.cutting.next(),
            processed_ns: self.cutting.last_time_ns(),
            drops,
            ..Report::default()
        };
        Ok(self.status.put(report).await?)
    }
}

/// Returns the open alerts and the lasting losses, in sentences without a full stop.
fn open_alerts(state: &StructureState) -> Vec<String> {
    let alerts = state.alerts.values();
    let open = alerts.filter(|alert| alert.stands() && !state.is_alert_stale(&alert.parameter));
    let judgements = state.judgements.values();
    let losses = judgements.filter(|judgement| judgement.alert_state().is_some());
    let losses = losses.map(|judgement| judgement.sentence.trim_end_matches('.').to_owned());
    open.map(|alert| alert.why.clone()).chain(losses).collect()
}

/// Waits until a query may be answered, and for the query. Further queries wait in the queue. The
/// wait is cancel-safe.
async fn next_question(
    questions: &Questions,
    replies: &Arc<Semaphore>,
) -> Option<(Question, OwnedSemaphorePermit)> {
    let permit = replies.clone().acquire_owned().await.ok()?;
    Some((questions.next().await?, permit))
}

/// Waits for the work of a thread, if there is any. The wait is cancel-safe.
async fn finished<T>(work: &mut Option<JoinHandle<T>>) -> Result<T, JoinError> {
    let result = match work {
        Some(handle) => handle.await,
        None => std::future::pending().await,
    };
    *work = None;
    result
}

/// Returns the result of a thread. `None` if the runtime is shutting down.
fn of_thread<T>(joined: Result<T, JoinError>) -> Option<T> {
    match joined {
        Ok(result) => Some(result),
        // The supervisor restarts the service, which then reads its files again.
        Err(error) => match error.try_into_panic() {
            Ok(panic) => std::panic::resume_unwind(panic),
            Err(_) => {
                warn!("a thread of the reports was stopped");
                None
            }
        },
    }
}

fn detection_settings(structure: &Structure, plan: &EarthquakePlan) -> DetectionSettings {
    let bytes = (structure.channel_count() * size_of::<f64>()).max(1);
    DetectionSettings {
        rate_hz: structure.sampling_rate_hz(),
        fundamental_hz: structure.fundamental_hz().unwrap_or(1.0),
        channels: plan.channels.len(),
        trigger: plan.trigger_m_per_s2,
        strong: plan.strong_m_per_s2,
        again_after_s: plan.again_after_s.clone(),
        most_frames: (MOST_BYTES / bytes) as u64,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use spandrel_bus::JudgementDisplay;
    use spandrel_listener::Input;

    #[test]
    fn a_report_states_the_lasting_losses_and_no_gain() {
        let text = r#"{"structure":"house","quantity":"storey-1","time_ns":9,"day_ns":0,
            "epoch_ns":8,"epochs":96,"measured":true,"state":"judged","change":
            {"kind":"lasting-loss","found_ns":0,"since_ns":0,"loss":0.05,
            "interval":{"level":0.95,"low":0.04,"high":0.06}},
            "sentence":"storey-1 has lost 5.0 % of stiffness (95 % interval 4.0 to 6.0 %).",
            "expectation":null,"false_alarms_per_year":0.1}"#;
        let open = |text: &str| {
            let display: JudgementDisplay = serde_json::from_str(text).unwrap();
            let mut state = StructureState::default();
            state.handle(Input::Judgement(display), &mut Vec::new());
            open_alerts(&state)
        };
        assert_eq!(
            open(text),
            ["storey-1 has lost 5.0 % of stiffness (95 % interval 4.0 to 6.0 %)"]
        );
        assert!(open(&text.replace("lasting-loss", "stiffer")).is_empty());
    }
}
