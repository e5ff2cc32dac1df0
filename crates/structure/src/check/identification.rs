//! From information to standard deviations, correlations and the pace of the filter.

use super::{IdentificationReport, NoiseLevelReport, ParameterReport};
use crate::information::Information;
use crate::structure::Structure;
use nalgebra::DMatrix;
use spandrel_filter::FadingFactor;

/// Standard deviation of the logarithm of a noise variance that nothing is known of: a factor of e¹⁰ either way.
const VAGUE: f64 = 10.0;

/// Priors are widened by this for correlations, so that these show what the data say and not what was believed.
const WIDE: f64 = 10.0;

/// An error that takes more memories than this to decay is never forgotten.
const NEVER: f64 = 100.0;

/// Returns the time in which an error decays (frames), infinite where it does not: the linearised equations may also give a
/// negative one.
fn decaying(frames: f64, memory_frames: f64) -> f64 {
    if (0.0..=NEVER * memory_frames).contains(&frames) {
        frames
    } else {
        f64::INFINITY
    }
}

impl Structure {
    /// Turns information into standard deviations; `None` if it cannot be inverted.
    pub(super) fn identification(
        &self,
        information: &Information,
        frames: u64,
    ) -> Option<IdentificationReport> {
        let settings = self.filter_settings().ok()?;
        // Σ λ⁻ᵏ over the frames before this one
        let noise_memory_frames = 1.0 / (settings.noise_settings.fading - 1.0);
        // without parameters only the levels are forgotten
        let memory_frames = match settings.fading {
            FadingFactor::NONE => noise_memory_frames,
            fading => 1.0 / (fading.value() - 1.0),
        };
        let (theta, all) = (self.parameters.len(), information.held.nrows());
        let everything: Vec<usize> = (0..all).collect();
        let unknown: Vec<usize> = (0..all)
            .filter(|index| *index < theta || self.noise_levels[*index - theta].adapted)
            .collect();
        let parameters_alone: Vec<usize> = (0..theta).collect();
        let [held, counted] = [&information.held, &information.counted];
        let after = self.covariance(held, frames as f64, &unknown, 1.0)?;
        let steady = self.covariance(held, memory_frames, &unknown, 1.0)?;
        let reported = self.covariance(counted, memory_frames, &parameters_alone, 1.0)?;
        let joint = self.covariance(held, frames as f64, &everything, WIDE)?;
        let known = self.covariance(held, frames as f64, &parameters_alone, 1.0)?;
        let settling_frames =
            self.settling(information, &unknown, memory_frames, noise_memory_frames)?;
        let step_s = self.step_s();
        let shifts = |parameter: usize| {
            // θ̂ moves by −P I_{θ,ln ψ} when ln ψ is stated too high; 10 % in deviation is 2 ln 1.1 in ln ψ
            let shift = |level| {
                let pull = held.column(level).rows(0, theta) * frames as f64;
                -known.column(parameter).dot(&pull) * 2.0 * 1.1_f64.ln()
            };
            (theta..all).map(shift).collect()
        };
        let parameters = self
            .parameters
            .iter()
            .enumerate()
            .map(|(index, parameter)| ParameterReport {
                name: parameter.name.clone(),
                prior_std: parameter.std(),
                std_after: after[(index, index)].sqrt(),
                std_steady: steady[(index, index)].sqrt(),
                std_reported: reported[(index, index)].sqrt(),
                settling_s: decaying(settling_frames[index], memory_frames) * step_s,
                dynamic_sensitivity: 0.01 * held[(index, index)].max(0.0).sqrt(),
                shifts: shifts(index),
            });
        let noise_levels =
            self.noise_levels
                .iter()
                .zip(theta..)
                .map(|(level, index)| NoiseLevelReport {
                    name: level.name.clone(),
                    adapted: level.adapted,
                    // the deviation is the square root of the variance
                    relative_std_after: 0.5 * joint[(index, index)].sqrt(),
                    haste: information.pull[(index, index)] / counted[(index, index)],
                });
        let correlation =
            |i: usize, j: usize| joint[(i, j)] / (joint[(i, i)] * joint[(j, j)]).sqrt();
        Some(IdentificationReport {
            duration_s: frames as f64 * step_s,
            memory_s: memory_frames * step_s,
            parameters: parameters.collect(),
            noise_levels: noise_levels.collect(),
            correlations: everything
                .iter()
                .map(|i| everything.iter().map(|j| correlation(*i, *j)).collect())
                .collect(),
        })
    }

