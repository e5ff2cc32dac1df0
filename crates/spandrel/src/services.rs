//! Starts services, monitors them, and stops them in the direction of the data flow.

use crate::earthquake::live::LiveReports;
use crate::error::AppError;
use crate::settings::Settings;
use crate::state::State;
use crate::supervision::supervise;
use spandrel_alert::{AlertPlan, AlertService, Baseline};
use spandrel_bus::{Bus, Keys, Name, Service};
use spandrel_dashboard::{DashboardPlan, DashboardService, Listen, PageSettings};
use spandrel_feed::{FeedConfig, FeedPlan, FeedService, WhenEnded};
use spandrel_fuse::{FusePlan, FuseService};
use spandrel_history::{Address, HistoryPlan, HistoryService, Keep};
use spandrel_identify::{
    FilterPool, IdentifyPlan, IdentifyService, NodeService, NodeServicePlan, Precedence, SetAside,
};
use spandrel_ingest::{IngestPlan, IngestService};
use spandrel_judging::{JudgePlanned, JudgeService};
use spandrel_modes::{ModesPlan, ModesService};
use spandrel_notify::{NotifyPlan, NotifyService, NotifySettings};
use spandrel_reports::{ReportsPlan, ReportsService};
use spandrel_service::{Monitored, Service as _, ServiceInstance};
use spandrel_structure::{Reference, Structure};
use std::net::SocketAddr;
use std::num::NonZeroUsize;
use std::panic::resume_unwind;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::task::Poll;
use std::time::Duration;
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::{oneshot, watch};
use tokio::task::{AbortHandle, JoinError, JoinSet};
use tracing::{error, info, warn};

/// Time limit for each stage to process its queue after a stop.
const STOP_DEADLINE: Duration = Duration::from_secs(10);

/// A structure with its keys.
#[derive(Debug)]
pub struct Watched {
    /// The structure.
    pub structure: Structure,
    /// Key expressions of the structure.
    pub keys: Keys,
    /// Baseline of the structure, if there is a baseline file.
    pub baseline: Option<Baseline>,
    /// Structure file, to which matrix files are relative.
    pub file: PathBuf,
}

/// Reads the structures that the arguments specify, or else those of the configuration.
///
/// # Errors
/// Returns an error if there is no structure, a structure is not valid, or two structures have the
/// same name.
pub fn read_structures(settings: &Settings, paths: &[PathBuf]) -> Result<Vec<Watched>, AppError> {
    let paths = if paths.is_empty() {
        &settings.structures
    } else {
        paths
    };
    if paths.is_empty() {
        return Err(AppError::NoStructure);
    }
    let all = *paths == settings.structures;
    let mut watched: Vec<Watched> = Vec::new();
    for (index, path) in paths.iter().enumerate() {
        let read = watch_structure(settings, path)?;
        let name = read.structure.name();
        if let Some(same) = watched
            .iter()
            .position(|other| other.structure.name() == name)
        {
            let (name, first, second) =
                (name.to_owned(), paths[same].clone(), paths[index].clone());
            return Err(AppError::SameStructure {
                name,
                first,
                second,
            });
        }
        watched.push(read);
    }
    let is_watched = |name: &String| {
        watched
            .iter()
            .any(|watched| watched.structure.name() == name)
    };
    if let Some((name, path)) = settings
        .baselines
        .iter()
        .find(|(name, _)| all && !is_watched(name))
    {
        let known: Vec<&str> = watched
            .iter()
            .map(|watched| watched.structure.name())
            .collect();
        return Err(AppError::BaselineOfNone {
            name: name.clone(),
            path: path.clone(),
            known: known.join(", "),
        });
    }
    Ok(watched)
}

