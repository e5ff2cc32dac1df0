//! The small systems of the published examples, written by hand so that filter tests need no
//! structure crate.

#![allow(dead_code, reason = "each test program uses its own part")]

pub mod bouc_wen;
pub mod bridge;
#[path = "../../../validate/src/systems/drifting/building.rs"]
pub mod drifting_building;
#[path = "../../../validate/src/systems/drifting/oscillator.rs"]
pub mod hysteretic;
#[path = "../../../validate/src/systems/drifting/integrate.rs"]
pub mod integrate;
#[path = "../../../validate/src/systems/drifting/numerical_ekf.rs"]
pub mod numerical_ekf;
#[path = "../../../validate/src/systems/tall_building.rs"]
pub mod tall_building;

pub use integrate::integrate;

use nalgebra::{DMatrix, DVector};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use spandrel_filter::{ObservationModel, ProcessModel};

/// A source of independent standard normal numbers.
pub struct Normal(ChaCha8Rng);

impl Normal {
    pub fn seeded(seed: u64) -> Self {
        Self(ChaCha8Rng::seed_from_u64(seed))
    }

    pub fn draw(&mut self) -> f64 {
        StandardNormal.sample(&mut self.0)
    }
}

/// Returns the root mean square of a sequence.
pub fn rms(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0.0), |(sum, count), value| {
        (sum + value * value, count + 1.0)
    });
    (sum / count).sqrt()
}

/// ẍ + 2ζω ẋ + ω² x = f with y = [x, ẋ, ω, ζ] and observed displacement and velocity (ch2 §4.3).
#[derive(Debug, Clone, Default)]
pub struct Oscillator {
    process: [f64; 4],
    force: f64,
    observed: [f64; 4],
}

impl Oscillator {
    fn jacobian_rows(&self) -> [f64; 4] {
        let [x, v, omega, zeta] = self.process;
        [
            -omega * omega,
            -2.0 * zeta * omega,
            -2.0 * omega * x - 2.0 * zeta * v,
            -2.0 * omega * v,
        ]
    }
}

impl ProcessModel for Oscillator {
    fn state_len(&self) -> usize {
        4
    }
    fn parameter_len(&self) -> usize {
        2
    }
    fn excitation_len(&self) -> usize {
        1
    }
    fn linearise_process(&mut self, state: &[f64], excitation: &[f64]) {
        self.process.copy_from_slice(state);
        self.force = excitation[0];
    }
    fn derivative(&self, out: &mut [f64]) {
        let [x, v, omega, zeta] = self.process;
        out.copy_from_slice(&[
            v,
            self.force - 2.0 * zeta * omega * v - omega * omega * x,
            0.0,
            0.0,
        ]);
    }
    fn jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        let row = self.jacobian_rows();
        for j in 0..columns.ncols() {
            out[(0, j)] = columns[(1, j)];
            out[(1, j)] = (0..4).map(|i| row[i] * columns[(i, j)]).sum();
            out[(2, j)] = 0.0;
            out[(3, j)] = 0.0;
        }
    }
    fn excitation_matrix(&self, out: &mut DMatrix<f64>) {
        out.copy_from_slice(&[0.0, 1.0, 0.0, 0.0]);
    }
    fn rate_bound(&self) -> f64 {
        let [_, _, omega, zeta] = self.process;
        omega.abs() * (1.0 + 2.0 * zeta.abs())
    }
}

impl ObservationModel for Oscillator {
    fn observation_len(&self) -> usize {
        2
    }
    fn linearise_observation(&mut self, state: &[f64], _: &[f64]) {
        self.observed.copy_from_slice(state);
    }
    fn observe(&self, out: &mut [f64]) {
        out.copy_from_slice(&self.observed[..2]);
    }
    fn observation_jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        out.copy_from(&columns.rows(0, 2));
    }
    fn feedthrough(&self) -> Option<&DMatrix<f64>> {
        None
    }
}

/// Chain of equal masses of 1 kg, fixed at one end, with y = [x, ẋ, θ_k, α, β] (ch3 §4.0).
///
/// A force acts on the last mass. All accelerations −(C ẋ + K x) are observed, without the direct
/// term f/m, as in the source.
#[derive(Debug, Clone)]
pub struct Chain {
    pub masses: usize,
    pub stiffness: f64,
    process: DVector<f64>,
    force: f64,
    observed: DVector<f64>,
}

impl Chain {
    pub fn new(masses: usize, stiffness: f64) -> Self {
        let zero = DVector::zeros(2 * masses + 3);
        Self {
            masses,
            stiffness,
            process: zero.clone(),
            force: 0.0,
            observed: zero,
        }
    }

