//! `spandrel baseline`: the sound values of the parameters, learnt from recordings.

use super::{print, refuse_overwriting};
use crate::cli::BaselineArguments;
use crate::error::AppError;
use crate::{offline, record_source};
use spandrel_alert::{Baseline, RecordSummary};
use spandrel_bus::Phase;
use spandrel_identify::Identification;
use spandrel_sensor::recorded_rows;
use spandrel_structure::Structure;
use std::fmt::Write as _;

/// Identifies each recording from its start and writes mean and spread of each parameter.
///
/// # Errors
/// When a file is wrong or has nothing to learn from.
pub fn run(arguments: &BaselineArguments) -> Result<(), AppError> {
    let inputs = std::iter::once(&arguments.structure).chain(&arguments.record);
    refuse_overwriting(&arguments.output, inputs.map(|path| path.as_path()))?;
    let structure = Structure::read(&arguments.structure)?;
    if structure.parameters().is_empty() {
        return Err(AppError::NoParameters { path: arguments.structure.clone() });
    }
    let skipped = (arguments.skip * structure.sampling_rate_hz()) as u64;
    let mut records = Vec::new();
    for path in &arguments.record {
        let recording = record_source::open(&structure, path)?;
        let mut frames: Vec<Vec<(f64, f64)>> = Vec::new();
        let identification = Identification::new(&structure, "identify")?;
        offline::identify(&structure, identification, recorded_rows(recording, 0), None, |block, _| {
            for (number, estimate) in block.iter() {
                if number >= skipped && estimate.flags.phase == Phase::Working {
                    let std = |index| estimate.variance(index).unwrap_or(0.0).max(0.0).sqrt();
                    frames.push(estimate.mean.iter().enumerate().map(|(index, mean)| (*mean, std(index))).collect());
                }
            }
            Ok(())
        })?;
        let nothing = || AppError::NothingLearnt { path: path.clone(), skip_s: arguments.skip };
        records.push(RecordSummary::from_estimates(frames).ok_or_else(nothing)?);
    }
    let names: Vec<&str> = structure.parameters().iter().map(|parameter| parameter.name()).collect();
    let baseline = Baseline::from_records(structure.name(), &names, &records)?;
    baseline.write(&arguments.output)?;
    let mut text = format!("sound values of {} from {} recordings\n", structure.name(), records.len());
    for name in &names {
        if let Some(reference) = baseline.reference(name) {
            // writing to a String does not fail
            let _ = writeln!(text, "  {name:<24} {:.4} ± {:.4}", reference.mean(), reference.std());
        }
    }
    print(&text)
}
