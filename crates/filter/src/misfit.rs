//! What a wrong model does to the parameters, and how the filter answers: honest deviations, and jumps.
//!
//! Notation: `Δ_i = (Vᵀ ν̃)_i` is the correction of parameter `i` at one step, `d_i = (VᵀV)_ii` its variance under the
//! filter's own assumptions, `P_i` the variance of the parameter before the step, `λ` the fading factor. `s_i = Δ_i/P_i` is
//! the score and `j_i = d_i/P_i²` its information. With a right model the scores are white: a sum over any stretch has the
//! variance `Σ j_i`. With a wrong model they are correlated over a good part of a period or more, because an unmodelled
//! force lasts that long. The ratio `R_i` of the two is measured over several lengths; the largest counts.
//!
//! The filter weights a datum that is `k` steps old by `λ⁻ᵏ`. Its `P` is the inverse of the weighted information
//! `J = Σ λ⁻ᵏ j`, but the variance of a weighted mean is `J⁻¹ (Σ λ⁻²ᵏ R j) J⁻¹`: half of `P` in a long stationary record
//! with a right model. That sandwich covariance is published.
//!
//! Sources: H. White, *Maximum likelihood estimation of misspecified models*, Econometrica 50 (1982), 1-25; W. K. Newey &
//! K. D. West, Econometrica 55 (1987), 703-708 (long-run variance); A. S. Willsky & H. L. Jones, *A generalized likelihood
//! ratio approach to the detection and estimation of jumps in linear systems*, IEEE Trans. Automatic Control 21 (1976),
//! 108-112.

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

/// Sums of scores over this many lengths are watched.
pub const SCALES: usize = 3;

/// Jumps are looked for in the sums over the shortest lengths: long sums react too late.
const JUMP_SCALES: usize = 2;

/// Ratio of long-run variance to information up to which the scatter of its own estimate explains it.
const EXPLAINED_BY_CHANCE: f64 = 1.3;

/// Factor for the correlation over times that are longer than the longest sum, once there is one.
///
/// Without it, 84 % of the 95 % intervals hold in simulations with three times the stated damping, where misfit lasts as long
/// as the motion of a mode takes to die away.
const BEYOND_THE_LONGEST: f64 = 1.5;

/// A squared sum counts at most this many times the usual one, so that a change of the structure is no misfit.
const LARGEST_SQUARE: f64 = 9.0;

/// Ratio of long-run variance to information beyond which a large sum is no jump: the model explains too little of the motion
/// for a fresh start to find more than another wrong value.
const LARGEST_RATIO_OF_JUMP: f64 = 10.0;

/// Ratio of long-run variance to information that a motion has which has only begun: whether the model explains it is not
/// known yet. At the onset of an earthquake the motion often enters by ways that no sensor of the ground measures.
const FIRST_RATIO: f64 = 10.0;

/// Mean normalised innovation squared that half a period of few samples reaches by chance.
const LARGEST_USUAL_SQUARE: f64 = 2.0;

/// How misfit is measured and jumps are followed; all lengths in steps.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct MisfitSettings {
    /// Time constants of the sums of scores, from short to long.
    pub block_steps: [f64; SCALES],
    /// Time constant of the means of their squares.
    pub memory_steps: f64,
    /// Steps at the start that are not judged: the filter is still in transition.
    pub start_steps: u64,
    /// Sum of scores, in its own standard deviations, beyond which the parameters have changed at once.
    pub jump_threshold: f64,
    /// Steps for which the filter follows a jump before it looks for the next one.
    pub jump_steps: u64,
    /// Largest lag at which the innovations are compared with themselves and with the excitation: one fundamental period.
    pub lag_steps: usize,
    /// Whether every excitation is measured. The effect of an unmeasured one is part of the innovations of a right model.
    pub excitation_is_measured: bool,
}

/// Misfit of one parameter.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
struct ParameterMisfit {
    sums: [Sum; SCALES],
    /// `J`, and `Σ λ⁻²ᵏ j`
    information: f64,
    squared_information: f64,
    /// Published variance over `P`.
    scale: f64,
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

