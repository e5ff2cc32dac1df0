//! Converts information to standard deviations, correlations and the settling time of the filter.

use super::{IdentificationReport, NoiseLevelReport, ParameterReport};
use crate::information::Information;
use crate::structure::Structure;
use nalgebra::DMatrix;
use spandrel_filter::FadingFactor;

/// Standard deviation of the logarithm of an unknown noise variance: a factor of e¹⁰ either way.
const VAGUE: f64 = 10.0;

/// Factor on the prior standard deviations for correlations, so that the data dominate the priors.
const WIDE: f64 = 10.0;

/// Number of memories above which the decay time of an error counts as infinite.
const NEVER: f64 = 100.0;

/// Returns the decay time of an error (frames), or infinity if it is negative or too long.
///
/// The linearised equations can give a negative time.
fn decaying(frames: f64, memory_frames: f64) -> f64 {
    if (0.0..=NEVER * memory_frames).contains(&frames) {
        frames
    } else {
        f64::INFINITY
    }
}

impl Structure {
    /// Converts information to standard deviations; `None` if it cannot be inverted.
    pub(super) fn identification(
        &self,
        information: &Information,
        frames: u64,
    ) -> Option<IdentificationReport> {
        let settings = self.filter_settings().ok()?;
        // Σ λ⁻ᵏ over the frames before the current frame
        let noise_memory_frames = 1.0 / (settings.noise_settings.fading - 1.0);
        // Without parameters, only the noise levels have a fading memory.
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
            // θ̂ moves by −P I_{θ,ln ψ} if ln ψ is stated too high. An error of 10 % in the
            // standard deviation is 2 ln 1.1 in ln ψ.
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
                    // The standard deviation is the square root of the variance.
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

    /// Returns the covariance of the `unknown` quantities after `frames` frames.
    ///
    /// The priors of the parameters count with `widened` times their standard deviation. Noise
    /// levels have a vague prior, because adaptation forgets the initial level.
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
        // Scaled to a unit diagonal, because parameters and levels differ by orders of magnitude.
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

    /// Returns the diagonal of `G⁻¹` (frames) over the `unknown` quantities.
    ///
    /// An error of these quantities decays as `exp(−k G)` over `k` frames. `G` is `J⁻¹ F` divided
    /// by the memory of each quantity (frames). `F` is the information that moves the filter, and
    /// `J` is the information that it counts. The prior is part of `J`, because the variance is
    /// bounded. The result is infinite for a quantity that the data do not move. Such a quantity
    /// does not affect the other quantities.
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
