//! `spandrel run`, `ingest`, `identify`, `fuse` and `alert`: services until they are stopped.

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
    fuse: bool,
    alert: bool,
}

impl Services {
    const NONE: Self = Self { ingest: false, identify: false, fuse: false, alert: false };
    /// All services of one machine.
    pub const ALL: Self = Self { ingest: true, identify: true, fuse: true, alert: true };
    /// The alignment only.
    pub const INGEST: Self = Self { ingest: true, ..Self::NONE };
    /// The identification only.
    pub const IDENTIFY: Self = Self { identify: true, ..Self::NONE };
    /// The central station only.
    pub const FUSE: Self = Self { fuse: true, ..Self::NONE };
    /// The alerts only.
    pub const ALERT: Self = Self { alert: true, ..Self::NONE };
}

/// Runs the services until Ctrl-C or SIGTERM.
///
/// # Errors
/// When the configuration or a structure is wrong, the bus cannot be joined, or a service fails.
pub fn run(arguments: &ServiceArguments, services: Services, nodes: &[String]) -> Result<(), AppError> {
    let settings = Settings::load(&arguments.bus)?;
    let watched = read_structures(&settings, &arguments.structures)?;
    if services == Services::FUSE && watched.iter().all(|watched| watched.structure.fusion().is_none()) {
        return Err(AppError::NothingToFuse);
    }
    block_on(async {
        let bus = Bus::open(&settings.bus).await?;
        let mut running = Running::new();
        // downstream first: whoever has a reader when it starts needs to repeat nothing
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
