//! Update of the state with the innovation, and the stages after it: the answer to misfit, the
//! limits of the state, and its checks.

use super::workspace::Workspace;
use super::{ExtendedKalmanFilter, Frame};
use crate::dense::diagonal_to;
use crate::error::FilterError;
use crate::fading::bound_variances_mut;
use crate::fit::{Shown, ShownParameters};
use crate::misfit::{Memory, PriorSpread};
use crate::model::{ObservationModel, ProcessModel};
use crate::noise::ExcitationPath;
use crate::outlier::OutlierState;
use crate::update::{self, ExcitationSpread};

/// Largest magnitude of a negative variance, relative to the largest variance, that counts as
/// rounding.
///
/// At the start of a wide prior, every form of the update leaves the smallest eigenvalue at this
/// level.
const ROUNDING: f64 = 1e-12;

/// Largest normalised innovation squared, per entry of the state, of a step that may update the
/// mean square of the motion.
const CREDIBLE: f64 = 25.0;

/// Quantile of the standard normal distribution for a two-sided interval of 95 %.
const QUANTILE_95: f64 = 1.96;

/// The entries of the state that a step clamped to their limits.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Limited {
    /// Number of clamped entries.
    pub(super) states: usize,
    /// `true` if the data moved a parameter to its limit, so that its interval excludes the prior
    /// mean.
    pub(super) is_on_bound: bool,
}

impl<M: ProcessModel + ObservationModel> ExtendedKalmanFilter<M> {
    /// Updates mean and covariance with the innovation, equations (2.68) to (2.70).
    pub(super) fn update_state(&mut self) {
        let Self {
            model, state, work, ..
        } = self;
        let path = work
            .propagator
            .noise_path(state.step_excitation(), &work.h_b);
        // `add_noises` left this part of the covariance as factors.
        let spread = matches!(path, ExcitationPath::Input(_)).then_some(ExcitationSpread {
            input: &work.input_matrix,
            scaled: &work.input_spread,
        });
        update::correct(
            model,
            &mut work.mean,
            &mut work.covariance,
            spread,
            &mut work.p_ht,
            &work.sensors,
            &mut work.update,
        );
    }

    /// Undoes the changes by a step without information. Measures the effect of misfit on the
    /// parameters, reduces the corrections of this step accordingly and follows jumps.
    pub(super) fn answer_misfit(&mut self, normalised_innovation_squared: f64) {
        let Self {
            model,
            settings,
            state,
            work,
            ..
        } = self;
        let Workspace {
            misfit: scratch,
            mean,
            covariance,
            p_ht,
            update,
            teaches,
            ..
        } = work;
        if *teaches && state.misfit.is_none() {
            return;
        }
        scratch.read(&update.variances, p_ht, update.whitened());
        if !*teaches {
            scratch.unlearn(settings.fading, mean, covariance);
        }
        let (Some(misfit_settings), Some(misfit)) = (&settings.misfit, &mut state.misfit) else {
            diagonal_to(covariance, &mut update.variances);
            return;
        };
        let is_excitation_known = !state.last_excitation.iter().any(|sample| sample.is_nan());
        let jumped = misfit.take(
            misfit_settings,
            scratch,
            normalised_innovation_squared,
            is_excitation_known,
        );
        scratch.temper(
            misfit,
            misfit_settings,
            Memory {
                fading: settings.fading,
                fades: *teaches && !state.fresh,
            },
            PriorSpread {
                std: &settings.prior_std,
                variance_bound: &settings.variance_bound,
            },
            mean,
            covariance,
        );
        if jumped {
            let first = mean.len() - model.parameter_len();
            for j in first..mean.len() {
                covariance[(j, j)] += settings.prior_std[j] * settings.prior_std[j];
            }
            misfit.start_jump((first..mean.len()).map(|j| covariance[(j, j)]));
            state.annealed_from = state.steps;
        }
        diagonal_to(covariance, &mut update.variances);
    }

    /// Makes the motion uncertain after samples were rejected although the structure or its motion
    /// had changed. The filter has then predicted the motion with a wrong model and few data.
    ///
    /// The running mean square of the motion is added to its variance.
    pub(super) fn reopen_motion(&mut self) {
        let Self { state, work, .. } = self;
        let began = |outliers: &OutlierState| outliers.change_began();
        if !state.outliers.as_ref().is_some_and(began) {
            return;
        }
        for (j, mean_square) in state.motion_mean_square.iter().enumerate() {
            work.covariance[(j, j)] += mean_square;
        }
        diagonal_to(&work.covariance, &mut work.update.variances);
    }

