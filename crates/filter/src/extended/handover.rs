//! Continuation from the state of a checkpoint or of another filter.

use super::{ExtendedKalmanFilter, FilterState};
use crate::error::FilterError;
use crate::model::{ObservationModel, ProcessModel};
use crate::noise::NoiseState;
use crate::outlier::OutlierState;
use nalgebra::{DMatrix, DVector};

impl<M: ProcessModel + ObservationModel> ExtendedKalmanFilter<M> {
    /// Restores the state from a checkpoint. Subsequent steps are bit-identical to those of an
    /// uninterrupted filter.
    ///
    /// # Errors
    /// Returns [`FilterError::Dimension`] if the state does not fit the model or the settings.
    pub fn restore(&mut self, state: FilterState) -> Result<(), FilterError> {
        let n = self.model.state_len();
        let [(states, inputs), (own_states, own_inputs)] =
            [&state, &self.state].map(FilterState::course_shape);
        let [(channels, sensors), (own_channels, own_sensors)] =
            [&state, &self.state].map(FilterState::screened);
        let sizes = [
            ("mean of a checkpoint", state.mean.len(), n),
            ("covariance of a checkpoint", state.covariance.len(), n * n),
            (
                "excitation of a checkpoint",
                state.last_excitation.len(),
                self.model.excitation_len(),
            ),
            ("screened channels of a checkpoint", channels, own_channels),
            ("screened sensors of a checkpoint", sensors, own_sensors),
            (
                "noise parameters of a checkpoint",
                state.noise.mean.len(),
                self.settings.noise.parameters.len(),
            ),
            (
                "misfit of a checkpoint",
                state.misfit_len(),
                self.state.misfit_len(),
            ),
            ("fit of a checkpoint", state.fit_len(), self.state.fit_len()),
            (
                "states that the excitation of a checkpoint drives",
                states,
                own_states,
            ),
            (
                "course of the excitation of a checkpoint",
                inputs,
                own_inputs,
            ),
        ];
        FilterError::check_sizes(sizes)?;
        self.state = state;
        Ok(())
    }

    /// Widens the prior of the motion by the mean square of the motion that another filter has
    /// observed.
    pub(crate) fn expect_motion_of<N>(
        &mut self,
        other: &ExtendedKalmanFilter<N>,
        motion_len: usize,
    ) {
        for j in 0..motion_len {
            self.state.covariance[(j, j)] += other.state.motion_mean_square[j];
        }
        self.state
            .motion_mean_square
            .copy_from(&other.state.motion_mean_square);
        self.state
            .excitation_mean_square
            .copy_from(&other.state.excitation_mean_square);
    }

    /// Fixes the noise levels at `psi` (N_ψ) and stops the outlier screening, because another
    /// filter of the same frames does both.
    pub(crate) fn follow(&mut self, psi: &[f64]) {
        self.follows = true;
        self.state.noise.mean.copy_from_slice(psi);
    }

    /// Starts to identify noise levels and to screen outliers, from the estimates of another
    /// filter.
    pub(crate) fn lead(&mut self, noise: NoiseState, outliers: Option<OutlierState>) {
        self.follows = false;
        (self.state.noise, self.state.outliers) = (noise, outliers);
    }

    /// Continues from the state of another filter of the same motion, with the given mean and
    /// covariance.
    ///
    /// `origin` returns the index in the state of `source` for an index in the state of this
    /// filter, or `None` for a new entry.
    pub(crate) fn continue_from(
        &mut self,
        source: &FilterState,
        mean: DVector<f64>,
        covariance: DMatrix<f64>,
        origin: impl Fn(usize) -> Option<usize>,
    ) {
        let mut state = source.clone();
        if let (Some(posterior), Some(known)) = (&mut state.posterior, &source.posterior) {
            posterior.cross = DMatrix::from_fn(mean.len(), known.cross.ncols(), |row, input| {
                origin(row).map_or(0.0, |row| known.cross[(row, input)])
            });
        }
        state.excitation_course = state
            .excitation_course
            .map(|course| course.of_states(mean.len()));
        (state.mean, state.covariance) = (mean, covariance);
        self.state = state;
    }
}
