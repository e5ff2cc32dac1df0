//! A chain of masses with yielding springs: the Bouc–Wen system as the source prints it, with `r`
//! driven by the velocity of its mass.
//!
//! An alternative to the kind `bouc-wen` of the structure file, for the chains of the examples
//! only.
//!
//! Source: Huang & Yuen (2023), §2.4.3: `M ẍ + C ẋ + F(r) = T f` (2.87),
//! `ṙ = u − μ|u||r|^(η−1) r − κ u |r|^η` (2.88). Nothing depends on the displacements, which
//! velocity sensors cannot observe. The state therefore omits them:
//! `y = [ẋ, r, θ_k, θ_α, θ_β, θ_μ, θ_κ, θ_η]`. All parameters are ratios to nominal.

use nalgebra::DMatrix;
use spandrel_filter::{ObservationModel, ProcessModel};

/// Threshold below which `|r|^η` and its logarithm count as zero (m).
const TINY: f64 = 1e-12;

/// Number of parameters after the stiffness groups: `α`, `β`, `μ`, `κ`, `η`.
pub(crate) const SHAPE_PARAMETERS: usize = 5;

/// A chain that is fixed at the bottom and free at the top, listed from the bottom up.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct BoucWenChain {
    /// Mass of each degree of freedom (kg).
    pub(crate) masses_kg: Vec<f64>,
    /// Stiffness of each spring (N/m).
    pub(crate) stiffnesses_n_per_m: Vec<f64>,
    /// Springs (from 0) of each stiffness parameter. Every spring belongs to exactly one.
    pub(crate) groups: Vec<Vec<usize>>,
    /// `α` (1/s) of Rayleigh damping.
    pub(crate) alpha_per_s: f64,
    /// `β` (s) of Rayleigh damping.
    pub(crate) beta_s: f64,
    /// `μ` (m^−η).
    pub(crate) mu: f64,
    /// `κ` (m^−η).
    pub(crate) kappa: f64,
    /// `η`.
    pub(crate) eta: f64,
    /// Degrees of freedom (from 0) whose velocities relative to the ground are observed.
    pub(crate) sensed: Vec<usize>,
}

/// Process and observation model of a [`BoucWenChain`] under ground acceleration.
#[derive(Debug, Clone)]
pub(crate) struct BoucWenModel {
    chain: BoucWenChain,
    group_of: Vec<usize>,
    state: Vec<f64>,
    observed: Vec<f64>,
    ground: f64,
    /// Derivatives `∂ṙ/∂(u, r, θ_μ, θ_κ, θ_η)` of each mass.
    slopes: Vec<[f64; 5]>,
}

/// Parts of a state vector.
struct Parts<'a> {
    v: &'a [f64],
    r: &'a [f64],
    theta: &'a [f64],
    shape: &'a [f64],
}

fn sign(value: f64) -> f64 {
    if value == 0.0 { 0.0 } else { value.signum() }
}

/// Returns `|r|^exponent`, also at 0.
fn power(r: f64, exponent: f64) -> f64 {
    if r.abs() < TINY {
        0.0
    } else {
        r.abs().powf(exponent)
    }
}

impl BoucWenModel {
    /// Creates the model. Returns `None` unless each mass has one spring, each spring is in exactly
    /// one group, and the sensed degrees of freedom exist.
    #[must_use]
    pub(crate) fn new(chain: BoucWenChain) -> Option<Self> {
        let masses = chain.masses_kg.len();
        let mut group_of = vec![usize::MAX; masses];
        for (group, springs) in chain.groups.iter().enumerate() {
            for spring in springs {
                let slot = group_of.get_mut(*spring)?;
                if *slot != usize::MAX {
                    return None;
                }
                *slot = group;
            }
        }
        let whole = chain.stiffnesses_n_per_m.len() == masses
            && !group_of.contains(&usize::MAX)
            && chain.sensed.iter().all(|dof| *dof < masses);
        whole.then(|| {
            let len = 2 * masses + chain.groups.len() + SHAPE_PARAMETERS;
            Self {
                group_of,
                state: vec![0.0; len],
                observed: vec![0.0; chain.sensed.len()],
                ground: 0.0,
                slopes: vec![[0.0; 5]; masses],
                chain,
            }
        })
    }

    fn masses(&self) -> usize {
        self.chain.masses_kg.len()
    }

