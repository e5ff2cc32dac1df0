//! `spandrel run`, `ingest`, `identify`, `fuse`, `alert`, `history` and `notify`: services until they are stopped.

use super::print;
use crate::cli::{PageArguments, ServiceArguments};
use crate::error::AppError;
use crate::services::{Running, Watched, block_on, interrupted, read_structures};
use crate::settings::Settings;
use spandrel_bus::Bus;
use spandrel_dashboard::Listen;
use std::process::{Command, Stdio};
use tracing::{info, warn};

/// Which services a process runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Services {
    ingest: bool,
    identify: bool,
    fuse: bool,
    alert: bool,
    history: bool,
    notify: bool,
    dashboard: bool,
}

impl Services {
    const NONE: Self = Self {
        ingest: false,
        identify: false,
        fuse: false,
        alert: false,
        history: false,
        notify: false,
        dashboard: false,
    };
    /// All services of one machine.
    pub const ALL: Self =
        Self { ingest: true, identify: true, fuse: true, alert: true, history: true, notify: true, dashboard: true };
    /// The alignment only.
    pub const INGEST: Self = Self { ingest: true, ..Self::NONE };
    /// The identification only.
    pub const IDENTIFY: Self = Self { identify: true, ..Self::NONE };
    /// The central station only.
    pub const FUSE: Self = Self { fuse: true, ..Self::NONE };
    /// The alerts only.
    pub const ALERT: Self = Self { alert: true, ..Self::NONE };
    /// The history only.
    pub const HISTORY: Self = Self { history: true, ..Self::NONE };
    /// The notices only.
    pub const NOTIFY: Self = Self { notify: true, ..Self::NONE };
}

/// Runs services without a page until Ctrl-C or SIGTERM.
///
/// # Errors
/// As [`run`].
pub fn one(arguments: &ServiceArguments, services: Services, nodes: &[String]) -> Result<(), AppError> {
    run(arguments, services, nodes, &PageArguments::default())
}

/// Runs the services until Ctrl-C or SIGTERM.
///
/// # Errors
/// When the configuration or a structure is wrong, the bus cannot be joined, or a service fails.
pub fn run(
    arguments: &ServiceArguments,
    services: Services,
    nodes: &[String],
    page: &PageArguments,
) -> Result<(), AppError> {
    let settings = Settings::load(&arguments.bus)?;
    let watched = read_structures(&settings, &arguments.structures)?;
    if services == Services::FUSE && watched.iter().all(|watched| watched.structure.fusion().is_none()) {
        return Err(AppError::NothingToFuse);
    }
    let database = if services.history { settings.history.address()? } else { None };
    if services == Services::HISTORY && database.is_none() {
        return Err(AppError::NoHistory);
    }
    if services == Services::NOTIFY && settings.notify.is_empty() {
        return Err(AppError::NobodyToTell);
    }
    settings.notify.check()?;
    block_on(async {
        let bus = Bus::open(&settings.bus).await?;
        let mut running = Running::new();
        if let Some(listen) = settings.dashboard.listen(page).filter(|_| services.dashboard) {
            serve_page(&mut running, &bus, &watched, &listen, page).await?;
        }
        // downstream first: whoever has a reader when it starts needs to repeat nothing
        if let Some(address) = &database {
            running.start_history(&bus, &watched, address, &settings.history.keep).await?;
        }
        if services.notify && !settings.notify.is_empty() {
            running.start_notify(&bus, &watched, &settings.notify).await?;
        }
        if services.alert {
            running.start_alert(&bus, &watched).await?;
        }
        if services.fuse {
            running.start_fuse(&bus, &watched).await?;
        }
        if services.identify {
            running.start_identify(&bus, &watched, settings.threads, nodes).await?;
        }
        if services.ingest {
            running.start_ingest(&bus, &watched).await?;
        }
        info!(structures = watched.len(), "ready");
        let failed = tokio::select! {
            failed = running.failed() => failed,
            () = interrupted() => Ok(()),
        };
        let stopped = running.stop().await;
        bus.close().await?;
        failed.and(stopped)
    })
}

/// Starts the dashboard, prints where its page is, and opens it if asked to. Returns the address of the page.
///
/// # Errors
/// When the address cannot be listened on, or the bus is closed.
pub async fn serve_page(
    running: &mut Running,
    bus: &Bus,
    watched: &[Watched],
    listen: &Listen,
    arguments: &PageArguments,
) -> Result<String, AppError> {
    let page = format!("http://{}/", running.start_dashboard(bus, watched, listen).await?);
    print(&format!("page: {page}\n"))?;
    if arguments.open {
        open_in_browser(&page);
    }
    Ok(page)
}

/// Asks the desktop to show a page; where there is none, the printed address has to do.
fn open_in_browser(page: &str) {
    let opener = if cfg!(target_os = "macos") { "open" } else { "xdg-open" };
    let quiet = || Stdio::null();
    let opened = Command::new(opener).arg(page).stdin(quiet()).stdout(quiet()).stderr(quiet()).spawn();
    if let Err(error) = opened {
        warn!(opener, page, %error, "no browser can be opened");
    }
}
