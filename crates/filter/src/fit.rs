//! Measures of how well the model explains the data.
//!
//! The noise levels adapt until the innovations have the size that the filter expects. Their size
//! therefore cannot reveal a wrong model. A wrong model has other effects: its innovations are
//! correlated in time, they follow the measured excitation, or the identified noise exceeds the
//! stated noise. [`Fit`] combines these measures into one [`FitVerdict`] with its reasons.

use crate::misfit::{MisfitSettings, MisfitState};
use nalgebra::DMatrix;
use serde::{Deserialize, Serialize};

/// Degree to which the data support the model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FitVerdict {
    /// No measure disagrees with the model.
    Supported,
    /// The model omits an important effect. The intervals are widened accordingly.
    Doubtful,
    /// The data contradict the model, and its estimates are meaningless.
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
    /// The innovations are correlated with the measured excitation.
    ExcitationInInnovations,
    /// The model explains too little of the response.
    LittleExplained,
    /// The identified noise is much larger than the stated noise.
    ExcessNoise,
    /// A parameter is at its bound.
    ParameterAtBound,
    /// A parameter lies far outside its prior.
    FarFromPrior,
    /// The innovations suddenly exceed the size that the filter expects.
    InnovationBurst,
}

impl FitReason {
    /// All reasons, in reporting order.
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

/// Verdict on the fit after one step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Fit {
    verdict: Option<FitVerdict>,
    reasons: u16,
    follows_jump: bool,
}

impl Fit {
    /// Returns the verdict, or `None` if the fit is not measured or too few steps have been
    /// processed.
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

    /// Returns `true` while the filter follows a sudden change, so that the estimates are still
    /// moving.
    #[must_use]
    pub fn follows_jump(&self) -> bool {
        self.follows_jump
    }

    /// Adds the verdict on one measure: doubtful or contradicted, if the measure exceeds the
    /// respective limit.
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

/// Values of a measure above which it disagrees with the model, or contradicts it.
#[derive(Debug, Clone, Copy)]
struct Limits {
    doubtful: f64,
    contradicted: f64,
}

impl Limits {
    /// Returns the same limits without a contradiction.
    fn for_doubt(self) -> Self {
        Self {
            contradicted: f64::INFINITY,
            ..self
        }
    }
}

/// Smallest explained share of every channel with which a parameter far from its prior is
/// plausible.
const WELL_EXPLAINED: f64 = 0.5;
/// Limits of the long-run variance of the scores divided by their information. The intervals are
/// widened by this ratio.
const WANDERING: Limits = Limits {
    doubtful: 3.0,
    contradicted: f64::INFINITY,
};
/// Limits of the identified noise divided by the stated noise, as standard deviations.
///
/// There is no contradiction, because the share of the noise in the motion is what matters.
const NOISE: Limits = Limits {
    doubtful: 3.0,
    contradicted: f64::INFINITY,
};
/// Limits of the share of a channel's variance that remains in its innovations, beyond the stated
/// noise.
///
/// Models of real bridges leave a third or more, and still track their stiffness.
const UNEXPLAINED: Limits = Limits {
    doubtful: 0.1,
    contradicted: 0.9,
};
/// Limits of the autocorrelation of the innovations.
///
/// There is no contradiction, because a band limit alone correlates the noise. The intervals are
/// widened for it.
const CORRELATION: Limits = Limits {
    doubtful: 0.3,
    contradicted: f64::INFINITY,
};
/// Limits of the correlation of the innovations with the excitation.
///
/// There is no contradiction, because the intervals are widened for the effect on the parameters.
const WITH_EXCITATION: Limits = Limits {
    doubtful: 0.3,
    contradicted: f64::INFINITY,
};
/// Limits of the distance by which a parameter exceeds its prior mean, in prior standard
/// deviations.
///
/// No event stiffens a structure this much. If the motion is well explained, the prior mean in the
/// structure file is wrong.
const STIFFER: Limits = Limits {
    doubtful: 3.0,
    contradicted: 4.0,
};
/// Limits of the factor by which a parameter falls below its prior mean by more than its prior
/// standard deviation.
///
/// Severe damage reaches a factor of six. A factor of ten is a wrong unit. If the motion is well
/// explained, a loss relative to a reference is meaningful in both cases.
const SOFTER: Limits = Limits {
    doubtful: 4.0,
    contradicted: 8.0,
};
/// Limits of the normalised innovation squared per channel, averaged over a period.
const BURST: Limits = Limits {
    doubtful: 4.0,
    contradicted: 16.0,
};
/// Limits of the share of time for which a parameter is at its bound.
const AT_BOUND: Limits = Limits {
    doubtful: 0.01,
    contradicted: 0.2,
};

/// Lags at which the innovations are compared, in steps: powers of two.
const LAGS: [usize; 8] = [1, 2, 4, 8, 16, 32, 64, 128];

/// Data of one step from which the fit is judged.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Shown<'a> {
    /// `z` (N_0), NaN for a missing channel.
    pub(crate) observations: &'a [f64],
    /// `ν` (N_0), NaN for a missing or rejected channel.
    pub(crate) innovations: &'a [f64],
    /// Known excitation (N_f).
    pub(crate) excitation: &'a [f64],
    /// Identified covariance of the measurement noise (N_0 × N_0).
    pub(crate) noise: &'a DMatrix<f64>,
    /// `νᵀ S⁻¹ ν` per used channel.
    pub(crate) normalised_innovation_squared: f64,
    /// Diagonal of `S − R` (N_0): the part of the innovations that state and excitation cause.
    pub(crate) predicted_variances: &'a [f64],
    pub(crate) at_bound: bool,
    pub(crate) parameters: ShownParameters<'a>,
}

