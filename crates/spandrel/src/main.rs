//! Structural health monitoring of bridges and buildings in real time.
//!
//! One program with one subcommand per service, and further tools.

mod bus_audit;
mod check_report;
mod cli;
mod commands;
mod distributed;
mod earthquake;
mod error;
mod judge_report;
mod logging;
mod modal_check;
mod modes;
mod offline;
mod printable;
mod record_source;
mod role_check;
mod sensor_report;
mod services;
mod settings;
mod state;
mod summary;
mod supervision;
mod watch;
mod zenoh_threads;

use clap::Parser;
use printable::escaped;
use spandrel_service::Audit;
use std::io::Write;
use std::process::ExitCode;
use tracing::warn;

/// The allocator of the C library never returns the memory of a burst when blocks of many streams
/// come and go.
///
/// This allocator returns it, after the time set in `.cargo/config.toml`. It is also faster for
/// blocks that one thread allocates and another frees.
#[cfg(target_os = "linux")]
#[global_allocator]
static ALLOCATOR: tikv_jemallocator::Jemalloc = tikv_jemallocator::Jemalloc;

fn main() -> ExitCode {
    let arguments = cli::Arguments::parse();
    let scope = arguments.command.audited();
    // Before any thread exists, because none survives it.
    let threads = match arguments.command.serves_many() {
        true => zenoh_threads::provide(),
        false => Ok(()),
    };
    logging::start(arguments.log, arguments.verbose, scope);
    if let Err(error) = threads {
        warn!(%error, "cannot start Zenoh with more threads; suspended subscribers delay all \
                       others");
    }
    let ended = commands::run(arguments.command);
    bus_audit::finish();
    Audit::of_process().finish();
    match ended {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            // If standard error is closed, only the exit code reports the error.
            let _ = std::io::stderr().write_all(escaped(&error.report()).as_bytes());
            error.exit_code()
        }
    }
}
