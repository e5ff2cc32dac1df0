//! `spandrel modes`: identifies the natural frequencies of a recording, or follows them live.

use super::run::{Services, one};
use super::{print, refuse_overwriting};
use crate::cli::{ModesArguments, ServiceArguments};
use crate::error::AppError;
use crate::modes::analysis::{Analysis, Choice, analyse, follow};
use crate::modes::frames::{Frames, Selection};
use crate::modes::{declaration, diagrams, table};
use crate::services::Share;
use spandrel_modal::{ModeSummary, Source};
use spandrel_record::RecordError;
use spandrel_structure::Structure;
use std::path::Path;

/// Names of the files of a report.
const STABILISATION: &str = "stabilisation.svg";
const SINGULAR_VALUES: &str = "singular-values.svg";
const MODES_JSON: &str = "modes.json";
const MODES_CSV: &str = "modes.csv";

/// Runs the service, or reads a recording, identifies its modes and prints them.
///
/// # Errors
/// The recording or an option is not valid, the recording is too short, it has no mode, a file
/// cannot be written, or the service fails.
pub fn run(arguments: &ModesArguments) -> Result<(), AppError> {
    if arguments.live {
        let service = ServiceArguments {
            structures: arguments.files.clone(),
            bus: arguments.bus.clone(),
        };
        return one(&service, Services::MODES, Share::ALL);
    }
    let (path, structure) = match (arguments.files.as_slice(), &arguments.structure) {
        ([record], structure) => (record.as_path(), structure.as_ref()),
        ([record, structure], None) => (record.as_path(), Some(structure)),
        (several, structure) => {
            let found = several.len() + usize::from(structure.is_some());
            return Err(AppError::FilesOfModes { found });
        }
    };
    if let Some(file) = &arguments.csv {
        refuse_overwriting(file, [path])?;
    }
    if let Some(folder) = &arguments.report {
        for name in [STABILISATION, SINGULAR_VALUES, MODES_JSON, MODES_CSV] {
            refuse_overwriting(&folder.join(name), [path])?;
        }
    }
    let selection = Selection {
        only: &arguments.channels,
        without: &arguments.without,
    };
    let choice = Choice {
        epoch_s: arguments.epoch,
        band_hz: arguments.band.map(|band| (band.lowest_hz, band.highest_hz)),
        highest_order: arguments.order,
        references: arguments.references.clone(),
    };
    let is_own_choice = choice.is_some() || selection.is_some();
    if structure.is_some() && arguments.reading.is_some() {
        return Err(AppError::ReadingOfStructure);
    }
    let structure = structure.map(|file| Structure::read(file)).transpose()?;
    let plan = structure
        .as_ref()
        .and_then(Structure::modal)
        .filter(|_| !is_own_choice);
    let frames = match (&structure, plan) {
        (Some(structure), Some(plan)) => Frames::of_plan(path, structure, plan)?,
        (Some(structure), None) => Frames::of_structure(path, structure, selection)?,
        (None, _) => Frames::read(path, &arguments.reading.options(), selection)?,
    };
    let analysis = match (&structure, plan) {
        (Some(structure), Some(plan)) => follow(&frames, structure, plan)?,
        _ => analyse(&frames, &choice)?,
    };
    if let Some(folder) = &arguments.report {
        report(folder, &frames, &analysis)?;
    }
    if let Some(file) = &arguments.csv {
        write(file, &table::csv(&frames, &analysis))?;
    }
    print(&if arguments.json {
        table::json(&frames, &analysis)
    } else if arguments.declare {
        declaration::tables(&choice, &arguments.without, plan, &analysis)
    } else {
        table::text(&frames, &analysis)
    })?;
    let is_mode = |mode: &ModeSummary| mode.source == Source::Mode;
    match analysis.modes.iter().any(is_mode) {
        true => Ok(()),
        false => Err(AppError::NoMode {
            path: path.to_owned(),
        }),
    }
}

/// Writes the files of a report into a folder, which is created if it does not exist.
fn report(folder: &Path, frames: &Frames, analysis: &Analysis) -> Result<(), AppError> {
    let undrawn = |error: Box<dyn std::error::Error>| AppError::Diagram {
        reason: error.to_string(),
    };
    let stabilisation = diagrams::stabilisation(analysis).map_err(undrawn)?;
    let spectrum = diagrams::singular_values(analysis).map_err(undrawn)?;
    std::fs::create_dir_all(folder).map_err(|source| cannot_write(folder, source))?;
    write(&folder.join(STABILISATION), &stabilisation)?;
    write(&folder.join(SINGULAR_VALUES), &spectrum)?;
    write(&folder.join(MODES_JSON), &table::json(frames, analysis))?;
    write(&folder.join(MODES_CSV), &table::csv(frames, analysis))
}

fn write(path: &Path, text: &str) -> Result<(), AppError> {
    std::fs::write(path, text).map_err(|source| cannot_write(path, source))
}

fn cannot_write(path: &Path, source: std::io::Error) -> AppError {
    AppError::Record(RecordError::Open {
        path: path.to_owned(),
        source,
    })
}
