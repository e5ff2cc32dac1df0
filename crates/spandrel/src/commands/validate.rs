//! `spandrel validate`: compares results for published examples with the published figures.

use super::{print, progress};
use crate::cli::ValidateArguments;
use crate::earthquake::course::Course;
use crate::earthquake::event_record::EventRecord;
use crate::earthquake::report::{EventName, ReportSettings};
use crate::earthquake::storeys::with_displacements;
use crate::error::AppError;
use indicatif::{MultiProgress, ProgressBar};
use spandrel_structure::Structure;
use spandrel_validate::robustness::records::{Extent, real_records};
use spandrel_validate::{
    Case, JudgedStiffness, Length, Outcome, Plan, Records, Report, ValidateError, Watch, cases,
    select,
};
use std::collections::HashMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

/// Number of steps of a bar, so that it shows the progress of a case to a thousandth.
const STEPS: u64 = 1000;

/// Runs the cases and prints their figures.
///
/// # Errors
/// Returns an error if a case is unknown, a report cannot be written, or a figure does not meet its
/// requirement.
pub fn run(arguments: &ValidateArguments) -> Result<(), AppError> {
    if arguments.list {
        return list();
    }
    let mut missed = 0;
    if let Some(folder) = &arguments.records
        && arguments.cases.is_empty()
    {
        let extent = match arguments.faulty_sensors {
            true => Extent::FaultySensors,
            false => Extent::Records,
        };
        missed = records(folder, extent, arguments.json)?;
        if arguments.faulty_sensors {
            return verdict(missed, 0);
        }
    }
    let length = if arguments.quick {
        Length::Quick
    } else {
        Length::Full
    };
    let threads = arguments
        .jobs
        .unwrap_or_else(|| std::thread::available_parallelism().map_or(1, usize::from));
    let mut plan = Plan::new(selected(arguments)?, seeds(arguments), length).threads(threads);
    if let Some(directory) = &arguments.report {
        plan = plan.keep(&directory.join("outcomes"), program_mark());
    }
    if let Some(folder) = &arguments.records {
        plan = plan.records(Records {
            folder: folder.clone(),
            judge_earthquakes,
        });
    }
    let report = plan.run(&Bars::default())?;
    if let Some(directory) = &arguments.report {
        report.write(directory)?;
    }
    print(&if arguments.json {
        lines(&report)
    } else {
        report.text()
    })?;
    missed += report
        .figures()
        .filter(|figure| figure.is_surprise())
        .count();
    let failed = report.cases.iter().map(|case| case.failures.len()).sum();
    verdict(missed, failed)
}

/// Returns an error unless all figures and runs are as required.
fn verdict(missed: usize, failed: usize) -> Result<(), AppError> {
    match missed + failed {
        0 => Ok(()),
        _ => Err(AppError::FiguresMissed { missed, failed }),
    }
}

/// Returns the requested cases.
///
/// Without records, the cases that need them are left out, unless no other case is requested. These
/// then state what they need.
fn selected(arguments: &ValidateArguments) -> Result<Vec<&'static Case>, AppError> {
    let mut cases = select(&arguments.cases)?;
    if arguments.records.is_some() {
        cases.retain(|case| !arguments.cases.is_empty() || case.needs_records());
    } else if cases.iter().any(|case| !case.needs_records()) {
        for case in cases.extract_if(.., |case| case.needs_records()) {
            tracing::warn!(case = case.name, "skipped, because it needs --records");
        }
    }
    Ok(cases)
}

/// Identifies the records of real structures and prints each row as soon as its condition is
/// complete. Returns the number of rows that miss their requirement.
fn records(folder: &Path, extent: Extent, json: bool) -> Result<usize, AppError> {
    let mut printed = Ok(());
    let rows = real_records(folder, extent, |row| {
        let text = if json {
            format!("{}\n", serde_json::json!(row))
        } else {
            format!("{row}\n")
        };
        if printed.is_ok() {
            printed = print(&text);
        }
    })
    .map_err(ValidateError::from)?;
    printed?;
    Ok(rows.iter().filter(|row| row.passed == Some(false)).count())
}

