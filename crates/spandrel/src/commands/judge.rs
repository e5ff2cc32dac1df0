//! `spandrel judge`: judges live estimates, or a series of natural frequencies or stiffnesses
//! offline, repeats a past judgement, or writes a simulated series.

mod example;
mod past;

use super::run::{Services, one};
use super::{print, refuse_overwriting};
use crate::cli::JudgeArguments;
use crate::error::AppError;
use crate::judge_report::{DayLine, Summary, course_csv, report_text};
use crate::services::Share;
use spandrel_bus::{is_without_date, read_text_up_to};
use spandrel_judge::{Budget, Epoch, Judge};
use spandrel_judging::{new_reference, read_annotations};
use spandrel_record::{ChannelColumn, ColumnMapping, CsvReader, RecordError, RecordReader};
use spandrel_structure::{JudgePlan, JudgedStructure};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// Maximum size of a file of annotations (bytes): some 100,000 annotations.
const MOST_ANNOTATION_BYTES: u64 = 64 << 20;

/// Runs the service, or judges every day of a series and prints what changed, or one line of JSON
/// per judgement.
///
/// # Errors
/// Returns an error if a file is not valid, a condition has a value that its unit does not allow,
/// or the service fails.
pub fn run(arguments: &JudgeArguments) -> Result<(), AppError> {
    if let Some(file) = &arguments.example.example {
        return example::run(file, &arguments.example);
    }
    if let Some(at) = &arguments.at {
        return past::run(arguments, at);
    }
    let structures = &arguments.service.structures;
    let structure = match (structures.as_slice(), arguments.series.is_empty()) {
        (_, true) if arguments.report || arguments.json || arguments.course.is_some() => {
            return Err(AppError::NoSeries);
        }
        (_, true) => return one(&arguments.service, Services::JUDGE, Share::ALL),
        ([structure], false) => JudgedStructure::read(structure)?,
        (several, false) => {
            let found = several.len();
            return Err(AppError::SeriesOfStructures { found });
        }
    };
    if let Some(file) = &arguments.course {
        refuse_overwriting(file, arguments.series.iter().map(PathBuf::as_path))?;
    }
    let mut judge = Judge::new(structure.plan.settings.clone())?;
    if let Some(path) = &arguments.annotations {
        let read = read_text_up_to(path, MOST_ANNOTATION_BYTES);
        let text = read.map_err(|source| RecordError::Open {
            path: path.clone(),
            source,
        })?;
        let annotations = read_annotations(&text, path);
        let new = annotations
            .iter()
            .filter_map(|annotation| new_reference(annotation, judge.settings()));
        let new: Vec<_> = new.collect();
        new.into_iter().for_each(|new| judge.start_anew(new));
    }
    let mut judgements = Vec::new();
    let mut epochs = 0_usize;
    for path in &arguments.series {
        read_series(path, &structure.plan, |epoch| {
            epochs += 1;
            judge.handle(&epoch, &mut judgements)
        })?;
    }
    judge.finish(&mut judgements);
    let mut budget = Budget::default();
    judgements
        .iter()
        .for_each(|judgement| budget.count(judgement));
    let spent = budget.spent(judge.settings().false_alarms_per_year);
    if let Some(file) = &arguments.course {
        let text = course_csv(judge.settings(), &judgements);
        std::fs::write(file, text).map_err(|source| RecordError::Open {
            path: file.clone(),
            source,
        })?;
    }
    if arguments.json {
        let mut text = String::new();
        for judgement in &judgements {
            let _ = writeln!(text, "{}", DayLine::new(&structure.name, judgement).json());
        }
        if arguments.report {
            for report in judge.report() {
                let _ = writeln!(text, "{}", serde_json::json!({ "report": report }));
            }
            let _ = writeln!(text, "{}", serde_json::json!({ "budget": spent }));
        }
        return print(&text);
    }
    let mut text = Summary::new(&structure.name, epochs, &judgements).to_string();
    if arguments.report {
        text += &report_text(judge.settings(), &spent, &judge.report());
    }
    print(&text)
}

