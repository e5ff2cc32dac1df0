//! The standard Kalman filter of a linear system with known matrices.
//!
//! Source: Huang & Yuen (2023), §2.2 and §2.3, equations (2.17) to (2.35). The matrices are dense.
//! The filter suits small systems and is an independent reference for the extended filter.

use crate::dense::{
    cholesky_mut, ln_determinant, solve_lower_mut, subtract_gram_mut, symmetrise_mut,
};
use crate::error::FilterError;
use nalgebra::{DMatrix, DVector};

/// A discrete linear system: `u_{i+1} = A u_i + B f_i` (2.7), `z_i = H u_i + n_i` (2.13).
#[derive(Debug, Clone, PartialEq)]
pub struct LinearModel {
    /// `A` (n × n).
    pub transition: DMatrix<f64>,
    /// `B` (n × N_f).
    pub input: DMatrix<f64>,
    /// `H` (N_0 × n).
    pub observation: DMatrix<f64>,
    /// `Σ_f` (N_f × N_f).
    pub excitation_covariance: DMatrix<f64>,
    /// `Σ_n` (N_0 × N_0).
    pub sensor_covariance: DMatrix<f64>,
}

impl LinearModel {
    /// Discretises `u̇ = A_u u + B_u f` for an excitation held over the step and returns `(A, B)`.
    ///
    /// Both are blocks of one exponential of an augmented matrix, which does not require an inverse
    /// of `A_u`. Equations (2.8) and (2.9).
    #[must_use]
    pub fn discretise(
        system: &DMatrix<f64>,
        input: &DMatrix<f64>,
        step_s: f64,
    ) -> (DMatrix<f64>, DMatrix<f64>) {
        let (n, inputs) = (system.nrows(), input.ncols());
        let mut augmented = DMatrix::zeros(n + inputs, n + inputs);
        augmented
            .view_mut((0, 0), (n, n))
            .copy_from(&(system * step_s));
        augmented
            .view_mut((0, n), (n, inputs))
            .copy_from(&(input * step_s));
        let exponential = augmented.exp();
        (
            exponential.view((0, 0), (n, n)).into_owned(),
            exponential.view((0, n), (n, inputs)).into_owned(),
        )
    }

    pub(crate) fn check(&self) -> Result<(), FilterError> {
        let (n, channels) = (self.transition.nrows(), self.observation.nrows());
        let inputs = self.input.ncols();
        let sizes = [
            ("transition matrix", self.transition.len(), n * n),
            ("input matrix", self.input.nrows(), n),
            ("observation matrix", self.observation.ncols(), n),
            (
                "excitation covariance",
                self.excitation_covariance.len(),
                inputs * inputs,
            ),
            (
                "sensor covariance",
                self.sensor_covariance.len(),
                channels * channels,
            ),
        ];
        FilterError::check_sizes(sizes)
    }
}

/// Result of one update of a [`KalmanFilter`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KalmanStep {
    /// Normalised innovation squared: `νᵀ S⁻¹ ν`, with the innovation `ν` and its covariance `S`.
    pub normalised_innovation_squared: f64,
    /// `ln p(z | D)`.
    pub log_evidence: f64,
}

/// A Kalman filter: mean and covariance of the state after the last update.
#[derive(Debug, Clone)]
pub struct KalmanFilter {
    model: LinearModel,
    mean: DVector<f64>,
    covariance: DMatrix<f64>,
    /// `B Σ_f Bᵀ` (n × n)
    process_noise: DMatrix<f64>,
    innovation: DVector<f64>,
    next_mean: DVector<f64>,
    product: DMatrix<f64>,
    h_p: DMatrix<f64>,
    factor: DMatrix<f64>,
}

impl KalmanFilter {
    /// Creates a filter from `u_{0|0}` (n) and `Σ_{0|0}` (n × n).
    ///
    /// # Errors
    /// Returns [`FilterError::Dimension`] if a size does not fit.
    pub fn new(
        model: LinearModel,
        mean: DVector<f64>,
        covariance: DMatrix<f64>,
    ) -> Result<Self, FilterError> {
        model.check()?;
        let (n, channels) = (model.transition.nrows(), model.observation.nrows());
        FilterError::check_sizes([
            ("mean", mean.len(), n),
            ("covariance", covariance.len(), n * n),
        ])?;
        let process_noise = &model.input * &model.excitation_covariance * model.input.transpose();
        Ok(Self {
            process_noise,
            innovation: DVector::zeros(channels),
            next_mean: DVector::zeros(n),
            product: DMatrix::zeros(n, n),
            h_p: DMatrix::zeros(channels, n),
            factor: DMatrix::zeros(channels, channels),
            model,
            mean,
            covariance,
        })
    }

    /// Predicts mean and covariance for the next step. `input` is the known part of the excitation
    /// (N_f).
    pub fn predict(&mut self, input: &[f64]) {
        self.next_mean
            .gemv(1.0, &self.model.transition, &self.mean, 0.0); // A u (2.17)
        for (b, known) in input.iter().enumerate() {
            self.next_mean
                .axpy(*known, &self.model.input.column(b), 1.0);
        }
        self.mean.copy_from(&self.next_mean);
        self.product
            .gemm(1.0, &self.model.transition, &self.covariance, 0.0); // A Σ
        self.product.transpose_mut();
        self.covariance
            .gemm(1.0, &self.model.transition, &self.product, 0.0); // A Σ Aᵀ
        self.covariance += &self.process_noise; // + B Σ_f Bᵀ (2.21)
        symmetrise_mut(&mut self.covariance);
    }

    /// Updates the state with the datum `z` (N_0).
    ///
    /// # Errors
    /// Returns [`FilterError::InnovationCovariance`] if the innovation covariance is not positive
    /// definite.
    pub fn update(&mut self, datum: &[f64]) -> Result<KalmanStep, FilterError> {
        let model = &self.model;
        self.innovation.copy_from_slice(datum);
        self.innovation
            .gemv(-1.0, &model.observation, &self.mean, 1.0); // ν = z − H u
        self.h_p
            .gemm(1.0, &model.observation, &self.covariance, 0.0);
        self.factor.copy_from(&model.sensor_covariance);
        self.factor
            .gemm(1.0, &self.h_p, &model.observation.transpose(), 1.0); // S (2.34)
        symmetrise_mut(&mut self.factor);
        cholesky_mut(&mut self.factor)
            .map_err(|pivot| FilterError::InnovationCovariance { pivot })?;
        solve_lower_mut(&self.factor, self.innovation.as_mut_slice());
        solve_lower_mut(&self.factor, self.h_p.as_mut_slice());
        self.mean.gemv_tr(1.0, &self.h_p, &self.innovation, 1.0); // (2.33)
        subtract_gram_mut(&mut self.covariance, &self.h_p); // (2.35)
        let normalised_innovation_squared = self.innovation.norm_squared();
        let log_evidence = -0.5
            * (datum.len() as f64 * std::f64::consts::TAU.ln()
                + ln_determinant(&self.factor)
                + normalised_innovation_squared);
        Ok(KalmanStep {
            normalised_innovation_squared,
            log_evidence,
        })
    }

    /// Returns the mean of the state (n).
    #[must_use]
    pub fn mean(&self) -> &DVector<f64> {
        &self.mean
    }

    /// Returns the covariance of the state (n × n).
    #[must_use]
    pub fn covariance(&self) -> &DMatrix<f64> {
        &self.covariance
    }
}

#[cfg(test)]
mod tests;