/// Checks that a baseline belongs to a structure.
///
/// # Errors
/// Returns an error if the baseline belongs to another structure.
pub fn check_baseline_structure(
    structure: &Structure,
    baseline: &Baseline,
    path: &Path,
) -> Result<(), AppError> {
    if baseline.structure() == structure.name() {
        return Ok(());
    }
    Err(AppError::OtherBaseline {
        path: path.to_owned(),
        found: baseline.structure().to_owned(),
        expected: structure.name().to_owned(),
    })
}

/// Warns of baseline entries without effect, and of parameters that still have to be learnt.
///
/// # Errors
/// Returns an error if the baseline belongs to another structure.
pub fn check_baseline(
    structure: &Structure,
    baseline: &Baseline,
    path: &Path,
) -> Result<(), AppError> {
    check_baseline_structure(structure, baseline, path)?;
    let (path, names) = (path.display(), || {
        structure
            .parameters()
            .iter()
            .map(|parameter| parameter.name())
    });
    let learning: Vec<&str> = structure
        .alert_rules()
        .iter()
        .filter(|rule| matches!(rule.reference, Reference::Baseline { .. }))
        .flat_map(|rule| &rule.parameters)
        .filter_map(|index| names().nth(*index))
        .collect();
    if learning.is_empty() {
        let structure = structure.name();
        warn!(
            "{path}: not used; no alert rule of {structure} learns its reference (reference = {{ \
             learn-s = … }})"
        );
        return Ok(());
    }
    let unknown: Vec<&str> = baseline
        .parameters()
        .filter(|name| !names().any(|known| known == *name))
        .collect();
    if !unknown.is_empty() {
        let known: Vec<&str> = names().collect();
        warn!(
            "{path}: unknown parameters of {}: {}, must be among {}",
            structure.name(),
            unknown.join(", "),
            known.join(", ")
        );
    }
    if baseline.is_old_file() {
        let records = baseline.records();
        warn!(
            "{path}: has version 1; assuming that its scatter between records was estimated from \
             {records} records"
        );
    }
    for name in learning {
        match baseline.claim(name) {
            None => warn!("{path}: lacks {name}, which will be learnt from the first data"),
            Some(Err(error)) => warn!("{path}: {name} will be learnt from the first data: {error}"),
            Some(Ok(_)) => {}
        }
    }
    Ok(())
}

/// Reads one structure with its keys and baseline.
///
/// # Errors
/// Returns an error if a file is not valid.
pub fn watch_structure(settings: &Settings, path: &Path) -> Result<Watched, AppError> {
    let structure = Structure::read(path)?;
    let keys = settings.bus.keys(structure.name())?;
    let baseline = match settings.baselines.get(structure.name()) {
        Some(path) => {
            let baseline = Baseline::read(path)?;
            check_baseline(&structure, &baseline, path)?;
            Some(baseline)
        }
        None => None,
    };
    Ok(Watched {
        structure,
        keys,
        baseline,
        file: path.to_owned(),
    })
}

/// Share of the identification that a process performs.
#[derive(Debug, Clone, Copy)]
pub struct Share<'s> {
    /// Nodes whose workers this process runs. If empty, it runs the workers of all distributed
    /// nodes.
    pub nodes: &'s [String],
    /// Whether this process leads or stands by if others identify the same structure.
    pub precedence: Precedence,
}

impl Share<'_> {
    /// The whole identification.
    pub const ALL: Share<'static> = Share {
        nodes: &[],
        precedence: Precedence::Leads,
    };
}

/// The order in which services stop: that of the data flow. They start in the opposite order.
const STOP_ORDER: [Service; 11] = [
    Service::Feed,
    Service::Ingest,
    Service::Identify,
    Service::Fuse,
    Service::Alert,
    Service::Modes,
    Service::Judge,
    Service::Reports,
    Service::History,
    Service::Notify,
    Service::Dashboard,
];

/// The services of one process, which share one session.
#[derive(Debug)]
pub struct Running {
    bus: Bus,
    monitored: Vec<Monitored>,
    /// Baseline of each structure, in the same order.
    baselines: Vec<Option<Baseline>>,
    /// File of each structure, in the same order.
    files: Vec<PathBuf>,
    stages: Vec<Stage>,
    pool: Option<FilterPool>,
}