/// Parameters of one step from which the fit is judged (N_θ each).
#[derive(Debug, Clone, Copy)]
pub(crate) struct ShownParameters<'a> {
    pub(crate) means: &'a [f64],
    /// The filter's own variances.
    pub(crate) variances: &'a [f64],
    pub(crate) prior_means: &'a [f64],
    pub(crate) prior_stds: &'a [f64],
    /// Standard deviations of errors that no data reveal, such as those caused by an unmeasured
    /// excitation.
    pub(crate) considered_stds: &'a [f64],
}

/// State of the fit measures between two steps.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FitState {
    channels: Vec<ChannelState>,
    fits: Vec<ChannelFit>,
    /// The latest innovations and excitations, one row per step.
    history: Vec<f64>,
    excitation_square: Vec<f64>,
    steps: u64,
    /// Faded share of the steps at a bound, and mean normalised innovation squared of a period.
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
    /// Part of the squared innovations that an unmeasured excitation causes.
    from_excitation: f64,
    lagged: Vec<f64>,
    with_excitation: Vec<f64>,
    weight: f64,
}

impl FitState {
    /// Creates an empty state. `stated_noise` is the stated noise variance of each channel (N_0).
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

    /// Returns the number of stored values, or 0 if the lengths disagree, as in a damaged
    /// checkpoint.
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

    /// Processes one step.
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
            // A missing value adds nothing to a product.
            *kept = if value.is_nan() { 0.0 } else { *value };
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
            // No model predicts an unmeasured excitation.
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
            // A considered error explains a part of the wandering.
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

/// Returns the lags for these settings: up to one fundamental period, and at least one lag.
fn lags(settings: &MisfitSettings) -> &'static [usize] {
    let count = LAGS
        .iter()
        .filter(|lag| **lag <= settings.lag_steps)
        .count();
    &LAGS[..count.max(1)]
}

impl ChannelState {
    /// Returns `true` once a fundamental period has been observed.
    fn is_judged(&self, settings: &MisfitSettings) -> bool {
        // The weight of a fading sum stays below its memory.
        self.weight >= (settings.lag_steps as f64).min(0.5 * settings.memory_steps)
    }

    fn measures(&self, noise: f64, excitation_square: &[f64]) -> ChannelFit {
        // Innovations below the stated noise mean that the structure is quiet, whatever their
        // correlation.
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
        // Below the stated noise, the channel contains no motion that a model could explain.
        let largest = variance.max(self.stated_noise);
        // Innovations and motion fade with the same memory, but the noise level has another memory.
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

/// Fit measures of one channel, for display.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ChannelFit {
    /// Largest absolute autocorrelation of the innovations over the lags of one period, 0 to 1.
    pub largest_autocorrelation: f64,
    /// Share of a channel's variance that the model or the stated noise explains, 0 to 1.
    pub explained_share: f64,
    /// Correlation of the innovations with the measured excitation, −1 to 1. It is the value with
    /// the largest magnitude over the lags of one period.
    pub excitation_correlation: f64,
    /// Identified noise divided by stated noise, as standard deviations.
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

    /// Processes steps of a sine whose innovations are the share `left` of it.
    ///
    /// The parameter is at `mean`, with a prior of 1 ± 0.2.
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
    fn parameter_far_from_its_prior_contradicts_only_if_the_motion_is_not_explained() {
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
