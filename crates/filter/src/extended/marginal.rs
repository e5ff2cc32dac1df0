//! Marginal density of the parameters: extraction, replacement and updates that preserve it.
//!
//! Source: Huang & Yuen (2023), §6.2 and §6.3. The replacement keeps the joint density consistent.
//! It is used instead of (6.17) and (6.21), which set the correlation of state and parameters to
//! zero.

use super::ExtendedKalmanFilter;
use crate::dense::{cholesky_mut, solve_lower_mut, solve_lower_transposed_mut, symmetrise_mut};
use crate::error::FilterError;
use crate::fusion::Gaussian;
use crate::model::{ObservationModel, ProcessModel};
use nalgebra::{DMatrix, DVector};

impl<M: ProcessModel + ObservationModel> ExtendedKalmanFilter<M> {
    /// Returns the marginal density of the parameters, `p(θ | D)` (N_θ).
    #[must_use]
    pub fn parameters(&self) -> Gaussian {
        let (first, len) = self.parameter_range();
        let state = &self.state;
        Gaussian {
            mean: state.mean.rows(first, len).into_owned(),
            covariance: state
                .covariance
                .view((first, first), (len, len))
                .into_owned(),
        }
    }

    /// Replaces the marginal density of the parameters and keeps `p(x, ẋ | θ)`.
    ///
    /// With `D = Σ_xθ Σ_θθ⁻¹`:
    ///
    /// - `x ← x + D (θ' − θ)`
    /// - `Σ_xx ← Σ_xx + D (Σ' − Σ_θθ) Dᵀ`
    /// - `Σ_xθ ← D Σ'`
    ///
    /// If `Σ'` is positive definite, the joint covariance remains positive definite. The means are
    /// clamped to their limits.
    ///
    /// # Errors
    /// Returns an error if `parameters` has another size or is not finite and positive definite, or
    /// if the current covariance of the parameters is singular. The filter is then unchanged.
    pub fn replace_parameters(&mut self, parameters: &Gaussian) -> Result<(), FilterError> {
        let (first, len) = self.parameter_range();
        FilterError::check_sizes([
            ("mean of parameters", parameters.mean.len(), len),
            (
                "covariance of parameters",
                parameters.covariance.len(),
                len * len,
            ),
        ])?;
        parameters.information()?;
        let now = self.parameters();
        let mut factor = now.covariance.clone();
        cholesky_mut(&mut factor).map_err(|pivot| FilterError::NotPositiveDefinite {
            what: "covariance of the parameters",
            pivot,
        })?;
        let mut mean = parameters.mean.clone();
        for (j, entry) in mean.iter_mut().enumerate() {
            *entry = entry.clamp(
                self.settings.lower[first + j],
                self.settings.upper[first + j],
            );
        }
        let step = &mean - &now.mean;
        let growth = &parameters.covariance - &now.covariance;

        let state = &mut self.state;
        let by_parameters = regression(
            &factor,
            state.covariance.view((first, 0), (len, first)).into_owned(),
        );
        let moved = &by_parameters * &step;
        state
            .mean
            .rows_mut(0, first)
            .zip_apply(&moved, |entry, moved| *entry += moved);
        state.mean.rows_mut(first, len).copy_from(&mean);
        let mut motion = state.covariance.view((0, 0), (first, first)).into_owned();
        motion += &by_parameters * &growth * by_parameters.transpose();
        symmetrise_mut(&mut motion);
        let cross = &by_parameters * &parameters.covariance;
        state
            .covariance
            .view_mut((0, 0), (first, first))
            .copy_from(&motion);
        state
            .covariance
            .view_mut((0, first), (first, len))
            .copy_from(&cross);
        state
            .covariance
            .view_mut((first, 0), (len, first))
            .copy_from(&cross.transpose());
        state
            .covariance
            .view_mut((first, first), (len, len))
            .copy_from(&parameters.covariance);
        if let Some(posterior) = &mut state.posterior {
            // The excitation posterior of the last frame depends on the parameters in the same way.
            let excitation = regression(&factor, posterior.cross.rows(first, len).into_owned());
            posterior.mean += &excitation * &step;
            posterior.covariance += &excitation * &growth * excitation.transpose();
            let with_motion = &by_parameters * &growth * excitation.transpose();
            posterior
                .cross
                .rows_mut(0, first)
                .zip_apply(&with_motion, |entry, moved| *entry += moved);
            posterior
                .cross
                .rows_mut(first, len)
                .copy_from(&(&parameters.covariance * excitation.transpose()));
        }
        Ok(())
    }