    /// Judges how well the model explains the data so far.
    pub(super) fn judge_fit(
        &mut self,
        frame: Frame<'_>,
        normalised_innovation_squared: f64,
        at_bound: bool,
    ) {
        let Self {
            model,
            settings,
            state,
            work,
            ..
        } = self;
        let first = work.mean.len() - model.parameter_len();
        let (Some(misfit_settings), Some(misfit), Some(fit)) =
            (&settings.misfit, &state.misfit, &mut state.fit)
        else {
            return;
        };
        fit.take(
            misfit_settings,
            misfit,
            Shown {
                observations: frame.observations,
                innovations: work.update.innovation.as_slice(),
                excitation: frame.excitation,
                noise: &work.sensors,
                normalised_innovation_squared,
                predicted_variances: work.predicted_variances.as_slice(),
                at_bound,
                parameters: ShownParameters {
                    means: &work.mean.as_slice()[first..],
                    variances: &work.update.variances.as_slice()[first..],
                    prior_means: &settings.prior_mean.as_slice()[first..],
                    prior_stds: &settings.prior_std.as_slice()[first..],
                    considered_stds: &settings.considered_std.as_slice()[first..],
                },
            },
        );
    }

    /// Clamps the entries of the state to their limits. The covariance remains unchanged.
    pub(super) fn limit_state(&mut self) -> Limited {
        let Self {
            model,
            settings,
            state,
            work,
            ..
        } = self;
        let first = work.mean.len() - model.parameter_len();
        let widening = |j: usize| {
            state
                .misfit
                .as_ref()
                .map_or(1.0, |misfit| misfit.variance_scale(j - first))
        };
        let mut limited = Limited::default();
        for j in 0..work.mean.len() {
            let inside = work.mean[j].clamp(settings.lower[j], settings.upper[j]);
            // NaN does not count here, because `check_result` reports it.
            if inside != work.mean[j] && !work.mean[j].is_nan() {
                work.mean[j] = inside;
                limited.states += 1;
                if j >= first {
                    let off = inside - settings.prior_mean[j];
                    let variance = work.update.variances[j] * widening(j);
                    limited.is_on_bound |= off * off > QUANTILE_95 * QUANTILE_95 * variance;
                }
            }
        }
        limited
    }

    /// Scales the covariance so that no variance exceeds its bound. Returns the number of variances
    /// that did.
    pub(super) fn bound_variances(&mut self) -> usize {
        let Self { settings, work, .. } = self;
        let (variances, bounds) = (&mut work.update.variances, &settings.variance_bound);
        if variances
            .iter()
            .zip(bounds)
            .all(|(variance, bound)| variance <= bound)
        {
            // `variances` already contains the diagonal. Reading it from the covariance is slow,
            // because its entries are a column length apart.
            return 0;
        }
        let bounded = bound_variances_mut(&mut work.covariance, bounds);
        diagonal_to(&work.covariance, variances);
        bounded
    }

    pub(super) fn check_result(&mut self) -> Result<(), FilterError> {
        if let Some(index) = self
            .state
            .noise
            .mean
            .iter()
            .position(|level| !level.is_finite())
        {
            return Err(FilterError::NotFinite {
                what: "noise level",
                index,
            });
        }
        let work = &mut self.work;
        for index in 0..work.mean.len() {
            if !work.mean[index].is_finite() {
                return Err(FilterError::NotFinite {
                    what: "mean of state",
                    index,
                });
            }
            let variance = work.update.variances[index];
            if !variance.is_finite() {
                return Err(FilterError::NotFinite {
                    what: "variance of state",
                    index,
                });
            }
            if variance < 0.0 {
                let largest = work.update.variances.max();
                if variance < -ROUNDING * largest {
                    return Err(FilterError::NegativeVariance { index, variance });
                }
                work.covariance[(index, index)] = 0.0;
            }
        }
        Ok(())
    }

    /// Commits the result of the step to the state.
    pub(super) fn commit(&mut self, frame: Frame<'_>, normalised_innovation_squared: f64) {
        let Self {
            model,
            settings,
            state,
            work,
            ..
        } = self;
        if let (Some(direct), Some(posterior)) = (model.feedthrough(), &mut state.posterior) {
            update::infer_excitation(
                direct,
                &work.frame_excitation,
                &work.p_ht,
                &work.update,
                posterior,
            );
        }
        std::mem::swap(&mut state.mean, &mut work.mean);
        std::mem::swap(&mut state.covariance, &mut work.covariance);
        let weight = 1.0 / (state.steps as f64 + 1.0).min(settings.fading.memory_steps());
        match &mut state.excitation_course {
            Some(course) if state.fresh => course.interrupt(),
            Some(course) => {
                course.take(&state.last_excitation, frame.excitation, &work.input_matrix)
            }
            None => {}
        }
        for j in 0..state.last_excitation.len() {
            let known = frame.excitation[j];
            state.last_excitation[j] = known;
            if !known.is_nan() {
                state.excitation_mean_square[j] +=
                    weight * (known * known - state.excitation_mean_square[j]);
            }
        }
        // A diverging filter gives no information about the size of the motion.
        if normalised_innovation_squared <= CREDIBLE * work.mean.len().max(1) as f64 {
            for (mean_square, value) in state.motion_mean_square.iter_mut().zip(&state.mean) {
                *mean_square += weight * (value * value - *mean_square);
            }
        }
        state.steps += 1;
        state.fresh = false;
    }
}
