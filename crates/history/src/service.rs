//! Connects the history to the bus.

use crate::backlog::Backlog;
use crate::batch::{Collector, Kind, Series};
use crate::database::Database;
use crate::error::HistoryError;
use crate::settings::{Address, Keep};
use crate::trouble::{News, Trouble};
use spandrel_bus::{
    BoxedFuture, Event, EventKind, KeyFamily, Keys, LiveToken, Question, Questions, Service,
    SpanQuery, Topic, parse_key,
};
use spandrel_listener::{DisplayTopic as T, Listener, Needs};
use spandrel_service::{
    Clock, EventPublisher, Monitored, Report, ServiceInstance, StatusPublisher, Stop,
};
use std::collections::{BTreeMap, BTreeSet};
use std::panic::resume_unwind;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::sync::{Notify, watch};
use tokio::task::JoinSet;
use tokio::time::MissedTickBehavior;
use tracing::{debug, info, warn};

/// The stored topics, the log of the alert service, and the latest conditions of each feed. The log
/// includes changes that were published during a loss of the link, and changes that an earlier run
/// of this service did not write.
const NEEDS: Needs = Needs {
    topics: &[
        T::Parameters,
        T::Losses,
        T::Noise,
        T::Outliers,
        T::Conditions,
        T::Classes,
        T::Nodes,
        T::Alerts,
        T::Acknowledgements,
        T::Events,
    ],
    services: &[Service::Alert, Service::Feed],
    logs: &[Service::Alert],
};
/// Interval at which messages are taken from the subscriptions.
const GATHER_EVERY: Duration = Duration::from_millis(50);
/// Interval between batches, and between status messages.
const WRITE_EVERY: Duration = Duration::from_secs(1);
/// Interval between deletions of old rows.
const PRUNE_EVERY: Duration = Duration::from_secs(60);
/// Capacity of the queue for queries.
const QUESTIONS_WAITING: usize = 64;
/// Maximum number of rows in one transaction. A single larger batch is allowed.
const ROWS_AT_ONCE: usize = 20_000;
/// First and longest delay before a write is retried. The delay doubles with each attempt.
const RETRY_AFTER: (Duration, Duration) = (Duration::from_millis(500), Duration::from_secs(15));
/// Time limit for writing the last values after a stop.
const END_WITHIN: Duration = Duration::from_secs(5);

/// Start-up settings of the history service.
#[derive(Clone, Debug)]
pub struct HistoryPlan {
    /// Session, id and clock of the service.
    pub instance: ServiceInstance,
    /// The structures whose values are stored.
    pub structures: Vec<Monitored>,
    /// The database.
    pub address: Address,
    /// Retention time of each resolution.
    pub keep: Keep,
}

/// The history service of one or more structures.
#[derive(Debug)]
pub struct HistoryService {
    sources: Vec<Source>,
    database: Database,
    keep: Keep,
    waiting: Arc<Waiting>,
    life: String,
    clock: Clock,
    answering: JoinSet<()>,
}

/// The backlog, shared with the writing task.
#[derive(Debug, Default)]
struct Waiting {
    backlog: Mutex<Backlog>,
    came: Notify,
    trouble: Mutex<Trouble>,
}

impl Waiting {
    fn backlog(&self) -> MutexGuard<'_, Backlog> {
        // No code that can panic runs under this lock.
        self.backlog.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn trouble(&self) -> MutexGuard<'_, Trouble> {
        // As above.
        self.trouble.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Notes the result of an attempt to use the database.
    fn note(&self, database: &Database, used: &Result<(), HistoryError>) {
        let rows_waiting = self.backlog().rows();
        let mut trouble = self.trouble();
        for file in database.take_corrupt() {
            trouble.set_aside(file);
        }
        match used {
            Ok(()) => trouble.succeeded(),
            Err(error) => trouble.failed(error, rows_waiting),
        }
    }
}

