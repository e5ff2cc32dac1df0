//! How well the model explains the data, measured in ways that an adapting noise level cannot hide.
//!
//! The noise levels adapt until the innovations have the size that the filter expects. A wrong model therefore shows
//! elsewhere: its innovations are correlated in time, they follow the measured excitation, or the noise found exceeds the
//! noise stated. [`Fit`] combines these measures into one [`FitVerdict`] with its reasons.

use crate::misfit::{MisfitSettings, MisfitState};
use nalgebra::DMatrix;
use serde::{Deserialize, Serialize};

/// Whether the data support the model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FitVerdict {
    /// No measure disagrees with the model.
    Supported,
    /// The model leaves out something that matters; intervals are widened for it.
    Doubtful,
    /// The data contradict the model: an estimate has no meaning.
    Contradicted,
}

/// A measure of fit that disagrees with the model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FitReason {
    /// The innovations are correlated over time.
    CorrelatedInnovations,
    /// The corrections of a parameter keep the same sign for longer than white innovations allow.
    WanderingParameters,
    /// The innovations follow the measured excitation.
    ExcitationInInnovations,
    /// The model explains too little of the response.
    LittleExplained,
    /// The noise found is much larger than the noise stated.
    ExcessNoise,
    /// A parameter rests on its bound.
    ParameterAtBound,
    /// A parameter lies far outside its prior.
    FarFromPrior,
    /// The innovations exceed what the filter expects, all at once.
    InnovationBurst,
}

impl FitReason {
    /// All reasons, in the order in which they are reported.
    pub const ALL: [Self; 8] = [
        Self::InnovationBurst,
        Self::ParameterAtBound,
        Self::FarFromPrior,
        Self::LittleExplained,
        Self::ExcessNoise,
        Self::CorrelatedInnovations,
        Self::WanderingParameters,
        Self::ExcitationInInnovations,
    ];
}

/// The verdict on the fit after one step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Fit {
    verdict: Option<FitVerdict>,
    reasons: u16,
    follows_jump: bool,
}

impl Fit {
    /// Returns the verdict; `None` where the fit is not measured, and before there are enough steps to judge it.
    #[must_use]
    pub fn verdict(&self) -> Option<FitVerdict> {
        self.verdict
    }

    /// Returns the reasons for a verdict other than [`FitVerdict::Supported`].
    pub fn reasons(&self) -> impl Iterator<Item = FitReason> {
        let reasons = self.reasons;
        FitReason::ALL
            .into_iter()
            .filter(move |reason| reasons & reason.bit() != 0)
    }

    /// Returns `true` while the filter follows a sudden change: the estimates are still moving.
    #[must_use]
    pub fn follows_jump(&self) -> bool {
        self.follows_jump
    }

    /// Takes a measure: beyond `doubtful` it is a reason for doubt, beyond `contradicted` for a contradiction.
    fn judge(&mut self, reason: FitReason, measure: f64, limits: Limits) {
        let verdict = if measure > limits.contradicted {
            FitVerdict::Contradicted
        } else if measure > limits.doubtful {
            FitVerdict::Doubtful
        } else {
            return;
        };
        self.verdict = self.verdict.max(Some(verdict));
        self.reasons |= reason.bit();
    }
}

impl FitReason {
    fn bit(self) -> u16 {
        1 << self as u16
    }
}

/// Where a measure begins to disagree with the model, and where it contradicts it.
#[derive(Debug, Clone, Copy)]
struct Limits {
    doubtful: f64,
    contradicted: f64,
}

impl Limits {
    /// Returns limits beyond which there is doubt, and never a contradiction.
    fn for_doubt(self) -> Self {
        Self {
            contradicted: f64::INFINITY,
            ..self
        }
    }
}