/// All instances of one service.
#[derive(Debug)]
struct Stage {
    service: Service,
    tasks: JoinSet<Result<(), AppError>>,
    /// Structures or nodes of each task.
    of: Vec<(String, AbortHandle)>,
    stop: watch::Sender<bool>,
}

/// Completes when a stop is requested.
async fn stopped(mut stop: watch::Receiver<bool>) {
    // A dropped sender also means stop.
    let _ = stop.wait_for(|stop| *stop).await;
}

impl Stage {
    fn new(service: Service) -> Self {
        Self {
            service,
            tasks: JoinSet::new(),
            of: Vec::new(),
            stop: watch::Sender::new(false),
        }
    }

    /// Runs a started service. After a panic, starts it again from the plan. `of` names its
    /// structures.
    fn run<S>(&mut self, of: String, service: S, plan: S::Plan)
    where
        S: spandrel_service::Service,
        AppError: From<S::Error>,
    {
        let stop = self.stop.subscribe();
        let first = service.run(Box::pin(stopped(stop.clone())));
        let first = async move { Ok(first.await?) };
        let plan = Arc::new(plan);
        let next = move || {
            let (plan, stop) = (plan.clone(), stopped(stop.clone()));
            async move { Ok(S::start(&plan).await?.run(Box::pin(stop)).await?) }
        };
        let life = supervise(self.service.as_str(), of.clone(), first, next);
        self.of.push((of, self.tasks.spawn(life)));
    }

    /// Returns how an instance ended.
    fn ended(&self, joined: Result<Result<(), AppError>, JoinError>) -> Result<(), AppError> {
        joined.unwrap_or_else(|source| {
            Err(AppError::Panicked {
                service: self.service.as_str(),
                source,
            })
        })
    }

    /// Stops all instances, and aborts those that do not finish before the deadline.
    async fn stop(&mut self, deadline: Duration) -> Result<(), AppError> {
        self.stop.send_replace(true);
        let mut first = Ok(());
        let all = async {
            while let Some(ended) = self.tasks.join_next().await {
                let ended = self.ended(ended);
                if first.is_ok() {
                    first = ended;
                }
            }
        };
        if tokio::time::timeout(deadline, all).await.is_err() {
            let late = { self.of.iter() }.filter(|(_, task)| !task.is_finished());
            let late: Vec<&str> = late.map(|(of, _)| of.as_str()).collect();
            let (service, of) = (self.service.as_str(), late.join(", "));
            let deadline_s = deadline.as_secs();
            error!(service, of, deadline_s, "did not finish in time");
            self.tasks.abort_all();
            first = first.and(Err(AppError::NotStopped {
                service,
                of,
                deadline_s,
            }));
        }
        first
    }
}

impl Running {
    /// Creates an empty set of services for these structures. With `state`, the services save their
    /// state.
    pub fn new(bus: &Bus, watched: &[Watched], state: Option<&State>) -> Self {
        let monitored = watched.iter().map(|watched| Monitored {
            remembering: state.map(|state| state.remembering(&watched.keys)),
            ..Monitored::new(&watched.structure, watched.keys.clone())
        });
        Self {
            bus: bus.clone(),
            monitored: monitored.collect(),
            baselines: watched
                .iter()
                .map(|watched| watched.baseline.clone())
                .collect(),
            files: watched.iter().map(|watched| watched.file.clone()).collect(),
            stages: STOP_ORDER.map(Stage::new).into(),
            pool: None,
        }
    }

    /// Returns the thread pool of the filters, if there is one.
    pub fn pool(&self) -> Option<FilterPool> {
        self.pool.clone()
    }

    /// Returns the only instance of a service in this process.
    fn instance(&self, service: Service) -> ServiceInstance {
        ServiceInstance::new(&self.bus, service.name())
    }

