//! `spandrel run`, `feed`, `ingest`, `identify`, `fuse`, `alert`, `modes`, `judge`, `reports`,
//! `history` and `notify`: run services until stopped.

use super::print;
use crate::cli::{PageArguments, ServiceArguments};
use crate::error::AppError;
use crate::role_check::{Need, Work, cannot_acknowledge, check};
use crate::services::{
    Running, Share, Watched, block_on, interrupted, open_unless_stopped, read_structures,
};
use crate::settings::Settings;
use crate::state::State;
use crate::supervision::{Hangups, feed_watchdog, keep_folders, report_lost_readers, tell_systemd};
use sd_notify::NotifyState;
use serde_json::Value;
use spandrel_access::isolation;
use spandrel_bus::{Bus, Keys, Mode, Name, Service};
use spandrel_dashboard::PageSettings;
use spandrel_feed::{FeedConfig, FeedError, WhenEnded};
use spandrel_history::Address;
use spandrel_identify::Precedence;
use spandrel_record::frame_log::check_unused;
use spandrel_structure::{Severity, Structure};
use std::process::{Command, Stdio};
use tracing::{info, warn};

/// Lease of a process that may lead (s). After this time without a message, others consider it
/// failed.
///
/// A takeover must complete within 3 s. The remaining time is for the takeover itself.
const STANDBY_LEASE_S: f64 = 2.0;

/// Simulated time of the check of a structure file at the start (s).
const CHECKED_S: f64 = 60.0;
/// Maximum memory of such a check (bytes).
const MOST_CHECKED_BYTES: usize = 10_000_000;

/// The services that a process runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Services(&'static [Service]);

impl Services {
    /// All services of one machine.
    pub const ALL: Self = Self(&[
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
    ]);
    /// Only the feed.
    pub const FEED: Self = Self(&[Service::Feed]);
    /// Only ingest.
    pub const INGEST: Self = Self(&[Service::Ingest]);
    /// Only identification.
    pub const IDENTIFY: Self = Self(&[Service::Identify]);
    /// Only the central station.
    pub const FUSE: Self = Self(&[Service::Fuse]);
    /// Only the alert service.
    pub const ALERT: Self = Self(&[Service::Alert]);
    /// Only the natural frequencies.
    pub const MODES: Self = Self(&[Service::Modes]);
    /// Only the judgement of lasting changes.
    pub const JUDGE: Self = Self(&[Service::Judge]);
    /// Only the reports of earthquakes.
    pub const REPORTS: Self = Self(&[Service::Reports]);
    /// Only the history.
    pub const HISTORY: Self = Self(&[Service::History]);
    /// Only notifications.
    pub const NOTIFY: Self = Self(&[Service::Notify]);

    fn has(self, service: Service) -> bool {
        self.0.contains(&service)
    }

    /// Returns the subcommand that runs these services.
    fn name(self) -> &'static str {
        match self.0 {
            [service] => service.as_str(),
            _ => "run",
        }
    }
}

/// Runs services without a page until Ctrl-C or SIGTERM.
///
/// # Errors
/// Returns the same errors as [`run`].
pub fn one(
    arguments: &ServiceArguments,
    services: Services,
    share: Share<'_>,
) -> Result<(), AppError> {
    run(arguments, services, share, &PageArguments::default())
}

/// Requirements of the configuration and the structure files.
struct Plan {
    settings: Settings,
    watched: Vec<Watched>,
    served: Option<PageSettings>,
    database: Option<Address>,
    state: Option<State>,
    feed: Option<FeedConfig>,
}

impl Plan {
    fn read(
        arguments: &ServiceArguments,
        services: Services,
        share: Share<'_>,
        page: &PageArguments,
    ) -> Result<Self, AppError> {
        let mut settings = Settings::load(&arguments.bus)?;
        let watched = read_structures(&settings, &arguments.structures)?;
        if share.precedence == Precedence::StandsBy {
            settings.bus.lease_s.get_or_insert(STANDBY_LEASE_S);
            if let Some(fused) = watched
                .iter()
                .find(|watched| watched.structure.fusion().is_some())
            {
                return Err(AppError::NoStandbyOfNodes {
                    structure: fused.structure.name().to_owned(),
                });
            }
        }
        check_work(services, &watched)?;
        if settings.isolated {
            settings.bus.access_control = Some(isolation_of(&settings, services, &watched)?);
        }
        let database = if services.has(Service::History) {
            settings.history.address(&settings.state)?
        } else {
            None
        };
        if services == Services::HISTORY && database.is_none() {
            return Err(AppError::NoHistory);
        }
        settings.notify.check()?;
        if services == Services::NOTIFY && settings.notify.is_empty() {
            return Err(AppError::NoRecipients);
        }
        let feed = match services.has(Service::Feed) {
            true if !settings.feed.is_empty() => Some(checked_feed(&settings, &watched)?),
            true if services == Services::FEED => return Err(FeedError::NoSource.into()),
            true | false => None,
        };
        let served = if services.has(Service::Dashboard) {
            settings.dashboard.page(page)?
        } else {
            None
        };
        let remembers = services.has(Service::Ingest)
            || services.has(Service::Identify)
            || services.has(Service::Fuse)
            || services.has(Service::Alert)
            || services.has(Service::Modes)
            || services.has(Service::Judge)
            || services.has(Service::Reports)
            || services.has(Service::Notify);
        let state = if remembers {
            settings.state.state()?
        } else {
            None
        };
        if services == Services::REPORTS && state.is_none() {
            return Err(AppError::NoFolderOfReports);
        }
        Ok(Self {
            settings,
            watched,
            served,
            database,
            state,
            feed,
        })
    }

