//! Long-run estimates if the true structure differs from the structure file.
//!
//! The filter converges to the point where the expected slope of its log-likelihood vanishes
//! (`spectral_information`). Newton's method finds this point, with the information instead of the
//! curvature. Adapted noise levels also change: they absorb the part that the model cannot explain.
//! The prior counts as in a filter with fading memory.

use crate::noise_level::NoiseSource;
use crate::spectral_information::{Direction, SpectralModel, Sums};
use crate::structure::Structure;

/// Number of search steps. A model with more than `LARGE` degrees of freedom gets one step, which
/// is the linear solution.
const STEPS: usize = 15;
const LARGE: usize = 40;

/// Maximum step of a parameter (ratio to nominal); the next constant limits the logarithm of a
/// variance.
///
/// Within these limits, the information approximates the curvature.
const LONGEST_PARAMETER_STEP: f64 = 0.25;
const LONGEST_LEVEL_STEP: f64 = 1.5;

/// Minimum share of a shortened step. A shorter step improves the fit by no more than rounding.
const SHORTEST_SHARE: f64 = 0.02;

/// Step (ratio to nominal) below which the search ends, because it does not change the findings.
const SETTLED: f64 = 1e-3;

impl Structure {
    /// Returns the shift of each parameter (ratio to nominal) if all true damping is `factor` times
    /// the stated damping.
    pub(crate) fn shifts_by_damping(&self, factor: f64) -> Option<Vec<f64>> {
        let mut other = self.clone();
        other.system.damping = self.system.damping.times(factor);
        other.analysis_basis = self.analysis_basis.kept(); // both move in the same shapes
        let truth = SpectralModel::new(&other, &self.prior_means(), &self.expected_variances());
        self.shifts(&truth)
    }

    /// Returns the shift of each parameter (ratio to nominal) if a noise level (from 0) is wrong.
    ///
    /// The true standard deviation is `factor` times the stated one.
    pub(crate) fn shifts_by_level(&self, level: usize, factor: f64) -> Option<Vec<f64>> {
        let mut variances = self.expected_variances();
        variances[level] *= factor * factor;
        let truth = SpectralModel::new(self, &self.prior_means(), &variances);
        self.shifts(&truth)
    }

    /// Returns the prior mean of each parameter (ratio to nominal).
    pub(crate) fn prior_means(&self) -> Vec<f64> {
        self.parameters.iter().map(crate::Parameter::mean).collect()
    }

    fn shifts(&self, truth: &SpectralModel<'_>) -> Option<Vec<f64>> {
        let (means, memory_frames) = (self.prior_means(), self.memory_frames()?);
        let adapted: Vec<usize> = (0..self.noise_levels.len())
            .filter(|level| self.noise_levels[*level].adapted)
            .collect();
        let levels = adapted.iter().map(|level| Direction::Level(*level));
        let directions: Vec<Direction> = (0..means.len())
            .map(Direction::Parameter)
            .chain(levels)
            .collect();
        let (mut theta, mut variances) = (means.clone(), self.expected_variances());
        let mut sums =
            SpectralModel::new(self, &theta, &variances).sums(Some(truth), &directions)?;
        let steps = if self.system.len() > LARGE { 1 } else { STEPS };
        for step_number in 1..=steps {
            let Sums {
                mut information,
                mut slope,
                misfit,
            } = sums;
            for (index, parameter) in self.parameters.iter().enumerate() {
                let precision = 1.0 / (memory_frames * parameter.std().powi(2));
                information[(index, index)] += precision;
                slope[index] += precision * (means[index] - theta[index]);
            }
            let step = information.cholesky()?.solve(&slope);
            // One factor shortens the whole step, so that the step keeps its direction.
            let longest = step.rows(0, means.len()).amax();
            let largest = step.rows(means.len(), adapted.len()).amax();
            let mut share = (LONGEST_PARAMETER_STEP / longest)
                .min(LONGEST_LEVEL_STEP / largest)
                .min(1.0);
            let model = loop {
                let moved = |index: usize| theta[index] + share * step[index];
                let within = |(index, parameter): (usize, &crate::Parameter)| {
                    let (low, high) = parameter.bounds();
                    moved(index).clamp(low, high)
                };
                let next: Vec<f64> = self.parameters.iter().enumerate().map(within).collect();
                let mut levels = variances.clone();
                for (entry, level) in adapted.iter().enumerate() {
                    levels[*level] *= (share * step[means.len() + entry]).exp();
                }
                let model = SpectralModel::new(self, &next, &levels);
                if share < SHORTEST_SHARE || model.misfit(truth)? <= misfit {
                    (theta, variances) = (next, levels);
                    break model;
                }
                share *= 0.5;
            };
            if share * longest < SETTLED || step_number == steps {
                break;
            }
            sums = model.sums(Some(truth), &directions)?;
        }
        Some(
            theta
                .iter()
                .zip(&means)
                .map(|(theta, mean)| theta - mean)
                .collect(),
        )
    }

    /// Returns `true` if some damping is neither identified nor stated to be known.
    pub(crate) fn damping_is_assumed(&self) -> bool {
        use crate::linear_system::Damping;
        use crate::parameter::Scales;
        let scaled = |wanted: &dyn Fn(&Scales) -> bool| {
            self.parameters
                .iter()
                .any(|parameter| wanted(&parameter.scales))
        };
        let identified = match &self.system.damping {
            Damping::Rayleigh {
                alpha_per_s,
                beta_s,
            } => {
                let whole = scaled(&|scales| *scales == Scales::Damping);
                let alpha =
                    *alpha_per_s == 0.0 || scaled(&|scales| *scales == Scales::DampingAlpha);
                let beta = *beta_s == 0.0 || scaled(&|scales| *scales == Scales::DampingBeta);
                whole || (alpha && beta)
            }
            Damping::Dashpots(parts) => (0..parts.len()).all(|part| {
                scaled(&|scales| matches!(scales, Scales::Dashpots(of) if of.contains(&part)))
            }),
            Damping::Matrix(_) => scaled(&|scales| matches!(scales, Scales::Dashpots(_))),
        };
        !identified && !self.damping_is_known && !self.parameters.is_empty()
    }

    /// Returns the unmeasured excitations (levels, from 0) whose level is fixed and not stated to
    /// be known.
    pub(crate) fn assumed_levels(&self) -> Vec<usize> {
        let assumed = |level: &usize| match self.noise_levels[*level].source() {
            NoiseSource::Excitation(_) => {
                self.is_unknown(*level) && !self.noise_levels[*level].adapted
            }
            NoiseSource::Sensors(_) => false,
        };
        (0..self.noise_levels.len()).filter(assumed).collect()
    }
}
