//! Effect of a wrong model on the parameters, and the reaction of the filter: realistic standard
//! deviations, and jumps.
//!
//! Notation, for parameter `i` at one step:
//!
//! - `Δ_i = (Vᵀ ν̃)_i`: correction of the parameter
//! - `d_i = (VᵀV)_ii`: variance of the correction under the filter's own assumptions
//! - `P_i`: variance of the parameter before the step
//! - `s_i = Δ_i/P_i`: score
//! - `j_i = d_i/P_i²`: information of the score
//! - `λ`: fading factor
//!
//! With a right model, the scores are white, and their sum over any interval has the variance
//! `Σ j_i`. With a wrong model, they are correlated over a large part of a period or longer,
//! because an unmodelled force lasts that long. `R_i` is the ratio of the long-run variance to the
//! information. The filter measures it over several lengths and uses the largest value.
//!
//! The filter weights a datum that is `k` steps old by `λ⁻ᵏ`. Its `P` is the inverse of the
//! weighted information `J = Σ λ⁻ᵏ j`. The variance of a weighted mean, however, is the sandwich
//! covariance `J⁻¹ (Σ λ⁻²ᵏ R j) J⁻¹`. For a long stationary record and a right model, this is half
//! of `P`. The filter publishes the sandwich covariance.
//!
//! Sources:
//!
//! - H. White, *Maximum likelihood estimation of misspecified models*, Econometrica 50 (1982), 1-25
//! - W. K. Newey & K. D. West, Econometrica 55 (1987), 703-708 (long-run variance)
//! - A. S. Willsky & H. L. Jones, *A generalized likelihood ratio approach to the detection and
//!   estimation of jumps in linear systems*, IEEE Trans. Automatic Control 21 (1976), 108-112

use crate::fading::FadingFactor;
use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

/// Number of lengths over which the scores are summed.
pub const SCALES: usize = 3;

/// Number of the shortest lengths whose sums can reveal a jump. Longer sums react too late.
const JUMP_SCALES: usize = 2;

/// Largest ratio of long-run variance to information that chance can explain, because the ratio is
/// itself an estimate.
const EXPLAINED_BY_CHANCE: f64 = 1.3;

/// Factor on a ratio above [`EXPLAINED_BY_CHANCE`], for correlation beyond the longest sum.
///
/// It was chosen in simulations with three times the stated damping, where misfit lasts as long as
/// the decay of a mode. Without the factor, only 84 % of the 95 % intervals contain the true value.
const BEYOND_THE_LONGEST: f64 = 1.5;

/// Limit of a squared sum, as a multiple of its usual value, so that a change of the structure does
/// not count as misfit.
const LARGEST_SQUARE: f64 = 9.0;

/// Largest ratio of long-run variance to information at which a large sum counts as a jump.
///
/// Above this ratio, the model explains too little of the motion. A fresh start would only find
/// another wrong value.
const LARGEST_RATIO_OF_JUMP: f64 = 10.0;

/// Assumed ratio of long-run variance to information at the onset of a motion, when the true ratio
/// is not yet known.
///
/// At the onset of an earthquake, the motion often enters in ways that no ground sensor measures.
const FIRST_RATIO: f64 = 10.0;

/// Mean normalised innovation squared that half a period with few samples can reach by chance.
const LARGEST_USUAL_SQUARE: f64 = 2.0;

/// Settings for the measurement of misfit and the detection of jumps. All lengths are in steps.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct MisfitSettings {
    /// Time constants of the sums of scores, in ascending order.
    pub block_steps: [f64; SCALES],
    /// Time constant of the means of the squared sums.
    pub memory_steps: f64,
    /// Number of initial steps that are not judged, because the filter has not yet settled.
    pub start_steps: u64,
    /// Sum of scores, in its own standard deviations, above which the parameters have jumped.
    pub jump_threshold: f64,
    /// Number of steps for which the filter follows a jump before it can detect the next jump.
    pub jump_steps: u64,
    /// Largest lag at which the innovations are compared with themselves and with the excitation:
    /// one fundamental period.
    pub lag_steps: usize,
    /// `true` if every excitation is measured. With a right model, the innovations contain the
    /// effect of an unmeasured excitation.
    pub excitation_is_measured: bool,
}

/// Misfit of one parameter.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
struct ParameterMisfit {
    sums: [Sum; SCALES],
    /// `J`, and `Σ λ⁻²ᵏ j`.
    information: f64,
    squared_information: f64,
    /// Published variance divided by `P`.
    scale: f64,
    gained: Gained,
}

