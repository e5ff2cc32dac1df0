//! `spandrel earthquake`: reports what earthquakes did to a structure, from recordings.

use super::{print, refuse_overwriting};
use crate::cli::EarthquakeArguments;
use crate::earthquake::course::Course;
use crate::earthquake::event_record::EventRecord;
use crate::earthquake::report::{EventName, ReportSettings};
use crate::earthquake::storeys::with_displacements;
use crate::earthquake::{index, page, wording};
use crate::error::AppError;
use spandrel_structure::Structure;
use std::path::Path;

/// Name of the list of all reports.
const INDEX: &str = "index.html";

/// Reports each recording, in the order of time, and writes the ranked list.
///
/// # Errors
/// Returns an error if a file is not valid or cannot be written. The reports of all valid
/// recordings are written before the first recording that is not valid is reported as an error.
pub fn run(arguments: &EarthquakeArguments) -> Result<(), AppError> {
    let structure = Structure::read_with_model(&arguments.structure)?;
    let of_file = ReportSettings::of(structure.earthquakes());
    let settings = ReportSettings {
        loss: arguments.loss.unwrap_or(of_file.loss),
        credibility: arguments.credibility.unwrap_or(of_file.credibility),
        strong_above_m_per_s2: arguments.strong.unwrap_or(of_file.strong_above_m_per_s2),
    };
    let with = with_displacements(structure, &arguments.structure);
    let mut records = Vec::new();
    let mut failed = Vec::new();
    for path in &arguments.records {
        match EventRecord::read(&with.structure, path) {
            Ok(record) => records.push(record),
            Err(error) => failed.push(error),
        }
    }
    match records.iter().find(|record| record.time_ns().is_none()) {
        None => records.sort_by_key(EventRecord::time_ns),
        // Nothing is known of where it belongs, so the order of the command line counts.
        Some(undated) => check_order(&records, undated)?,
    }
    let names: Vec<EventName> = records
        .iter()
        .map(|record| EventName::new(&with.structure, record))
        .collect();
    for (index, name) in names.iter().enumerate() {
        if let Some(first) = names[..index]
            .iter()
            .position(|one| one.event == name.event)
        {
            return Err(AppError::SameEvent {
                first: records[first].path.clone(),
                second: records[index].path.clone(),
                event: name.event.clone(),
            });
        }
        for extension in ["html", "json"] {
            let file = arguments.report.join(format!("{}.{extension}", name.event));
            refuse_overwriting(&file, arguments.records.iter().map(|path| path.as_path()))?;
        }
    }
    if records.is_empty() {
        return failed.into_iter().next().map_or(Ok(()), Err);
    }
    create(&arguments.report)?;
    let mut course = Course::new(with, settings)?;
    for (record, name) in records.iter().zip(names) {
        let report = course.report(record, name, &[])?;
        let file = |extension| {
            arguments
                .report
                .join(format!("{}.{extension}", report.name.event))
        };
        write(&file("html"), &page::html(&report, &record.channels, ""))?;
        write(&file("json"), &report.json())?;
        print(&(wording::line(&report) + "\n"))?;
    }
    let entries = index::entries(&arguments.report)?;
    write(&arguments.report.join(INDEX), &index::html(&entries, &[]))?;
    match failed.len() {
        0 => Ok(()),
        count => Err(AppError::NotReported {
            count,
            reported: records.len(),
            source: Box::new(failed.swap_remove(0)),
        }),
    }
}

/// Checks that the recordings with dates are in the order of time.
fn check_order(records: &[EventRecord], undated: &EventRecord) -> Result<(), AppError> {
    let dated = records.iter().filter(|record| record.time_ns().is_some());
    let dated: Vec<&EventRecord> = dated.collect();
    let wrong = dated
        .windows(2)
        .find(|two| two[0].time_ns() > two[1].time_ns());
    wrong.map_or(Ok(()), |two| {
        Err(AppError::NotInOrder {
            first: two[0].path.clone(),
            later: two[0].date().unwrap_or_default(),
            second: two[1].path.clone(),
            earlier: two[1].date().unwrap_or_default(),
            undated: undated.path.clone(),
        })
    })
}

fn create(folder: &Path) -> Result<(), AppError> {
    std::fs::create_dir_all(folder).map_err(|source| AppError::Io {
        what: format!("cannot create {}", folder.display()),
        source,
    })
}

fn write(path: &Path, text: &str) -> Result<(), AppError> {
    std::fs::write(path, text).map_err(|source| AppError::Io {
        what: format!("cannot write {}", path.display()),
        source,
    })
}