    fn parts<'a>(&self, state: &'a [f64]) -> Parts<'a> {
        let (motion, parameters) = state.split_at(2 * self.masses());
        let (v, r) = motion.split_at(self.masses());
        let (theta, shape) = parameters.split_at(self.chain.groups.len());
        Parts { v, r, theta, shape }
    }

    /// Returns the force of spring `j` from the drift of `s`, for values `s` at the masses and a
    /// factor for each group.
    fn by_drift(&self, theta: &[f64], s: &[f64], j: usize) -> f64 {
        let below = if j > 0 { s[j - 1] } else { 0.0 };
        theta[self.group_of[j]] * self.chain.stiffnesses_n_per_m[j] * (s[j] - below)
    }

    /// Returns `−F/m` on mass `i` for the spring forces that `force` returns.
    fn acceleration(&self, i: usize, force: impl Fn(usize) -> f64) -> f64 {
        let above = if i + 1 < self.masses() {
            force(i + 1)
        } else {
            0.0
        };
        (above - force(i)) / self.chain.masses_kg[i]
    }
}

impl ProcessModel for BoucWenModel {
    fn state_len(&self) -> usize {
        self.state.len()
    }

    fn parameter_len(&self) -> usize {
        self.chain.groups.len() + SHAPE_PARAMETERS
    }

    fn excitation_len(&self) -> usize {
        1
    }

    fn linearise_process(&mut self, state: &[f64], excitation: &[f64]) {
        self.state.copy_from_slice(state);
        self.ground = excitation[0];
        for i in 0..self.masses() {
            let Parts { v, r, shape, .. } = self.parts(&self.state);
            let BoucWenChain { mu, kappa, eta, .. } = self.chain;
            let (mu_now, kappa_now, eta_now) = (mu * shape[2], kappa * shape[3], eta * shape[4]);
            let (u, r) = (v[i], r[i]);
            let (strength, weaker) = (power(r, eta_now), power(r, eta_now - 1.0));
            let (su, sr) = (sign(u), sign(r));
            let logarithm = if r.abs() < TINY {
                0.0
            } else {
                strength * r.abs().ln()
            };
            self.slopes[i] = [
                1.0 - (mu_now * su * sr + kappa_now) * strength,
                -eta_now * (mu_now * u.abs() + kappa_now * u * sr) * weaker,
                -mu * u.abs() * sr * strength,
                -kappa * u * strength,
                -eta * (mu_now * u.abs() * sr + kappa_now * u) * logarithm,
            ];
        }
    }

    fn derivative(&self, out: &mut [f64]) {
        let Parts { v, r, theta, shape } = self.parts(&self.state);
        let masses = self.masses();
        let BoucWenChain {
            alpha_per_s,
            beta_s,
            mu,
            kappa,
            eta,
            ..
        } = self.chain;
        out.fill(0.0);
        for i in 0..masses {
            let force =
                |j| self.by_drift(theta, r, j) + shape[1] * beta_s * self.by_drift(theta, v, j);
            out[i] = self.acceleration(i, force) - shape[0] * alpha_per_s * v[i] - self.ground;
            let (u, strength) = (v[i], power(r[i], shape[4] * eta));
            out[masses + i] =
                u - (shape[2] * mu * u.abs() * sign(r[i]) + shape[3] * kappa * u) * strength;
        }
    }

    fn jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        let len = self.state.len();
        let masses = self.masses();
        let Parts { v, r, theta, shape } = self.parts(&self.state);
        let BoucWenChain {
            alpha_per_s,
            beta_s,
            ..
        } = self.chain;
        for (column, out) in columns
            .as_slice()
            .chunks_exact(len)
            .zip(out.as_mut_slice().chunks_exact_mut(len))
        {
            out.fill(0.0);
            let along = self.parts(column);
            for i in 0..masses {
                let force = |j| {
                    self.by_drift(theta, along.r, j)
                        + self.by_drift(along.theta, r, j)
                        + shape[1]
                            * beta_s
                            * (self.by_drift(theta, along.v, j) + self.by_drift(along.theta, v, j))
                        + along.shape[1] * beta_s * self.by_drift(theta, v, j)
                };
                out[i] = self.acceleration(i, force)
                    - shape[0] * alpha_per_s * along.v[i]
                    - along.shape[0] * alpha_per_s * v[i];
                let [by_drive, by_r, by_mu, by_kappa, by_eta] = self.slopes[i];
                out[masses + i] = by_drive * along.v[i]
                    + by_r * along.r[i]
                    + by_mu * along.shape[2]
                    + by_kappa * along.shape[3]
                    + by_eta * along.shape[4];
            }
        }
    }

    fn excitation_matrix(&self, out: &mut DMatrix<f64>) {
        out.fill(0.0);
        for i in 0..self.masses() {
            out[(i, 0)] = -1.0;
        }
    }

    /// Returns a bound on the rate of change.
    ///
    /// By Gershgorin's theorem, the largest row sum of `M⁻¹ K` bounds `ω²`. Hysteresis only
    /// softens, except for a factor of up to 1.2 around the yield point.
    fn rate_bound(&self) -> f64 {
        let Parts { theta, shape, .. } = self.parts(&self.state);
        let spring = |j: usize| match self.group_of.get(j) {
            Some(group) => theta[*group].abs() * self.chain.stiffnesses_n_per_m[j],
            None => 0.0,
        };
        let row = |i: usize| 2.0 * (spring(i) + spring(i + 1)) / self.chain.masses_kg[i];
        let squared = (0..self.masses()).map(row).fold(0.0, f64::max);
        let omega = 1.2 * squared.sqrt();
        omega * (1.0 + omega * (shape[1] * self.chain.beta_s).abs())
            + (shape[0] * self.chain.alpha_per_s).abs()
    }
}