    /// Adds the square of the sum to the memory.
    fn remember(&mut self, memory: f64) {
        let square = (self.value * self.value).min(LARGEST_SQUARE * self.ratio() * self.variance);
        self.squares = memory * self.squares + square;
        self.expected = memory * self.expected + self.variance;
    }

    /// Returns the long-run variance over the information, at least 1.
    fn ratio(&self) -> f64 {
        if self.expected > 0.0 {
            (self.squares / self.expected).max(1.0)
        } else {
            1.0
        }
    }

    /// Returns the same, and [`FIRST_RATIO`] where nearly all information is that of the last `steps`.
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

/// The misfit of all parameters between two steps.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MisfitState {
    parameters: Vec<ParameterMisfit>,
    steps: u64,
    /// Steps since the last jump; `None` before the first.
    since_jump: Option<u64>,
    /// Normalised innovation squared per channel, mean over the shortest length.
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

    /// Returns the long-run variance of the scores of parameter `j` over their information: 1 when the model is right.
    #[must_use]
    pub fn variance_ratio(&self, j: usize) -> f64 {
        self.parameters[j]
            .sums
            .iter()
            .map(Sum::ratio)
            .fold(1.0, f64::max)
    }

    /// Returns the factor from the filter's own variance of parameter `j` to the published one.
    #[must_use]
    pub fn variance_scale(&self, j: usize) -> f64 {
        self.parameters[j].scale
    }

    /// Returns the steps since the parameters last jumped; `None` before the first jump.
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

    /// Takes the scores of one step and `νᵀ S⁻¹ ν` per used channel; returns `true` if the parameters have jumped.
    ///
    /// While a measured excitation has no samples, its return is as likely a cause of large scores as a change of the
    /// structure: no jump is followed then (`is_excitation_known`).
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

    /// Begins to follow a jump after which the parameters have these variances (N_θ).
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

    /// Moves the published variances, and returns the share of the correction of parameter `j` that is believed.
    ///
    /// Where the sandwich variance would exceed that of the prior (`prior`), the data teach less than was known before:
    /// the correction is reduced to what they do teach.
    fn weigh(
        &mut self,
        j: usize,
        settings: &MisfitSettings,
        fading: f64,
        prior: f64,
        step: (f64, f64),
    ) -> f64 {
        let (before, information) = step;
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
        parameter.information = parameter.information / fading + information;
        parameter.squared_information =
            parameter.squared_information / (fading * fading) + information;
        let after_fading = parameter.squared_information / parameter.information;
        let limit = (prior / before).max(after_fading);
        parameter.scale = (ratio * after_fading).min(limit);
        // A motion that begins exceeds what the model explained while it was quiet. The noise level follows in a second or
        // two; until then the parameters must not take the blame.
        let excess = (self.innovation_square / LARGEST_USUAL_SQUARE).max(1.0);
        (prior / (ratio * before)).min(1.0) / excess
    }
}

/// Scratch of one step (N_θ).
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

    /// Reads scores and information of this step from the variances (n) after it, `Vᵀ` (n × N_0) and `ν̃` (N_0).
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

    /// Reduces what this step taught of the parameters to what the misfit leaves of it.
    pub(crate) fn temper(
        &self,
        state: &mut MisfitState,
        settings: &MisfitSettings,
        fading: f64,
        prior_std: &DVector<f64>,
        mean: &mut DVector<f64>,
        covariance: &mut DMatrix<f64>,
    ) {
        let first = mean.len() - self.scores.len();
        for j in 0..self.scores.len() {
            let at = first + j;
            let before = covariance[(at, at)] + self.gains[j];
            if before <= 0.0 {
                continue;
            }
            let prior = prior_std[at] * prior_std[at];
            let believed = state.weigh(j, settings, fading, prior, (before, self.information[j]));
            if believed < 1.0 {
                mean[at] -= (1.0 - believed) * self.corrections[j];
                covariance[(at, at)] += (1.0 - believed) * self.gains[j];
            }
        }
    }
}
