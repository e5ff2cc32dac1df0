//! `spandrel run`, `ingest`, `identify` and `alert`: services until they are stopped.

use crate::cli::ServiceArguments;
use crate::error::AppError;
use crate::services::{Running, block_on, interrupted, read_structures};
use crate::settings::Settings;
use spandrel_bus::Bus;
use tracing::info;

/// Which services a process runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Services {
    ingest: bool,
    identify: bool,
    alert: bool,
}

impl Services {
    /// All services of one machine.
    pub const ALL: Self = Self { ingest: true, identify: true, alert: true };
    /// The alignment only.
    pub const INGEST: Self = Self { ingest: true, identify: false, alert: false };
    /// The identification only.
    pub const IDENTIFY: Self = Self { ingest: false, identify: true, alert: false };
    /// The alerts only.
    pub const ALERT: Self = Self { ingest: false, identify: false, alert: true };
}

/// Runs the services until Ctrl-C or SIGTERM.
///
/// # Errors
/// When the configuration or a structure is wrong, the bus cannot be joined, or a service fails.
pub fn run(arguments: &ServiceArguments, services: Services) -> Result<(), AppError> {
    let settings = Settings::load(&arguments.bus)?;
    let watched = read_structures(&settings, &arguments.structures)?;
    block_on(async {
        let bus = Bus::open(&settings.bus).await?;
        let mut running = Running::new();
        // downstream first: whoever has a reader when it starts needs to repeat nothing
        if services.alert {
            running.start_alert(&bus, &watched).await?;
        }
        if services.identify {
            running.start_identify(&bus, &watched, settings.threads).await?;
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
