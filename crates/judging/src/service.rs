//! Connects the judgement of one structure to the bus.

use crate::bench::{Bench, Saved};
use crate::epochs::{ClosedEpoch, ConditionSource, EpochInput, Epochs, QuantitySource, Sources};
use crate::error::JudgingError;
use crate::judging::{Judging, name, quantity_names, withdraw_old};
use spandrel_bus::{
    Annotation, BoxedFuture, DisplayPublisher, EpochDisplay, Event, EventKind, JudgementDisplay,
    KeyFamily, Keys, LiveToken, LiveWatch, Name, Pace, Question, Questions, Service, SpanQuery,
    Subscription, parse_key, reported_pace,
};
use spandrel_judge::QuantityKind;
use spandrel_listener::{DisplayTopic, Input, Listener, Needs, StructureState};
use spandrel_service::{
    Clock, EventPublisher, Monitored, Report, STATUS_EVERY, ServiceInstance, StatusPublisher, Stop,
};
use spandrel_structure::{JudgePlan, Parameter, Structure};
use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};
use tracing::{info, warn};

/// What the epochs are formed of. Events and conditions precede the estimates and modes, because
/// these close epochs.
const NEEDS: Needs = Needs {
    topics: &[
        DisplayTopic::Statuses,
        DisplayTopic::Events,
        DisplayTopic::Monitoring,
        DisplayTopic::Conditions,
        DisplayTopic::Parameters,
        DisplayTopic::Modes,
    ],
    services: &[Service::Alert, Service::Feed, Service::Sensor],
    logs: &[],
};
/// Interval at which messages are taken from the subscriptions.
const GATHER_EVERY: Duration = Duration::from_millis(50);
/// Interval at which each state is published again, for those who have subscribed meanwhile.
const REPEAT_EVERY: Duration = Duration::from_secs(5);

/// Number of epochs without any closed one after which a judgement can be too old. A restart has
/// this time to receive the first values.
const SILENT_EPOCHS: u32 = 2;

/// Capacities of the queues for queries and for annotations.
const QUESTIONS_WAITING: usize = 64;
const ANNOTATIONS_WAITING: usize = 64;

/// Start-up settings of the judgement service of one structure.
#[derive(Clone, Debug)]
pub struct JudgePlanned {
    /// Session, id and clock of the service.
    pub instance: ServiceInstance,
    /// The structure to judge. The service does not start if the structure file has no table
    /// `[judge]`.
    pub monitored: Monitored,
}

/// The service that judges one structure: it collects epochs from the bus, and publishes the state
/// of each judged quantity.
///
/// At its start, the service judges the saved epochs again. It also answers queries for the history
/// of a quantity and for the past of the lasting losses, and takes annotations. An epoch that is
/// not over at a stop is lost.
#[derive(Debug)]
pub struct JudgeService {
    keys: Keys,
    clock: Clock,
    started: Instant,
    listener: Listener,
    state: StructureState,
    simulated: LiveWatch,
    /// Whether the samples are measured. It remains while no node is present.
    is_measured: Option<bool>,
    epochs: Epochs,
    /// Time from `started` to the last closed epoch.
    closed_at: Duration,
    /// `None` only while another thread judges.
    bench: Option<Bench>,
    topics: BTreeMap<Name, DisplayPublisher<JudgementDisplay>>,
    epoch_topics: BTreeMap<Name, DisplayPublisher<EpochDisplay>>,
    /// Queries for the histories of the quantities.
    questions: Questions,
    /// Queries for the past of the lasting losses.
    log_questions: Questions,
    annotations: Subscription<Annotation>,
    events: EventPublisher,
    status: StatusPublisher,
    token: LiveToken,
    /// Number of epochs that the judge has refused.
    refused: u64,
    /// Number of annotations that were not kept.
    not_kept: u64,
}

impl spandrel_service::Service for JudgeService {
    type Plan = JudgePlanned;
    type Error = JudgingError;

    /// Judges the saved epochs again, and joins the bus.
    ///
    /// # Errors
    /// Fails if the structure has no table `[judge]`, the file of the epochs cannot be used, or the
    /// bus rejects a declaration.
    fn start(plan: &JudgePlanned) -> BoxedFuture<'_, Result<Self, JudgingError>> {
        Self::start_from(plan)
    }

    /// Runs until `stop`. An epoch that is not over is lost.
    ///
    /// # Errors
    /// Fails if the bus is closed.
    fn run<'a>(self, stop: Stop<'a>) -> BoxedFuture<'a, Result<(), JudgingError>> {
        self.run_until(stop)
    }
}