/// The subscriptions of one structure.
#[derive(Debug)]
struct Source {
    keys: Keys,
    collector: Collector,
    listener: Listener,
    status: StatusPublisher,
    events: EventPublisher,
    token: LiveToken,
}

impl spandrel_service::Service for HistoryService {
    type Plan = HistoryPlan;
    type Error = HistoryError;

    /// Opens the database, subscribes to messages and announces liveliness tokens.
    ///
    /// If the database cannot be used, the service retries later. A corrupt file is set aside. Only
    /// a path that can never be a file is an error.
    ///
    /// # Errors
    /// Returns an error if the path can never be a file, or the bus rejects a declaration.
    fn start(plan: &HistoryPlan) -> BoxedFuture<'_, Result<Self, HistoryError>> {
        Self::start_from(plan)
    }

    /// Runs until `stop`. Messages taken by then are still written.
    ///
    /// # Errors
    /// Returns an error if the bus is closed.
    fn run<'a>(self, stop: Stop<'a>) -> BoxedFuture<'a, Result<(), HistoryError>> {
        self.run_until(stop)
    }
}

impl HistoryService {
    fn start_from(plan: &HistoryPlan) -> BoxedFuture<'_, Result<Self, HistoryError>> {
        Box::pin(async move {
            let HistoryPlan {
                instance,
                structures,
                address,
                keep,
            } = plan;
            let database = Database::new(address)?;
            let waiting = Arc::<Waiting>::default();
            let ready = database.ready().await;
            waiting.note(&database, &ready);
            if let Err(error) = ready {
                if error.is_of_the_path() {
                    return Err(error);
                }
                warn!("history is waiting for its database");
            }
            let mut service = Self {
                sources: Vec::new(),
                database,
                keep: keep.clone(),
                waiting,
                life: format!("{}-{}", instance.clock.now_ns(), std::process::id()),
                clock: instance.clock,
                answering: JoinSet::new(),
            };
            for monitored in structures {
                service.listen(monitored, instance).await?;
            }
            if address.believes_the_network() {
                warn!(database = %address, "the identity of the database server is not verified; \
                                            set sslmode=verify-full to verify it");
            }
            info!(database = %address, structures = structures.len(), "history ready");
            Ok(service)
        })
    }

    async fn listen(
        &mut self,
        monitored: &Monitored,
        instance: &ServiceInstance,
    ) -> Result<(), HistoryError> {
        let bus = &instance.bus;
        let Monitored {
            structure, keys, ..
        } = monitored;
        let spans = bus.questions(keys.all_history(), QUESTIONS_WAITING).await?;
        let log = bus.questions(keys.history_log(), QUESTIONS_WAITING).await?;
        let source = Source {
            collector: Collector::new(structure, keys.root().as_str()),
            listener: Listener::start(bus, keys.root(), Some(keys.structure()), NEEDS).await?,
            status: instance.publish_status(Service::History, keys).await?,
            events: EventPublisher::declare(bus, keys).await?,
            // The token comes last, because dashboards send queries as soon as they see it.
            token: instance.announce(Service::History, keys).await?,
            keys: keys.clone(),
        };
        let named = source.collector.named().clone();
        self.answering.spawn(answer_spans(
            spans,
            self.database.clone(),
            keys.clone(),
            named,
        ));
        self.answering
            .spawn(answer_log(log, self.database.clone(), keys.clone()));
        self.sources.push(source);
        Ok(())
    }

    fn run_until(mut self, stop: BoxedFuture<'_, ()>) -> BoxedFuture<'_, Result<(), HistoryError>> {
        Box::pin(async move {
            let (stopped, stopping) = watch::channel(false);
            let mut writing = JoinSet::new();
            writing.spawn(write(
                self.database.clone(),
                self.waiting.clone(),
                self.life.clone(),
                stopping,
            ));
            let mut number = 0;
            let listened = tokio::select! {
                listened = self.gather(&mut number) => listened,
                never = share_panic_of(&mut writing) => never,
                () = stop => Ok(()),
            };
            self.take();
            self.pass_on(&mut number);
            stopped.send_replace(true);
            let written = tokio::time::timeout(END_WITHIN, writing.join_next()).await;
            if !matches!(written, Ok(Some(Ok(())))) {
                writing.abort_all();
                warn!(
                    rows = self.waiting.backlog().rows(),
                    "history write failed at shutdown; the last values are lost"
                );
            }
            self.answering.shutdown().await;
            self.database.close().await;
            for source in self.sources {
                source.token.withdraw().await?;
            }
            listened
        })
    }

    /// Takes messages from the bus and passes them on. Returns only with an error.
    async fn gather(&mut self, number: &mut i64) -> Result<(), HistoryError> {
        let mut gather = tokio::time::interval(GATHER_EVERY);
        gather.set_missed_tick_behavior(MissedTickBehavior::Skip);
        let mut pass_on = tokio::time::interval(WRITE_EVERY);
        pass_on.set_missed_tick_behavior(MissedTickBehavior::Skip);
        let mut prune = tokio::time::interval(PRUNE_EVERY);
        let mut pruning = JoinSet::new();
        loop {
            tokio::select! {
                _ = gather.tick() => self.take(),
                _ = pass_on.tick() => {
                    self.pass_on(number);
                    self.put_status().await?;
                    self.put_news().await?;
                }
                _ = prune.tick() => if pruning.is_empty() {
                    pruning.spawn(forget_old(self.database.clone(), self.newest(), self.keep.clone()));
                },
                Some(_) = pruning.join_next() => {}
                never = share_panic_of(&mut self.answering) => return never,
            }
        }
    }

    /// Returns the time of the newest value of each structure, limited to the current time.
    ///
    /// Without the limit, a single wrong timestamp would delete all other values.
    fn newest(&self) -> Vec<(String, i64)> {
        let now_ns = self.clock.now_ns();
        let newest = self.sources.iter().filter_map(|source| {
            let structure = format!("{}/{}", source.keys.root(), source.keys.structure());
            Some((structure, source.collector.newest_ns?.min(now_ns)))
        });
        newest.collect()
    }

    fn take(&mut self) {
        let now_ns = self.clock.now_ns();
        for source in &mut self.sources {
            source.collector.set_now(now_ns);
            let inputs = source.listener.gather().into_iter();
            inputs.for_each(|input| source.collector.handle(input));
        }
    }

    /// Passes the collected messages to the writing task.
    fn pass_on(&mut self, number: &mut i64) {
        let mut backlog = self.waiting.backlog();
        for source in &mut self.sources {
            if let Some(batch) = source.collector.take(*number + 1) {
                *number += 1;
                backlog.push(batch);
            }
        }
        drop(backlog);
        self.waiting.came.notify_one();
    }

    async fn put_status(&self) -> Result<(), HistoryError> {
        let (points, rows) = {
            let backlog = self.waiting.backlog();
            (backlog.dropped_points, backlog.dropped_rows)
        };
        let common = [
            ("dropped-values", points),
            ("dropped-rows", rows),
            ("rows-set-aside", self.database.set_aside()),
            ("repeated-values", self.database.repeated()),
        ];
        let [failures, files] = self.waiting.trouble().drops();
        let common: Vec<(&str, u64)> = common.into_iter().chain([failures, files]).collect();
        for source in &self.sources {
            let mut drops = source.refused();
            drops.extend(
                common
                    .iter()
                    .filter(|(_, count)| *count > 0)
                    .map(|(name, count)| ((*name).to_owned(), *count)),
            );
            let report = Report {
                done: source.listener.taken(),
                processed_ns: source.collector.newest_ns,
                drops,
                ..Report::default()
            };
            source.status.put(report).await?;
        }
        Ok(())
    }

    /// Publishes and logs the changes of the state of the database.
    async fn put_news(&self) -> Result<(), HistoryError> {
        let news = self.waiting.trouble().take_news();
        for source in &self.sources {
            for news in &news {
                let event = to_event(news, &source.keys, self.clock.now_ns());
                source.events.put(&event).await?;
            }
        }
        Ok(())
    }
}

