//! The stiffnesses of a recording, frame by frame, and the displacements of the model.

use super::event_record::EventRecord;
use super::storeys::WithDisplacements;
use crate::error::AppError;
use crate::summary::Summary;
use crate::{distributed, offline};
use serde::Serialize;
use spandrel_bus::{Estimate, EstimateBlock, FitVerdict, Phase};
use spandrel_earthquake::FrameEstimate;
use spandrel_identify::Identification;
use spandrel_structure::Structure;

/// Share of the prior standard deviation below which a frame informs about a parameter.
const LEARNING: f64 = 0.5;

/// The estimates of a recording.
#[derive(Debug)]
pub struct Identified {
    /// Estimates of each parameter of the structure, frame by frame.
    pub estimates: Vec<Vec<FrameEstimate>>,
    /// Largest value of each response.
    pub responses: Vec<ResponsePeak>,
    /// Summary of the identification, as `spandrel estimate` prints it.
    pub summary: Summary,
}

/// The largest value of an estimated response.
#[derive(Debug, Clone, Serialize)]
pub struct ResponsePeak {
    /// Name for people.
    pub name: String,
    /// Largest absolute value (SI).
    pub peak: f64,
    /// Standard deviation of the largest value (SI).
    pub std: f64,
    /// Time of the largest value, since the first frame (s).
    pub at_s: f64,
}

/// Identifies a recording by the same steps as `spandrel estimate`.
///
/// # Errors
/// Returns an error if the structure cannot be identified.
pub fn identify(with: &WithDisplacements, record: &EventRecord) -> Result<Identified, AppError> {
    let structure = &with.structure;
    let frames = record.channels.first().map_or(0, Vec::len);
    let priors: Vec<f64> = structure.parameters().iter().map(|one| one.std()).collect();
    let nothing = FrameEstimate {
        mean: 1.0,
        std: 1.0,
        is_learning: false,
        is_contradicted: false,
    };
    let mut estimates = vec![vec![nothing; frames]; priors.len()];
    let mut responses: Vec<ResponsePeak> = with
        .labels
        .iter()
        .map(|name| ResponsePeak {
            name: name.clone(),
            peak: 0.0,
            std: 0.0,
            at_s: 0.0,
        })
        .collect();
    let rate_hz = structure.sampling_rate_hz();
    let mut take = |block: &EstimateBlock, found: &[Vec<(f64, f64)>]| {
        for (index, (number, estimate)) in block.iter().enumerate() {
            let frame = usize::try_from(number).unwrap_or(usize::MAX);
            for (parameter, prior) in priors.iter().enumerate() {
                if let Some(kept) = estimates[parameter].get_mut(frame) {
                    *kept = frame_estimate(estimate, parameter, *prior).unwrap_or(nothing);
                }
            }
            let values = found.get(index).into_iter().flatten();
            if estimate.flags.phase == Phase::Working {
                for (peak, (mean, std)) in responses.iter_mut().zip(values) {
                    if mean.abs() > peak.peak {
                        peak.peak = mean.abs();
                        peak.std = *std;
                        peak.at_s = number as f64 / rate_hz;
                    }
                }
            }
        }
        Ok(())
    };
    let rows = record.rows.iter().cloned().map(Ok);
    let collector = match structure.fusion() {
        Some(_) => distributed::fuse(structure, rows, None, &mut take)?,
        None => {
            let identification = Identification::new(structure, "identify")?;
            offline::identify(structure, identification, rows, None, &mut take)?
        }
    };
    Ok(Identified {
        estimates,
        responses,
        summary: collector.finish(),
    })
}

/// Returns one parameter of an estimate. `None` if it is not a positive number.
fn frame_estimate(estimate: &Estimate, parameter: usize, prior: f64) -> Option<FrameEstimate> {
    let mean = *estimate.mean.get(parameter)?;
    let std = estimate.variance(parameter)?.max(0.0).sqrt();
    // What the filter would keep at its present rate; without it, what it knows now.
    let sustained = estimate.sustained_information.get(parameter);
    let sustained_std = sustained.map_or(std, |rate| f64::from(*rate).sqrt().recip());
    let is_working = estimate.flags.phase == Phase::Working && !estimate.flags.prediction_only;
    (mean > 0.0).then_some(FrameEstimate {
        mean,
        std,
        is_learning: is_working && std.max(sustained_std) < LEARNING * prior,
        is_contradicted: estimate.flags.fit == Some(FitVerdict::Contradicted),
    })
}

/// Returns the half-life of the filter (s). Infinite if it forgets nothing.
pub fn half_life_s(structure: &Structure) -> f64 {
    // λ = 2^(2 Δt/half-life)
    let fading = structure
        .filter_settings()
        .map_or(1.0, |one| one.fading.value());
    2.0 * structure.step_s() / fading.log2()
}