    /// Starts a service and runs it until a stop. `of` names its structures.
    async fn start<S>(&mut self, service: Service, of: &str, plan: S::Plan) -> Result<(), AppError>
    where
        S: spandrel_service::Service,
        AppError: From<S::Error>,
    {
        let started = S::start(&plan).await?;
        if let Some(stage) = self.stage(service) {
            stage.run(of.to_owned(), started, plan);
        }
        // A start may never wait, and a stop during the starts must be noticed.
        tokio::task::yield_now().await;
        Ok(())
    }

    /// Starts an instance for each structure for which `plan` returns a plan.
    async fn start_each<S>(
        &mut self,
        service: Service,
        plan: impl Fn(ServiceInstance, Monitored) -> Option<S::Plan>,
    ) -> Result<(), AppError>
    where
        S: spandrel_service::Service,
        AppError: From<S::Error>,
    {
        for monitored in self.monitored.clone() {
            let of = monitored.structure.name().to_owned();
            if let Some(plan) = plan(self.instance(service), monitored) {
                self.start::<S>(service, &of, plan).await?;
            }
        }
        Ok(())
    }

    fn stage(&mut self, service: Service) -> Option<&mut Stage> {
        self.stages
            .iter_mut()
            .find(|stage| stage.service == service)
    }

    /// Returns the names of all structures.
    fn names(&self) -> String {
        let names: Vec<&str> = self
            .monitored
            .iter()
            .map(|monitored| monitored.structure.name())
            .collect();
        names.join(", ")
    }

    /// Starts the feed of all sources.
    ///
    /// # Errors
    /// Returns an error if the feed cannot start.
    pub async fn start_feed(
        &mut self,
        config: &FeedConfig,
        when_ended: WhenEnded,
    ) -> Result<(), AppError> {
        let plan = FeedPlan {
            instance: self.instance(Service::Feed),
            structures: self.monitored.clone(),
            config: config.clone(),
            when_ended,
        };
        self.start::<FeedService>(Service::Feed, &self.names(), plan)
            .await
    }

    /// Starts ingest for each structure. With `state`, ingest records its frames.
    ///
    /// # Errors
    /// Returns an error if an instance cannot start.
    pub async fn start_ingest(&mut self, state: Option<&State>) -> Result<(), AppError> {
        self.start_each::<IngestService>(Service::Ingest, |instance, monitored| {
            Some(IngestPlan {
                instance,
                recording: state.map(|state| state.recording(&monitored.keys)),
                monitored,
            })
        })
        .await
    }

    /// Starts the identification of each structure with a model on one thread pool.
    ///
    /// A structure has one worker, or one worker per node if it is distributed.
    ///
    /// # Errors
    /// Returns an error if an instance cannot start, a node is unknown, or a distributed structure
    /// is to have a standby.
    pub async fn start_identify(
        &mut self,
        threads: Option<NonZeroUsize>,
        share: Share<'_>,
    ) -> Result<(), AppError> {
        let Share {
            nodes: only,
            precedence,
        } = share;
        check_nodes(&self.monitored, only)?;
        let threads = threads
            .or_else(|| std::thread::available_parallelism().ok())
            .unwrap_or(NonZeroUsize::MIN);
        let no_thread = |source| AppError::Io {
            what: "cannot start a thread for the filters".to_owned(),
            source,
        };
        let pool = FilterPool::start(threads).map_err(no_thread)?;
        self.pool = Some(pool.clone());
        let mut instance = self.instance(Service::Identify);
        if precedence == Precedence::StandsBy {
            instance.id = Name::new(format!("identify-{:.8}", self.bus.instance()?.as_str()))?;
        }
        let baselines = self.baselines.clone();
        for (monitored, baseline) in self.monitored.clone().into_iter().zip(baselines) {
            let structure = monitored.structure.clone();
            if !structure.has_model() {
                info!(
                    structure = structure.name(),
                    "no model to identify, only natural frequencies"
                );
                continue;
            }
            if !structure.is_filtered() {
                info!(
                    structure = structure.name(),
                    "no filter: natural frequencies update the stiffnesses"
                );
                continue;
            }
            if structure.fusion().is_none() {
                let plan = IdentifyPlan {
                    instance: instance.clone(),
                    monitored,
                    pool: pool.clone(),
                    precedence,
                    sensors: baseline.map_or_else(Vec::new, |known| known.sensors().to_vec()),
                };
                self.start::<IdentifyService>(Service::Identify, structure.name(), plan)
                    .await?;
                continue;
            }
            let is_wanted = |name: &str| only.is_empty() || only.iter().any(|one| one == name);
            for (position, node) in structure.nodes().iter().enumerate() {
                if !is_wanted(node.name()) {
                    continue;
                }
                let plan = NodeServicePlan {
                    bus: self.bus.clone(),
                    clock: instance.clock,
                    monitored: monitored.clone(),
                    position,
                    pool: pool.clone(),
                    set_aside: SetAside::default(),
                };
                let of = format!("{}/{}", structure.name(), node.name());
                self.start::<NodeService>(Service::Identify, &of, plan)
                    .await?;
            }
        }
        Ok(())
    }