    /// Returns the covariance of the `unknown` quantities after `frames` frames, priors `widened` times included.
    ///
    /// Noise levels start with a vague prior: adapting forgets where they started.
    fn covariance(
        &self,
        information: &DMatrix<f64>,
        frames: f64,
        unknown: &[usize],
        widened: f64,
    ) -> Option<DMatrix<f64>> {
        let mut precision = DMatrix::from_fn(unknown.len(), unknown.len(), |i, j| {
            frames * information[(unknown[i], unknown[j])]
        });
        for (entry, index) in unknown.iter().enumerate() {
            let std = self
                .parameters
                .get(*index)
                .map_or(VAGUE, |parameter| widened * parameter.std());
            precision[(entry, entry)] += 1.0 / (std * std);
        }
        // scaled to a unit diagonal: parameters and levels differ by orders of magnitude
        let scale = precision.diagonal().map(|entry| 1.0 / entry.sqrt());
        let scaled = DMatrix::from_fn(unknown.len(), unknown.len(), |i, j| {
            precision[(i, j)] * scale[i] * scale[j]
        });
        let inverse = scaled
            .cholesky()?
            .solve(&DMatrix::identity(unknown.len(), unknown.len()));
        Some(DMatrix::from_fn(unknown.len(), unknown.len(), |i, j| {
            inverse[(i, j)] * scale[i] * scale[j]
        }))
    }

    /// Returns the diagonal of `G⁻¹` (frames) over the `unknown` quantities: an error of theirs falls as `exp(−k G)`.
    ///
    /// `G = J⁻¹ F` divided by the memory of each (frames): the filter moves by what pulls it over what it counts. Its prior
    /// counts too, because the variance is bounded. Infinite where nothing pulls; what nothing pulls does not move the others.
    fn settling(
        &self,
        information: &Information,
        unknown: &[usize],
        memory_frames: f64,
        noise_memory_frames: f64,
    ) -> Option<Vec<f64>> {
        let pulled: Vec<usize> = unknown
            .iter()
            .copied()
            .filter(|i| information.pull[(*i, *i)] != 0.0)
            .collect();
        let of = |x: &DMatrix<f64>| {
            DMatrix::from_fn(pulled.len(), pulled.len(), |i, j| x[(pulled[i], pulled[j])])
        };
        let mut counted = of(&information.counted);
        for (entry, index) in pulled.iter().enumerate() {
            if let Some(parameter) = self.parameters.get(*index) {
                counted[(entry, entry)] += 1.0 / (parameter.std().powi(2) * memory_frames);
            }
        }
        let mut rates = counted.cholesky()?.solve(&of(&information.pull));
        for (index, mut row) in pulled.iter().zip(rates.row_iter_mut()) {
            row /= if *index < self.parameters.len() {
                memory_frames
            } else {
                noise_memory_frames
            };
        }
        let times = rates
            .lu()
            .solve(&DMatrix::identity(pulled.len(), pulled.len()));
        let time = |index: &usize| {
            let entry = pulled.iter().position(|pulled| pulled == index)?;
            Some(times.as_ref()?[(entry, entry)])
        };
        Some(
            unknown
                .iter()
                .map(|index| time(index).unwrap_or(f64::INFINITY))
                .collect(),
        )
    }
}
