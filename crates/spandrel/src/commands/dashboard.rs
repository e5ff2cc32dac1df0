//! `spandrel dashboard`: serves the web page of a running system.

use super::run::serve_page;
use super::watch::joining_by_default;
use crate::cli::RunArguments;
use crate::error::AppError;
use crate::role_check::{Need, Work, cannot_acknowledge, check};
use crate::services::{Running, block_on, interrupted, open_unless_stopped, read_structures};
use crate::settings::Settings;
use crate::supervision::{feed_watchdog, tell_systemd};
use sd_notify::NotifyState;
use spandrel_bus::Bus;
use spandrel_dashboard::PageSettings;
use tracing::info;

/// Serves the page until Ctrl-C or SIGTERM.
///
/// # Errors
/// Returns an error if the configuration or a structure is not valid, no process replies on the
/// bus, or the address is in use.
pub fn run(arguments: &RunArguments) -> Result<(), AppError> {
    let settings = Settings::load(&arguments.service.bus)?;
    let watched = read_structures(&settings, &arguments.service.structures)?;
    let page = settings
        .dashboard
        .page(&arguments.page)?
        .ok_or(AppError::NoPage)?;
    let config = joining_by_default(settings.bus);
    block_on(async {
        let interrupted = interrupted();
        tokio::pin!(interrupted);
        let joined = config.clone();
        let opening = async move { Bus::open(&joined).await };
        let bus = open_unless_stopped(opening, &mut interrupted).await?;
        let structures = watched
            .iter()
            .map(|watched| watched.structure.name())
            .collect();
        let work = Work {
            subcommand: "dashboard",
            needs: &[Need::SHOW_A_PAGE],
            structures,
            nodes: Vec::new(),
        };
        check(&bus, &config, &work).await?;
        let page = PageSettings {
            cannot_acknowledge: cannot_acknowledge(&bus, &config).await?,
            ..page
        };
        let mut running = Running::new(&bus, &watched, None);
        serve_page(&mut running, &page, &arguments.page).await?;
        info!(structures = watched.len(), "ready");
        tell_systemd(NotifyState::Ready);
        let failed = tokio::select! {
            failed = running.failed() => failed,
            () = interrupted => Ok(()),
            never = feed_watchdog(None) => never,
        };
        tell_systemd(NotifyState::Stopping);
        let stopped = running.stop().await;
        bus.close().await?;
        failed.and(stopped)
    })
}
