//! Bouc-Wen chain of ten masses under ground motion, with observed velocities (ch2 §4.5).

use super::Normal;
use nalgebra::DMatrix;
use spandrel_filter::{ObservationModel, ProcessModel};

pub const MASSES: usize = 10;
pub const GROUPS: usize = 6;
/// Stiffness k/m (s⁻²): 2000 kN/m and 1000 kg.
const STIFFNESS: f64 = 2000.0;
/// True values of α (1/s), β (s), μ and κ (m^−η), η. The unknowns are ratios to these values.
const NOMINAL: [f64; 5] = [0.100, 7.526e-4, 1000.0, 1500.0, 2.0];
/// Sensed masses, from 0.
pub const SENSED: [usize; 5] = [0, 2, 4, 7, 9];

/// Presence of the displacements in the state; they occur in no equation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Displacements {
    Kept,
    LeftOut,
}

/// State y = [x,] ẋ, r, θ_k (6), and α, β, μ, κ, η relative to their true values.
#[derive(Debug, Clone)]
pub struct BoucWen {
    displacements: Displacements,
    state: Vec<f64>,
    ground: f64,
    /// ∂ṙ/∂(ẋ, r, μ, κ, η) of each mass, the last three for unknowns relative to their true values.
    slopes: [[f64; 5]; MASSES],
}

/// The parts of a state vector.
struct Parts<'a> {
    v: &'a [f64],
    r: &'a [f64],
    theta: &'a [f64],
    other: &'a [f64],
}

impl BoucWen {
    pub fn new(displacements: Displacements) -> Self {
        let mut model = Self {
            displacements,
            state: Vec::new(),
            ground: 0.0,
            slopes: [[0.0; 5]; MASSES],
        };
        model.state = vec![0.0; model.first_velocity() + 2 * MASSES + GROUPS + 5];
        model
    }

    pub fn first_velocity(&self) -> usize {
        match self.displacements {
            Displacements::Kept => MASSES,
            Displacements::LeftOut => 0,
        }
    }

    fn parts<'a>(&self, state: &'a [f64]) -> Parts<'a> {
        let (motion, parameters) = state[self.first_velocity()..].split_at(2 * MASSES);
        let (v, r) = motion.split_at(MASSES);
        let (theta, other) = parameters.split_at(GROUPS);
        Parts { v, r, theta, other }
    }
}

/// Returns `[K(θ) x]_i / m`: springs 1 to 5 have a group each, springs 6 to 10 share one.
fn elastic(theta: &[f64], x: &[f64], i: usize) -> f64 {
    let spring = |j: usize| {
        let below = if j > 0 { x[j - 1] } else { 0.0 };
        STIFFNESS * theta[j.min(GROUPS - 1)] * (x[j] - below)
    };
    spring(i) - if i + 1 < MASSES { spring(i + 1) } else { 0.0 }
}

/// Returns `|r|^η`, or 0 if `r` is almost 0.
fn power(r: f64, exponent: f64) -> f64 {
    if r.abs() < 1e-12 {
        0.0
    } else {
        r.abs().powf(exponent)
    }
}

fn sign(value: f64) -> f64 {
    if value == 0.0 { 0.0 } else { value.signum() }
}