/// Share of every channel that a model explains whose parameters are where the data put them, however far that is from the
/// prior.
const WELL_EXPLAINED: f64 = 0.5;
/// Ratio of the long-run variance of the scores to their information: the intervals are widened by it.
const WANDERING: Limits = Limits {
    doubtful: 3.0,
    contradicted: f64::INFINITY,
};
/// Noise found over noise stated, as standard deviations. What matters is its share of the motion.
const NOISE: Limits = Limits {
    doubtful: 3.0,
    contradicted: f64::INFINITY,
};
/// Share of the variance of a channel that is left in its innovations, beyond the stated noise. Models of real bridges leave a third and
/// more, and follow their stiffness nonetheless.
const UNEXPLAINED: Limits = Limits {
    doubtful: 0.1,
    contradicted: 0.9,
};
/// Autocorrelation of the innovations. A band limit alone correlates the noise, and the intervals are widened for it.
const CORRELATION: Limits = Limits {
    doubtful: 0.3,
    contradicted: f64::INFINITY,
};
/// Correlation of the innovations with the excitation: the intervals are widened for what it does to the parameters.
const WITH_EXCITATION: Limits = Limits {
    doubtful: 0.3,
    contradicted: f64::INFINITY,
};
/// Prior deviations by which a parameter exceeds its prior mean: no event stiffens a structure so. Where the motion is well
/// explained, the number of the file is wrong.
const STIFFER: Limits = Limits {
    doubtful: 3.0,
    contradicted: 4.0,
};
/// Factor by which a parameter falls below its prior mean, if it also leaves the standard deviation of its prior. Severe damage
/// reaches six; ten is a mistake of units. Where the motion is well explained, a loss against a reference has a meaning in
/// both cases.
const SOFTER: Limits = Limits {
    doubtful: 4.0,
    contradicted: 8.0,
};
/// Normalised innovation squared per channel, over a period.
const BURST: Limits = Limits {
    doubtful: 4.0,
    contradicted: 16.0,
};
/// Share of the time at which a parameter was brought back to its bound.
const AT_BOUND: Limits = Limits {
    doubtful: 0.01,
    contradicted: 0.2,
};

/// The lags at which innovations are compared: powers of two.
const LAGS: [usize; 8] = [1, 2, 4, 8, 16, 32, 64, 128];

/// What one step shows of the fit.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Shown<'a> {
    /// `z` (N_0), NaN where missing
    pub(crate) observations: &'a [f64],
    /// `ν` (N_0), NaN where missing or rejected
    pub(crate) innovations: &'a [f64],
    /// the known excitation (N_f)
    pub(crate) excitation: &'a [f64],
    /// covariance of the measurement noise as found (N_0 × N_0)
    pub(crate) noise: &'a DMatrix<f64>,
    /// `νᵀ S⁻¹ ν` per used channel
    pub(crate) normalised_innovation_squared: f64,
    /// diagonal of `S − R` (N_0): what the innovations owe to the state and to the excitation
    pub(crate) predicted_variances: &'a [f64],
    pub(crate) at_bound: bool,
    pub(crate) parameters: ShownParameters<'a>,
}

/// What one step shows of the parameters (N_θ each).
#[derive(Debug, Clone, Copy)]
pub(crate) struct ShownParameters<'a> {
    pub(crate) means: &'a [f64],
    /// variances of the filter's own
    pub(crate) variances: &'a [f64],
    pub(crate) prior_means: &'a [f64],
    pub(crate) prior_stds: &'a [f64],
    /// deviations of errors that no data reveal, such as those by an unmeasured excitation
    pub(crate) considered_stds: &'a [f64],
}

/// The measures of fit between two steps.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FitState {
    channels: Vec<ChannelState>,
    fits: Vec<ChannelFit>,
    /// the last innovations and excitations, a row a step
    history: Vec<f64>,
    excitation_square: Vec<f64>,
    steps: u64,
    /// faded share of the steps at a bound, and mean normalised innovation squared of a period
    at_bound: f64,
    burst: f64,
    fit: Fit,
}

/// Faded sums of one channel.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct ChannelState {
    stated_noise: f64,
    observation: f64,
    observation_square: f64,
    square: f64,
    /// part of the squares that an unmeasured excitation causes
    from_excitation: f64,
    lagged: Vec<f64>,
    with_excitation: Vec<f64>,
    weight: f64,
}