    /// Returns the keys of all structures.
    fn keys(&self) -> Vec<Keys> {
        let keys = self.watched.iter().map(|watched| watched.keys.clone());
        keys.collect()
    }

    /// Returns the keys of the structures whose readers connect to this process.
    fn with_readers(&self) -> Vec<Keys> {
        match self.settings.bus.mode {
            Mode::Client => Vec::new(), // readers connect to the router
            Mode::Peer | Mode::Router => self.keys(),
        }
    }

    /// Returns the rights on the bus that the services need.
    fn needs(&self, services: Services) -> Vec<Need> {
        let any = |is_such: &dyn Fn(&Structure) -> bool| {
            let mut structures = self.watched.iter().map(|watched| &watched.structure);
            structures.any(is_such)
        };
        let is_fused = |structure: &Structure| structure.fusion().is_some();
        let any_fused = any(&is_fused);
        let any_whole = any(&|structure| !is_fused(structure));
        let any_estimated = any(&|structure| structure.is_filtered() && !is_fused(structure));
        let wanted = [
            (self.feed.is_some(), Need::PUT_SAMPLES),
            (services.has(Service::Ingest) && any_whole, Need::PUT_FRAMES),
            (
                services.has(Service::Identify) && any_estimated,
                Need::PUT_ESTIMATES,
            ),
            (services == Services::IDENTIFY && any_fused, Need::PUT_LOCAL),
            (services.has(Service::Fuse) && any_fused, Need::PUT_FEEDBACK),
            (
                services.has(Service::Alert) && any(&Structure::is_filtered),
                Need::PUT_ALERTS,
            ),
            (
                services.has(Service::Judge) && any(&|structure| structure.judge().is_some()),
                Need::PUT_JUDGEMENTS,
            ),
            (
                services.has(Service::Modes) && any(&|structure| structure.modal().is_some()),
                Need::PUT_MODES,
            ),
            (
                services.has(Service::Reports)
                    && any(&|structure| structure.earthquakes().is_some()),
                Need::ANSWER_REPORTS,
            ),
            (self.database.is_some(), Need::ANSWER_HISTORY),
            (
                services.has(Service::Notify) && !self.settings.notify.is_empty(),
                Need::NOTIFY,
            ),
            (self.served.is_some(), Need::SHOW_A_PAGE),
        ];
        wanted
            .into_iter()
            .filter(|(is_wanted, _)| *is_wanted)
            .map(|(_, need)| need)
            .collect()
    }

    /// Rejects a certificate that does not grant the rights that the services need.
    async fn check_role(
        &self,
        bus: &Bus,
        services: Services,
        share: Share<'_>,
    ) -> Result<(), AppError> {
        let needs = self.needs(services);
        let structures = self
            .watched
            .iter()
            .map(|watched| watched.structure.name())
            .collect();
        let fed = self.feed.iter().flat_map(|feed| &feed.nodes);
        let nodes = share
            .nodes
            .iter()
            .map(String::as_str)
            .chain(fed.map(|node| node.name.as_str()))
            .collect();
        let work = Work {
            subcommand: services.name(),
            needs: &needs,
            structures,
            nodes,
        };
        check(bus, &self.settings.bus, &work).await
    }

