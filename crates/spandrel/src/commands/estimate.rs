//! `spandrel estimate`: identification of a recording without a bus.

use super::{print, progress, refuse_overwriting};
use crate::cli::EstimateArguments;
use crate::error::AppError;
use crate::{offline, record_source};
use spandrel_alert::Baseline;
use spandrel_bus::EstimateBlock;
use spandrel_record::EstimateWriter;
use spandrel_sensor::recorded_rows;
use spandrel_structure::Structure;

/// Identifies the recording, writes the estimates if asked, and prints the summary.
///
/// # Errors
/// When a file is wrong or cannot be written.
pub fn run(arguments: &EstimateArguments) -> Result<(), AppError> {
    if let Some(output) = &arguments.output {
        let inputs = [Some(&arguments.structure), Some(&arguments.record), arguments.baseline.as_ref()];
        refuse_overwriting(output, inputs.into_iter().flatten().map(|path| path.as_path()))?;
    }
    let structure = Structure::read(&arguments.structure)?;
    let recording = record_source::open(&structure, &arguments.record)?;
    let baseline = arguments.baseline.as_deref().map(Baseline::read).transpose()?;
    let names: Vec<&str> = structure.parameters().iter().map(|parameter| parameter.name()).collect();
    let mut writer = arguments.output.as_deref().map(|path| EstimateWriter::create(path, &names)).transpose()?;
    let bar = progress::bar("identifying", None);
    let collector = offline::identify(&structure, recorded_rows(recording, 0), baseline.as_ref(), |block| {
        bar.inc(block.estimates.len() as u64);
        match &mut writer {
            Some(writer) => write(writer, block),
            None => Ok(()),
        }
    })?;
    bar.finish_and_clear();
    if let Some(writer) = writer {
        writer.finish()?;
    }
    let summary = collector.finish();
    print(&if arguments.json { summary.json() } else { summary.text() })
}

fn write(writer: &mut EstimateWriter, block: &EstimateBlock) -> Result<(), AppError> {
    let Some(grid) = block.grid() else {
        return Ok(()); // our own blocks have one
    };
    for (number, estimate) in block.iter() {
        let pairs = estimate.mean.iter().enumerate();
        let pairs = pairs.map(|(index, mean)| (*mean, estimate.variance(index).unwrap_or(0.0).max(0.0).sqrt()));
        writer.write(grid.time_ns(number), pairs)?;
    }
    Ok(())
}