impl FitState {
    /// Starts without knowledge; `stated_noise` is the variance of the noise of each channel as stated (N_0).
    pub(crate) fn new(
        settings: &MisfitSettings,
        stated_noise: impl Iterator<Item = f64>,
        inputs: usize,
    ) -> Self {
        let lags = lags(settings);
        let channels: Vec<ChannelState> = stated_noise
            .map(|stated_noise| ChannelState {
                stated_noise,
                observation: 0.0,
                observation_square: 0.0,
                square: 0.0,
                from_excitation: 0.0,
                lagged: vec![0.0; lags.len()],
                with_excitation: vec![0.0; lags.len() * inputs],
                weight: 0.0,
            })
            .collect();
        let rows = lags.last().map_or(1, |lag| lag + 1);
        Self {
            history: vec![0.0; rows * (channels.len() + inputs)],
            fits: vec![ChannelFit::default(); channels.len()],
            channels,
            excitation_square: vec![0.0; inputs],
            steps: 0,
            at_bound: 0.0,
            burst: 1.0,
            fit: Fit::default(),
        }
    }

    /// Returns the verdict after the last step.
    #[must_use]
    pub fn fit(&self) -> Fit {
        self.fit
    }

    /// Returns the measures of each channel (N_0).
    #[must_use]
    pub fn channels(&self) -> &[ChannelFit] {
        &self.fits
    }

    /// Returns the number of values remembered; 0 where the lengths disagree, as in a damaged checkpoint.
    pub(crate) fn remembered_len(&self) -> usize {
        let (channels, inputs) = (self.channels.len(), self.excitation_square.len());
        let lags = self
            .channels
            .first()
            .map_or(0, |channel| channel.lagged.len());
        let agrees = |channel: &ChannelState| {
            channel.lagged.len() == lags && channel.with_excitation.len() == lags * inputs
        };
        let whole = self.fits.len() == channels && self.channels.iter().all(agrees);
        if whole {
            self.history.len() + channels * (1 + lags) + inputs
        } else {
            0
        }
    }

    /// Takes one step.
    pub(crate) fn take(
        &mut self,
        settings: &MisfitSettings,
        misfit: &MisfitState,
        shown: Shown<'_>,
    ) {
        let lags = lags(settings);
        let (channels, inputs) = (self.channels.len(), shown.excitation.len());
        let width = channels + inputs;
        let rows = self.history.len() / width.max(1);
        let row = (self.steps as usize % rows.max(1)) * width;
        let shown_values = shown.innovations.iter().chain(shown.excitation);
        for (kept, value) in self.history[row..row + width].iter_mut().zip(shown_values) {
            *kept = if value.is_nan() { 0.0 } else { *value }; // a missing value adds nothing to a product
        }
        let fade = (-1.0 / settings.memory_steps).exp();
        let follows_jump = misfit.follows_jump(settings);
        self.steps += 1;
        let period = 1.0 / settings.lag_steps.max(1) as f64;
        self.burst += period * (shown.normalised_innovation_squared - self.burst);
        self.at_bound = fade * self.at_bound + (1.0 - fade) * f64::from(u8::from(shown.at_bound));
        if self.steps <= settings.start_steps || follows_jump {
            self.fit.follows_jump = follows_jump;
            return;
        }
        for (square, value) in self.excitation_square.iter_mut().zip(shown.excitation) {
            if !value.is_nan() {
                *square = fade * *square + value * value;
            }
        }
        for (c, channel) in self.channels.iter_mut().enumerate() {
            let (innovation, observation) = (shown.innovations[c], shown.observations[c]);
            if innovation.is_nan() || observation.is_nan() {
                continue;
            }
            channel.weight = fade * channel.weight + 1.0;
            channel.observation += (observation - channel.observation) / channel.weight;
            channel.observation_square =
                fade * channel.observation_square + (observation - channel.observation).powi(2);
            channel.square = fade * channel.square + innovation * innovation;
            // no model predicts an excitation that nobody measures
            let from_excitation = if settings.excitation_is_measured {
                0.0
            } else {
                shown.predicted_variances[c]
            };
            channel.from_excitation = fade * channel.from_excitation + from_excitation;
            for (k, lag) in lags.iter().enumerate() {
                let past = (row + (rows - lag) * width) % (rows * width);
                channel.lagged[k] = fade * channel.lagged[k] + innovation * self.history[past + c];
                for input in 0..inputs {
                    let product = &mut channel.with_excitation[k * inputs + input];
                    *product = fade * *product + innovation * self.history[past + channels + input];
                }
            }
        }
        if self
            .channels
            .iter()
            .any(|channel| channel.is_judged(settings))
        {
            self.judge(misfit, &shown);
        }
    }