    /// Starts the services, receivers first, so that no service has to repeat messages for a late
    /// reader.
    async fn start(
        &self,
        bus: &Bus,
        services: Services,
        share: Share<'_>,
        page: &PageArguments,
    ) -> Result<Running, AppError> {
        let Self {
            settings,
            watched,
            served,
            database,
            state,
            feed,
        } = self;
        if let Some(state) = state
            && services.has(Service::Ingest)
        {
            // A second process would replace the checkpoints of the first before it fails.
            for watched in watched {
                check_unused(&state.recording(&watched.keys).folder)?;
            }
        }
        let mut running = Running::new(bus, watched, state.as_ref());
        if let Some(served) = served {
            let cannot_acknowledge = cannot_acknowledge(bus, &settings.bus).await?;
            let served = PageSettings {
                cannot_acknowledge,
                ..served.clone()
            };
            serve_page(&mut running, &served, page).await?;
        }
        if let Some(address) = database {
            running
                .start_history(address, &settings.history.keep)
                .await?;
        }
        if services.has(Service::Notify) && !settings.notify.is_empty() {
            running.start_notify(&settings.notify).await?;
        }
        if services.has(Service::Judge) {
            running.start_judge().await?;
        }
        if services.has(Service::Reports) {
            running.start_reports(state.as_ref()).await?;
        }
        if services.has(Service::Modes) {
            running.start_modes().await?;
        }
        if services.has(Service::Alert) {
            running.start_alert().await?;
        }
        if services.has(Service::Fuse) {
            running.start_fuse().await?;
        }
        if services.has(Service::Identify) {
            running.start_identify(settings.threads, share).await?;
        }
        if services.has(Service::Ingest) {
            running.start_ingest(state.as_ref()).await?;
        }
        if let Some(feed) = feed {
            let when_ended = match services == Services::FEED {
                true => WhenEnded::Stop,
                false => WhenEnded::Wait,
            };
            running.start_feed(feed, when_ended).await?;
        }
        Ok(running)
    }
}

/// Checks that the structures have work for the service, if it runs alone.
fn check_work(services: Services, watched: &[Watched]) -> Result<(), AppError> {
    if services == Services::FUSE
        && watched
            .iter()
            .all(|watched| watched.structure.fusion().is_none())
    {
        return Err(AppError::NothingToFuse);
    }
    let is_filtered = |watched: &Watched| watched.structure.is_filtered();
    if [Services::IDENTIFY, Services::ALERT].contains(&services) && !watched.iter().any(is_filtered)
    {
        return Err(AppError::NothingToIdentify {
            service: services.name(),
        });
    }
    let is_judged = |watched: &Watched| watched.structure.judge().is_some();
    if services == Services::JUDGE && !watched.iter().any(is_judged) {
        return Err(AppError::NothingToJudge);
    }
    let has_modal = |watched: &Watched| watched.structure.modal().is_some();
    if services == Services::MODES && !watched.iter().any(has_modal) {
        return Err(AppError::NothingToFollow);
    }
    let is_reported = |watched: &Watched| watched.structure.earthquakes().is_some();
    if services == Services::REPORTS && !watched.iter().any(is_reported) {
        return Err(AppError::NothingToReport);
    }
    Ok(())
}

/// Returns the access control of an isolated process.
///
/// # Errors
/// Returns an error if services of other processes would be refused, or if the access control would
/// have no effect.
fn isolation_of(
    settings: &Settings,
    services: Services,
    watched: &[Watched],
) -> Result<Value, AppError> {
    let refuse = |why: String| Err(AppError::Isolated { why });
    if services != Services::ALL {
        let name = services.name();
        return refuse(format!(
            "`spandrel {name}` exchanges its results with other processes; only `spandrel run` \
             contains all services"
        ));
    }
    if settings.bus.mode == Mode::Client {
        return refuse("a client accepts no connections; its router states the rights".to_owned());
    }
    if let Some(file) = &settings.bus.config_file {
        let file = file.display();
        return refuse(format!("{file} states the rights; omit one of the two"));
    }
    let is_fused = |watched: &&Watched| watched.structure.fusion().is_some();
    if let Some(fused) = watched.iter().find(is_fused) {
        let name = fused.structure.name();
        return refuse(format!(
            "the nodes of {name} have their own filters, in other processes; use a router"
        ));
    }
    Ok(isolation(&Name::new(&*settings.bus.root)?))
}

/// Checks the sources of the configuration against the structures.
///
/// # Errors
/// Returns an error if a source has mistakes.
pub fn checked_feed(settings: &Settings, watched: &[Watched]) -> Result<FeedConfig, AppError> {
    let structures: Vec<&Structure> = watched.iter().map(|watched| &watched.structure).collect();
    Ok(settings.feed.check(&structures)?)
}

