//! `spandrel modes`: identifies the natural frequencies of a recording, or follows them live.

use super::run::{Services, one};
use super::{print, refuse_overwriting};
use crate::cli::{ModesArguments, ServiceArguments};
use crate::error::AppError;
use crate::modes::analysis::{Analysis, Choice, analyse, follow};
use crate::modes::frames::{Frames, Reading, Selection, recordings};
use crate::modes::table::Recordings;
use crate::modes::{declaration, diagrams, table, uff};
use crate::services::Share;
use spandrel_modal::{ModeSummary, Source};
use spandrel_record::RecordError;
use spandrel_structure::Structure;
use std::path::{Path, PathBuf};

/// Names of the files of a report.
const STABILISATION: &str = "stabilisation.svg";
const SINGULAR_VALUES: &str = "singular-values.svg";
const MODES_JSON: &str = "modes.json";
const MODES_CSV: &str = "modes.csv";

/// Runs the service, or reads a recording, identifies its modes and prints them.
///
/// # Errors
/// Returns an error if the recording or an option is not valid, the recording is too short, it has
/// no mode, a file cannot be written, or the service fails.
pub fn run(arguments: &ModesArguments) -> Result<(), AppError> {
    if arguments.live {
        let service = ServiceArguments {
            structures: arguments.files.clone(),
            bus: arguments.bus.clone(),
        };
        return one(&service, Services::MODES, Share::ALL);
    }
    let (paths, structure) = divide(arguments)?;
    let Some(path) = paths.first() else {
        return Err(AppError::FilesOfModes {
            found: "no recording is given",
        });
    };
    check_outputs(arguments, &paths)?;
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
    let structure = structure.map(Structure::read).transpose()?;
    let plan = structure
        .as_ref()
        .and_then(Structure::modal)
        .filter(|_| !is_own_choice);
    let options = arguments.reading.options();
    let files: Vec<Vec<PathBuf>> = paths
        .iter()
        .map(|path| recordings(path, &options))
        .collect::<Result<_, _>>()?;
    let reading = match (&structure, plan) {
        (Some(structure), Some(plan)) => Reading::Plan(structure, plan),
        (Some(structure), None) => Reading::Structure(structure, selection),
        (None, _) => Reading::Files(&options, selection),
    };
    let all = Frames::read(&files.concat(), reading)?;
    let analysis = match (&structure, plan) {
        (Some(structure), Some(plan)) => follow(&all, structure, plan)?,
        _ => analyse(&all, &choice)?,
    };
    let Some(first) = all.first() else {
        return Ok(()); // there is a path, and each has a recording
    };
    let common = match paths.len() {
        1 => path,
        _ => path.parent().unwrap_or(path),
    };
    let records = Recordings {
        path: common,
        all: &all,
        first,
    };
    write_outputs(arguments, records, &analysis, structure.as_ref())?;
    print(&if arguments.json {
        table::json(records, &analysis)
    } else if arguments.declare {
        declaration::tables(&choice, &arguments.without, plan, &analysis)
    } else {
        table::text(records, &analysis)
    })?;
    let is_mode = |mode: &ModeSummary| mode.source == Source::Mode;
    match analysis.modes.iter().any(is_mode) {
        true => Ok(()),
        false => Err(AppError::NoMode {
            path: common.to_owned(),
        }),
    }
}

/// Divides the files into recordings and at most one structure file.
fn divide(arguments: &ModesArguments) -> Result<(Vec<&Path>, Option<&Path>), AppError> {
    let is_structure = |file: &&Path| file.extension().is_some_and(|ending| ending == "toml");
    let files = arguments.files.iter().map(PathBuf::as_path);
    let (structures, recordings): (Vec<&Path>, Vec<&Path>) = files.partition(is_structure);
    match (structures.as_slice(), arguments.structure.as_deref()) {
        ([], structure) => Ok((recordings, structure)),
        ([structure], None) => Ok((recordings, Some(*structure))),
        _ => Err(AppError::FilesOfModes {
            found: "several structure files are given",
        }),
    }
}

/// Refuses outputs that would overwrite a recording.
fn check_outputs(arguments: &ModesArguments, recordings: &[&Path]) -> Result<(), AppError> {
    let inputs = || recordings.iter().copied();
    for file in arguments.csv.iter().chain(&arguments.uff) {
        refuse_overwriting(file, inputs())?;
    }
    if let Some(folder) = &arguments.report {
        for name in [STABILISATION, SINGULAR_VALUES, MODES_JSON, MODES_CSV] {
            refuse_overwriting(&folder.join(name), inputs())?;
        }
    }
    Ok(())
}

/// Writes the requested files.
fn write_outputs(
    arguments: &ModesArguments,
    records: Recordings<'_>,
    analysis: &Analysis,
    structure: Option<&Structure>,
) -> Result<(), AppError> {
    if let Some(folder) = &arguments.report {
        report(folder, records, analysis)?;
    }
    if let Some(file) = &arguments.csv {
        write(file, &table::csv(records, analysis))?;
    }
    if let Some(file) = &arguments.uff {
        write(file, &uff::file(records.first, analysis, structure))?;
    }
    Ok(())
}

/// Writes the files of a report into a folder, which is created if it does not exist.
fn report(folder: &Path, records: Recordings<'_>, analysis: &Analysis) -> Result<(), AppError> {
    let undrawn = |error: Box<dyn std::error::Error>| AppError::Diagram {
        reason: error.to_string(),
    };
    let stabilisation = diagrams::stabilisation(analysis).map_err(undrawn)?;
    let spectrum = diagrams::singular_values(analysis).map_err(undrawn)?;
    std::fs::create_dir_all(folder).map_err(|source| cannot_write(folder, source))?;
    write(&folder.join(STABILISATION), &stabilisation)?;
    write(&folder.join(SINGULAR_VALUES), &spectrum)?;
    write(&folder.join(MODES_JSON), &table::json(records, analysis))?;
    write(&folder.join(MODES_CSV), &table::csv(records, analysis))
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