    fn judge(&mut self, misfit: &MisfitState, shown: &Shown<'_>) {
        let mut fit = Fit {
            verdict: Some(FitVerdict::Supported),
            ..Fit::default()
        };
        for (c, (channel, measures)) in self.channels.iter().zip(&mut self.fits).enumerate() {
            *measures = channel.measures(shown.noise[(c, c)], &self.excitation_square);
            fit.judge(
                FitReason::CorrelatedInnovations,
                measures.largest_autocorrelation,
                CORRELATION,
            );
            fit.judge(
                FitReason::ExcitationInInnovations,
                measures.excitation_correlation.abs(),
                WITH_EXCITATION,
            );
            fit.judge(
                FitReason::LittleExplained,
                1.0 - measures.explained_share,
                UNEXPLAINED,
            );
            fit.judge(FitReason::ExcessNoise, measures.noise_ratio, NOISE);
        }
        let ShownParameters {
            means,
            variances,
            prior_means,
            prior_stds,
            considered_stds,
        } = shown.parameters;
        for j in 0..misfit.parameter_len() {
            // a considered error covers a part of the wandering
            let uncovered = variances[j] / (variances[j] + considered_stds[j].powi(2));
            fit.judge(
                FitReason::WanderingParameters,
                misfit.variance_ratio(j) * uncovered,
                WANDERING,
            );
        }
        let explained = self
            .fits
            .iter()
            .map(|measures| measures.explained_share)
            .fold(1.0, f64::min);
        let far = |limits: Limits| {
            if explained >= WELL_EXPLAINED {
                limits.for_doubt()
            } else {
                limits
            }
        };
        for ((mean, prior_mean), prior_std) in means.iter().zip(prior_means).zip(prior_stds) {
            fit.judge(
                FitReason::FarFromPrior,
                (mean - prior_mean) / prior_std,
                far(STIFFER),
            );
            if prior_mean - mean > *prior_std {
                fit.judge(FitReason::FarFromPrior, prior_mean / mean, far(SOFTER));
            }
        }
        fit.judge(FitReason::ParameterAtBound, self.at_bound, AT_BOUND);
        fit.judge(FitReason::InnovationBurst, self.burst, BURST);
        self.fit = fit;
    }
}

/// Returns the lags of these settings: up to one fundamental period, and at least one.
fn lags(settings: &MisfitSettings) -> &'static [usize] {
    let count = LAGS
        .iter()
        .filter(|lag| **lag <= settings.lag_steps)
        .count();
    &LAGS[..count.max(1)]
}

impl ChannelState {
    /// Returns `true` once a fundamental period has been seen.
    fn is_judged(&self, settings: &MisfitSettings) -> bool {
        // the weight of a sum that fades stays below its memory
        self.weight >= (settings.lag_steps as f64).min(0.5 * settings.memory_steps)
    }

