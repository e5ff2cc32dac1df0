//! The chain of chapter 3.

use nalgebra::{DMatrix, DVector};
use spandrel_filter::{ObservationModel, ProcessModel};

/// A chain of equal masses of 1 kg, fixed at one end, with y = [x, ẋ, θ_k, α, β] (ch3 §4.0).
///
/// A force acts on the last mass. All accelerations −(C ẋ + K x) are observed without the direct
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

    /// Returns the derivative of that acceleration along a direction of the state.
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