/// Number of segments of the half-life over which gained information is summed.
const SEGMENTS: usize = 8;

/// Information that the latest half-life has contributed, in segments.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
struct Gained {
    /// Sums of the latest complete segments, as a ring.
    segments: [f64; SEGMENTS],
    /// Sum of the present segment, and its number of steps.
    present: f64,
    steps: u64,
    /// Number of complete segments since the start.
    complete: u64,
    /// Mean information per step of the complete segments. `None` before the first is complete.
    per_step: Option<f64>,
}

impl Gained {
    /// Adds the information of one step. A segment has `segment_steps` steps.
    fn add(&mut self, segment_steps: u64, information: f64) {
        self.present += information;
        self.steps += 1;
        if self.steps < segment_steps {
            return;
        }
        self.segments[(self.complete % SEGMENTS as u64) as usize] = self.present;
        self.complete += 1;
        (self.present, self.steps) = (0.0, 0);
        let steps = self.complete.min(SEGMENTS as u64) * segment_steps;
        self.per_step = Some(self.segments.iter().sum::<f64>() / steps as f64);
    }
}

/// Returns the number of steps in a segment of the half-life, or `None` without fading.
fn segment_steps(fading: FadingFactor) -> Option<u64> {
    // λ = 2^(2/N_λ), so that the half-life N_λ is 2 ln 2 times the memory 1/ln λ.
    let half_life_steps = 2.0 * std::f64::consts::LN_2 * fading.memory_steps();
    half_life_steps
        .is_finite()
        .then(|| (half_life_steps / SEGMENTS as f64).ceil() as u64)
}

/// Sums of scores over one length.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
struct Sum {
    value: f64,
    /// Variance of `value` with a right model.
    variance: f64,
    /// Faded sums of the squared values and of their variances.
    squares: f64,
    expected: f64,
}

impl Sum {
    fn add(&mut self, fade: f64, score: f64, information: f64) {
        self.value = fade * self.value + score;
        self.variance = fade * fade * self.variance + information;
    }

    /// Adds the square of the sum to the long-term memory.
    fn remember(&mut self, memory: f64) {
        let square = (self.value * self.value).min(LARGEST_SQUARE * self.ratio() * self.variance);
        self.squares = memory * self.squares + square;
        self.expected = memory * self.expected + self.variance;
    }

    /// Returns the long-run variance divided by the information, at least 1.
    fn ratio(&self) -> f64 {
        if self.expected > 0.0 {
            (self.squares / self.expected).max(1.0)
        } else {
            1.0
        }
    }

    /// Returns the same ratio, averaged with [`FIRST_RATIO`] by information.
    ///
    /// [`FIRST_RATIO`] has the weight of the last `steps`, and the measured ratio has the weight of
    /// the memory.
    fn cautious_ratio(&self, steps: f64) -> f64 {
        let (recent, known) = (steps * self.variance, self.expected);
        if known > 0.0 {
            ((self.squares + FIRST_RATIO * recent) / (known + recent)).max(1.0)
        } else {
            1.0
        }
    }

    /// Returns the square of the sum in units of its usual variance.
    fn standardised_square(&self) -> f64 {
        if self.variance > 0.0 {
            self.value * self.value / (self.variance * self.ratio())
        } else {
            0.0
        }
    }
}

/// Sums of scores and published variances of all parameters between two steps, as a part of the
/// filter state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MisfitState {
    parameters: Vec<ParameterMisfit>,
    steps: u64,
    /// Number of steps since the last jump; `None` before the first jump.
    since_jump: Option<u64>,
    /// Normalised innovation squared per channel, averaged over the shortest length.
    innovation_square: f64,
}

impl MisfitState {
    pub(crate) fn new(parameters: usize) -> Self {
        let parameter = ParameterMisfit {
            scale: 1.0,
            ..ParameterMisfit::default()
        };
        Self {
            parameters: vec![parameter; parameters],
            steps: 0,
            since_jump: None,
            innovation_square: 1.0,
        }
    }

    /// Returns the number of parameters.
    pub(crate) fn parameter_len(&self) -> usize {
        self.parameters.len()
    }

    /// Returns the long-run variance of the scores of parameter `j` divided by their information: 1
    /// if the model is right.
    #[must_use]
    pub fn variance_ratio(&self, j: usize) -> f64 {
        self.parameters[j]
            .sums
            .iter()
            .map(Sum::ratio)
            .fold(1.0, f64::max)
    }

