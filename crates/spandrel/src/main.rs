//! Watches over bridges and buildings in real time: one program, one subcommand per service, and the tools around them.

mod check_report;
mod cli;
mod commands;
mod error;
mod logging;
mod offline;
mod record_source;
mod services;
mod settings;
mod summary;
mod watch;

use clap::Parser;
use std::process::ExitCode;

fn main() -> ExitCode {
    let arguments = cli::Arguments::parse();
    logging::start(arguments.log, arguments.verbose);
    match commands::run(arguments.command) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprint!("{}", error.report());
            error.exit_code()
        }
    }
}