    fn measures(&self, noise: f64, excitation_square: &[f64]) -> ChannelFit {
        // innovations below the stated noise are a quiet structure, whatever their colour
        let own_square = self.square.max(self.stated_noise * self.weight);
        let of = |product: f64, other: f64| {
            let scale = (own_square * other).sqrt();
            if scale > 0.0 { product / scale } else { 0.0 }
        };
        let correlations = self.lagged.iter().map(|product| of(*product, own_square));
        let inputs = excitation_square.len();
        let excitation = self
            .with_excitation
            .iter()
            .enumerate()
            .map(|(at, product)| of(*product, excitation_square[at % inputs]));
        let variance = if self.weight > 0.0 {
            self.observation_square / self.weight
        } else {
            0.0
        };
        let largest = variance.max(self.stated_noise); // below the stated noise there is no motion to explain
        // innovations and motion have the same memory; the noise level has another
        let innovation = if self.weight > 0.0 {
            (self.square - self.from_excitation) / self.weight
        } else {
            0.0
        };
        let unexplained = if largest > 0.0 {
            (innovation - self.stated_noise) / largest
        } else {
            0.0
        };
        ChannelFit {
            largest_autocorrelation: correlations.map(f64::abs).fold(0.0, f64::max),
            explained_share: 1.0 - unexplained.clamp(0.0, 1.0),
            excitation_correlation: excitation
                .fold(0.0, |a: f64, b| if b.abs() > a.abs() { b } else { a }),
            noise_ratio: if self.stated_noise > 0.0 {
                (noise / self.stated_noise).sqrt()
            } else {
                1.0
            },
        }
    }
}

/// The measures of one channel, for display.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ChannelFit {
    /// Largest autocorrelation of the innovations over the lags of one period, 0 to 1.
    pub largest_autocorrelation: f64,
    /// Share of the variance of the channel that the model explains or the stated noise accounts for, 0 to 1.
    pub explained_share: f64,
    /// Correlation of the innovations with the measured excitation, −1 to 1; the largest over the lags of one period.
    pub excitation_correlation: f64,
    /// Noise found divided by the noise stated, as standard deviations.
    pub noise_ratio: f64,
}

impl Default for ChannelFit {
    fn default() -> Self {
        Self {
            largest_autocorrelation: 0.0,
            explained_share: 1.0,
            excitation_correlation: 0.0,
            noise_ratio: 1.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SETTINGS: MisfitSettings = MisfitSettings {
        block_steps: [5.0, 20.0, 100.0],
        memory_steps: 1000.0,
        start_steps: 0,
        jump_threshold: 5.0,
        jump_steps: 40,
        lag_steps: 10,
        excitation_is_measured: true,
    };

    /// Takes steps of a sine of which the innovations leave this share; the parameter is at `mean`, its prior 1 ± 0.2.
    fn take(fit: &mut FitState, steps: std::ops::Range<u32>, left: f64, mean: f64) {
        let (misfit, noise) = (MisfitState::new(1), DMatrix::from_element(1, 1, 1e-4));
        for step in steps {
            let observation = (f64::from(step) * 0.6).sin();
            fit.take(
                &SETTINGS,
                &misfit,
                Shown {
                    observations: &[observation],
                    innovations: &[left * observation],
                    excitation: &[],
                    noise: &noise,
                    normalised_innovation_squared: 1.0,
                    predicted_variances: &[0.0],
                    at_bound: false,
                    parameters: ShownParameters {
                        means: &[mean],
                        variances: &[1e-4],
                        prior_means: &[1.0],
                        prior_stds: &[0.2],
                        considered_stds: &[0.0],
                    },
                },
            );
        }
    }

    fn started() -> FitState {
        FitState::new(&SETTINGS, std::iter::once(1e-4), 0)
    }

    #[test]
    fn parameter_far_from_its_prior_is_a_contradiction_only_where_the_motion_is_not_explained() {
        for (left, verdict) in [(0.1, FitVerdict::Doubtful), (0.9, FitVerdict::Contradicted)] {
            let mut fit = started();
            take(&mut fit, 0..300, left, 0.1);
            assert_eq!(
                fit.fit().verdict(),
                Some(verdict),
                "{left} of the motion left"
            );
            assert!(
                fit.fit()
                    .reasons()
                    .any(|reason| reason == FitReason::FarFromPrior)
            );
        }
    }
}
