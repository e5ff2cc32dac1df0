//! The measured motion of a structure along each direction of its ground, for the stiffness of the
//! whole structure.

use super::event_record::EventRecord;
use crate::error::AppError;
use spandrel_earthquake::{Accelerometer, MeasuredMotion, Mode};
use spandrel_filter::BandLimit;
use spandrel_structure::{CommonMotion, Structure};

/// Returns the name for people of each direction in which the stiffness of the whole structure can
/// be fitted.
pub fn names(structure: &Structure) -> Vec<String> {
    let motions = structure.common_motions();
    let one = motions.len() == 1;
    motions
        .iter()
        .map(|motion| {
            let ground = motion.channels().next();
            let name = ground.and_then(|index| structure.channels().nth(index));
            match (one, name) {
                (false, Some(channel)) => format!("the whole structure along {}", channel.name()),
                _ => "the whole structure".to_owned(),
            }
        })
        .collect()
}

/// Returns the motion along each direction, in the order of [`names`].
///
/// All channels pass the band limit of the structure file, which leaves the equation of motion as
/// it is.
///
/// # Errors
/// Returns an error if the band limit is not valid.
pub fn motions(
    structure: &Structure,
    record: &EventRecord,
) -> Result<Vec<MeasuredMotion>, AppError> {
    let motions = structure.common_motions();
    let each = motions
        .iter()
        .map(|motion| measured(structure, motion, record));
    each.collect()
}

fn measured(
    structure: &Structure,
    motion: &CommonMotion,
    record: &EventRecord,
) -> Result<MeasuredMotion, AppError> {
    let mut channels = motion
        .channels()
        .map(|index| -> Result<Vec<f64>, AppError> {
            let samples = record.channels.get(index).map_or(&[][..], Vec::as_slice);
            let mean = spandrel_earthquake::motion::mean(samples).unwrap_or(0.0);
            let mut centred: Vec<f64> = samples.iter().map(|value| value - mean).collect();
            limit(structure, &mut centred)?;
            Ok(centred)
        });
    let ground = channels.next().unwrap_or_else(|| Ok(Vec::new()))?;
    let responses = channels.collect::<Result<Vec<_>, AppError>>()?;
    let sensors = responses.into_iter().zip(motion.shapes().skip(1)).map(
        |(samples, (rigid, participation))| Accelerometer {
            samples,
            rigid,
            participation: participation.to_vec(),
        },
    );
    Ok(MeasuredMotion {
        rate_hz: structure.sampling_rate_hz(),
        ground,
        sensors: sensors.collect(),
        modes: motion
            .modes()
            .map(|(frequency_hz, damping)| Mode {
                frequency_hz,
                damping,
            })
            .collect(),
        fundamental_hz: motion.fundamental_hz(),
    })
}

fn limit(structure: &Structure, samples: &mut [f64]) -> Result<(), AppError> {
    let Some(declared) = structure.band_limit() else {
        return Ok(());
    };
    let filter = BandLimit::low_pass(
        declared.order,
        declared.frequency_hz,
        structure.sampling_rate_hz(),
        1,
    );
    let mut filter = filter.map_err(|source| spandrel_identify::IdentifyError::Filter {
        structure: structure.name().to_owned(),
        source,
    })?;
    for value in samples {
        filter.apply(std::slice::from_mut(value));
    }
    Ok(())
}