impl ProcessModel for BoucWen {
    fn state_len(&self) -> usize {
        self.state.len()
    }
    fn parameter_len(&self) -> usize {
        GROUPS + 5
    }
    fn excitation_len(&self) -> usize {
        1
    }
    fn linearise_process(&mut self, state: &[f64], excitation: &[f64]) {
        self.state.copy_from_slice(state);
        self.ground = excitation[0];
        let Parts { v, r, other, .. } = self.parts(state);
        let [_, _, mu, kappa, eta] = std::array::from_fn(|p| other[p] * NOMINAL[p]);
        self.slopes = std::array::from_fn(|i| {
            let (strength, weaker) = (power(r[i], eta), power(r[i], eta - 1.0));
            let (sv, sr) = (sign(v[i]), sign(r[i]));
            let logarithm = if r[i].abs() < 1e-12 {
                0.0
            } else {
                strength * r[i].abs().ln()
            };
            [
                1.0 - mu * sv * sr * strength - kappa * strength,
                -mu * eta * v[i].abs() * weaker - kappa * eta * v[i] * weaker * sr,
                -NOMINAL[2] * v[i].abs() * sr * strength,
                -NOMINAL[3] * v[i] * strength,
                -NOMINAL[4] * (mu * v[i].abs() * sr + kappa * v[i]) * logarithm,
            ]
        });
    }
    fn derivative(&self, out: &mut [f64]) {
        let Parts { v, r, theta, other } = self.parts(&self.state);
        let [alpha, beta, mu, kappa, eta] = std::array::from_fn(|p| other[p] * NOMINAL[p]);
        out.fill(0.0);
        let first = self.first_velocity();
        for i in 0..MASSES {
            if first > 0 {
                out[i] = v[i];
            }
            let damped = beta * elastic(theta, v, i);
            out[first + i] = -alpha * v[i] - elastic(theta, r, i) - damped - self.ground;
            let strength = power(r[i], eta);
            out[first + MASSES + i] =
                v[i] - mu * v[i].abs() * strength * sign(r[i]) - kappa * v[i] * strength;
        }
    }
    fn jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        let n = self.state.len();
        let first = self.first_velocity();
        let Parts { v, r, theta, other } = self.parts(&self.state);
        let (alpha, beta) = (other[0] * NOMINAL[0], other[1] * NOMINAL[1]);
        for j in 0..columns.ncols() {
            let column = &columns.as_slice()[j * n..(j + 1) * n];
            let result = &mut out.as_mut_slice()[j * n..(j + 1) * n];
            result.fill(0.0);
            let along = self.parts(column);
            for i in 0..MASSES {
                if first > 0 {
                    result[i] = along.v[i];
                }
                result[first + i] = -alpha * along.v[i]
                    - elastic(theta, along.r, i)
                    - beta * elastic(theta, along.v, i)
                    - elastic(along.theta, r, i)
                    - beta * elastic(along.theta, v, i)
                    - along.other[0] * NOMINAL[0] * v[i]
                    - along.other[1] * NOMINAL[1] * elastic(theta, v, i);
                let slopes = &self.slopes[i];
                result[first + MASSES + i] = slopes[0] * along.v[i]
                    + slopes[1] * along.r[i]
                    + slopes[2] * along.other[2]
                    + slopes[3] * along.other[3]
                    + slopes[4] * along.other[4];
            }
        }
    }
    fn excitation_matrix(&self, out: &mut DMatrix<f64>) {
        out.fill(0.0);
        for i in 0..MASSES {
            out[(self.first_velocity() + i, 0)] = -1.0;
        }
    }
    fn rate_bound(&self) -> f64 {
        let Parts { theta, .. } = self.parts(&self.state);
        let largest = theta
            .iter()
            .fold(0.0_f64, |largest, factor| largest.max(factor.abs()));
        (4.0 * STIFFNESS * largest).sqrt() * 1.2
    }
}

impl ObservationModel for BoucWen {
    fn observation_len(&self) -> usize {
        SENSED.len()
    }
    fn linearise_observation(&mut self, state: &[f64], _: &[f64]) {
        self.state.copy_from_slice(state);
    }
    fn observe(&self, out: &mut [f64]) {
        for (value, mass) in out.iter_mut().zip(SENSED) {
            *value = self.state[self.first_velocity() + mass];
        }
    }
    fn observation_jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        for (row, mass) in SENSED.into_iter().enumerate() {
            out.row_mut(row)
                .copy_from(&columns.row(self.first_velocity() + mass));
        }
    }
    fn feedthrough(&self) -> Option<&DMatrix<f64>> {
        None
    }
}

/// Returns the velocities of the sensed masses without noise.
///
/// It takes one Runge-Kutta step per sample with held excitation.
pub fn simulate(
    normal: &mut Normal,
    steps: usize,
    step_s: f64,
    excitation_std: f64,
) -> Vec<[f64; 5]> {
    let mut model = BoucWen::new(Displacements::LeftOut);
    let mut y = vec![0.0; 2 * MASSES];
    y.extend([1.0; GROUPS + 5]);
    let n = y.len();
    (0..steps)
        .map(|_| {
            let ground = [excitation_std * normal.draw()];
            let mut slope_at = |state: &[f64]| {
                let mut slope = vec![0.0; n];
                model.linearise_process(state, &ground);
                model.derivative(&mut slope);
                slope
            };
            let moved = |slope: &[f64], by: f64| -> Vec<f64> {
                y.iter().zip(slope).map(|(y, k)| y + by * k).collect()
            };
            let k1 = slope_at(&y);
            let k2 = slope_at(&moved(&k1, step_s / 2.0));
            let k3 = slope_at(&moved(&k2, step_s / 2.0));
            let k4 = slope_at(&moved(&k3, step_s));
            for i in 0..n {
                y[i] += step_s / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
            }
            SENSED.map(|mass| y[mass])
        })
        .collect()
}