impl JudgeService {
    fn start_from(plan: &JudgePlanned) -> BoxedFuture<'_, Result<Self, JudgingError>> {
        Box::pin(async move {
            let JudgePlanned {
                instance,
                monitored,
            } = plan;
            let Monitored {
                structure,
                keys,
                remembering,
            } = monitored;
            let plan = structure.judge().ok_or_else(|| JudgingError::NotJudged {
                structure: structure.name().to_owned(),
            })?;
            let names = quantity_names(plan)?;
            let sources = sources(structure, plan)?;
            warn_without_source(structure, plan, &sources);
            let ServiceInstance { bus, clock, .. } = instance;
            let saved = remembering.as_ref().map(|remembering| Saved {
                folder: remembering.folder.clone(),
                plan: plan.clone(),
            });
            let bench = tokio::task::block_in_place(|| {
                let judging = Judging::of_plan(keys.structure().clone(), plan)?;
                Bench::open(judging, saved, *clock)
            })?;
            let (mut topics, mut epoch_topics) = (BTreeMap::new(), BTreeMap::new());
            for name in names {
                let topic = bus.publish_display(keys.epoch(&name)).await?;
                epoch_topics.insert(name.clone(), topic);
                let topic = bus.publish_display(keys.judgement(&name)).await?;
                topics.insert(name, topic);
            }
            info!(
                structure = keys.structure().as_str(),
                quantities = topics.len(),
                epochs = bench.judging.epochs(),
                "judgement ready"
            );
            #[expect(
                clippy::disallowed_methods,
                reason = "silence of the alert service is measured with the monotonic clock"
            )]
            let started = Instant::now();
            Ok(Self {
                clock: *clock,
                started,
                epochs: Epochs::new(sources, bench.judging.epoch_ns()),
                closed_at: Duration::ZERO,
                bench: Some(bench),
                topics,
                epoch_topics,
                questions: bus
                    .questions(keys.all_judgement_courses(), QUESTIONS_WAITING)
                    .await?,
                log_questions: bus
                    .questions(keys.judgement_log(), QUESTIONS_WAITING)
                    .await?,
                annotations: bus
                    .subscribe(keys.annotation(), ANNOTATIONS_WAITING)
                    .await?,
                events: EventPublisher::declare(bus, keys).await?,
                state: StructureState::default(),
                simulated: bus.watch_live(keys.all_simulated()).await?,
                is_measured: None,
                listener: Listener::start(bus, keys.root(), Some(keys.structure()), NEEDS).await?,
                status: instance.publish_status(Service::Judge, keys).await?,
                token: instance.announce(Service::Judge, keys).await?,
                keys: keys.clone(),
                refused: 0,
                not_kept: 0,
            })
        })
    }

    fn run_until(
        mut self,
        mut stop: BoxedFuture<'_, ()>,
    ) -> BoxedFuture<'_, Result<(), JudgingError>> {
        Box::pin(async move {
            let mut gather = tokio::time::interval(GATHER_EVERY);
            let mut repeat = tokio::time::interval(REPEAT_EVERY);
            let mut status = tokio::time::interval(STATUS_EVERY);
            loop {
                tokio::select! {
                    biased;
                    () = &mut stop => break,
                    _ = status.tick() => {
                        self.judge(Vec::new()).await?; // tries again to save what waits
                        self.tell().await?;
                        self.put_status().await?;
                    }
                    _ = repeat.tick() => self.put_states().await?,
                    _ = gather.tick() => self.gather().await?,
                    Some(question) = self.questions.next() => self.answer(&question).await,
                    Some(question) = self.log_questions.next() => self.answer_log(&question).await,
                }
            }
            self.gather().await?;
            self.token.withdraw().await?;
            Ok(())
        })
    }

    /// Answers a query for the history of a quantity.
    async fn answer(&self, question: &Question) {
        let Some(bench) = &self.bench else {
            return; // an earlier call has ended the service
        };
        let topic = parse_key(self.keys.root(), question.key_expression());
        let topic = topic.map(|(_, topic)| topic);
        let Some(quantity) = topic.and_then(|topic| {
            topic
                .of
                .filter(|_| topic.family == KeyFamily::JudgementCourse)
        }) else {
            return question
                .reject("must be for one quantity, without wildcards")
                .await;
        };
        let query: SpanQuery = match question.parameters().parse() {
            Ok(query) => query,
            Err(error) => return question.reject(&error.to_string()).await,
        };
        let Some(course) = bench.judging.course(&quantity, &query) else {
            let known: Vec<&str> = self.topics.keys().map(Name::as_str).collect();
            let known = known.join(", ");
            let why = format!("unknown quantity {quantity}, must be one of: {known}");
            return question.reject(&why).await;
        };
        let key = self.keys.judgement_course(&quantity);
        if let Err(error) = question.answer(&key, &course).await {
            question.refuse(&error.to_string()).await;
        }
    }

    /// Answers a query for the past of the lasting losses.
    async fn answer_log(&self, question: &Question) {
        let Some(bench) = &self.bench else {
            return; // an earlier call has ended the service
        };
        let key = self.keys.judgement_log();
        if let Err(error) = question.answer(&key, bench.losses()).await {
            question.refuse(&error.to_string()).await;
        }
    }

    /// Processes what has arrived since the last call.
    async fn gather(&mut self) -> Result<(), JudgingError> {
        let mut closed = Vec::new();
        let mut inputs = vec![
            EpochInput::Now(self.started.elapsed()),
            EpochInput::Clock(self.clock.now_ns()),
        ];
        for input in self.listener.gather() {
            match input {
                Input::Monitoring(display) => inputs.push(EpochInput::Monitoring(display)),
                Input::Condition(display) | Input::StandingCondition(display, _) => {
                    inputs.push(EpochInput::Condition(display));
                }
                Input::Parameter(display) => inputs.push(EpochInput::Parameter(display)),
                Input::Mode(display) => inputs.push(EpochInput::Mode(display)),
                Input::Event(event) if event.kind == EventKind::Earthquake => {
                    inputs.push(EpochInput::Earthquake(event.time_ns));
                }
                other => self.state.handle(other, &mut Vec::new()),
            }
        }
        self.look_at_the_origin();
        self.epochs
            .handle(EpochInput::Measured(self.is_measured), &mut closed);
        for input in inputs {
            self.epochs.handle(input, &mut closed);
        }
        if !closed.is_empty() {
            self.closed_at = self.started.elapsed();
            self.judge(closed).await?;
        }
        for ahead in self.epochs.take_ahead() {
            let event = ahead.event(self.keys.structure(), self.clock.now_ns());
            self.events.put(&event).await?;
        }
        self.take_annotations().await
    }

    /// Stores the received annotations, and confirms each one with an event.
    async fn take_annotations(&mut self) -> Result<(), JudgingError> {
        while let Ok((_, annotation)) = self.annotations.messages().try_recv() {
            let told = annotation.clone();
            let Some(kept) = self.at_the_bench(|bench| bench.annotate(annotation)).await else {
                return Ok(()); // an earlier call has ended the service
            };
            if let Err(why) = kept {
                let (who, structure) = (&told.who, &told.structure);
                warn!(who, %structure, %why, "an annotation is not kept");
                self.not_kept += 1;
                continue;
            }
            let subject = told.quantity.as_ref().unwrap_or(&told.structure);
            let event = Event {
                structure: told.structure.clone(),
                time_ns: told.from_ns,
                kind: EventKind::Annotation,
                subject: subject.to_string(),
                what: told.what(),
                why: told.why(),
            };
            self.events.put(&event.legible()).await?;
            self.put_states().await?;
        }
        Ok(())
    }

    /// Determines whether the samples are measured.
    ///
    /// A structure with simulated and measured nodes counts as measured, so that nobody can mute a
    /// real structure by simulating one of its nodes.
    fn look_at_the_origin(&mut self) {
        let root = self.keys.root();
        let node = |key: &String| parse_key(root, key).and_then(|(_, topic)| topic.of);
        let simulated: BTreeSet<Name> = self.simulated.present().iter().filter_map(node).collect();
        let nodes = self.state.present();
        let nodes = nodes.filter(|(service, _)| *service == Service::Sensor);
        let present: BTreeSet<&Name> = nodes.map(|(_, node)| node).collect();
        if present.is_empty() && self.is_measured.is_some() {
            return;
        }
        let is_simulated =
            !present.is_empty() && present.iter().all(|node| simulated.contains(*node));
        let pace = reported_pace(self.state.statuses().map(|(_, status)| status));
        self.is_measured = pace.map(|pace| pace == Pace::Live && !is_simulated);
    }

    /// Publishes the events about the saved epochs.
    async fn tell(&mut self) -> Result<(), JudgingError> {
        let told = self.bench.as_mut().map(Bench::take_told);
        for event in told.unwrap_or_default() {
            self.events.put(&event.legible()).await?;
        }
        Ok(())
    }

    /// Saves and judges epochs, and publishes what has changed.
    async fn judge(&mut self, closed: Vec<ClosedEpoch>) -> Result<(), JudgingError> {
        let Some(outcome) = self.at_the_bench(move |bench| bench.judge(&closed)).await else {
            return Ok(());
        };
        self.refused += outcome.refused;
        self.put_epochs(&outcome.taken).await?;
        for event in &outcome.events {
            self.events.put(event).await?;
        }
        match outcome.is_day_over {
            true => self.put_states().await,
            false => Ok(()),
        }
    }

    /// Works on a thread that may block. Returns `None` if an earlier call has ended the service.
    async fn at_the_bench<T: Send + 'static>(
        &mut self,
        work: impl FnOnce(&mut Bench) -> T + Send + 'static,
    ) -> Option<T> {
        let mut bench = self.bench.take()?;
        let worked = tokio::task::spawn_blocking(move || {
            let outcome = work(&mut bench);
            (bench, outcome)
        });
        match worked.await {
            Ok((bench, outcome)) => {
                self.bench = Some(bench);
                Some(outcome)
            }
            // The supervisor restarts the service, which then reads its epochs again.
            Err(error) => match error.try_into_panic() {
                Ok(panic) => std::panic::resume_unwind(panic),
                Err(_) => None, // the runtime is shutting down
            },
        }
    }

    /// Publishes epochs that have been judged.
    async fn put_epochs(&self, taken: &[ClosedEpoch]) -> Result<(), JudgingError> {
        let Some(bench) = &self.bench else {
            return Ok(());
        };
        let length = Duration::from_nanos(self.epochs.length_ns().unsigned_abs());
        for closed in taken {
            for display in bench.judging.epoch_displays(closed, length.as_secs_f64()) {
                if let Some(topic) = self.epoch_topics.get(&display.quantity) {
                    topic.put(&display).await?;
                }
            }
        }
        Ok(())
    }

    async fn put_states(&self) -> Result<(), JudgingError> {
        let Some(bench) = &self.bench else {
            return Ok(());
        };
        let time_ns = self.clock.now_ns();
        let length = Duration::from_nanos(self.epochs.length_ns().unsigned_abs());
        let silence = self.started.elapsed().saturating_sub(self.closed_at);
        for mut display in bench.judging.displays(time_ns) {
            if silence > SILENT_EPOCHS * length {
                withdraw_old(&mut display, time_ns);
            }
            if let Some(topic) = self.topics.get(&display.quantity) {
                topic.put(&display).await?;
            }
        }
        Ok(())
    }

    async fn put_status(&self) -> Result<(), JudgingError> {
        let Some(bench) = &self.bench else {
            return Ok(());
        };
        let refused = self.epochs.refused().iter();
        let refused = refused.map(|(reason, count)| ((*reason).to_owned(), *count));
        let mut drops = self.listener.refused();
        drops.extend(refused);
        drops.extend(bench.drops());
        if self.refused > 0 {
            drops.insert("refused-epochs".to_owned(), self.refused);
        }
        if self.not_kept > 0 {
            drops.insert("annotations-not-kept".to_owned(), self.not_kept);
        }
        let report = Report {
            done: bench.judging.epochs(),
            processed_ns: self.epochs.newest_ns(),
            drops,
            ..Report::default()
        };
        Ok(self.status.put(report).await?)
    }
}

