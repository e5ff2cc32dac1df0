//! `spandrel estimate`: identifies a recording without a bus.

use super::{print, progress, refuse_overwriting};
use crate::cli::{EstimateArguments, FilterChoice};
use crate::error::AppError;
use crate::services::check_baseline;
use crate::{distributed, offline, record_source};
use spandrel_alert::Baseline;
use spandrel_bus::EstimateBlock;
use spandrel_identify::{Estimator, Identification, IdentifyError};
use spandrel_record::EstimateWriter;
use spandrel_sensor::{open_record, recorded_rows};
use spandrel_structure::{MOST_PARTICLE_STATES, Structure};
use tracing::warn;

/// Identifies the recording, writes the estimates on request, and prints the summary.
///
/// # Errors
/// Returns an error if a file is not valid or cannot be written.
pub fn run(arguments: &EstimateArguments) -> Result<(), AppError> {
    check_arguments(arguments)?;
    let structure = Structure::read_with_model(&arguments.structure)?;
    let recording = open_record(&structure, &arguments.record)?;
    let baseline = arguments
        .baseline
        .as_deref()
        .map(Baseline::read)
        .transpose()?;
    if let (Some(baseline), Some(path)) = (&baseline, &arguments.baseline) {
        check_baseline(&structure, baseline, path)?;
    }
    let by_nodes = structure.fusion().is_some() && arguments.filter != FilterChoice::Particle;
    let one_filter = if by_nodes {
        None
    } else {
        Some(identification(&structure, arguments)?)
    };
    let names = match &one_filter {
        Some(identification) => columns(&structure, identification),
        None => structure
            .parameters()
            .iter()
            .map(|parameter| parameter.name().to_owned())
            .collect(),
    };
    let mut writer = arguments
        .output
        .as_deref()
        .map(|path| EstimateWriter::create(path, &names))
        .transpose()?;
    let bar = progress::bar(
        "identifying",
        record_source::expected_rows(&arguments.record),
    );
    let rows = recorded_rows(recording, 0);
    let take = |block: &EstimateBlock, responses: &[Vec<(f64, f64)>]| {
        bar.inc(block.estimates.len() as u64);
        match &mut writer {
            Some(writer) => write(writer, block, responses),
            None => Ok(()),
        }
    };
    let collector = match one_filter {
        Some(identification) => {
            offline::identify(&structure, identification, rows, baseline.as_ref(), take)?
        }
        None => distributed::fuse(&structure, rows, baseline.as_ref(), take)?,
    };
    bar.finish_and_clear();
    if let Some(writer) = writer {
        writer.finish()?;
    }
    let summary = collector.finish();
    if arguments.filter == FilterChoice::Particle && summary.effective_share.is_none() {
        let (warm_up_s, record_s) = (
            arguments.particle.plan().warm_up_s,
            summary.frames as f64 / structure.sampling_rate_hz(),
        );
        return Err(AppError::WarmUpTooLong {
            warm_up_s,
            record_s,
        });
    }
    print(&if arguments.json {
        summary.json()
    } else {
        summary.text()
    })
}

/// Refuses an output that would overwrite an input, and options of another filter.
fn check_arguments(arguments: &EstimateArguments) -> Result<(), AppError> {
    if let Some(output) = &arguments.output {
        let inputs = [
            Some(&arguments.structure),
            Some(&arguments.record),
            arguments.baseline.as_ref(),
        ];
        refuse_overwriting(
            output,
            inputs.into_iter().flatten().map(|path| path.as_path()),
        )?;
    }
    match (arguments.filter, arguments.particle.given()) {
        (FilterChoice::File | FilterChoice::Kalman, Some(option)) => {
            Err(AppError::ParticlesOnly { option })
        }
        _ => Ok(()),
    }
}

/// Creates the requested filter.
fn identification(
    structure: &Structure,
    arguments: &EstimateArguments,
) -> Result<Identification, AppError> {
    const ID: &str = "identify";
    let refused = |source| IdentifyError::Filter {
        structure: structure.name().to_owned(),
        source,
    };
    match arguments.filter {
        FilterChoice::File => Ok(Identification::new(structure, ID)?),
        FilterChoice::Kalman => {
            let estimator = Estimator::kalman(structure).map_err(refused)?;
            Ok(Identification::with_estimator(structure, ID, estimator)?)
        }
        FilterChoice::Particle => {
            if structure.has_classes() || structure.screens_outliers() {
                warn!(
                    "the particle filter identifies each parameter separately and uses every \
                     sample; ignoring [classes] and [outliers]"
                );
            }
            let states = 2 * structure.degrees_of_freedom().len() + structure.parameters().len();
            if states > MOST_PARTICLE_STATES {
                warn!(
                    "{states} states and parameters: the required number of particles grows \
                     exponentially with them, and with too few particles the intervals are much \
                     too narrow; compare several --seed, and see docs/theory/particle-filter.md"
                );
            }
            let plan = arguments.particle.plan();
            let estimator = Estimator::with_particles(structure, &plan).map_err(refused)?;
            Ok(Identification::with_estimator(structure, ID, estimator)?)
        }
    }
}

/// Returns the column names of the output: parameters, responses, and then the identified noise
/// levels.
fn columns(structure: &Structure, identification: &Identification) -> Vec<String> {
    let parameters = structure
        .parameters()
        .iter()
        .map(|parameter| parameter.name().to_owned());
    let responses = structure
        .estimated_responses()
        .iter()
        .map(|response| response.name().to_owned());
    // A level can have the same name as a parameter.
    let levels = identification
        .noise_names()
        .iter()
        .map(|name| format!("noise/{name}"));
    parameters.chain(responses).chain(levels).collect()
}

fn write(
    writer: &mut EstimateWriter,
    block: &EstimateBlock,
    responses: &[Vec<(f64, f64)>],
) -> Result<(), AppError> {
    let Some(grid) = block.grid() else {
        return Ok(()); // blocks of this process always have a grid
    };
    for (index, (number, estimate)) in block.iter().enumerate() {
        let std = |variance: f64| variance.max(0.0).sqrt();
        let parameters = estimate.mean.iter().enumerate();
        let parameters =
            parameters.map(|(index, mean)| (*mean, std(estimate.variance(index).unwrap_or(0.0))));
        let responses = responses.get(index).into_iter().flatten().copied();
        let levels = estimate.noise_mean.iter().zip(&estimate.noise_covariance);
        let levels = levels.map(|(mean, variance)| (*mean, std(*variance)));
        writer.write(
            grid.time_ns(number),
            parameters.chain(responses).chain(levels),
        )?;
    }
    Ok(())
}