    /// Returns the nominal stiffness matrix (N_d × N_d).
    pub fn matrix(&self) -> DMatrix<f64> {
        let n = self.masses;
        DMatrix::from_fn(n, n, |i, j| match i.abs_diff(j) {
            0 if i + 1 == n => self.stiffness,
            0 => 2.0 * self.stiffness,
            1 => -self.stiffness,
            _ => 0.0,
        })
    }

    /// Returns `[K x]_i` for the nominal stiffness.
    fn force_row(&self, x: &[f64], i: usize) -> f64 {
        let below = if i > 0 { x[i - 1] } else { 0.0 };
        let above = if i + 1 < self.masses {
            x[i + 1] - x[i]
        } else {
            0.0
        };
        self.stiffness * (x[i] - below - above)
    }

    /// Returns `−(C ẋ + K x)` at a state.
    fn acceleration(&self, y: &[f64], i: usize) -> f64 {
        let n = self.masses;
        let (theta, alpha, beta) = (y[2 * n], y[2 * n + 1], y[2 * n + 2]);
        let elastic = self.force_row(&y[..n], i) + beta * self.force_row(&y[n..2 * n], i);
        -theta * elastic - alpha * y[n + i]
    }

    /// Returns the derivative of this acceleration along a direction of the state.
    fn acceleration_along(&self, y: &[f64], direction: &[f64], i: usize) -> f64 {
        let n = self.masses;
        let (theta, alpha, beta) = (y[2 * n], y[2 * n + 1], y[2 * n + 2]);
        let elastic = self.force_row(&y[..n], i) + beta * self.force_row(&y[n..2 * n], i);
        let along =
            self.force_row(&direction[..n], i) + beta * self.force_row(&direction[n..2 * n], i);
        -theta * along
            - alpha * direction[n + i]
            - elastic * direction[2 * n]
            - y[n + i] * direction[2 * n + 1]
            - theta * self.force_row(&y[n..2 * n], i) * direction[2 * n + 2]
    }
}

impl ProcessModel for Chain {
    fn state_len(&self) -> usize {
        2 * self.masses + 3
    }
    fn parameter_len(&self) -> usize {
        3
    }
    fn excitation_len(&self) -> usize {
        1
    }
    fn linearise_process(&mut self, state: &[f64], excitation: &[f64]) {
        self.process.copy_from_slice(state);
        self.force = excitation[0];
    }
    fn derivative(&self, out: &mut [f64]) {
        let n = self.masses;
        out.fill(0.0);
        for i in 0..n {
            out[i] = self.process[n + i];
            out[n + i] = self.acceleration(self.process.as_slice(), i);
        }
        out[2 * n - 1] += self.force;
    }
    fn jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        let n = self.masses;
        let len = self.state_len();
        for j in 0..columns.ncols() {
            let direction = &columns.as_slice()[j * len..(j + 1) * len];
            let result = &mut out.as_mut_slice()[j * len..(j + 1) * len];
            result.fill(0.0);
            for i in 0..n {
                result[i] = direction[n + i];
                result[n + i] = self.acceleration_along(self.process.as_slice(), direction, i);
            }
        }
    }
    fn excitation_matrix(&self, out: &mut DMatrix<f64>) {
        out.fill(0.0);
        out[(2 * self.masses - 1, 0)] = 1.0;
    }
    fn rate_bound(&self) -> f64 {
        let n = self.masses;
        let omega = (4.0 * self.stiffness * self.process[2 * n].abs()).sqrt();
        omega * (1.0 + self.process[2 * n + 2].abs() * omega) + self.process[2 * n + 1].abs()
    }
}

impl ObservationModel for Chain {
    fn observation_len(&self) -> usize {
        self.masses
    }
    fn linearise_observation(&mut self, state: &[f64], _: &[f64]) {
        self.observed.copy_from_slice(state);
    }
    fn observe(&self, out: &mut [f64]) {
        for (i, value) in out.iter_mut().enumerate() {
            *value = self.acceleration(self.observed.as_slice(), i);
        }
    }
    fn observation_jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        let len = self.state_len();
        for j in 0..columns.ncols() {
            let direction = &columns.as_slice()[j * len..(j + 1) * len];
            for i in 0..self.masses {
                out[(i, j)] = self.acceleration_along(self.observed.as_slice(), direction, i);
            }
        }
    }
    fn feedthrough(&self) -> Option<&DMatrix<f64>> {
        None
    }
}
