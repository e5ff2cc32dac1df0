//! State of a filter between two steps.

use super::settings::FilterSettings;
use crate::discretise::InputHold;
use crate::excitation_course::ExcitationCourse;
use crate::fit::FitState;
use crate::misfit::MisfitState;
use crate::model::{ObservationModel, ProcessModel};
use crate::noise::NoiseState;
use crate::outlier::OutlierState;
use crate::update::ExcitationPosterior;
use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

/// Complete state of a filter between two steps, as stored in a checkpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FilterState {
    pub(super) mean: DVector<f64>,
    pub(super) covariance: DMatrix<f64>,
    pub(super) noise: NoiseState,
    pub(super) outliers: Option<OutlierState>,
    pub(super) misfit: Option<MisfitState>,
    pub(super) fit: Option<FitState>,
    pub(super) steps: u64,
    /// Step from which the start-up aid counts: the start, or the last jump of the parameters.
    pub(super) annealed_from: u64,
    /// `true` if the next frame updates the motion without a prediction.
    pub(super) fresh: bool,
    /// Known excitation of the last frame (N_f), NaN for a missing sample.
    pub(super) last_excitation: DVector<f64>,
    /// Course of the known excitation between frames; `None` if the excitation is held over a step.
    pub(super) excitation_course: Option<ExcitationCourse>,
    /// Running mean square of the known excitation (N_f), the variance of a missing sample.
    pub(super) excitation_mean_square: DVector<f64>,
    /// Running mean square of the physical state (n − N_θ), for a reset of the motion.
    pub(super) motion_mean_square: DVector<f64>,
    pub(super) posterior: Option<ExcitationPosterior>,
}

impl FilterState {
    /// Returns the estimates of the noise parameters.
    pub(crate) fn noise(&self) -> &NoiseState {
        &self.noise
    }

    /// Returns the state of the outlier screening, or `None` if outliers are not screened.
    pub(crate) fn outliers(&self) -> Option<&OutlierState> {
        self.outliers.as_ref()
    }

    /// Returns the numbers of channels and sensors with outlier screening, or 0 without screening.
    pub(super) fn screened(&self) -> (usize, usize) {
        self.outliers.as_ref().map_or((0, 0), OutlierState::shape)
    }

    /// Returns the number of parameters whose misfit is measured.
    pub(super) fn misfit_len(&self) -> usize {
        self.misfit.as_ref().map_or(0, MisfitState::parameter_len)
    }

    /// Returns the number of values stored in the measures of fit, or 0 if their lengths disagree.
    pub(super) fn fit_len(&self) -> usize {
        self.fit.as_ref().map_or(0, FitState::remembered_len)
    }

    /// Returns the numbers of states and of components in the statistics of the excitation.
    ///
    /// Both are 0 if the filter has no such statistics or if their lengths disagree.
    pub(super) fn course_shape(&self) -> (usize, usize) {
        self.excitation_course
            .as_ref()
            .and_then(ExcitationCourse::shape)
            .unwrap_or_default()
    }

    /// Returns what is known about the excitation of the coming step.
    pub(super) fn step_excitation(&self) -> StepExcitation<'_> {
        match &self.posterior {
            _ if self.fresh => StepExcitation::AtPrior,
            Some(posterior) => StepExcitation::Inferred(posterior),
            None => StepExcitation::WhiteNoise,
        }
    }

    /// Returns the state at the prior.
    pub(super) fn start(
        model: &(impl ProcessModel + ObservationModel),
        settings: &FilterSettings,
    ) -> Self {
        let (n, inputs) = (model.state_len(), model.excitation_len());
        Self {
            mean: settings.prior_mean.clone(),
            covariance: DMatrix::from_diagonal(&settings.prior_std.map(|std| std * std)),
            noise: NoiseState::start(&settings.noise, &settings.noise_settings),
            outliers: settings
                .outliers
                .map(|outliers| OutlierState::new(&outliers, &settings.sensors)),
            misfit: settings
                .misfit
                .map(|_| MisfitState::new(model.parameter_len())),
            fit: settings
                .misfit
                .map(|misfit| FitState::new(&misfit, settings.stated_noise(), inputs)),
            steps: 0,
            annealed_from: 0,
            fresh: true,
            last_excitation: DVector::zeros(inputs),
            excitation_course: (settings.input_hold == InputHold::First)
                .then(|| ExcitationCourse::new(n, inputs)),
            excitation_mean_square: DVector::zeros(inputs),
            motion_mean_square: DVector::zeros(n - model.parameter_len()),
            posterior: model
                .feedthrough()
                .map(|direct| ExcitationPosterior::new(n, direct.nrows(), inputs)),
        }
    }
}

/// What a filter knows about the unknown excitation that acts on the motion over the coming step.
#[derive(Debug, Clone, Copy)]
pub(super) enum StepExcitation<'s> {
    /// No excitation acts, because the motion is at its prior. The prior applies to the time of the
    /// next frame.
    AtPrior,
    /// White noise with the covariance `Σ_f`: the sensors have not measured it yet.
    WhiteNoise,
    /// The previous frame has measured it through the direct term.
    Inferred(&'s ExcitationPosterior),
}
