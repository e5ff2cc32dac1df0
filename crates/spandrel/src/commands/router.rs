//! `spandrel router`: a Zenoh router from the configuration file of `zenohd`.

use super::print;
use crate::cli::RouterArguments;
use crate::error::AppError;
use crate::services::{block_on, interrupted};
use spandrel_bus::Bus;
use tracing::{info, warn};

/// Routes until Ctrl-C or SIGTERM.
///
/// # Errors
/// When the file is wrong, lets others in without a certificate, or an endpoint is taken.
pub fn run(arguments: &RouterArguments) -> Result<(), AppError> {
    block_on(async {
        let (bus, listen) = Bus::open_router(&arguments.file).await?;
        let interrupted = interrupted();
        print(&format!("router: {}\n", listen.join(" ")))?;
        info!(file = %arguments.file.display(), "ready");
        interrupted.await;
        // a router that tries to reach another one, and does not, cannot be closed in time; nothing is lost with it
        if let Err(error) = bus.close().await {
            warn!(%error, "not all links were closed in order");
        }
        Ok(())
    })
}
