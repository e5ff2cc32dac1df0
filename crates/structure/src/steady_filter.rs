//! Stationary Kalman filter of a structure with known parameters and noise levels, and its
//! derivatives with respect to them.
//!
//! Predictor form, `û_{i+1} = A û_i + B f̄_i + K ν_i`, `ν_i = z_i − H û_i − D f̄_i`, where `f̄` is
//! the known part of the excitation. Unlike (2.17) to (2.35) of Huang & Yuen (2023), it allows a
//! direct term `D`. The noises of the state and of the datum are then correlated. The covariance of
//! the prediction solves `P = A P Aᵀ + B Σ_f Bᵀ − K S Kᵀ` and is computed by doubling.
//!
//! With `Ā = A − K H` and `B̄ = B − K D`, this equation is `P = Ā P Āᵀ + B̄ Σ_f B̄ᵀ + K Σ_n Kᵀ`.
//! The gain minimises `P`, so that a small change of the gain does not change it. The derivative is
//! therefore the solution of `∂P = Ā ∂P Āᵀ + W`, where `W` contains the derivatives of all matrices
//! at a constant gain.

use crate::linear_form::{LinearForm, Recursion};
use nalgebra::{Cholesky, DMatrix, DVector, Dyn};
use spandrel_filter::steady::riccati_by_doubling;

/// Largest number of doublings of the closed loop, each of which squares `Ā`.
const MOST_DOUBLINGS: usize = 60;

/// Norm of a power `M` of `Ā` below which `M X Mᵀ` is below the rounding of `X`.
const FADED: f64 = 1e-8;

/// Covariance of the unknown excitation (N_f × N_f) and variances of the sensors (N_0).
#[derive(Debug, Clone)]
pub(crate) struct NoiseCovariances {
    pub(crate) excitation: DMatrix<f64>,
    pub(crate) sensors: DVector<f64>,
}

impl NoiseCovariances {
    /// Returns the contribution to the covariance of a datum with the direct terms `d` (N_0 × N_f).
    fn seen_through(&self, d: &DMatrix<f64>) -> DMatrix<f64> {
        d * &self.excitation * d.transpose() + DMatrix::from_diagonal(&self.sensors)
    }

    /// Returns the covariance `U` of a datum that arises within one step (N_0 × N_0).
    pub(crate) fn within_a_step(&self, model: &SampledModel) -> DMatrix<f64> {
        let h_b = &model.observation * &model.recursion.input;
        &h_b * &self.excitation * h_b.transpose() + self.seen_through(&model.direct)
    }
}

/// A structure with known parameters from frame to frame, or the derivative of its matrices.
#[derive(Debug, Clone)]
pub(crate) struct SampledModel {
    pub(crate) recursion: Recursion,
    /// `H` (N_0 × 2 N_d).
    pub(crate) observation: DMatrix<f64>,
    /// `D` (N_0 × N_f).
    pub(crate) direct: DMatrix<f64>,
}

impl SampledModel {
    pub(crate) fn new(form: LinearForm, recursion: Recursion) -> Self {
        Self {
            recursion,
            observation: form.observation,
            direct: form.direct,
        }
    }

    /// Returns the difference to another model, divided by `distance`.
    pub(crate) fn difference(mut self, from: &Self, distance: f64) -> Self {
        let pairs = [
            (&mut self.recursion.transition, &from.recursion.transition),
            (&mut self.recursion.input, &from.recursion.input),
            (&mut self.recursion.slope, &from.recursion.slope),
            (&mut self.observation, &from.observation),
            (&mut self.direct, &from.direct),
        ];
        for (to, from) in pairs {
            *to -= from;
            *to /= distance;
        }
        self
    }
}