/// Judges recordings of earthquakes, which are in the order of time, as `spandrel earthquake` does.
fn judge_earthquakes(
    structure: &Structure,
    recordings: &[PathBuf],
) -> Result<Vec<Vec<JudgedStiffness>>, String> {
    let judge = || -> Result<_, AppError> {
        let settings = ReportSettings::of(structure.earthquakes());
        let with = with_displacements(structure.clone(), Path::new(""));
        let mut course = Course::new(with, settings)?;
        let mut judged = Vec::new();
        for path in recordings {
            let record = EventRecord::read(structure, path)?;
            let report = course.report(&record, EventName::new(structure, &record), &[])?;
            let stiffnesses = report.parameters.into_iter().map(|one| JudgedStiffness {
                judgement: one.judgement,
                coverage: one.coverage,
            });
            judged.push(stiffnesses.collect());
        }
        Ok(judged)
    };
    judge().map_err(|error| error.report())
}

/// Returns the requested seeds without duplicates, in the order of the command line.
fn seeds(arguments: &ValidateArguments) -> Vec<u64> {
    if let Some(range) = arguments.seeds {
        return range.iter().collect();
    }
    let mut seeds = Vec::new();
    for seed in &arguments.seed {
        if !seeds.contains(seed) {
            seeds.push(*seed);
        }
    }
    if seeds.is_empty() { vec![1] } else { seeds }
}

fn list() -> Result<(), AppError> {
    let mut text = String::new();
    let widest = cases()
        .iter()
        .map(|case| case.name.len())
        .max()
        .unwrap_or(0);
    for Case {
        name,
        title,
        source,
        ..
    } in cases()
    {
        // Writing to a string cannot fail.
        let _ = writeln!(text, "{name:<widest$}  {title} ({source})");
    }
    print(&text)
}

/// Returns one line of JSON per figure. A failed run has one line with an error.
fn lines(report: &Report) -> String {
    let mut text = String::new();
    for case in &report.cases {
        for figure in &case.figures {
            let _ = writeln!(text, "{}", serde_json::json!(figure));
        }
        for (seed, why) in &case.failures {
            let _ = writeln!(
                text,
                "{}",
                serde_json::json!({"case": case.name, "seed": seed, "error": why, "pass": false})
            );
        }
    }
    text
}

/// Returns a mark that identifies this program: its version, and the size and date of its file.
///
/// The mark separates its stored outcomes from those of another program.
fn program_mark() -> String {
    let file = std::env::current_exe().and_then(|path| path.metadata());
    let changed = file.as_ref().ok().and_then(|file| file.modified().ok());
    let age = changed
        .and_then(|time| time.duration_since(std::time::UNIX_EPOCH).ok())
        .map_or(0, |age| age.as_nanos());
    format!(
        "{} {} {age}",
        env!("CARGO_PKG_VERSION"),
        file.map_or(0, |file| file.len())
    )
}

/// One bar for each run in progress.
#[derive(Default)]
struct Bars {
    all: MultiProgress,
    running: Mutex<HashMap<(&'static str, u64), ProgressBar>>,
}

impl Bars {
    fn running(&self) -> std::sync::MutexGuard<'_, HashMap<(&'static str, u64), ProgressBar>> {
        self.running.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Watch for Bars {
    fn advanced(&self, case: &Case, seed: u64, share: f64) {
        let mut running = self.running();
        let bar = running.entry((case.name, seed)).or_insert_with(|| {
            let bar = self.all.add(progress::share_bar(STEPS));
            bar.set_message(format!("{} seed {seed}", case.name));
            bar
        });
        bar.set_position((share * STEPS as f64) as u64);
    }

    fn finished(
        &self,
        case: &Case,
        seed: u64,
        result: Result<&Outcome, &ValidateError>,
        kept: bool,
    ) {
        if let Some(bar) = self.running().remove(&(case.name, seed)) {
            bar.finish_and_clear();
        }
        match result {
            Ok(_) if kept => {
                tracing::info!(case = case.name, seed, "reused from the report directory")
            }
            Ok(_) => tracing::info!(case = case.name, seed, "done"),
            Err(error) => tracing::warn!(case = case.name, seed, %error, "run failed"),
        }
    }
}