impl ObservationModel for BoucWenModel {
    fn observation_len(&self) -> usize {
        self.observed.len()
    }

    fn linearise_observation(&mut self, state: &[f64], _: &[f64]) {
        for (observed, dof) in self.observed.iter_mut().zip(&self.chain.sensed) {
            *observed = state[*dof];
        }
    }

    fn observe(&self, out: &mut [f64]) {
        out.copy_from_slice(&self.observed);
    }

    fn observation_jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        for (row, dof) in self.chain.sensed.iter().enumerate() {
            for j in 0..columns.ncols() {
                out[(row, j)] = columns[(*dof, j)];
            }
        }
    }

    fn feedthrough(&self) -> Option<&DMatrix<f64>> {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn model() -> BoucWenModel {
        BoucWenModel::new(BoucWenChain {
            masses_kg: vec![1.0, 1.2, 0.8],
            stiffnesses_n_per_m: vec![2000.0, 1800.0, 2100.0],
            groups: vec![vec![0], vec![1, 2]],
            alpha_per_s: 0.38,
            beta_s: 8e-4,
            mu: 1000.0,
            kappa: 1500.0,
            eta: 2.0,
            sensed: vec![0, 2],
        })
        .unwrap()
    }

    #[test]
    fn jacobian_agrees_with_central_differences() {
        {
            let mut model = model();
            let n = model.state_len();
            let state: Vec<f64> = vec![
                0.2, -0.3, 0.15, 0.01, -0.015, 0.012, 0.9, 1.1, 1.2, 0.8, 1.05, 0.95, 1.1,
            ];
            assert_eq!(state.len(), n);
            let derivative = |model: &mut BoucWenModel, state: &[f64]| {
                let mut out = vec![0.0; n];
                model.linearise_process(state, &[0.7]);
                model.derivative(&mut out);
                out
            };
            let mut jacobian = DMatrix::zeros(n, n);
            model.linearise_process(&state, &[0.7]);
            model.jacobian_mul(&DMatrix::identity(n, n), &mut jacobian);
            for j in 0..n {
                let h = 1e-6 * state[j].abs().max(1e-3);
                let moved = |by: f64| {
                    let mut moved = state.clone();
                    moved[j] += by;
                    moved
                };
                let (up, down) = (
                    derivative(&mut model, &moved(h)),
                    derivative(&mut model, &moved(-h)),
                );
                for i in 0..n {
                    let expected = (up[i] - down[i]) / (2.0 * h);
                    let scale = 1.0 + expected.abs();
                    assert!(
                        (jacobian[(i, j)] - expected).abs() < 1e-5 * scale,
                        "({i}, {j})"
                    );
                }
            }
        }
    }

    #[test]
    fn springs_belong_to_exactly_one_group() {
        let chain = model().chain;
        for groups in [
            vec![vec![0], vec![1]],
            vec![vec![0, 1], vec![1, 2]],
            vec![vec![0, 1, 2, 3]],
        ] {
            assert!(
                BoucWenModel::new(BoucWenChain {
                    groups,
                    ..chain.clone()
                })
                .is_none()
            );
        }
        assert!(
            BoucWenModel::new(BoucWenChain {
                sensed: vec![3],
                ..chain
            })
            .is_none()
        );
    }

    #[test]
    fn rates_are_below_their_bound() {
        let mut model = model();
        let n = model.state_len();
        let mut state = vec![0.1; n];
        state[3..6].fill(0.005);
        state[6..].fill(1.0);
        model.linearise_process(&state, &[0.0]);
        let mut jacobian = DMatrix::zeros(n, n);
        model.jacobian_mul(&DMatrix::identity(n, n), &mut jacobian);
        let largest = jacobian
            .complex_eigenvalues()
            .iter()
            .map(|value| value.norm())
            .fold(0.0, f64::max);
        assert!(
            largest <= model.rate_bound(),
            "{largest} > {}",
            model.rate_bound()
        );
    }
}
