//! A model wrapper that forces the filter's route for a general Jacobian.

use nalgebra::DMatrix;
use spandrel_filter::{ObservationModel, ProcessModel};
use spandrel_structure::StructureModel;

/// A structure that hides its proportional damping from the filter.
#[derive(Debug, Clone)]
pub struct ByOperator(pub StructureModel);

impl ProcessModel for ByOperator {
    fn state_len(&self) -> usize {
        self.0.state_len()
    }
    fn parameter_len(&self) -> usize {
        self.0.parameter_len()
    }
    fn excitation_len(&self) -> usize {
        self.0.excitation_len()
    }
    fn linearise_process(&mut self, state: &[f64], excitation: &[f64]) {
        self.0.linearise_process(state, excitation);
    }
    fn derivative(&self, out: &mut [f64]) {
        self.0.derivative(out);
    }
    fn jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        self.0.jacobian_mul(columns, out);
    }
    fn excitation_matrix(&self, out: &mut DMatrix<f64>) {
        self.0.excitation_matrix(out);
    }
    fn rate_bound(&self) -> f64 {
        self.0.rate_bound()
    }
}

impl ObservationModel for ByOperator {
    fn observation_len(&self) -> usize {
        self.0.observation_len()
    }
    fn linearise_observation(&mut self, state: &[f64], excitation: &[f64]) {
        self.0.linearise_observation(state, excitation);
    }
    fn observe(&self, out: &mut [f64]) {
        self.0.observe(out);
    }
    fn observation_jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        self.0.observation_jacobian_mul(columns, out);
    }
    fn feedthrough(&self) -> Option<&DMatrix<f64>> {
        self.0.feedthrough()
    }
}