    /// Returns the published variance of parameter `j` divided by the filter's own variance.
    #[must_use]
    pub fn variance_scale(&self, j: usize) -> f64 {
        self.parameters[j].scale
    }

    /// Returns the published variance that parameter `j` would have if the filter had always learnt
    /// as much per step as in the last half-life.
    ///
    /// A steady information of `j` per step gives `J = j/ln λ`, and a published variance of
    /// `1/(2J)` times the ratio of misfit. Returns infinity if nothing was learnt, and `None` in
    /// the first eighth of a half-life and without fading.
    #[must_use]
    pub fn sustained_variance(&self, j: usize, fading: FadingFactor) -> Option<f64> {
        let parameter = &self.parameters[j];
        let steady = parameter.gained.per_step? * fading.memory_steps();
        let of_fading = parameter.squared_information / parameter.information;
        let ratio = parameter.scale / of_fading;
        Some(0.5 * ratio / steady)
    }

    /// Returns the number of steps since the last jump of the parameters, or `None` before the
    /// first jump.
    #[must_use]
    pub fn since_jump(&self) -> Option<u64> {
        self.since_jump
    }

    /// Returns `true` while the filter follows a jump.
    #[must_use]
    pub fn follows_jump(&self, settings: &MisfitSettings) -> bool {
        self.since_jump
            .is_some_and(|since| since < settings.jump_steps)
    }

    /// Processes the scores of one step and returns `true` if the parameters have jumped.
    ///
    /// `innovation_square` is `νᵀ S⁻¹ ν` per used channel. Without samples of a measured excitation
    /// (`is_excitation_known` is `false`), no jump is detected. Large scores can then also come
    /// from the return of that excitation.
    pub(crate) fn take(
        &mut self,
        settings: &MisfitSettings,
        scratch: &Workspace,
        innovation_square: f64,
        is_excitation_known: bool,
    ) -> bool {
        let short = (1.0 / settings.block_steps[0]).min(1.0);
        self.innovation_square += short * (innovation_square - self.innovation_square);
        let memory = (-1.0 / settings.memory_steps).exp();
        let fades = settings.block_steps.map(|steps| (-1.0 / steps).exp());
        let settled = self.steps >= settings.start_steps && !self.follows_jump(settings);
        let mut largest = 0.0f64;
        for (j, parameter) in self.parameters.iter_mut().enumerate() {
            for (sum, fade) in parameter.sums.iter_mut().zip(fades) {
                sum.add(fade, scratch.scores[j], scratch.information[j]);
            }
            let explained = parameter
                .sums
                .iter()
                .all(|sum| sum.ratio() <= LARGEST_RATIO_OF_JUMP);
            for sum in parameter.sums[..JUMP_SCALES].iter().filter(|_| explained) {
                largest = largest.max(sum.standardised_square());
            }
            if settled {
                parameter
                    .sums
                    .iter_mut()
                    .for_each(|sum| sum.remember(memory));
            }
        }
        self.steps += 1;
        self.since_jump = self.since_jump.map(|since| since + 1);
        settled
            && is_excitation_known
            && largest > settings.jump_threshold * settings.jump_threshold
    }

    /// Starts to follow a jump. `variances` (N_θ) are the variances of the parameters after the
    /// jump.
    pub(crate) fn start_jump(&mut self, variances: impl Iterator<Item = f64>) {
        self.since_jump = Some(0);
        for (parameter, variance) in self.parameters.iter_mut().zip(variances) {
            parameter.information = variance.recip();
            parameter.squared_information = parameter.information;
            for sum in &mut parameter.sums {
                (sum.value, sum.variance) = (0.0, 0.0);
            }
        }
    }

    /// Updates the published variance of parameter `j` and returns the accepted share of its
    /// correction.
    ///
    /// If the sandwich variance would exceed the prior variance, the data contain less
    /// information than the prior. The correction is then reduced to the information in the data.
    fn weigh(&mut self, j: usize, settings: &MisfitSettings, fading: f64, step: Learnt) -> f64 {
        let Learnt {
            prior,
            bound,
            before,
            information,
        } = step;
        let cautious = self.parameters[j].sums[0].cautious_ratio(settings.block_steps[0]);
        let ratio = self.variance_ratio(j).max(cautious);
        let ratio = if ratio <= EXPLAINED_BY_CHANCE {
            1.0
        } else {
            BEYOND_THE_LONGEST * ratio
        };
        let parameter = &mut self.parameters[j];
        if parameter.information == 0.0 {
            (parameter.information, parameter.squared_information) =
                (before.recip(), before.recip());
        }
        // Information fades until the variance reaches its bound.
        let fading = if before < bound { fading } else { 1.0 };
        parameter.information = parameter.information / fading + information;
        parameter.squared_information =
            parameter.squared_information / (fading * fading) + information;
        let after_fading = parameter.squared_information / parameter.information;
        let limit = (prior / before).max(after_fading);
        parameter.scale = (ratio * after_fading).min(limit);
        // The onset of a motion exceeds what the model explained while the structure was quiet. The
        // noise level follows within a second or two. Until then, the excess must not change the
        // parameters.
        let excess = (self.innovation_square / LARGEST_USUAL_SQUARE).max(1.0);
        (prior / (ratio * before)).min(1.0) / excess
    }
}

