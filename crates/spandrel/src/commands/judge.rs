//! `spandrel judge`: judges live estimates, or a series of natural frequencies or stiffnesses
//! offline, repeats a past judgement, or writes a simulated series.

mod example;
mod notes;
mod past;
mod series;

use super::run::{Services, one};
use super::{print, refuse_overwriting};
use crate::cli::JudgeArguments;
use crate::error::AppError;
use crate::judge_report::{DayLine, Summary, course_csv, report_text};
use crate::services::Share;
use spandrel_judge::{Budget, Judge};
use spandrel_record::RecordError;
use spandrel_structure::JudgedStructure;
use std::fmt::Write as _;
use std::path::PathBuf;

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
    let references = match &arguments.annotations {
        Some(path) => notes::read(path, &structure, &mut judge)?,
        None => Vec::new(),
    };
    let mut judgements = Vec::new();
    let mut epochs = 0_usize;
    let mut span_s: Option<[f64; 2]> = None;
    for path in &arguments.series {
        series::read(path, &structure.plan, |epoch| {
            epochs += 1;
            span_s.get_or_insert([epoch.time_s; 2])[1] = epoch.time_s;
            judge.handle(&epoch, &mut judgements)
        })?;
    }
    judge.finish(&mut judgements);
    if let Some(span_s) = span_s {
        notes::warn_outside(&references, span_s);
    }
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
