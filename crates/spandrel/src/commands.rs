//! The subcommands, each in its own file.

mod annotate;
mod baseline;
mod bench;
mod check;
mod convert;
mod dashboard;
mod demo;
mod earthquake;
mod estimate;
mod feed;
mod info;
mod judge;
mod maintenance;
mod modes;
mod notify;
mod progress;
mod replay;
mod router;
mod run;
mod simulate;
mod site;
mod token;
mod validate;
mod watch;

use crate::cli::{Arguments, Command};
use crate::error::AppError;
use crate::printable::escaped;
use crate::services::Share;
use clap::CommandFactory;
use spandrel_identify::Precedence;
use std::io::Write;
use std::path::Path;

/// What was found if [`own_name`] returns no name.
const NO_NAME: &str = "no name is given, and the variable USER has none";

/// Returns the given name, or that of the variable `USER`. `None` if it is blank.
fn own_name(given: Option<&str>) -> Option<String> {
    let name = given.map_or_else(|| std::env::var("USER").unwrap_or_default(), str::to_owned);
    (!name.trim().is_empty()).then_some(name)
}

/// Runs a subcommand.
///
/// # Errors
/// Returns any error that ends the subcommand.
pub fn run(command: Command) -> Result<(), AppError> {
    match command {
        Command::Demo(arguments) => demo::run(arguments),
        Command::Run(arguments) => run::run(
            &arguments.service,
            run::Services::ALL,
            Share::ALL,
            &arguments.page,
        ),
        Command::Feed(arguments) => feed::run(&arguments),
        Command::Ingest(arguments) => run::one(&arguments, run::Services::INGEST, Share::ALL),
        Command::Identify(arguments) => {
            let precedence = if arguments.standby {
                Precedence::StandsBy
            } else {
                Precedence::Leads
            };
            let share = Share {
                nodes: &arguments.node,
                precedence,
            };
            run::one(&arguments.service, run::Services::IDENTIFY, share)
        }
        Command::Fuse(arguments) => run::one(&arguments, run::Services::FUSE, Share::ALL),
        Command::Alert(arguments) => run::one(&arguments, run::Services::ALERT, Share::ALL),
        Command::Reports(arguments) => run::one(&arguments, run::Services::REPORTS, Share::ALL),
        Command::History(arguments) => run::one(&arguments, run::Services::HISTORY, Share::ALL),
        Command::Notify(arguments) => notify::run(&arguments),
        Command::Maintenance(arguments) => maintenance::run(&arguments),
        Command::Annotate(arguments) => annotate::run(&arguments),
        Command::Dashboard(arguments) => dashboard::run(&arguments),
        Command::Simulate(arguments) => simulate::run(arguments),
        Command::Replay(arguments) => replay::run(arguments),
        Command::Estimate(arguments) => estimate::run(&arguments),
        Command::Baseline(arguments) => baseline::run(&arguments),
        Command::Bench(arguments) => bench::run(&arguments),
        Command::Check(arguments) => check::run(arguments),
        Command::Earthquake(arguments) => earthquake::run(&arguments),
        Command::Judge(arguments) => judge::run(&arguments),
        Command::Info(arguments) => info::run(&arguments),
        Command::Convert(arguments) => convert::run(&arguments),
        Command::Modes(arguments) => modes::run(&arguments),
        Command::Validate(arguments) => validate::run(&arguments),
        Command::Watch(arguments) => watch::run(arguments),
        Command::Router(arguments) => router::run(&arguments),
        Command::Site(command) => site::run(command),
        Command::Token(arguments) => token::run(&arguments),
        Command::Completions { shell } => {
            let mut script = Vec::new();
            clap_complete::generate(shell, &mut Arguments::command(), "spandrel", &mut script);
            print(&String::from_utf8_lossy(&script))
        }
    }
}

/// Rejects an output file that is also an input, because writing would destroy it before it is read
/// completely.
pub fn refuse_overwriting<'p>(
    output: &Path,
    inputs: impl IntoIterator<Item = &'p Path>,
) -> Result<(), AppError> {
    let same = |input: &Path| match (output.canonicalize(), input.canonicalize()) {
        (Ok(output), Ok(input)) => output == input,
        // A file that does not exist cannot be overwritten.
        (Ok(_) | Err(_), Ok(_) | Err(_)) => false,
    };
    match inputs.into_iter().any(same) {
        true => Err(AppError::WouldOverwrite {
            path: output.to_owned(),
        }),
        false => Ok(()),
    }
}

/// Returns the message suffix for an output file that already exists.
pub fn in_place_of(output: &Path) -> &'static str {
    if output.exists() {
        ", replacing the existing file"
    } else {
        ""
    }
}

/// Formats a count with the singular or plural noun.
pub fn counted(count: usize, one: &str, many: &str) -> String {
    format!("{count} {}", if count == 1 { one } else { many })
}

/// Writes a result to standard output, with control characters escaped. A closed pipe (`| head`) is
/// not an error.
pub fn print(text: &str) -> Result<(), AppError> {
    let text = escaped(text);
    match std::io::stdout().lock().write_all(text.as_bytes()) {
        Err(source) if source.kind() != std::io::ErrorKind::BrokenPipe => Err(AppError::Io {
            what: "cannot write to standard output".to_owned(),
            source,
        }),
        Ok(()) | Err(_) => Ok(()),
    }
}