/// How the parameters remember one step.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Memory {
    pub(crate) fading: FadingFactor,
    /// `false` if the covariance has not faded: [`Workspace::unlearn`] has taken the step back, or
    /// the motion was reset and not predicted.
    pub(crate) fades: bool,
}

/// Prior standard deviation and largest variance of each entry of the state (n).
#[derive(Debug, Clone, Copy)]
pub(crate) struct PriorSpread<'a> {
    pub(crate) std: &'a DVector<f64>,
    pub(crate) variance_bound: &'a DVector<f64>,
}

/// What one step has learnt about a parameter.
#[derive(Debug, Clone, Copy)]
struct Learnt {
    /// Prior variance of the parameter.
    prior: f64,
    /// Its largest variance.
    bound: f64,
    /// Its variance before the step.
    before: f64,
    /// Information of the step about it.
    information: f64,
}

/// Scratch space of one step (N_θ).
#[derive(Debug, Clone)]
pub(crate) struct Workspace {
    scores: DVector<f64>,
    information: DVector<f64>,
    corrections: DVector<f64>,
    gains: DVector<f64>,
}

impl Workspace {
    pub(crate) fn new(parameters: usize) -> Self {
        let zeros = || DVector::zeros(parameters);
        Self {
            scores: zeros(),
            information: zeros(),
            corrections: zeros(),
            gains: zeros(),
        }
    }

    /// Computes scores and information of this step.
    ///
    /// `variances` (n) are the variances after the step. The other arguments are `Vᵀ` (n × N_0) and
    /// `ν̃` (N_0).
    pub(crate) fn read(
        &mut self,
        variances: &DVector<f64>,
        v_transposed: &DMatrix<f64>,
        whitened: &DVector<f64>,
    ) {
        let parameters = self.scores.len();
        let first = variances.len() - parameters;
        self.corrections.fill(0.0);
        self.gains.fill(0.0);
        for (column, innovation) in v_transposed
            .as_slice()
            .chunks_exact(variances.len())
            .zip(whitened.iter())
        {
            for ((gain, correction), total) in column[first..]
                .iter()
                .zip(self.corrections.iter_mut())
                .zip(self.gains.iter_mut())
            {
                *correction += gain * innovation;
                *total += gain * gain;
            }
        }
        for j in 0..parameters {
            let before = variances[first + j] + self.gains[j];
            let known = before > 0.0;
            self.scores[j] = if known {
                self.corrections[j] / before
            } else {
                0.0
            };
            self.information[j] = if known {
                self.gains[j] / (before * before)
            } else {
                0.0
            };
        }
    }

    /// Undoes the corrections and the fading of the parameters, because this step contains no
    /// information about them.
    ///
    /// If the memory faded while the structure is at rest, the first weak motion after it would
    /// move the parameters freely.
    pub(crate) fn unlearn(
        &mut self,
        fading: FadingFactor,
        mean: &mut DVector<f64>,
        covariance: &mut DMatrix<f64>,
    ) {
        let first = mean.len() - self.scores.len();
        for j in 0..self.scores.len() {
            mean[first + j] -= self.corrections[j];
            covariance[(first + j, first + j)] += self.gains[j];
        }
        let of_parameter = fading.value().sqrt().recip();
        for j in first..mean.len() {
            covariance.row_mut(j).scale_mut(of_parameter);
            covariance.column_mut(j).scale_mut(of_parameter);
        }
        for values in [
            &mut self.scores,
            &mut self.information,
            &mut self.corrections,
            &mut self.gains,
        ] {
            values.fill(0.0);
        }
    }