/// A running filter with constant gain.
#[derive(Debug, Clone)]
pub(crate) struct SteadyFilter {
    model: SampledModel,
    noise: NoiseCovariances,
    /// `P` (2 N_d × 2 N_d).
    covariance: DMatrix<f64>,
    /// `K` (2 N_d × N_0).
    gain: DMatrix<f64>,
    /// `P Hᵀ S⁻¹` (2 N_d × N_0) and `Σ_f Dᵀ S⁻¹` (N_f × N_0), the updates of state and excitation.
    update: [DMatrix<f64>; 2],
    /// `S` (N_0 × N_0), and its factor.
    pub(crate) innovation_covariance: DMatrix<f64>,
    s_factor: Cholesky<f64, Dyn>,
    /// `Ā`, `Ā²`, `Ā⁴` and so on, until nothing is left, and `B̄` (2 N_d × N_f).
    closed_powers: Vec<DMatrix<f64>>,
    closed_input: DMatrix<f64>,
    /// `û` (2 N_d) before the next datum.
    pub(crate) state: DVector<f64>,
    next: DVector<f64>,
    /// `ν` (N_0) of the last datum.
    pub(crate) innovation: DVector<f64>,
}

/// Derivative of a filter with respect to a parameter or the logarithm of a noise variance.
///
/// `∂û_{i+1} = Ā ∂û_i + (∂A − K ∂H) û_i + (∂B − K ∂D) f̄_i + ∂B₁ (f̄_{i+1} − f̄_i) + ∂K ν_i` and
/// `∂ν_i = −H ∂û_i − ∂H û_i − ∂D f̄_i`.
#[derive(Debug, Clone)]
pub(crate) struct Tangent {
    /// `[∂A − K ∂H, ∂B − K ∂D, ∂B₁; −∂H, −∂D, 0]`, the effect of `[û_i, f̄_i, f̄_{i+1} − f̄_i]` on
    /// `[∂û_{i+1}, ∂ν_i]`. `None` for a noise level.
    pub(crate) by_motion: Option<DMatrix<f64>>,
    /// `∂K` (2 N_d × N_0).
    pub(crate) gain: DMatrix<f64>,
    /// `∂K` of the extended filter, which holds its updates constant, minus [`Self::gain`]. `None`
    /// for a noise level.
    pub(crate) held_gain: Option<DMatrix<f64>>,
    /// `∂S` (N_0 × N_0).
    pub(crate) innovation_covariance: DMatrix<f64>,
}

impl SteadyFilter {
    /// Creates the filter; `None` if no stationary filter exists (a mode neither damped nor
    /// observed).
    pub(crate) fn new(model: SampledModel, noise: NoiseCovariances) -> Option<Self> {
        let Recursion {
            transition: a,
            input: b,
            ..
        } = &model.recursion;
        let (h, d) = (&model.observation, &model.direct);
        let b_f = b * &noise.excitation; // B Σ_f
        let r = noise.seen_through(d); // D Σ_f Dᵀ + Σ_n
        let f_d = &noise.excitation * d.transpose(); // Σ_f Dᵀ
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
        let gain = a * &update[0] + b * &update[1];
        Some(Self {
            closed_powers: powers(a - &gain * h)?,
            closed_input: b - &gain * d,
            gain,
            update,
            state: DVector::zeros(a.nrows()),
            next: DVector::zeros(a.nrows()),
            innovation: DVector::zeros(s.nrows()),
            innovation_covariance: s,
            s_factor,
            covariance: p,
            noise,
            model,
        })
    }

    /// Returns `A`, `B`, `H` and `D`.
    pub(crate) fn model(&self) -> &SampledModel {
        &self.model
    }

    /// Returns `Ā` (2 N_d × 2 N_d).
    pub(crate) fn closed(&self) -> &DMatrix<f64> {
        &self.closed_powers[0]
    }

