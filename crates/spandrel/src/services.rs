//! Starts services, monitors them, and stops them in the direction of the data flow.

use crate::error::AppError;
use crate::settings::Settings;
use crate::state::State;
use crate::supervision::supervise;
use spandrel_alert::{AlertService, Baseline};
use spandrel_bus::{BoxedFuture, Bus, Keys, Name};
use spandrel_dashboard::{DashboardService, Listen, PageSettings};
use spandrel_fuse::FuseService;
use spandrel_history::{Address, HistoryService, Keep};
use spandrel_identify::{FilterPool, IdentifyService, NodeService, Precedence, SetAside};
use spandrel_ingest::{FrameWait, IngestService, IngestSettings};
use spandrel_notify::{NotifyService, NotifySettings};
use spandrel_structure::{Reference, Structure};
use std::net::SocketAddr;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::{oneshot, watch};
use tokio::task::JoinSet;
use tracing::{info, warn};

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
}

/// Reads the structures that the arguments specify, or else those of the configuration.
///
/// # Errors
/// There is no structure, a structure is not valid, or two structures have the same name.
pub fn read_structures(settings: &Settings, paths: &[PathBuf]) -> Result<Vec<Watched>, AppError> {
    let paths = if paths.is_empty() {
        &settings.structures
    } else {
        paths
    };
    if paths.is_empty() {
        return Err(AppError::NoStructure);
    }
    let all = paths.len() == settings.structures.len();
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

/// Warns of baseline entries without effect, and of parameters that still have to be learnt.
pub fn tell_unused_baseline(structure: &Structure, baseline: &Baseline, path: &Path) {
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
        return;
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
}

/// Reads one structure with its keys and baseline.
///
/// # Errors
/// A file is not valid.
pub fn watch_structure(settings: &Settings, path: &Path) -> Result<Watched, AppError> {
    let structure = Structure::read(path)?;
    let keys = settings.bus.keys(structure.name())?;
    let baseline = match settings.baselines.get(structure.name()) {
        Some(path) => {
            let baseline = Baseline::read(path)?;
            tell_unused_baseline(&structure, &baseline, path);
            Some(baseline)
        }
        None => None,
    };
    Ok(Watched {
        structure,
        keys,
        baseline,
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

/// The services of one process, which share one session.
#[derive(Debug)]
pub struct Running {
    ingest: Stage,
    identify: Stage,
    fuse: Stage,
    alert: Stage,
    history: Stage,
    notify: Stage,
    dashboard: Stage,
    pool: Option<FilterPool>,
}

/// A future that completes when a service must stop.
type Stop = BoxedFuture<'static, ()>;

/// A function that runs a service until it must stop.
type Run<S, E> = fn(S, Stop) -> BoxedFuture<'static, Result<(), E>>;

/// Completes when a stop is requested.
async fn stopped(mut stop: watch::Receiver<bool>) {
    // A dropped sender also means stop.
    let _ = stop.wait_for(|stop| *stop).await;
}

/// All instances of one service.
#[derive(Debug)]
struct Stage {
    name: &'static str,
    tasks: JoinSet<Result<(), AppError>>,
    stop: watch::Sender<bool>,
}

impl Stage {
    fn new(name: &'static str) -> Self {
        Self {
            name,
            tasks: JoinSet::new(),
            stop: watch::Sender::new(false),
        }
    }

    /// Starts a service of this stage, and restarts it after a panic. `of` names its structures.
    async fn start<S, E, Starting>(
        &mut self,
        of: String,
        start: impl Fn() -> Starting + Send + 'static,
        run: Run<S, E>,
    ) -> Result<(), AppError>
    where
        Starting: Future<Output = Result<S, E>> + Send + 'static,
        S: Send + 'static,
        E: Send + 'static,
        AppError: From<E>,
    {
        let service = start().await?;
        self.run(of, service, start, run);
        Ok(())
    }

    /// Runs a service that has already been started, and restarts it after a panic like
    /// [`Stage::start`].
    fn run<S, E, Starting>(
        &mut self,
        of: String,
        service: S,
        start: impl Fn() -> Starting + Send + 'static,
        run: Run<S, E>,
    ) where
        Starting: Future<Output = Result<S, E>> + Send + 'static,
        S: Send + 'static,
        E: Send + 'static,
        AppError: From<E>,
    {
        let stop = self.stop.subscribe();
        let first = run(service, Box::pin(stopped(stop.clone())));
        let first = async move { Ok(first.await?) };
        let next = move || {
            let (starting, stop) = (start(), stopped(stop.clone()));
            async move { Ok(run(starting.await?, Box::pin(stop)).await?) }
        };
        self.tasks.spawn(supervise(self.name, of, first, next));
    }

    /// Waits until an instance ends. No instance ends before a stop unless it fails.
    async fn ended(&mut self) -> Result<(), AppError> {
        match self.tasks.join_next().await {
            None => std::future::pending().await,
            Some(Ok(result)) => result,
            Some(Err(source)) => Err(AppError::Panicked {
                service: self.name,
                source,
            }),
        }
    }

    async fn stop(&mut self) -> Result<(), AppError> {
        self.stop.send_replace(true);
        let mut first = Ok(());
        let all = async {
            while let Some(ended) = self.tasks.join_next().await {
                let ended = ended.unwrap_or_else(|source| {
                    Err(AppError::Panicked {
                        service: self.name,
                        source,
                    })
                });
                if first.is_ok() {
                    first = ended;
                }
            }
        };
        if tokio::time::timeout(STOP_DEADLINE, all).await.is_err() {
            warn!(
                service = self.name,
                deadline_s = STOP_DEADLINE.as_secs(),
                "did not finish in time"
            );
            self.tasks.abort_all();
        }
        first
    }
}

impl Running {
    /// Creates an empty set of services.
    pub fn new() -> Self {
        Self {
            ingest: Stage::new("ingest"),
            identify: Stage::new("identify"),
            fuse: Stage::new("fuse"),
            alert: Stage::new("alert"),
            history: Stage::new("history"),
            notify: Stage::new("notify"),
            dashboard: Stage::new("dashboard"),
            pool: None,
        }
    }

    /// Returns the thread pool of the filters, if there is one.
    pub fn pool(&self) -> Option<FilterPool> {
        self.pool.clone()
    }

    /// Starts ingest for each structure. With `state`, ingest records its frames.
    ///
    /// # Errors
    /// An instance cannot start.
    pub async fn start_ingest(
        &mut self,
        bus: &Bus,
        watched: &[Watched],
        state: Option<&State>,
    ) -> Result<(), AppError> {
        for Watched {
            structure, keys, ..
        } in watched
        {
            let structure_name = structure.name().to_owned();
            let lateness = Duration::try_from_secs_f64(structure.ingest().lateness_s);
            let settings = IngestSettings {
                id: Name::new("ingest")?,
                epoch: epoch_now(),
                waiting: lateness.map_or(FrameWait::Unlimited, FrameWait::Limited),
                recording: state.map(|state| state.recording(keys)),
            };
            let (structure, bus, keys) = (structure.clone(), bus.clone(), keys.clone());
            let start = move || {
                let settings = IngestSettings {
                    epoch: epoch_now(),
                    ..settings.clone()
                };
                let (structure, bus, keys) = (structure.clone(), bus.clone(), keys.clone());
                async move { IngestService::start(&structure, &bus, keys, settings).await }
            };
            self.ingest
                .start(structure_name, start, |service, stop| service.run(stop))
                .await?;
        }
        Ok(())
    }

    /// Starts the identification of each structure on one thread pool.
    ///
    /// A structure has one worker, or one worker per node if it is distributed.
    ///
    /// # Errors
    /// An instance cannot start, a node is unknown, or a distributed structure is to have a
    /// standby.
    pub async fn start_identify(
        &mut self,
        bus: &Bus,
        watched: &[Watched],
        threads: Option<NonZeroUsize>,
        share: Share<'_>,
        state: Option<&State>,
    ) -> Result<(), AppError> {
        let Share {
            nodes: only,
            precedence,
        } = share;
        check_nodes(watched, only)?;
        let threads = threads
            .or_else(|| std::thread::available_parallelism().ok())
            .unwrap_or(NonZeroUsize::MIN);
        let no_thread = |source| AppError::Io {
            what: "cannot start a thread for the filters".to_owned(),
            source,
        };
        let pool = FilterPool::start(threads).map_err(no_thread)?;
        self.pool = Some(pool.clone());
        let wanted = |name: &str| only.is_empty() || only.iter().any(|wanted| wanted == name);
        for Watched {
            structure, keys, ..
        } in watched
        {
            let remembering = state.map(|state| state.remembering(keys));
            if structure.fusion().is_some() {
                for (position, node) in structure
                    .nodes()
                    .iter()
                    .enumerate()
                    .filter(|(_, node)| wanted(node.name()))
                {
                    let of = format!("{}/{}", structure.name(), node.name());
                    let (structure, bus, keys, pool) =
                        (structure.clone(), bus.clone(), keys.clone(), pool.clone());
                    let (remembering, set_aside) = (remembering.clone(), SetAside::default());
                    let start = move || {
                        let (structure, bus, keys, pool) =
                            (structure.clone(), bus.clone(), keys.clone(), pool.clone());
                        let (remembering, set_aside) = (remembering.clone(), set_aside.clone());
                        async move {
                            let (remembering, epoch) = (remembering.as_ref(), epoch_now());
                            let service = NodeService::start(
                                &structure,
                                position,
                                &bus,
                                &keys,
                                epoch,
                                pool,
                                remembering,
                            )
                            .await?;
                            Ok(service.without(set_aside))
                        }
                    };
                    self.identify
                        .start(of, start, |service, stop| NodeService::run(service, stop))
                        .await?;
                }
                continue;
            }
            let id = match precedence {
                Precedence::Leads => Name::new("identify")?,
                Precedence::StandsBy => {
                    Name::new(format!("identify-{:.8}", bus.instance()?.as_str()))?
                }
            };
            let of = structure.name().to_owned();
            let (structure, bus, keys, pool) =
                (structure.clone(), bus.clone(), keys.clone(), pool.clone());
            let start = move || {
                let (structure, bus, keys, id) =
                    (structure.clone(), bus.clone(), keys.clone(), id.clone());
                let (pool, remembering) = (pool.clone(), remembering.clone());
                async move {
                    IdentifyService::start(
                        &structure,
                        &bus,
                        keys,
                        id,
                        pool,
                        remembering.as_ref(),
                        precedence,
                    )
                    .await
                }
            };
            self.identify
                .start(of, start, |service, stop| service.run(stop))
                .await?;
        }
        Ok(())
    }

    /// Starts the central station of each distributed structure.
    ///
    /// # Errors
    /// An instance cannot start.
    pub async fn start_fuse(
        &mut self,
        bus: &Bus,
        watched: &[Watched],
        state: Option<&State>,
    ) -> Result<(), AppError> {
        for Watched {
            structure, keys, ..
        } in watched
            .iter()
            .filter(|watched| watched.structure.fusion().is_some())
        {
            let (id, remembering) = (
                Name::new("fuse")?,
                state.map(|state| state.remembering(keys)),
            );
            let of = structure.name().to_owned();
            let (structure, bus, keys) = (structure.clone(), bus.clone(), keys.clone());
            let start = move || {
                let (structure, bus, keys) = (structure.clone(), bus.clone(), keys.clone());
                let (id, remembering) = (id.clone(), remembering.clone());
                async move {
                    FuseService::start(
                        &structure,
                        &bus,
                        keys,
                        id,
                        epoch_now(),
                        remembering.as_ref(),
                    )
                    .await
                }
            };
            self.fuse
                .start(of, start, |service, stop| service.run(stop))
                .await?;
        }
        Ok(())
    }

    /// Starts the alert service of each structure.
    ///
    /// # Errors
    /// An instance cannot start.
    pub async fn start_alert(
        &mut self,
        bus: &Bus,
        watched: &[Watched],
        state: Option<&State>,
    ) -> Result<(), AppError> {
        for Watched {
            structure,
            keys,
            baseline,
        } in watched
        {
            let id = Name::new("alert")?;
            let remembering = state.map(|state| state.remembering(keys));
            let of = structure.name().to_owned();
            let (structure, bus, keys, baseline) = (
                structure.clone(),
                bus.clone(),
                keys.clone(),
                baseline.clone(),
            );
            let start = move || {
                let (structure, bus, keys, id) =
                    (structure.clone(), bus.clone(), keys.clone(), id.clone());
                let (baseline, remembering) = (baseline.clone(), remembering.clone());
                async move {
                    AlertService::start(
                        &structure,
                        baseline.as_ref(),
                        &bus,
                        keys,
                        id,
                        remembering.as_ref(),
                    )
                    .await
                }
            };
            self.alert
                .start(of, start, |service, stop| service.run(stop))
                .await?;
        }
        Ok(())
    }

    /// Starts the history of all structures.
    ///
    /// # Errors
    /// The history cannot start.
    pub async fn start_history(
        &mut self,
        bus: &Bus,
        watched: &[Watched],
        address: &Address,
        keep: &Keep,
    ) -> Result<(), AppError> {
        let (all, bus, address, keep) =
            (All::of(watched), bus.clone(), address.clone(), keep.clone());
        let (of, id) = (all.names(), Name::new("history")?);
        let start = move || {
            let (all, bus, address) = (all.clone(), bus.clone(), address.clone());
            let (keep, id) = (keep.clone(), id.clone());
            async move { HistoryService::start(&all.structures(), &bus, &address, keep, id).await }
        };
        self.history
            .start(of, start, |service, stop| service.run(stop))
            .await
    }

    /// Starts the notifications of all structures. With `state`, undelivered notifications survive
    /// a restart of the process.
    ///
    /// # Errors
    /// The service cannot start.
    pub async fn start_notify(
        &mut self,
        bus: &Bus,
        watched: &[Watched],
        settings: &NotifySettings,
        state: Option<&State>,
    ) -> Result<(), AppError> {
        let folder = |keys: &Keys| state.map(|state| state.remembering(keys).folder);
        let structures: Vec<_> = watched
            .iter()
            .map(|watched| (watched.keys.clone(), folder(&watched.keys)))
            .collect();
        let (of, id) = (All::of(watched).names(), Name::new("notify")?);
        let (bus, settings) = (bus.clone(), settings.clone());
        let start = move || {
            let (structures, bus) = (structures.clone(), bus.clone());
            let (settings, id) = (settings.clone(), id.clone());
            async move { NotifyService::start(&structures, &bus, &settings, id).await }
        };
        self.notify
            .start(of, start, |service, stop| service.run(stop))
            .await
    }

    /// Starts the dashboard of all structures and returns the address of its page.
    ///
    /// # Errors
    /// The dashboard cannot start.
    pub async fn start_dashboard(
        &mut self,
        bus: &Bus,
        watched: &[Watched],
        page: &PageSettings,
    ) -> Result<SocketAddr, AppError> {
        let (all, bus, id) = (All::of(watched), bus.clone(), Name::new("dashboard")?);
        let service = DashboardService::start(&all.structures(), &bus, page, id.clone()).await?;
        let (of, address) = (all.names(), service.address());
        // After a restart, open pages find the dashboard at the same address.
        let page = PageSettings {
            listen: Listen::At(address.to_string()),
            ..page.clone()
        };
        let start = move || {
            let (all, bus, page, id) = (all.clone(), bus.clone(), page.clone(), id.clone());
            async move { DashboardService::start(&all.structures(), &bus, &page, id).await }
        };
        self.dashboard
            .run(of, service, start, |service, stop| service.run(stop));
        Ok(address)
    }

    /// Waits until a service ends prematurely.
    ///
    /// # Errors
    /// The error of that service.
    pub async fn failed(&mut self) -> Result<(), AppError> {
        tokio::select! {
            ended = self.ingest.ended() => ended,
            ended = self.identify.ended() => ended,
            ended = self.fuse.ended() => ended,
            ended = self.alert.ended() => ended,
            ended = self.history.ended() => ended,
            ended = self.notify.ended() => ended,
            ended = self.dashboard.ended() => ended,
        }
    }

    /// Stops all services, the source first, so that data in transit is still processed.
    ///
    /// # Errors
    /// The first error of a service.
    pub async fn stop(mut self) -> Result<(), AppError> {
        let ingest = self.ingest.stop().await;
        let identify = self.identify.stop().await;
        let fuse = self.fuse.stop().await;
        let alert = self.alert.stop().await;
        let history = self.history.stop().await;
        let notify = self.notify.stop().await;
        let dashboard = self.dashboard.stop().await;
        ingest
            .and(identify)
            .and(fuse)
            .and(alert)
            .and(history)
            .and(notify)
            .and(dashboard)
    }
}

/// The structures of a service with a single instance for all of them.
#[derive(Clone)]
struct All(Arc<[(Structure, Keys)]>);

impl All {
    fn of(watched: &[Watched]) -> Self {
        Self(
            watched
                .iter()
                .map(|watched| (watched.structure.clone(), watched.keys.clone()))
                .collect(),
        )
    }

    fn structures(&self) -> Vec<(&Structure, Keys)> {
        self.0
            .iter()
            .map(|(structure, keys)| (structure, keys.clone()))
            .collect()
    }

    fn names(&self) -> String {
        let names: Vec<&str> = self
            .0
            .iter()
            .map(|(structure, _)| structure.name())
            .collect();
        names.join(", ")
    }
}

/// Rejects node names that do not belong to a distributed structure.
fn check_nodes(watched: &[Watched], only: &[String]) -> Result<(), AppError> {
    let distributed = || {
        watched
            .iter()
            .filter(|watched| watched.structure.fusion().is_some())
    };
    let known = || {
        distributed()
            .flat_map(|watched| watched.structure.nodes())
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

/// Returns the wall clock time in ns, which is higher at each start of a source.
pub fn epoch_now() -> u64 {
    #[expect(
        clippy::disallowed_methods,
        reason = "an epoch must be higher at each start"
    )]
    let now = SystemTime::now();
    now.duration_since(UNIX_EPOCH)
        .map_or(1, |elapsed| elapsed.as_nanos() as u64)
}

/// Runs a future on a new runtime.
///
/// # Errors
/// The runtime cannot start, or the future fails.
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