    /// Replaces mean (n) and covariance (n × n) of the whole state, like the feedback of the
    /// source.
    ///
    /// # Errors
    /// Returns an error if a size is wrong or a number is not finite. The filter is then unchanged.
    pub fn replace_state(
        &mut self,
        mean: &DVector<f64>,
        covariance: &DMatrix<f64>,
    ) -> Result<(), FilterError> {
        let n = self.state.mean.len();
        FilterError::check_sizes([
            ("mean of state", mean.len(), n),
            ("covariance of state", covariance.len(), n * n),
        ])?;
        if let Some(index) = mean
            .iter()
            .chain(covariance.iter())
            .position(|entry| !entry.is_finite())
        {
            return Err(FilterError::NotFinite {
                what: "entry of a replaced state",
                index,
            });
        }
        self.state.mean.copy_from(mean);
        self.state.covariance.copy_from(covariance);
        self.limit_mean();
        if let Some(posterior) = &mut self.state.posterior {
            posterior.clear();
        }
        Ok(())
    }

    /// Updates the motion with measurements of `R [x, ẋ]` (r) whose errors are independent and have
    /// known variances.
    ///
    /// The marginal density of the parameters remains unchanged (a Schmidt-Kalman update that
    /// considers them).
    ///
    /// # Errors
    /// Returns an error if a size is wrong, a value is not finite or a variance is not positive and
    /// finite. The filter is then unchanged.
    pub fn observe_motion(
        &mut self,
        rows: &DMatrix<f64>,
        values: &DVector<f64>,
        variances: &DVector<f64>,
    ) -> Result<(), FilterError> {
        let (first, _) = self.parameter_range();
        let sizes = [
            ("rows of observed motion", rows.ncols(), first),
            ("observed motion", values.len(), rows.nrows()),
            (
                "variances of observed motion",
                variances.len(),
                rows.nrows(),
            ),
        ];
        FilterError::check_sizes(sizes)?;
        if let Some(index) = values.iter().position(|value| !value.is_finite()) {
            return Err(FilterError::NotFinite {
                what: "observed motion",
                index,
            });
        }
        if let Some(found) = variances
            .iter()
            .find(|variance| !(**variance > 0.0 && variance.is_finite()))
        {
            let what = "variance of observed motion";
            return Err(FilterError::Setting {
                what,
                found: *found,
                allowed: "positive and finite",
            });
        }
        let state = &mut self.state;
        let n = state.mean.len();
        let mut spread = DVector::zeros(n);
        let mut gain = DVector::zeros(n);
        for (row, (value, variance)) in values.iter().zip(variances.iter()).enumerate() {
            let response = rows.row(row).transpose();
            spread.gemv(1.0, &state.covariance.columns(0, first), &response, 0.0); // P Rᵀ
            let total = response.dot(&spread.rows(0, first)) + variance;
            gain.copy_from(&spread);
            gain /= total;
            gain.rows_mut(first, n - first).fill(0.0);
            let innovation = value - response.dot(&state.mean.rows(0, first));
            state.mean.axpy(innovation, &gain, 1.0);
            // Joseph form of one row: P − K sᵀ − s Kᵀ + K t Kᵀ
            for j in 0..n {
                for i in 0..=j {
                    let change =
                        total * gain[i] * gain[j] - gain[i] * spread[j] - spread[i] * gain[j];
                    state.covariance[(i, j)] += change;
                    state.covariance[(j, i)] = state.covariance[(i, j)];
                }
            }
        }
        Ok(())
    }

    fn limit_mean(&mut self) {
        let settings = &self.settings;
        for (j, entry) in self.state.mean.iter_mut().enumerate() {
            *entry = entry.clamp(settings.lower[j], settings.upper[j]);
        }
    }

    fn parameter_range(&self) -> (usize, usize) {
        let len = self.model.parameter_len();
        (self.model.state_len() - len, len)
    }
}

/// Returns `D = Σ_rθ Σ_θθ⁻¹` (r × N_θ) from the factor of `Σ_θθ` and `Σ_θr` (N_θ × r).
fn regression(factor: &DMatrix<f64>, mut cross: DMatrix<f64>) -> DMatrix<f64> {
    solve_lower_mut(factor, cross.as_mut_slice());
    solve_lower_transposed_mut(factor, cross.as_mut_slice());
    cross.transpose()
}