    /// Starts the central station of each distributed structure.
    ///
    /// # Errors
    /// Returns an error if an instance cannot start.
    pub async fn start_fuse(&mut self) -> Result<(), AppError> {
        self.start_each::<FuseService>(Service::Fuse, |instance, monitored| {
            monitored.structure.fusion()?;
            Some(FusePlan {
                instance,
                monitored,
            })
        })
        .await
    }

    /// Starts the alert service of each structure that a filter estimates, with its baseline if
    /// there is one.
    ///
    /// # Errors
    /// Returns an error if an instance cannot start.
    pub async fn start_alert(&mut self) -> Result<(), AppError> {
        for (monitored, baseline) in self
            .monitored
            .clone()
            .into_iter()
            .zip(self.baselines.clone())
        {
            if !monitored.structure.is_filtered() {
                continue; // without estimates, no rule can be decided
            }
            let of = monitored.structure.name().to_owned();
            let plan = AlertPlan {
                instance: self.instance(Service::Alert),
                monitored,
                baseline,
            };
            self.start::<AlertService>(Service::Alert, &of, plan)
                .await?;
        }
        Ok(())
    }

    /// Starts to follow the modes of each structure that has a table `[modal]`.
    ///
    /// # Errors
    /// Returns an error if an instance cannot start.
    pub async fn start_modes(&mut self) -> Result<(), AppError> {
        self.start_each::<ModesService>(Service::Modes, |instance, monitored| {
            monitored.structure.modal()?;
            Some(ModesPlan {
                instance,
                monitored,
            })
        })
        .await
    }

    /// Starts the judgement of each structure that has a table `[judge]`.
    ///
    /// # Errors
    /// Returns an error if an instance cannot start.
    pub async fn start_judge(&mut self) -> Result<(), AppError> {
        self.start_each::<JudgeService>(Service::Judge, |instance, monitored| {
            monitored.structure.judge()?;
            Some(JudgePlanned {
                instance,
                monitored,
            })
        })
        .await
    }

    /// Starts the reports of each structure that has a table `[earthquakes]`.
    ///
    /// # Errors
    /// Returns an error if an instance cannot start.
    pub async fn start_reports(&mut self, state: Option<&State>) -> Result<(), AppError> {
        let files = self.files.clone();
        for (monitored, file) in self.monitored.clone().into_iter().zip(files) {
            let Some(plan) = monitored.structure.earthquakes() else {
                continue;
            };
            let of = monitored.structure.name().to_owned();
            let Some(state) = state else {
                warn!(
                    structure = of,
                    "no state folder, so earthquakes are not reported"
                );
                continue;
            };
            let maker = LiveReports::new(monitored.structure.clone(), &file, plan);
            let plan = ReportsPlan {
                instance: self.instance(Service::Reports),
                folder: state.events(&monitored.keys),
                maker: Arc::new(maker),
                monitored,
            };
            self.start::<ReportsService>(Service::Reports, &of, plan)
                .await?;
        }
        Ok(())
    }

