//! Prediction of the datum, with the screening of outliers and the update of the noise parameters,
//! which both use its covariance.

use super::state::StepExcitation;
use super::{Annealing, ExtendedKalmanFilter, Frame};
use crate::dense::{add_quadratic_form_mut, diagonal_to, symmetrise_mut};
use crate::model::{ObservationModel, ProcessModel};
use crate::noise::{ExcitationPath, NoiseEvents, NoiseRule, NoiseTarget};
use crate::product::{Extent, Left, Sum};
use crate::small;
use nalgebra::DMatrix;

/// Largest factor of the start-up aid at which residuals can set the scales of the outlier
/// screening.
///
/// A larger factor also enlarges the residuals. The scales are estimated again when the factor
/// falls to this value.
const LARGEST_SCREENED_ANNEALING: f64 = 2.0;

impl<M: ProcessModel + ObservationModel> ExtendedKalmanFilter<M> {
    /// Writes innovation, `S₀` and `P Hᵀ` without the noise, and screens outliers.
    ///
    /// Returns the number of rejected channels.
    pub(super) fn predict_observation(&mut self, frame: Frame<'_>) -> usize {
        let Self { model, work, .. } = self;
        model.linearise_observation(work.mean.as_slice(), work.newer.as_slice());
        model.observe(work.predicted.as_mut_slice());
        let innovations = work.update.innovation.iter_mut();
        let predictions = work.predicted.iter();
        for ((innovation, datum), predicted) in innovations.zip(frame.observations).zip(predictions)
        {
            *innovation = datum - predicted; // NaN for a missing channel
        }
        let is_time_invariant = work.propagator.time_invariant().is_some();
        let is_known = is_time_invariant && work.by_h_t.is_packed(); // H never changes
        if is_known || model.observation_matrix(&mut work.h_t) {
            if !is_known {
                work.by_h_t.repack_sparse(&work.h_t);
            }
            if work.mean.len() <= small::MOST_ROWS {
                small::multiply_to(
                    work.multiplier.arch(),
                    &work.covariance,
                    &work.h_t,
                    &mut work.p_ht,
                );
            } else {
                let left = Left::new(&work.covariance);
                work.multiplier.multiply_to(
                    left,
                    &work.by_h_t,
                    Extent::Full,
                    Sum::PLAIN,
                    &mut work.p_ht,
                );
            }
        } else {
            model.observation_jacobian_mul(&work.covariance, &mut work.h_p);
            work.p_ht.tr_copy_from(&work.h_p); // because P is symmetric
        }
        model.observation_jacobian_mul(&work.p_ht, &mut work.update.innovation_covariance); // S₀
        symmetrise_mut(&mut work.update.innovation_covariance);
        if !is_time_invariant {
            model.observation_jacobian_mul(&work.input_matrix, &mut work.h_b);
        }
        self.screen_outliers(frame)
    }

    /// Rejects outliers, using the noise levels from before this step. Returns the number of
    /// rejected channels.
    fn screen_outliers(&mut self, frame: Frame<'_>) -> usize {
        if self.follows || self.settings.outliers.is_none() {
            return 0;
        }
        self.write_noise_covariances(frame);
        let annealing = self.annealing();
        let was_annealed =
            self.annealing_at(self.state.steps.saturating_sub(1)) > LARGEST_SCREENED_ANNEALING;
        let Self {
            model,
            settings,
            state,
            work,
            ..
        } = self;
        let is_white_noise = matches!(state.step_excitation(), StepExcitation::WhiteNoise);
        for channel in 0..work.variances.len() {
            let of_row = |row: &DMatrix<f64>, covariance: &DMatrix<f64>| {
                let mut sum = 0.0;
                for b in 0..covariance.ncols() {
                    for a in 0..covariance.nrows() {
                        sum += row[(channel, a)] * covariance[(a, b)] * row[(channel, b)];
                    }
                }
                sum
            };
            let mut variance = work.update.innovation_covariance[(channel, channel)];
            variance += annealing * work.sensors[(channel, channel)];
            if is_white_noise {
                variance += settings.fading.value() * of_row(&work.h_b, &work.step_excitation);
            }
            if let Some(direct) = model.feedthrough() {
                variance += of_row(direct, &work.frame_excitation);
            }
            work.variances[channel] = variance;
        }
        let (Some(outlier_settings), Some(outliers)) = (&settings.outliers, &mut state.outliers)
        else {
            return 0;
        };
        if was_annealed && annealing <= LARGEST_SCREENED_ANNEALING {
            outliers.rescale(&mut work.sorted);
        }
        let residuals = work.update.innovation.as_mut_slice();
        let follows_jump = state
            .misfit
            .as_ref()
            .zip(settings.misfit.as_ref())
            .is_some_and(|(misfit, settings)| misfit.follows_jump(settings));
        outliers.screen(
            outlier_settings,
            residuals,
            work.variances.as_slice(),
            follows_jump,
            &mut work.sorted,
        )
    }

    /// Returns the factor by which the start-up aid increases the sensor noise at this step.
    fn annealing(&self) -> f64 {
        self.annealing_at(self.state.steps)
    }

