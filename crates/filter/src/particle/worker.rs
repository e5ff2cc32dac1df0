//! One step of one particle: the importance density in the space of the disturbance.
//!
//! Source: Ching, Beck, Porter & Shaikhutdinov (2006), weights of equation (10), written for `w`
//! instead of `x_k`. The Jacobian of `w ↦ x_k` cancels, because it occurs in numerator and
//! denominator. All quantities are whitened by `L Lᵀ = R`: `r = L⁻¹ (ŷ − y₀)`, `J̃ = L⁻¹ J`
//! (q × l), `S̃ = I + J̃ J̃ᵀ`. Hence `|S̃| = |S|/|R|` and `P⁻¹ = I + J̃ᵀ J̃`.

use super::model::{DifferenceWorkspace, Interval, ParticleModel};
use super::settings::ImportanceDensity;
use crate::dense::{cholesky_mut, ln_determinant, solve_lower_mut, solve_lower_transposed_mut};
use nalgebra::{DMatrix, DVector};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// A model with the scratch space of one thread.
#[derive(Debug, Clone)]
pub(super) struct Worker<M> {
    pub(super) model: M,
    differences: DifferenceWorkspace,
    /// y (q).
    output: DVector<f64>,
    /// r (q).
    residual: DVector<f64>,
    /// v₀ (q).
    noise: DVector<f64>,
    /// J, then J̃ (q × l).
    jacobian: DMatrix<f64>,
    /// R, then L (q × q).
    sensors: DMatrix<f64>,
    /// S̃, then its factor (q × q).
    innovation: DMatrix<f64>,
    /// w, μ, then δ (l).
    disturbance: DVector<f64>,
    centre: DVector<f64>,
    /// z for a draw of a whole state (n).
    pub(super) normals: Vec<f64>,
}

impl<M: ParticleModel> Worker<M> {
    pub(super) fn new(model: M) -> Self {
        let (l, q) = (model.disturbance_len(), model.observation_len());
        Self {
            differences: DifferenceWorkspace::new(&model),
            output: DVector::zeros(q),
            residual: DVector::zeros(q),
            noise: DVector::zeros(q),
            jacobian: DMatrix::zeros(q, l),
            sensors: DMatrix::zeros(q, q),
            innovation: DMatrix::zeros(q, q),
            disturbance: DVector::zeros(l),
            centre: DVector::zeros(l),
            normals: vec![0.0; model.state_len()],
            model,
        }
    }

    /// Draws standard normal numbers for a whole state.
    pub(super) fn draw_normals(&mut self, rng: &mut ChaCha8Rng) {
        fill_normal(&mut self.normals, rng);
    }

    /// Moves a particle to the frame `datum` (q, NaN where missing) and returns the logarithm of
    /// its weight factor.
    ///
    /// Minus infinity removes the particle. `predicted` (q) becomes a draw from the particle's
    /// prediction of the frame without sensor noise: `y₀ + J w` with `w` from its prior.
    pub(super) fn advance(
        &mut self,
        density: ImportanceDensity,
        interval: Interval<'_>,
        datum: &[f64],
        rng: &mut ChaCha8Rng,
        state: &mut [f64],
        predicted: &mut [f64],
    ) -> f64 {
        fill_normal(self.disturbance.as_mut_slice(), rng);
        let correction = match density {
            ImportanceDensity::Prior => 0.0,
            ImportanceDensity::Optimal => self.draw_optimal(interval, datum, rng, state, predicted),
        };
        self.model
            .propagate(interval, self.disturbance.as_slice(), state);
        if !state.iter().all(|value| value.is_finite()) {
            return f64::NEG_INFINITY;
        }
        let weight = correction + self.log_likelihood(interval, datum, state);
        if density == ImportanceDensity::Prior {
            predicted.copy_from_slice(self.output.as_slice());
        }
        if weight.is_finite() {
            weight
        } else {
            f64::NEG_INFINITY
        }
    }