fn to_event(news: &News, keys: &Keys, time_ns: i64) -> Event {
    let (kind, what, why) = match news {
        News::Unavailable(why) => (
            EventKind::HistoryUnavailable,
            "the history cannot use its database; values wait in memory".to_owned(),
            why.clone(),
        ),
        News::Back => (
            EventKind::HistoryBack,
            "the history uses its database again".to_owned(),
            "an attempt succeeded".to_owned(),
        ),
        News::SetAside(file) => (
            EventKind::HistoryUnavailable,
            format!(
                "{} is corrupt; it is now {}, and a new file replaces it",
                file.path.display(),
                file.aside.display()
            ),
            file.why.clone(),
        ),
    };
    Event {
        structure: keys.structure().clone(),
        time_ns,
        kind,
        subject: "history".to_owned(),
        what,
        why,
    }
    .legible() // a path may be longer than a message
}

impl Source {
    /// Returns the number of overwritten and rejected messages, by reason.
    fn refused(&self) -> BTreeMap<String, u64> {
        let mut sum = self.listener.refused();
        if self.collector.unknown > 0 {
            sum.insert("unknown-quantity".to_owned(), self.collector.unknown);
        }
        let rejected = self.collector.rejected.iter();
        sum.extend(rejected.map(|(reason, count)| (format!("{reason}-conditions"), *count)));
        sum
    }
}

