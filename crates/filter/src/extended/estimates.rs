//! Read access to the estimates of a filter and to the measures of its last step.

use super::propagator::Propagator;
use super::{ExtendedKalmanFilter, FilterSettings, FilterState};
use crate::fit::{ChannelFit, Fit, FitState};
use crate::misfit::MisfitState;
use crate::model::{ObservationModel, ProcessModel};
use crate::noise::NoiseState;
use crate::outlier::OutlierState;
use crate::update::ExcitationPosterior;
use nalgebra::{DMatrix, DVector};

impl<M: ProcessModel + ObservationModel> ExtendedKalmanFilter<M> {
    /// Returns the model.
    pub fn model(&self) -> &M {
        &self.model
    }

    /// Returns the settings.
    pub fn settings(&self) -> &FilterSettings {
        &self.settings
    }

    /// Returns the filtered state `y` (n).
    pub fn mean(&self) -> &DVector<f64> {
        &self.state.mean
    }

    /// Returns the covariance of the filtered state (n × n).
    pub fn covariance(&self) -> &DMatrix<f64> {
        &self.state.covariance
    }

    /// Returns the estimates of the noise parameters.
    pub fn noise(&self) -> &NoiseState {
        &self.state.noise
    }

    /// Returns the misfit of the parameters, or `None` if it is not measured.
    pub fn misfit(&self) -> Option<&MisfitState> {
        self.state.misfit.as_ref()
    }

    /// Returns the verdict on the fit after the last step.
    pub fn fit(&self) -> Fit {
        self.state
            .fit
            .as_ref()
            .map(FitState::fit)
            .unwrap_or_default()
    }

    /// Returns the measures of fit of each channel (N_0), or an empty slice if the fit is not
    /// measured.
    pub fn channel_fits(&self) -> &[ChannelFit] {
        self.state.fit.as_ref().map_or(&[], FitState::channels)
    }

    /// Returns the covariance of parameters `i` and `j` (from 0), including the detectable model
    /// error.
    ///
    /// If the misfit is not measured, it is the filter's own covariance. In both cases, it includes
    /// [`FilterSettings::considered_std`].
    pub fn parameter_covariance(&self, i: usize, j: usize) -> f64 {
        let first = self.model.state_len() - self.model.parameter_len();
        let own = self.state.covariance[(first + i, first + j)];
        let scaled = self.state.misfit.as_ref().map_or(own, |misfit| {
            own * (misfit.variance_scale(i) * misfit.variance_scale(j)).sqrt()
        });
        scaled + self.settings.considered_std[first + i] * self.settings.considered_std[first + j]
    }

    /// Returns the variance that parameter `j` (from 0) would have if the filter had always learnt
    /// as much as in the last half-life. Infinity means that it has learnt nothing.
    ///
    /// Unlike [`Self::parameter_covariance`], it does not count what was learnt earlier. `None` if
    /// the misfit is not measured, without fading, and in the first eighth of a half-life.
    pub fn sustained_variance(&self, j: usize) -> Option<f64> {
        let first = self.model.state_len() - self.model.parameter_len();
        let considered = self.settings.considered_std[first + j];
        let misfit = self.state.misfit.as_ref()?;
        let own = misfit.sustained_variance(j, self.settings.fading)?;
        Some(own + considered * considered)
    }

    /// Returns the state of the outlier screening, or `None` if outliers are not screened.
    pub fn outliers(&self) -> Option<&OutlierState> {
        self.state.outliers.as_ref()
    }

    /// Returns the innovation of the last step (N_0), NaN for a missing or rejected channel.
    pub fn innovation(&self) -> &DVector<f64> {
        &self.work.update.innovation
    }

    /// Returns the prediction of each channel in the last step, before the correction (N_0). It
    /// includes missing channels.
    pub fn predicted(&self) -> &DVector<f64> {
        &self.work.predicted
    }

    /// Returns `S` of the last step (N_0 × N_0). The rows of missing channels are those of the
    /// identity.
    pub fn innovation_covariance(&self) -> &DMatrix<f64> {
        &self.work.update.innovation_covariance
    }

    /// Returns the number of terms with which the last prediction moved one row of the covariance.
    ///
    /// The cost of a step follows from this number. It is `None` for models whose step does not use
    /// a [`ProportionalForm`](crate::ProportionalForm).
    pub fn transition_term_count(&self) -> Option<usize> {
        match &self.work.propagator {
            Propagator::ProportionalDamping(transition) => Some(transition.term_count()),
            Propagator::TimeInvariant(_) | Propagator::TaylorSeries(_) => None,
        }
    }

    /// Returns the number of processed frames.
    pub fn steps(&self) -> u64 {
        self.state.steps
    }

    /// Returns the state for a checkpoint.
    pub fn state(&self) -> &FilterState {
        &self.state
    }

    /// Returns the known excitation of the last frame (N_f): NaN for a missing sample, zero before
    /// the first frame.
    pub(crate) fn last_excitation(&self) -> &DVector<f64> {
        &self.state.last_excitation
    }

    /// Returns the posterior of the unknown excitation of the last frame, or `None` for a model
    /// without a direct term.
    pub(crate) fn excitation_posterior(&self) -> Option<&ExcitationPosterior> {
        self.state.posterior.as_ref()
    }
}
