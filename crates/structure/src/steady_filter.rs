//! Stationary Kalman filter of a structure with known parameters and noise levels.
//!
//! Predictor form, `û_{i+1} = A û_i + B f̄_i + K ν_i`, `ν_i = z_i − H û_i − D f̄_i`, where `f̄` is
//! the known part of the excitation. Unlike (2.17) to (2.35) of Huang & Yuen (2023), it allows a
//! direct term `D`. The noises of the state and of the datum are then correlated. The covariance of
//! the prediction solves `P = A P Aᵀ + B Σ_f Bᵀ − K S Kᵀ` and is computed by doubling.

use crate::linear_form::{LinearForm, Recursion};
use nalgebra::{DMatrix, DVector};
use spandrel_filter::steady::riccati_by_doubling;

/// Covariance of the unknown excitation (N_f × N_f) and variances of the sensors (N_0).
#[derive(Debug, Clone)]
pub(crate) struct NoiseCovariances {
    pub(crate) excitation: DMatrix<f64>,
    pub(crate) sensors: DVector<f64>,
}

/// A running filter with constant gain.
#[derive(Debug, Clone)]
pub(crate) struct SteadyFilter {
    recursion: Recursion,
    observation: DMatrix<f64>,
    direct: DMatrix<f64>,
    /// `K` (2 N_d × N_0).
    gain: DMatrix<f64>,
    /// `P Hᵀ S⁻¹` (2 N_d × N_0) and `Σ_f Dᵀ S⁻¹` (N_f × N_0), the updates of state and excitation.
    update: [DMatrix<f64>; 2],
    /// `S` (N_0 × N_0).
    pub(crate) innovation_covariance: DMatrix<f64>,
    /// `û` (2 N_d) before the next datum.
    state: DVector<f64>,
    next: DVector<f64>,
    /// `ν` (N_0) of the last datum.
    pub(crate) innovation: DVector<f64>,
}

impl SteadyFilter {
    /// Creates the filter; `None` if no stationary filter exists (a mode neither damped nor
    /// observed).
    pub(crate) fn new(
        form: &LinearForm,
        recursion: Recursion,
        noise: &NoiseCovariances,
    ) -> Option<Self> {
        let (a, b) = (&recursion.transition, &recursion.input);
        let (h, d) = (&form.observation, &form.direct);
        let b_f = b * &noise.excitation; // B Σ_f
        let d_f = d * &noise.excitation;
        let r = &d_f * d.transpose() + DMatrix::from_diagonal(&noise.sensors); // D Σ_f Dᵀ + Σ_n
        let f_d = d_f.transpose(); // Σ_f Dᵀ
        let cross = b * &f_d;
        let r_factor = r.clone().cholesky()?;
        let r_h = r_factor.solve(h);
        let decorrelated = a - &cross * &r_h;
        let q = &b_f * b.transpose() - &cross * r_factor.solve(&cross.transpose());
        let p = riccati_by_doubling(decorrelated.transpose(), h.transpose() * r_h, q)?;
        let s = h * &p * h.transpose() + r;
        let s_factor = s.clone().cholesky()?;
        let over_s = |x: DMatrix<f64>| s_factor.solve(&x.transpose()).transpose(); // X S⁻¹
        let update = [over_s(&p * h.transpose()), over_s(f_d)];
        Some(Self::with_update(form, recursion, update, s))
    }

    /// Creates the filter of another structure with the updates of this filter.
    ///
    /// An extended filter differentiates such a filter.
    pub(crate) fn with_frozen_update(&self, form: &LinearForm, recursion: Recursion) -> Self {
        Self::with_update(
            form,
            recursion,
            self.update.clone(),
            self.innovation_covariance.clone(),
        )
    }

    fn with_update(
        form: &LinearForm,
        recursion: Recursion,
        update: [DMatrix<f64>; 2],
        innovation_covariance: DMatrix<f64>,
    ) -> Self {
        let (n, rows) = (form.system.nrows(), form.observation.nrows());
        Self {
            observation: form.observation.clone(),
            direct: form.direct.clone(),
            gain: &recursion.transition * &update[0] + &recursion.input * &update[1],
            update,
            innovation_covariance,
            recursion,
            state: DVector::zeros(n),
            next: DVector::zeros(n),
            innovation: DVector::zeros(rows),
        }
    }

    /// Processes the datum `z` (N_0) with the known excitation `f̄` (N_f) of this and the next
    /// frame.
    pub(crate) fn step(
        &mut self,
        z: &DVector<f64>,
        known: &DVector<f64>,
        next_known: &DVector<f64>,
    ) {
        self.innovation.copy_from(z);
        self.innovation
            .gemv(-1.0, &self.observation, &self.state, 1.0);
        self.innovation.gemv(-1.0, &self.direct, known, 1.0);
        let Recursion {
            transition,
            input,
            slope,
        } = &self.recursion;
        self.next.gemv(1.0, transition, &self.state, 0.0);
        self.next.gemv(1.0, input, known, 1.0);
        self.next.gemv(1.0, slope, next_known, 1.0);
        self.next.gemv(-1.0, slope, known, 1.0);
        self.next.gemv(1.0, &self.gain, &self.innovation, 1.0);
        std::mem::swap(&mut self.state, &mut self.next);
    }
}