/// Writes the backlog, oldest batch first, until it is empty and the service stops.
async fn write(
    database: Database,
    waiting: Arc<Waiting>,
    life: String,
    mut stopping: watch::Receiver<bool>,
) {
    let mut retry_after = RETRY_AFTER.0;
    loop {
        let batches = waiting.backlog().oldest(ROWS_AT_ONCE);
        if batches.is_empty() && *stopping.borrow() {
            return;
        }
        // Without data, the database is opened all the same, so that its state is known.
        let used = match batches.is_empty() {
            true => database.ready().await,
            false => database.write(&life, &batches).await,
        };
        waiting.note(&database, &used);
        if used.is_err() {
            tokio::time::sleep(retry_after).await;
            retry_after = (2 * retry_after).min(RETRY_AFTER.1);
            continue;
        }
        retry_after = RETRY_AFTER.0;
        match batches.last() {
            Some(last) => waiting.backlog().written(last.number),
            None => tokio::select! {
                () = waiting.came.notified() => {}
                // A dropped sender also means that the service stops.
                _ = stopping.changed() => {}
            },
        }
    }
}

/// Propagates a panic of one of the tasks, so that the whole service restarts. Otherwise it never
/// returns.
///
/// Without it, the service would continue without the task.
async fn share_panic_of<T>(tasks: &mut JoinSet<()>) -> T {
    while let Some(ended) = tasks.join_next().await {
        if let Err(error) = ended
            && let Ok(panic) = error.try_into_panic()
        {
            resume_unwind(panic);
        }
    }
    std::future::pending().await
}

async fn forget_old(database: Database, newest: Vec<(String, i64)>, keep: Keep) {
    for (structure, newest_ns) in newest {
        if let Err(error) = database.prune(&structure, newest_ns, &keep).await {
            warn!(structure, %error, reason = error.reason(), "cannot remove old values from the \
                                                               history");
        }
    }
}

/// Replies to queries for spans. `named` contains the series of the structure file.
///
/// A query for any other series is rejected, unless the database contains it or it is a model
/// class.
async fn answer_spans(
    questions: Questions,
    database: Database,
    keys: Keys,
    named: BTreeSet<Series>,
) {
    let structure = format!("{}/{}", keys.root(), keys.structure());
    while let Some(question) = questions.next().await {
        let Some((
            _,
            Topic {
                family: KeyFamily::History,
                of: Some(name),
            },
        )) = parse_key(keys.root(), question.key_expression())
        else {
            question
                .reject("must be for one name, without wildcards")
                .await;
            continue;
        };
        let Some(query) = parse(&question).await else {
            continue;
        };
        let Some(series) = Series::asked(&query.kind, &name) else {
            question
                .reject("kind must be parameter, loss, noise, outlier, class, node or condition")
                .await;
            continue;
        };
        match database
            .span(&structure, keys.structure(), &series, &query)
            .await
        {
            Ok(span) if span.kept_from_s.is_none() && !may_come(&named, &series) => {
                question.reject(&unknown(&named, &series)).await;
            }
            Ok(span) => answer(&question, &keys.history(&name), &span).await,
            Err(error) => refuse(&question, &error).await,
        }
    }
}

