//! The oscillator of chapter 2, whose frequency and damping ratio are unknown.

use nalgebra::DMatrix;
use spandrel_filter::{ObservationModel, ProcessModel};

/// The system ẍ + 2ζω ẋ + ω² x = f with y = [x, ẋ, ω, ζ]. Displacement and velocity are observed
/// (ch2 §4.3).
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
