//! `spandrel router`: runs a Zenoh router from a configuration file of `zenohd`.

use super::print;
use crate::cli::RouterArguments;
use crate::error::AppError;
use crate::services::{block_on, interrupted, open_unless_stopped};
use spandrel_bus::Bus;
use tracing::{info, warn};

/// Routes until Ctrl-C or SIGTERM.
///
/// # Errors
/// Returns an error if the file is not valid, it admits others without a certificate, or an
/// endpoint is in use.
pub fn run(arguments: &RouterArguments) -> Result<(), AppError> {
    block_on(async {
        let interrupted = interrupted();
        tokio::pin!(interrupted);
        let file = arguments.file.clone();
        let opening = async move { Bus::open_router(&file).await };
        let (bus, listen) = open_unless_stopped(opening, &mut interrupted).await?;
        print(&format!("router: {}\n", listen.join(" ")))?;
        info!(file = %arguments.file.display(), "ready");
        interrupted.await;
        // A router that is still trying to reach another router cannot be closed in time. This
        // loses no data.
        if let Err(error) = bus.close().await {
            warn!(%error, "some links were not closed properly");
        }
        Ok(())
    })
}
