//! A textbook filter for comparison, with a matrix exponential and dense products at every step.
//!
//! Notation: Huang & Yuen (2023), §2.4: `A = exp(A_y Δt)` (2.54), `P = λ (A Σ Aᵀ + B Σ_f Bᵀ)`
//! (2.61), gain `G = P Hᵀ (H P Hᵀ + Σ_n)⁻¹` (2.68), `Σ = (I − GH) P` (2.70). The noise covariances
//! are known.

use nalgebra::{Cholesky, DMatrix, DVector};
use spandrel_filter::{FilterSettings, ObservationModel, ProcessModel};

/// An extended Kalman filter that does not exploit the structure of the Jacobian.
#[derive(Debug, Clone)]
pub struct DenseFilter<M> {
    model: M,
    settings: FilterSettings,
    mean: DVector<f64>,
    covariance: DMatrix<f64>,
    fresh: bool,
}

impl<M: ProcessModel + ObservationModel> DenseFilter<M> {
    /// Creates a filter at its prior. It uses the time step, prior, fading and known noise
    /// covariances of `settings`.
    pub fn new(model: M, settings: FilterSettings) -> Self {
        let mean = settings.prior_mean.clone();
        let covariance = DMatrix::from_diagonal(&settings.prior_std.map(|std| std * std));
        Self {
            model,
            settings,
            mean,
            covariance,
            fresh: true,
        }
    }

    /// Processes the samples of one frame (N_0). No sample may be missing, and no excitation is
    /// known.
    ///
    /// Returns `None` if the innovation covariance is not positive definite.
    pub fn step(&mut self, samples: &[f64]) -> Option<()> {
        let n = self.mean.len();
        let at_rest = vec![0.0; self.model.excitation_len()];
        if !self.fresh {
            self.predict(&at_rest);
        }
        self.fresh = false;
        self.model
            .linearise_observation(self.mean.as_slice(), &at_rest);
        let mut h = DMatrix::zeros(samples.len(), n);
        self.model
            .observation_jacobian_mul(&DMatrix::identity(n, n), &mut h);
        let mut innovation = DVector::zeros(samples.len());
        self.model.observe(innovation.as_mut_slice());
        innovation = DVector::from_column_slice(samples) - innovation;
        let p_ht = &self.covariance * h.transpose();
        let s = &h * &p_ht + &self.settings.noise.sensors;
        let gain = Cholesky::new(s)?.solve(&p_ht.transpose()).transpose();
        self.mean += &gain * innovation;
        self.covariance = (DMatrix::identity(n, n) - gain * h) * &self.covariance;
        self.covariance = 0.5 * (&self.covariance + self.covariance.transpose());
        Some(())
    }

    fn predict(&mut self, at_rest: &[f64]) {
        let (n, inputs) = (self.mean.len(), self.model.excitation_len());
        self.model.linearise_process(self.mean.as_slice(), at_rest);
        // The exponential of [[A_y, g, B_y], [0, 0, 0]] Δt contains the transition and the
        // integrals of the inputs.
        let mut augmented = DMatrix::zeros(n + 1 + inputs, n + 1 + inputs);
        let mut jacobian = DMatrix::zeros(n, n);
        self.model
            .jacobian_mul(&DMatrix::identity(n, n), &mut jacobian);
        let mut rate = DVector::zeros(n);
        self.model.derivative(rate.as_mut_slice());
        let mut input = DMatrix::zeros(n, inputs);
        self.model.excitation_matrix(&mut input);
        augmented.view_mut((0, 0), (n, n)).copy_from(&jacobian);
        augmented.column_mut(n).rows_mut(0, n).copy_from(&rate);
        augmented
            .view_mut((0, n + 1), (n, inputs))
            .copy_from(&input);
        let exponential = (augmented * self.settings.step_s).exp();
        let transition = exponential.view((0, 0), (n, n));
        let input = exponential.view((0, n + 1), (n, inputs));
        self.mean += exponential.column(n).rows(0, n);
        let noise = input * &self.settings.noise.excitation * input.transpose();
        self.covariance = self.settings.fading.value()
            * (transition * &self.covariance * transition.transpose() + noise);
    }

    /// Returns the filtered state `y` (n).
    pub fn mean(&self) -> &DVector<f64> {
        &self.mean
    }

    /// Returns the covariance of the filtered state (n × n).
    pub fn covariance(&self) -> &DMatrix<f64> {
        &self.covariance
    }
}
