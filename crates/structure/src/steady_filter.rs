//! The stationary Kalman filter of a structure whose parameters and noise levels are known.
//!
//! Predictor form, `û_{i+1} = A û_i + B f̄_i + K ν_i`, `ν_i = z_i − H û_i − D f̄_i`, with `f̄` the known part of the
//! excitation. Unlike (2.17) to (2.35) of Huang & Yuen (2023) it allows a direct term `D`, for which the noises of the
//! state and of the datum are correlated. The covariance of the prediction solves
//! `P = A P Aᵀ + B Σ_f Bᵀ − K S Kᵀ`, found by doubling (Chu, Fan, Lin & Wang 2004, *Int. J. Control* 77, 767): each
//! iteration covers twice as many steps as the one before.

use crate::linear_form::{LinearForm, Recursion};
use nalgebra::{DMatrix, DVector};

/// Doublings before giving up: 2⁶⁰ steps are for ever.
const LARGEST_DOUBLINGS: usize = 60;
/// The doubling ends when it changes the covariance by less than this share.
const CONVERGED: f64 = 1e-13;

/// Variances of the unknown excitation (N_f) and of the sensors (N_0).
#[derive(Debug, Clone)]
pub(crate) struct NoiseVariances {
    pub(crate) excitation: DVector<f64>,
    pub(crate) sensors: DVector<f64>,
}

/// A running filter with constant gain.
#[derive(Debug, Clone)]
pub(crate) struct SteadyFilter {
    recursion: Recursion,
    observation: DMatrix<f64>,
    direct: DMatrix<f64>,
    /// `K` (2 N_d × N_0)
    gain: DMatrix<f64>,
    /// `P Hᵀ S⁻¹` (2 N_d × N_0) and `Σ_f Dᵀ S⁻¹` (N_f × N_0): the updates of the state and of the excitation
    update: [DMatrix<f64>; 2],
    /// `S` (N_0 × N_0)
    pub(crate) innovation_covariance: DMatrix<f64>,
    /// `û` (2 N_d) before the coming datum
    state: DVector<f64>,
    next: DVector<f64>,
    /// `ν` (N_0) of the last datum
    pub(crate) innovation: DVector<f64>,
}

impl SteadyFilter {
    /// Makes the filter; `None` if there is no stationary one (a mode neither damped nor observed).
    pub(crate) fn new(form: &LinearForm, recursion: Recursion, noise: &NoiseVariances) -> Option<Self> {
        let (a, b) = (&recursion.transition, &recursion.input);
        let (h, d) = (&form.observation, &form.direct);
        let b_f = b * DMatrix::from_diagonal(&noise.excitation); // B Σ_f
        let d_f = d * DMatrix::from_diagonal(&noise.excitation);
        let r = &d_f * d.transpose() + DMatrix::from_diagonal(&noise.sensors); // D Σ_f Dᵀ + Σ_n
        let f_d = d_f.transpose(); // Σ_f Dᵀ
        let cross = b * &f_d;
        let r_factor = r.clone().cholesky()?;
        let r_h = r_factor.solve(h);
        let decorrelated = a - &cross * &r_h;
        let q = &b_f * b.transpose() - &cross * r_factor.solve(&cross.transpose());
        let p = doubled(decorrelated.transpose(), h.transpose() * r_h, q)?;
        let s = h * &p * h.transpose() + r;
        let s_factor = s.clone().cholesky()?;
        let over_s = |x: DMatrix<f64>| s_factor.solve(&x.transpose()).transpose(); // X S⁻¹
        let update = [over_s(&p * h.transpose()), over_s(f_d)];
        Some(Self::with_update(form, recursion, update, s))
    }

    /// Makes the filter of another structure with the updates of this one: what an extended filter differentiates.
    pub(crate) fn with_frozen_update(&self, form: &LinearForm, recursion: Recursion) -> Self {
        Self::with_update(form, recursion, self.update.clone(), self.innovation_covariance.clone())
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

    /// Takes the datum `z` (N_0) with the known excitation `f̄` (N_f) of this instant and of the next.
    pub(crate) fn step(&mut self, z: &DVector<f64>, known: &DVector<f64>, next_known: &DVector<f64>) {
        self.innovation.copy_from(z);
        self.innovation.gemv(-1.0, &self.observation, &self.state, 1.0);
        self.innovation.gemv(-1.0, &self.direct, known, 1.0);
        let Recursion { transition, input, slope } = &self.recursion;
        self.next.gemv(1.0, transition, &self.state, 0.0);
        self.next.gemv(1.0, input, known, 1.0);
        self.next.gemv(1.0, slope, next_known, 1.0);
        self.next.gemv(-1.0, slope, known, 1.0);
        self.next.gemv(1.0, &self.gain, &self.innovation, 1.0);
        std::mem::swap(&mut self.state, &mut self.next);
    }
}

/// Solves `X = Aᵀ X (I + G X)⁻¹ A + Q` for symmetric `G`, `Q`; `None` if the doubling does not settle.
fn doubled(mut a: DMatrix<f64>, mut g: DMatrix<f64>, mut q: DMatrix<f64>) -> Option<DMatrix<f64>> {
    let n = a.nrows();
    for _ in 0..LARGEST_DOUBLINGS {
        let factor = (DMatrix::identity(n, n) + &g * &q).lu();
        let w_a = factor.solve(&a)?; // W⁻¹ A
        let w_g = factor.solve(&g)?; // W⁻¹ G
        let change = a.transpose() * (&q * &w_a);
        g += &a * w_g * a.transpose();
        a = &a * w_a;
        q += &change;
        q = (&q + q.transpose()) * 0.5;
        g = (&g + g.transpose()) * 0.5;
        let size = q.norm();
        if !size.is_finite() {
            return None;
        }
        if change.norm() <= CONVERGED * size {
            return Some(q);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A scalar with `a = 1`, unit noises: `P² = P + 1`, the golden ratio.
    #[test]
    fn a_random_walk_has_the_golden_ratio_as_its_variance() {
        let one = || DMatrix::from_element(1, 1, 1.0);
        let p = doubled(one(), one(), one()).unwrap();
        assert!((p[(0, 0)] - (1.0 + 5.0_f64.sqrt()) / 2.0).abs() < 1e-12);
    }
}