    /// Returns the derivative with respect to a parameter that changes the model by `slope`.
    pub(crate) fn by_parameter(&self, slope: &SampledModel) -> Tangent {
        let (p, f, k) = (&self.covariance, &self.noise.excitation, &self.gain);
        let (h, d) = (&self.model.observation, &self.model.direct);
        let Recursion {
            transition: da,
            input: db,
            slope: db1,
        } = &slope.recursion;
        let (dh, dd) = (&slope.observation, &slope.direct);
        let (state, input) = (da - k * dh, db - k * dd); // ∂Ā and ∂B̄ at constant K
        let w = twice(&state * p * self.closed().transpose())
            + twice(&input * f * self.closed_input.transpose());
        let [p_h, f_d] = [p * h.transpose(), f * d.transpose()];
        let direct_s = twice(dh * &p_h) + twice(dd * &f_d);
        let Recursion {
            transition: a,
            input: b,
            ..
        } = &self.model.recursion;
        // ∂(K S) at constant P, with K S = A P Hᵀ + B Σ_f Dᵀ
        let direct_k = da * &p_h + a * (p * dh.transpose()) + db * &f_d + b * (f * dd.transpose());
        let mut tangent = self.tangent(w, direct_s, direct_k);
        let held = da * &self.update[0] + db * &self.update[1];
        tangent.held_gain = Some(held - &tangent.gain);
        let (n, rows, inputs) = (h.ncols(), h.nrows(), d.ncols());
        let mut by_motion = DMatrix::zeros(n + rows, n + 2 * inputs);
        let blocks = [
            (0, 0, state),
            (0, n, input),
            (0, n + inputs, db1.clone()),
            (n, 0, -dh),
            (n, n, -dd),
        ];
        for (row, column, block) in blocks {
            let mut place = by_motion.view_mut((row, column), block.shape());
            place.copy_from(&block);
        }
        tangent.by_motion = Some(by_motion);
        tangent
    }

    /// Returns the derivative with respect to the logarithm of a variance that contributes `part`.
    pub(crate) fn by_level(&self, part: &NoiseCovariances) -> Tangent {
        let (b, d) = (&self.model.recursion.input, &self.model.direct);
        let (k, closed) = (&self.gain, &self.closed_input);
        let of_sensors = k * DMatrix::from_diagonal(&part.sensors) * k.transpose();
        let w = closed * &part.excitation * closed.transpose() + of_sensors;
        let direct_k = b * (&part.excitation * d.transpose());
        self.tangent(w, part.seen_through(d), direct_k)
    }

    /// Returns the derivative from `W`, and from the parts of `∂S` and `∂(K S)` at constant `P`.
    fn tangent(
        &self,
        mut w: DMatrix<f64>,
        direct_s: DMatrix<f64>,
        direct_k: DMatrix<f64>,
    ) -> Tangent {
        for power in &self.closed_powers {
            w += power * &w * power.transpose(); // ∂P = Σ Āⁱ W Āⁱᵀ
        }
        let p_h = w * self.model.observation.transpose(); // ∂P Hᵀ
        let s = direct_s + &self.model.observation * &p_h;
        let k = direct_k + &self.model.recursion.transition * p_h - &self.gain * &s; // ∂K S
        Tangent {
            by_motion: None,
            gain: self.s_factor.solve(&k.transpose()).transpose(),
            held_gain: None,
            innovation_covariance: s,
        }
    }

    /// Returns this filter with the updates of another, as the extended filter uses it.
    #[cfg(test)]
    pub(crate) fn with_updates_of(&self, other: &Self) -> Self {
        let Recursion {
            transition: a,
            input: b,
            ..
        } = &self.model.recursion;
        Self {
            gain: a * &other.update[0] + b * &other.update[1],
            ..self.clone()
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
        let SampledModel {
            recursion,
            observation,
            direct,
        } = &self.model;
        self.innovation.copy_from(z);
        self.innovation.gemv(-1.0, observation, &self.state, 1.0);
        self.innovation.gemv(-1.0, direct, known, 1.0);
        let Recursion {
            transition,
            input,
            slope,
        } = recursion;
        self.next.gemv(1.0, transition, &self.state, 0.0);
        self.next.gemv(1.0, input, known, 1.0);
        self.next.gemv(1.0, slope, next_known, 1.0);
        self.next.gemv(-1.0, slope, known, 1.0);
        self.next.gemv(1.0, &self.gain, &self.innovation, 1.0);
        std::mem::swap(&mut self.state, &mut self.next);
    }
}

/// Returns `X + Xᵀ`.
fn twice(x: DMatrix<f64>) -> DMatrix<f64> {
    let transposed = x.transpose();
    x + transposed
}

/// Returns `X`, `X²`, `X⁴` and so on; `None` if they do not fade, because `X` is not stable.
fn powers(x: DMatrix<f64>) -> Option<Vec<DMatrix<f64>>> {
    let mut powers = vec![x];
    while powers.len() < MOST_DOUBLINGS {
        let last = &powers[powers.len() - 1];
        let size = last.norm();
        if size < FADED {
            return Some(powers);
        }
        if !size.is_finite() {
            return None;
        }
        powers.push(last * last);
    }
    None
}