    /// Reduces the parameter corrections of this step to the share that the misfit permits.
    pub(crate) fn temper(
        &self,
        state: &mut MisfitState,
        settings: &MisfitSettings,
        memory: Memory,
        prior: PriorSpread<'_>,
        mean: &mut DVector<f64>,
        covariance: &mut DMatrix<f64>,
    ) {
        let first = mean.len() - self.scores.len();
        let segment_steps = segment_steps(memory.fading);
        for j in 0..self.scores.len() {
            let at = first + j;
            if let Some(segment_steps) = segment_steps {
                let gained = &mut state.parameters[j].gained;
                gained.add(segment_steps, self.information[j]);
            }
            let before = covariance[(at, at)] + self.gains[j];
            if before <= 0.0 {
                continue;
            }
            let learnt = Learnt {
                prior: prior.std[at] * prior.std[at],
                bound: prior.variance_bound[at],
                before,
                information: self.information[j],
            };
            let fading = if memory.fades {
                memory.fading.value()
            } else {
                1.0
            };
            let believed = state.weigh(j, settings, fading, learnt);
            if believed < 1.0 {
                mean[at] -= (1.0 - believed) * self.corrections[j];
                covariance[(at, at)] += (1.0 - believed) * self.gains[j];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SETTINGS: MisfitSettings = MisfitSettings {
        block_steps: [10.0, 20.0, 40.0],
        memory_steps: 1000.0,
        start_steps: 0,
        jump_threshold: 1e9,
        jump_steps: 1,
        lag_steps: 10,
        excitation_is_measured: true,
    };

    /// Returns the sustained and the published variance of one parameter whose filter learns this
    /// information in each step of each half-life, with a prior variance of 1.
    fn variances(half_lives: &[f64]) -> (Option<f64>, f64) {
        const HALF_LIFE: usize = 800;
        let fading = FadingFactor::from_half_life(HALF_LIFE as f64).unwrap();
        let mut state = MisfitState::new(1);
        let mut scratch = Workspace::new(1);
        let (mut mean, mut covariance) = (DVector::zeros(1), DMatrix::from_element(1, 1, 1.0));
        let prior_std = DVector::from_element(1, 1.0);
        let variance_bound = DVector::from_element(1, 1.0);
        for information in half_lives.iter().flat_map(|gain| [*gain; HALF_LIFE]) {
            let before = (fading.value() * covariance[(0, 0)]).min(1.0);
            // 1/after = 1/before + information; the gain is before - after
            let gain = before * before * information / (1.0 + before * information);
            covariance[(0, 0)] = before - gain;
            scratch.gains[0] = gain;
            scratch.information[0] = gain / (before * before);
            state.take(&SETTINGS, &scratch, 1.0, true);
            scratch.temper(
                &mut state,
                &SETTINGS,
                Memory {
                    fading,
                    fades: true,
                },
                PriorSpread {
                    std: &prior_std,
                    variance_bound: &variance_bound,
                },
                &mut mean,
                &mut covariance,
            );
        }
        let published = covariance[(0, 0)] * state.variance_scale(0);
        (state.sustained_variance(0, fading), published)
    }

    #[test]
    fn steady_information_sustains_the_published_variance() {
        let (sustained, published) = variances(&[1000.0; 12]);
        let ratio = sustained.unwrap() / published;
        // The sums are discrete: λ/(λ − 1) differs from 1/ln λ by half a step of 577.
        assert!((ratio - 1.0).abs() < 0.005, "{ratio}");
    }

    #[test]
    fn filter_without_information_for_a_half_life_sustains_no_variance() {
        let (sustained, published) = variances(&[1000.0, 1000.0, 1000.0, 0.0]);
        assert_eq!(sustained, Some(f64::INFINITY));
        assert!(
            published < 1e-3,
            "the estimate alone does not show it: {published}"
        );
    }

    #[test]
    fn published_variance_stays_when_the_variance_is_at_its_bound() {
        let before = variances(&[1000.0; 4]).1;
        let mut quiet = [0.0; 44];
        quiet[..4].fill(1000.0);
        let after = variances(&quiet).1;
        assert!((after / before - 1.0).abs() < 0.1, "{after} {before}");
    }

    #[test]
    fn a_hundredth_of_the_information_sustains_a_hundred_times_the_variance() {
        let before = variances(&[1000.0; 12]).0.unwrap();
        let mut calm = [1000.0; 13];
        calm[12] = 10.0;
        let ratio = variances(&calm).0.unwrap() / before;
        assert!((ratio - 100.0).abs() < 1.0, "{ratio}");
    }
}