fn sources(structure: &Structure, plan: &JudgePlan) -> Result<Sources, JudgingError> {
    let sources = plan.settings.quantities.iter().map(|quantity| {
        let parameters = structure.parameters().iter().map(Parameter::name);
        let modes = structure.modal().into_iter().flat_map(|plan| &plan.modes);
        let modes = modes.map(|mode| mode.name.as_str());
        let is_it = |known: &str| known == quantity.name;
        match quantity.kind {
            QuantityKind::Stiffness if parameters.into_iter().any(is_it) => {
                Ok(Some(QuantitySource::Parameter(name(&quantity.name)?)))
            }
            QuantityKind::Frequency if modes.into_iter().any(is_it) => {
                Ok(Some(QuantitySource::Mode(name(&quantity.name)?)))
            }
            QuantityKind::Stiffness | QuantityKind::Frequency => Ok(None),
        }
    });
    let conditions = plan.settings.conditions.iter().map(|condition| {
        let mut declared = structure.conditions().iter();
        Ok(ConditionSource {
            name: name(&condition.name)?,
            kind: condition.kind,
            declared: declared
                .find(|declared| declared.name() == condition.name)
                .cloned(),
        })
    });
    Ok(Sources {
        is_updated: structure.has_model() && !structure.is_filtered(),
        length_ns: i64::from(plan.epoch_s).saturating_mul(1_000_000_000),
        quantities: sources.collect::<Result<_, JudgingError>>()?,
        conditions: conditions.collect::<Result<_, JudgingError>>()?,
    })
}

/// Warns of quantities that no live value will ever reach.
fn warn_without_source(structure: &Structure, plan: &JudgePlan, sources: &Sources) {
    let quantities = plan.settings.quantities.iter().zip(&sources.quantities);
    let without: Vec<&str> = quantities
        .filter(|(_, source)| source.is_none())
        .map(|(quantity, _)| quantity.name.as_str())
        .collect();
    if !without.is_empty() {
        warn!(
            structure = structure.name(),
            quantities = without.join(", "),
            "no live values: only a stiffness with the name of a parameter and a frequency with \
             the name of a declared mode have them"
        );
    }
}
