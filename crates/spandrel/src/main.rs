//! Watches over bridges and buildings in real time: one program, one subcommand per service, and the tools around them.

mod check_report;
mod cli;
mod commands;
mod distributed;
mod error;
mod logging;
mod offline;
mod record_source;
mod role_check;
mod services;
mod settings;
mod state;
mod summary;
mod supervision;
mod watch;

use clap::Parser;
use std::io::Write;
use std::process::ExitCode;

/// The allocator of the C library keeps the memory of a burst for good when blocks of many streams come and go; this one gives it
/// back (`.cargo/config.toml` says how soon), and takes less time for blocks that one thread makes and another drops.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
#[global_allocator]
static ALLOCATOR: tikv_jemallocator::Jemalloc = tikv_jemallocator::Jemalloc;

fn main() -> ExitCode {
    let arguments = cli::Arguments::parse();
    logging::start(arguments.log, arguments.verbose);
    match commands::run(arguments.command) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            // a reader of the errors that has gone away is told by the exit code alone
            let _ = std::io::stderr().write_all(error.report().as_bytes());
            error.exit_code()
        }
    }
}