    /// Starts the history of all structures.
    ///
    /// # Errors
    /// Returns an error if the history cannot start.
    pub async fn start_history(&mut self, address: &Address, keep: &Keep) -> Result<(), AppError> {
        let plan = HistoryPlan {
            instance: self.instance(Service::History),
            structures: self.monitored.clone(),
            address: address.clone(),
            keep: keep.clone(),
        };
        self.start::<HistoryService>(Service::History, &self.names(), plan)
            .await
    }

    /// Starts the notifications of all structures.
    ///
    /// # Errors
    /// Returns an error if the service cannot start.
    pub async fn start_notify(&mut self, settings: &NotifySettings) -> Result<(), AppError> {
        let plan = NotifyPlan {
            instance: self.instance(Service::Notify),
            structures: self.monitored.clone(),
            settings: settings.clone(),
        };
        self.start::<NotifyService>(Service::Notify, &self.names(), plan)
            .await
    }

    /// Starts the dashboard of all structures and returns the address of its page.
    ///
    /// # Errors
    /// Returns an error if the dashboard cannot start.
    pub async fn start_dashboard(&mut self, page: &PageSettings) -> Result<SocketAddr, AppError> {
        let mut plan = DashboardPlan {
            instance: self.instance(Service::Dashboard),
            structures: self.monitored.clone(),
            page: page.clone(),
        };
        let service = DashboardService::start(&plan).await?;
        let address = service.address();
        // After a restart, open pages find the dashboard at the same address.
        plan.page.listen = Listen::At(address.to_string());
        let of = self.names();
        if let Some(stage) = self.stage(Service::Dashboard) {
            stage.run(of, service, plan);
        }
        Ok(address)
    }

    /// Waits until a service ends. No service ends before a stop unless it fails.
    ///
    /// # Errors
    /// Returns the error of that service.
    pub async fn failed(&mut self) -> Result<(), AppError> {
        std::future::poll_fn(|context| {
            for stage in &mut self.stages {
                if let Poll::Ready(Some(ended)) = stage.tasks.poll_join_next(context) {
                    return Poll::Ready(stage.ended(ended));
                }
            }
            Poll::Pending
        })
        .await
    }

    /// Stops all services, the source first, so that data in transit is still processed.
    ///
    /// # Errors
    /// Returns the first error of a service.
    pub async fn stop(mut self) -> Result<(), AppError> {
        let mut first = Ok(());
        for stage in &mut self.stages {
            let stopped = stage.stop(STOP_DEADLINE).await;
            first = first.and(stopped);
        }
        first
    }
}

/// Rejects node names that do not belong to a distributed structure.
fn check_nodes(monitored: &[Monitored], only: &[String]) -> Result<(), AppError> {
    let distributed = || {
        monitored
            .iter()
            .filter(|monitored| monitored.structure.fusion().is_some())
    };
    let known = || {
        distributed()
            .flat_map(|monitored| monitored.structure.nodes())
            .map(|node| node.name().to_owned())
    };
    match only
        .iter()
        .find(|name| !known().any(|known| known == **name))
    {
        Some(name) => {
            let known: Vec<String> = known().collect();
            let known = if known.is_empty() {
                "none".to_owned()
            } else {
                known.join(", ")
            };
            Err(AppError::NoSuchNode {
                name: name.clone(),
                known,
            })
        }
        None => Ok(()),
    }
}