/// Runs the services until Ctrl-C or SIGTERM. SIGHUP rereads the configuration and structure files
/// and restarts the services.
///
/// # Errors
/// Returns an error if the configuration or a structure is not valid, the bus cannot be joined, or
/// a service fails.
pub fn run(
    arguments: &ServiceArguments,
    services: Services,
    share: Share<'_>,
    page: &PageArguments,
) -> Result<(), AppError> {
    let mut plan = Plan::read(arguments, services, share, page)?;
    block_on(async {
        let interrupted = interrupted();
        tokio::pin!(interrupted);
        let config = plan.settings.bus.clone();
        let opening = async move { Bus::open(&config).await };
        let bus = open_unless_stopped(opening, &mut interrupted).await?;
        plan.check_role(&bus, services, share).await?;
        let mut hangups = Hangups::new();
        let mut page = page.clone();
        let ended = loop {
            let mut running = tokio::select! {
                started = plan.start(&bus, services, share, &page) => started?,
                // Hundreds of structures take long to start.
                () = &mut interrupted => {
                    tell_systemd(NotifyState::Stopping);
                    break Ok(());
                }
            };
            page.open = false; // the browser shows the page already when the services restart
            info!(structures = plan.watched.len(), "ready");
            if services == Services::ALL {
                log_findings(&plan.watched);
            }
            tell_systemd(NotifyState::Ready);
            let pool = running.pool();
            let ended = tokio::select! {
                failed = running.failed() => Ended::Done(failed),
                () = &mut interrupted => Ended::Done(Ok(())),
                next = hangups.read(|| Plan::read(arguments, services, share, &page)) => Ended::Anew(Box::new(next)),
                never = feed_watchdog(pool) => never,
                never = keep_folders(plan.state.as_ref(), plan.keys()) => never,
                never = report_lost_readers(&bus, plan.with_readers()) => never,
            };
            if matches!(ended, Ended::Done(_)) {
                tell_systemd(NotifyState::Stopping);
            }
            let stopped = running.stop().await;
            match ended {
                Ended::Done(result) => break result.and(stopped),
                Ended::Anew(next) => {
                    match stopped {
                        // The error is logged, and the next start does not depend on the old
                        // service.
                        Ok(()) | Err(AppError::NotStopped { .. }) => {}
                        Err(error) => break Err(error),
                    }
                    if next.settings.bus != plan.settings.bus {
                        warn!(
                            "bus settings changed; they apply from the next start of the process"
                        );
                    }
                    plan = *next;
                }
            }
        };
        bus.close().await?;
        ended
    })
}

/// Logs the warnings of a check of the structure files, because the estimates depend on them.
///
/// A thread of its own checks the files. It leaves large ones to `spandrel check`, which takes
/// minutes for them. A process with a single service may run on a small computer, and checks none.
fn log_findings(watched: &[Watched]) {
    let structures = watched.iter().map(|watched| &watched.structure);
    let is_small = |structure: &&Structure| structure.check_bytes() <= MOST_CHECKED_BYTES;
    let checked = structures.filter(|structure| structure.is_filtered());
    let checked: Vec<Structure> = checked.filter(is_small).cloned().collect();
    let check = move || {
        for structure in checked {
            let findings = structure.check(CHECKED_S, 0).findings;
            let warnings = findings
                .iter()
                .filter(|one| one.severity() == Severity::Warning);
            for finding in warnings {
                warn!(structure = structure.name(), "structure file: {finding}");
            }
        }
    };
    let thread = std::thread::Builder::new().name("check".to_owned());
    if let Err(error) = thread.spawn(check) {
        warn!(%error, "cannot check the structure files");
    }
}

/// Reason why the services were stopped.
enum Ended {
    Done(Result<(), AppError>),
    Anew(Box<Plan>),
}

/// Starts the dashboard, prints the address of its page, and opens it on request. Returns the
/// address.
///
/// # Errors
/// Returns an error if the process cannot listen on the address, or if the bus is closed.
pub async fn serve_page(
    running: &mut Running,
    settings: &PageSettings,
    arguments: &PageArguments,
) -> Result<String, AppError> {
    let scheme = if settings.certificate.is_some() {
        "https"
    } else {
        "http"
    };
    let page = format!("{scheme}://{}/", running.start_dashboard(settings).await?);
    print(&format!("page: {page}\n"))?;
    if arguments.open {
        open_in_browser(&page);
    }
    Ok(page)
}

/// Opens a page in the browser of the desktop. Without a desktop, only the printed address remains.
fn open_in_browser(page: &str) {
    let opener = if cfg!(target_os = "macos") {
        "open"
    } else {
        "xdg-open"
    };
    let quiet = || Stdio::null();
    let opened = Command::new(opener)
        .arg(page)
        .stdin(quiet())
        .stdout(quiet())
        .stderr(quiet())
        .spawn();
    match opened {
        // The end of the opener must be awaited, because it otherwise remains as a zombie process.
        Ok(mut opener) => {
            let thread = std::thread::Builder::new().name("opener".to_owned());
            if let Err(error) = thread.spawn(move || opener.wait()) {
                warn!(%error, "cannot wait for the program that opens the page");
            }
        }
        Err(error) => warn!(opener, page, %error, "cannot open a browser"),
    }
}
