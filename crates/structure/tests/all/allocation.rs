//! Checks that a model of any kind serves the filter without allocating.

use nalgebra::DMatrix;
use spandrel_filter::{ExtendedKalmanFilter, Frame, ObservationModel, ProcessModel};
use spandrel_structure::Structure;
use std::path::Path;

fn example(name: &str) -> Structure {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../docs/examples")
        .join(name)
        .with_extension("toml");
    Structure::read(&path).unwrap_or_else(|error| panic!("{error}"))
}

#[test]
fn a_model_allocates_nothing_after_construction() {
    for name in [
        "demo",
        "noisy",
        "matrices",
        "three-pier-bridge",
        "dome",
        "bouc-wen-ten",
        "dashpot-building",
    ] {
        let mut model = example(name).model();
        let (len, rows, inputs) = (
            model.state_len(),
            model.observation_len(),
            model.excitation_len(),
        );
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

/// Covers a single series (a narrow band, a full matrix), a halved step (`matrices`), and the
/// operator.
#[test]
fn a_step_of_the_filter_of_a_structure_allocates_nothing() {
    for name in [
        "demo",
        "high-rise",
        "three-pier-bridge",
        "fourteen-bay-truss",
        "matrices",
        "dashpot-building",
    ] {
        let structure = example(name);
        let mut filter =
            ExtendedKalmanFilter::new(structure.model(), structure.filter_settings().unwrap())
                .unwrap();
        let observations = vec![1e-3; structure.observation_channels().len()];
        let excitation = vec![1e-3; structure.excitation_channels().len()];
        let counted = allocation_counter::measure(|| {
            for _ in 0..5 {
                filter
                    .step(Frame {
                        observations: &observations,
                        excitation: &excitation,
                    })
                    .unwrap();
            }
        });
        assert_eq!(counted.count_total, 0, "{name}");
    }
}