    /// Moves the disturbance from its prior to the density of one extended Kalman step; returns
    /// `ln p(w) − ln q(w)`.
    fn draw_optimal(
        &mut self,
        interval: Interval<'_>,
        datum: &[f64],
        rng: &mut ChaCha8Rng,
        state: &[f64],
        predicted: &mut [f64],
    ) -> f64 {
        fill_normal(self.noise.as_mut_slice(), rng);
        self.model.linearise(
            interval,
            state,
            self.output.as_mut_slice(),
            &mut self.jacobian,
            &mut self.differences,
        );
        for (j, predicted) in predicted.iter_mut().enumerate() {
            let moved = self
                .jacobian
                .row(j)
                .iter()
                .zip(self.disturbance.iter())
                .map(|(a, b)| a * b)
                .sum::<f64>();
            *predicted = self.output[j] + moved; // y₀ + J w₀
        }
        if self.whiten_residual(datum, state).is_none() || !self.whiten_jacobian(datum) {
            return 0.0; // no valid density from here; the prior is always correct
        }
        let Self {
            residual,
            noise,
            jacobian,
            innovation,
            disturbance,
            centre,
            ..
        } = self;
        let q = residual.len();
        for b in 0..q {
            for a in 0..q {
                let product: f64 = jacobian
                    .row(a)
                    .iter()
                    .zip(jacobian.row(b).iter())
                    .map(|(a, b)| a * b)
                    .sum();
                // S̃ = I + J̃ J̃ᵀ
                innovation[(a, b)] = if a == b { 1.0 + product } else { product };
            }
        }
        if cholesky_mut(innovation).is_err() {
            return 0.0;
        }
        for (noise, residual) in noise.iter_mut().zip(residual.iter()) {
            *noise = residual - *noise;
        }
        noise.gemv(-1.0, jacobian, disturbance, 1.0); // r − J̃ w₀ − v₀
        for vector in [&mut *noise, &mut *residual] {
            solve_lower_mut(innovation, vector.as_mut_slice());
            solve_lower_transposed_mut(innovation, vector.as_mut_slice());
        }
        disturbance.gemv_tr(1.0, jacobian, noise, 1.0); // w = w₀ + K (ŷ − y₀ − J w₀ − v₀)
        centre.gemv_tr(1.0, jacobian, residual, 0.0); // μ = K (ŷ − y₀)
        let prior = disturbance.norm_squared();
        centre.axpy(1.0, disturbance, -1.0); // δ = w − μ
        noise.gemv(1.0, jacobian, centre, 0.0);
        let drawn = centre.norm_squared() + noise.norm_squared(); // δᵀ P⁻¹ δ
        0.5 * (drawn - prior - ln_determinant(innovation))
    }

    /// Returns `ln N(ŷ; h(x_k), R(x_k))` over the available channels.
    fn log_likelihood(&mut self, interval: Interval<'_>, datum: &[f64], state: &[f64]) -> f64 {
        self.model
            .observe(interval, state, self.output.as_mut_slice());
        match self.whiten_residual(datum, state) {
            None => f64::NEG_INFINITY,
            Some(ln_determinant) => {
                let used = datum.iter().filter(|value| !value.is_nan()).count() as f64;
                -0.5 * (self.residual.norm_squared()
                    + ln_determinant
                    + used * std::f64::consts::TAU.ln())
            }
        }
    }

    /// Computes `L` and `r` for the current output and the noise levels of `state`; returns
    /// `ln|R|`.
    ///
    /// A missing channel becomes a row of the identity in `R` with zero residual. Returns `None` if
    /// `R` is not positive definite.
    fn whiten_residual(&mut self, datum: &[f64], state: &[f64]) -> Option<f64> {
        let Self {
            model,
            output,
            residual,
            sensors,
            ..
        } = self;
        model.sensor_covariance(state, sensors);
        for j in 0..datum.len() {
            if datum[j].is_nan() {
                sensors.row_mut(j).fill(0.0);
                sensors.column_mut(j).fill(0.0);
                sensors[(j, j)] = 1.0;
                residual[j] = 0.0;
            } else {
                residual[j] = datum[j] - output[j];
            }
        }
        cholesky_mut(sensors).ok()?;
        solve_lower_mut(sensors, residual.as_mut_slice());
        Some(ln_determinant(sensors))
    }

    /// Replaces `J` by `J̃`; returns `true` if `J̃` and the residual are finite.
    fn whiten_jacobian(&mut self, datum: &[f64]) -> bool {
        for (j, value) in datum.iter().enumerate() {
            if value.is_nan() {
                self.jacobian.row_mut(j).fill(0.0);
            }
        }
        solve_lower_mut(&self.sensors, self.jacobian.as_mut_slice());
        self.residual
            .iter()
            .chain(self.jacobian.iter())
            .all(|value| value.is_finite())
    }
}

fn fill_normal(values: &mut [f64], rng: &mut ChaCha8Rng) {
    for value in values {
        *value = StandardNormal.sample(rng);
    }
}