    fn annealing_at(&self, step: u64) -> f64 {
        self.settings.annealing.map_or(
            1.0,
            |Annealing {
                 amount,
                 time_constant_s,
             }| {
                let elapsed_s =
                    step.saturating_sub(self.state.annealed_from) as f64 * self.settings.step_s;
                1.0 + amount * (-elapsed_s / time_constant_s).exp()
            },
        )
    }

    /// Updates the noise parameters with this frame.
    pub(super) fn update_noise(&mut self, frame: Frame<'_>) -> NoiseEvents {
        let fixed = self.settings.noise.parameters.is_empty()
            || self.settings.noise_settings.rule == NoiseRule::Fixed;
        if self.follows || fixed {
            return NoiseEvents::default();
        }
        let Self {
            model,
            settings,
            state,
            work,
            ..
        } = self;
        if let (Some(outlier_settings), Some(outliers)) = (&settings.outliers, &state.outliers)
            && settings.noise_settings.rule == NoiseRule::Fisher
            && outliers.trained_with_outliers(outlier_settings)
        {
            // A few wrong samples can have raised the levels thirtyfold. With the information of
            // these samples, the levels would fall only over a half-life.
            state.noise.forget_levels(&settings.noise);
        }
        if state.fresh && frame.observations.iter().all(|datum| datum.is_nan()) {
            // The prior applies to the time of this frame, so no information has faded.
            return NoiseEvents::default();
        }
        let lambda = settings.fading.value();
        work.step_excitation.copy_from(&settings.noise.excitation);
        work.frame_excitation.copy_from(&settings.noise.excitation);
        work.apply_reliability();
        work.add_missing_excitation(frame, &state.excitation_mean_square);
        let path = work
            .propagator
            .noise_path(state.step_excitation(), &work.h_b);
        let objective = &mut work.objective;
        objective.set_reliability(work.reliability.as_slice());
        let known = &mut work.frame_known;
        known.copy_from(&work.update.innovation_covariance);
        *known += &settings.noise.sensors;
        match path {
            ExcitationPath::Felt => {}
            ExcitationPath::Input(h_b) => {
                add_quadratic_form_mut(known, h_b, &work.step_excitation, lambda);
            }
            ExcitationPath::Constant(constant) => {
                constant.add_known_datum_mut(lambda, &work.missing, known);
            }
        }
        if let Some(direct) = model.feedthrough() {
            add_quadratic_form_mut(known, direct, &work.frame_excitation, 1.0);
        }
        objective.set_frame(
            &settings.noise,
            known,
            path,
            model.feedthrough(),
            lambda,
            &work.update.innovation,
        );
        state
            .noise
            .update(&settings.noise, &settings.noise_settings, objective)
    }

    /// Writes `Σ_f` of the coming step, `Σ_f` of the frame and `Σ_n` for the current noise
    /// parameters.
    fn write_noise_covariances(&mut self, frame: Frame<'_>) {
        let Self {
            settings,
            state,
            work,
            ..
        } = self;
        let psi = &state.noise.mean;
        settings
            .noise
            .covariance_to(NoiseTarget::Sensors, psi, &mut work.sensors);
        settings
            .noise
            .covariance_to(NoiseTarget::Excitation, psi, &mut work.step_excitation);
        work.frame_excitation.copy_from(&work.step_excitation);
        work.apply_reliability();
        work.add_missing_excitation(frame, &state.excitation_mean_square);
    }

    /// Adds the noise covariances to `P Hᵀ` and `S`, and also to `P` for a time-invariant model.
    pub(super) fn add_noises(&mut self, frame: Frame<'_>) {
        self.write_noise_covariances(frame);
        let annealing = self.annealing();
        let Self {
            model,
            settings,
            state,
            work,
            ..
        } = self;
        let lambda = settings.fading.value();
        let innovation_covariance = &mut work.update.innovation_covariance;
        match work
            .propagator
            .noise_path(state.step_excitation(), &work.h_b)
        {
            ExcitationPath::Felt => {}
            ExcitationPath::Constant(constant) => constant.add_noise_mut(
                &state.noise.mean,
                lambda,
                &work.missing,
                &mut work.covariance,
                &mut work.p_ht,
                innovation_covariance,
            ),
            ExcitationPath::Input(h_b) => {
                add_quadratic_form_mut(innovation_covariance, h_b, &work.step_excitation, lambda);
                for (b, mut spread) in work.input_spread.column_iter_mut().enumerate() {
                    spread.gemv(
                        lambda,
                        &work.input_matrix,
                        &work.step_excitation.column(b),
                        0.0,
                    ); // λ B Σ_f
                    for (channel, mut p_ht) in work.p_ht.column_iter_mut().enumerate() {
                        p_ht.axpy(h_b[(channel, b)], &spread, 1.0); // + B Σ_f Bᵀ Hᵀ
                    }
                }
            }
        }
        if let Some(direct) = model.feedthrough() {
            add_quadratic_form_mut(innovation_covariance, direct, &work.frame_excitation, 1.0);
        }
        diagonal_to(innovation_covariance, &mut work.predicted_variances);
        if annealing != 1.0 {
            work.sensors *= annealing;
        }
        *innovation_covariance += &work.sensors;
    }
}
