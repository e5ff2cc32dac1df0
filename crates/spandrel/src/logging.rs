//! Logging to standard error, so that standard output contains only results.

use crate::cli::LogFormat;
use crate::watch::HeldStderr;
use std::io::IsTerminal;
use tracing_subscriber::EnvFilter;

/// Starts logging.
///
/// The default level is warnings, and `-v` raises it. `RUST_LOG` overrides both.
pub fn start(format: LogFormat, verbose: u8) {
    let level = match verbose {
        // Scripts wait for the line that reports the services as ready.
        0 => "warn,spandrel::commands::run=info",
        1 => "info",
        2 => "debug",
        _ => "trace",
    };
    // Zenoh logs links that appear and disappear. Spandrel's services report these themselves.
    let fallback = format!(
        "error,spandrel={level},spandrel_bus={level},spandrel_sensor={level},spandrel_ingest={level},spandrel_identify={level},spandrel_alert={level},spandrel_structure={level},spandrel_record={level}"
    );
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(fallback));
    // A failure to write the log (closed pipe, full disk) must not stop a service. By default it
    // panics.
    let builder = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .log_internal_errors(false);
    let builder = builder.with_writer(HeldStderr::default);
    match format {
        LogFormat::Text => builder.with_ansi(std::io::stderr().is_terminal()).init(),
        LogFormat::Json => builder.json().init(),
    }
}