/// Returns `true` if values of a series can occur. The structure file does not name model classes.
fn may_come(named: &BTreeSet<Series>, series: &Series) -> bool {
    match series.kind {
        Kind::Class => true,
        Kind::Parameter
        | Kind::Loss
        | Kind::Noise
        | Kind::Outlier
        | Kind::Node
        | Kind::Condition
        | Kind::Mode => named.contains(series),
    }
}

/// Returns an error message that lists the known series of this kind.
fn unknown(named: &BTreeSet<Series>, series: &Series) -> String {
    let kind = series.kind.as_str();
    let known: Vec<&str> = named
        .iter()
        .filter(|known| known.kind == series.kind)
        .map(|known| known.name.as_str())
        .collect();
    let known = if known.is_empty() {
        "none".to_owned()
    } else {
        known.join(", ")
    };
    format!(
        "unknown {kind} {:?} without stored values, must be one of: {known}",
        series.name
    )
}

async fn answer_log(questions: Questions, database: Database, keys: Keys) {
    let structure = format!("{}/{}", keys.root(), keys.structure());
    while let Some(question) = questions.next().await {
        let Some(query) = parse(&question).await else {
            continue;
        };
        match database.log(&structure, keys.structure(), &query).await {
            Ok(log) => answer(&question, &keys.history_log(), &log).await,
            Err(error) => refuse(&question, &error).await,
        }
    }
}

async fn parse(question: &Question) -> Option<SpanQuery> {
    match question.parameters().parse() {
        Ok(query) => Some(query),
        Err(error) => {
            question.reject(&error.to_string()).await;
            None
        }
    }
}

async fn answer<M: spandrel_bus::Message>(question: &Question, key: &str, message: &M) {
    if let Err(error) = question.answer(key, message).await {
        question.refuse(&error.to_string()).await;
    }
}

/// Replies that the database cannot be used. The writing task reports the reason to users.
async fn refuse(question: &Question, error: &HistoryError) {
    debug!(%error, reason = error.reason(), "history query failed");
    question.refuse(&error.to_string()).await;
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Regression: the writing task had panicked, and the service continued without a message.
    #[tokio::test]
    async fn panic_of_a_task_ends_the_service() {
        let mut tasks = JoinSet::new();
        tasks.spawn(async {});
        tasks.spawn(async { assert_eq!(1, 2, "as it should") });
        let ended = tokio::spawn(async move { share_panic_of::<()>(&mut tasks).await }).await;
        assert!(ended.is_err_and(|error| error.is_panic()));
    }

    #[test]
    fn error_lists_the_names_of_the_structure_file() {
        let series = |kind, name: &str| Series {
            kind,
            name: name.to_owned(),
        };
        let named = BTreeSet::from([
            series(Kind::Parameter, "storey-1"),
            series(Kind::Parameter, "storey-2"),
            series(Kind::Noise, "floors"),
        ]);
        let misspelt = series(Kind::Parameter, "story-1");
        assert!(
            may_come(&named, &series(Kind::Parameter, "storey-2")) && !may_come(&named, &misspelt)
        );
        assert!(
            may_come(&named, &series(Kind::Class, "baseline")),
            "classes come and go"
        );
        let told = "unknown parameter \"story-1\" without stored values, must be one of: storey-1, \
                    storey-2";
        assert_eq!(unknown(&named, &misspelt), told);
    }
}