/// Completes when the process receives Ctrl-C or SIGTERM, starting with this call. A second signal
/// exits at once.
pub fn interrupted() -> impl Future<Output = ()> {
    let mut signals = StopSignals::new();
    let (mut told, asked) = oneshot::channel();
    tokio::spawn(async move {
        tokio::select! {
            () = signals.next() => {}
            () = told.closed() => return, // the receiver was dropped
        }
        info!("stopping; a second signal stops at once");
        let _ = told.send(());
        signals.next().await;
        std::process::exit(130);
    });
    async {
        if asked.await.is_err() {
            std::future::pending::<()>().await; // the runtime is shutting down
        }
    }
}

/// Awaits the opening of a session, which blocks its thread for as long as no router answers.
///
/// The stop signal `interrupted` meanwhile ends the process with exit code 0. Nothing has been
/// started yet, and the runtime would wait for the blocked thread.
pub async fn open_unless_stopped<T: Send + 'static>(
    opening: impl Future<Output = T> + Send + 'static,
    interrupted: impl Future<Output = ()>,
) -> T {
    tokio::select! {
        opened = tokio::spawn(opening) => opened.unwrap_or_else(|failed| resume_unwind(failed.into_panic())),
        () = interrupted => std::process::exit(0),
    }
}

/// Handlers for Ctrl-C and SIGTERM.
///
/// Without a handler, these signals end the process silently. The handlers must therefore exist
/// before the process reports that it is ready.
struct StopSignals([Option<Signal>; 2]);

impl StopSignals {
    fn new() -> Self {
        Self(
            [SignalKind::interrupt(), SignalKind::terminate()].map(|kind| match signal(kind) {
                Ok(signal) => Some(signal),
                Err(error) => {
                    warn!(%error, signal = kind.as_raw_value(), "cannot handle a stop signal");
                    None
                }
            }),
        )
    }

    async fn next(&mut self) {
        let Self([interrupted, terminated]) = self;
        tokio::select! {
            () = heard(interrupted) => {}
            () = heard(terminated) => {}
        }
    }
}

/// Waits for a signal, or forever if there is no handler for it.
async fn heard(signal: &mut Option<Signal>) {
    let is_heard = match signal {
        Some(signal) => signal.recv().await.is_some(),
        None => false,
    };
    if !is_heard {
        std::future::pending::<()>().await;
    }
}

/// Runs a future on a new runtime.
///
/// # Errors
/// Returns an error if the runtime cannot start, or if the future fails.
pub fn block_on<T>(future: impl Future<Output = Result<T, AppError>>) -> Result<T, AppError> {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build();
    let runtime = runtime.map_err(|source| AppError::Io {
        what: "cannot start the runtime".to_owned(),
        source,
    })?;
    runtime.block_on(future)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::future::pending;

    fn example(name: &str) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../../docs/examples")
            .join(name)
    }

    /// Regression: as many arguments as structures of the configuration counted as all of them.
    #[test]
    fn baselines_of_other_structures_are_allowed_if_the_arguments_name_one() {
        let settings = Settings {
            structures: vec![example("demo.toml")],
            baselines: [("demo".to_owned(), "baseline.json".into())].into(),
            ..Settings::default()
        };
        let watched = read_structures(&settings, &[example("tower.toml")]).unwrap();
        assert_eq!(watched.len(), 1);
        let settings = Settings {
            structures: vec![example("tower.toml")],
            ..settings
        };
        let error = read_structures(&settings, &[]).unwrap_err();
        assert!(
            matches!(error, AppError::BaselineOfNone { .. }),
            "{error:?}"
        );
    }

    #[tokio::test]
    async fn error_names_what_did_not_stop_before_the_deadline() {
        let mut stage = Stage::new(Service::Ingest);
        for (of, stops) in [("tower", true), ("bridge", false)] {
            let life = async move { if stops { Ok(()) } else { pending().await } };
            stage.of.push((of.to_owned(), stage.tasks.spawn(life)));
        }
        let error = stage.stop(Duration::from_secs(1)).await.unwrap_err();
        assert_eq!(
            error.to_string(),
            "ingest of bridge: the service did not stop before its deadline of 1 s"
        );
    }
}
