//! A model answers the filter without allocating, whatever its kind.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

use nalgebra::DMatrix;
use spandrel_filter::{ObservationModel, ProcessModel};
use spandrel_structure::Structure;
use std::path::Path;

#[test]
fn a_model_allocates_nothing_after_construction() {
    for name in ["demo", "noisy", "matrices", "three-pier-bridge", "dome", "bouc-wen-ten", "dashpot-building"] {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples").join(name).with_extension("toml");
        let structure = Structure::read(&path).unwrap_or_else(|error| panic!("{error}"));
        let mut model = structure.model();
        let (len, rows, inputs) = (model.state_len(), model.observation_len(), model.excitation_len());
        let state: Vec<f64> = (0..len).map(|entry| 0.5 + 0.01 * entry as f64).collect();
        let excitation = vec![0.3; inputs];
        let columns = DMatrix::from_fn(len, 7, |row, column| (row * 7 + column) as f64);
        let mut product = DMatrix::zeros(len, 7);
        let mut observed = DMatrix::zeros(rows, 7);
        let mut rate = vec![0.0; len];
        let mut seen = vec![0.0; rows];
        let mut input = DMatrix::zeros(len, inputs);
        let counted = allocation_counter::measure(|| {
            model.linearise_process(&state, &excitation);
            model.derivative(&mut rate);
            model.jacobian_mul(&columns, &mut product);
            model.excitation_matrix(&mut input);
            std::hint::black_box(model.rate_bound());
            model.linearise_observation(&state, &excitation);
            model.observe(&mut seen);
            model.observation_jacobian_mul(&columns, &mut observed);
            std::hint::black_box(model.feedthrough());
        });
        assert_eq!(counted.count_total, 0, "{name}");
    }
}
