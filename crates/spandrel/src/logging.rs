//! Logging to standard error, so that standard output contains only results.

use crate::bus_audit::{BusAudit, Scope};
use crate::cli::LogFormat;
use crate::watch::HeldStderr;
use std::io::IsTerminal;
use tracing_subscriber::layer::SubscriberExt as _;
use tracing_subscriber::util::SubscriberInitExt as _;
use tracing_subscriber::{EnvFilter, Layer as _, fmt, registry};

/// Starts logging.
///
/// The default level is warnings, and `-v` raises it. `RUST_LOG` overrides both. With `audited`,
/// the log also reports what Zenoh refuses.
pub fn start(format: LogFormat, verbose: u8, audited: Option<Scope>) {
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
    let lines = fmt::layer()
        .log_internal_errors(false)
        .with_writer(HeldStderr::default);
    let lines = match format {
        LogFormat::Text => lines.with_ansi(std::io::stderr().is_terminal()).boxed(),
        LogFormat::Json => lines.json().boxed(),
    };
    let audit = audited.and_then(|scope| Some((BusAudit::start()?, scope.targets())));
    let audit = audit.map(|(audit, targets)| audit.with_filter(targets));
    registry()
        .with(lines.with_filter(filter))
        .with(audit)
        .init();
}