/// Reads the rows of a CSV series as epochs.
fn read_series(
    path: &Path,
    plan: &JudgePlan,
    mut handle: impl FnMut(Epoch) -> Result<(), spandrel_judge::JudgeError>,
) -> Result<(), AppError> {
    let names = plan
        .settings
        .quantities
        .iter()
        .map(|quantity| &quantity.name);
    let names = names.chain(
        plan.settings
            .conditions
            .iter()
            .map(|condition| &condition.name),
    );
    let columns = plan.quantity_columns.iter().chain(&plan.condition_columns);
    let mapping = names
        .zip(columns)
        .map(|(name, column)| ChannelColumn::new(name).with_column(column))
        .collect();
    let mapping = ColumnMapping::new(mapping).with_time_column(&plan.time_column);
    let mut reader = CsvReader::open(path, &mapping)?;
    let quantities = plan.settings.quantities.len();
    let mut previous_ns = None;
    while let Some(row) = reader.next_row()? {
        let value = |value: &f64| (!value.is_nan()).then_some(*value);
        let (measured, conditions) = row.values.split_at(quantities);
        let epoch = Epoch {
            time_s: row.time_ns as f64 * 1e-9,
            quantities: measured.iter().map(value).collect(),
            conditions: conditions.iter().map(value).collect(),
        };
        let (time_ns, line) = (row.time_ns, reader.line());
        check_time(path, plan, line, previous_ns.replace(time_ns), time_ns)?;
        check_row(path, plan, line, &epoch)?;
        handle(epoch).map_err(|source| AppError::Epoch {
            path: path.to_owned(),
            line,
            source,
        })?;
    }
    Ok(())
}

/// Rejects numbers that are not seconds, such as numbers of hours. Read as seconds, they are in
/// 1970 and closer together than epochs.
fn check_time(
    path: &Path,
    plan: &JudgePlan,
    line: u64,
    previous_ns: Option<i64>,
    time_ns: i64,
) -> Result<(), AppError> {
    let step_s = previous_ns.map(|previous_ns| (time_ns - previous_ns) as f64 * 1e-9);
    let epoch_s = plan.epoch_s;
    match step_s {
        Some(step_s) if is_without_date(time_ns) && step_s < f64::from(epoch_s) => {
            Err(AppError::SeriesValue {
                path: path.to_owned(),
                line,
                column: plan.time_column.clone(),
                what: format!(
                    "read as seconds since 1970, the row is {step_s} s after the previous one, \
                     must be at least judge.epoch-s, {epoch_s} s; write a time as seconds since \
                     1970, or in ISO 8601, such as 2025-01-01T06:00:00Z"
                ),
            })
        }
        _ => Ok(()),
    }
}

/// Rejects a value that its column cannot have. Offline, a wrong unit is a mistake in the file, and
/// not a day without a statement.
fn check_row(path: &Path, plan: &JudgePlan, line: u64, epoch: &Epoch) -> Result<(), AppError> {
    let conditions = plan.settings.conditions.iter().zip(&plan.condition_columns);
    for ((condition, column), value) in conditions.zip(&epoch.conditions) {
        if let Some(value) = value {
            condition
                .kind
                .convert(*value)
                .map_err(|source| AppError::SeriesValue {
                    path: path.to_owned(),
                    line,
                    column: column.clone(),
                    what: source.to_string(),
                })?;
        }
    }
    let wrong =
        |value: &&Option<f64>| value.is_some_and(|value| !(value > 0.0 && value.is_finite()));
    let columns = plan.quantity_columns.iter().zip(&epoch.quantities);
    match columns.into_iter().find(|(_, value)| wrong(value)) {
        Some((column, value)) => Err(AppError::SeriesValue {
            path: path.to_owned(),
            line,
            column: column.clone(),
            what: format!(
                "is {}, must be above 0; leave the value of a mode that was not found empty",
                value.unwrap_or_default()
            ),
        }),
        None => Ok(()),
    }
}
