//! The filter identifies what the simulator has done to the structure.
#![expect(clippy::unwrap_used, clippy::panic, reason = "helpers of tests are no tests to clippy")]

use spandrel_filter::{ExtendedKalmanFilter, Frame};
use spandrel_structure::{Structure, StructureModel};
use std::path::Path;

fn example(name: &str) -> Structure {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples").join(name);
    Structure::read(&path).unwrap_or_else(|error| panic!("{error}"))
}

/// Runs the filter over `seconds` of the simulation with `seed`.
fn run(structure: &Structure, seconds: f64, seed: u64) -> ExtendedKalmanFilter<StructureModel> {
    let mut filter = ExtendedKalmanFilter::new(structure.model(), structure.filter_settings().unwrap()).unwrap();
    let frames = (seconds * structure.sampling_rate_hz()) as usize;
    for frame in structure.simulator(seed).take(frames) {
        let observations: Vec<f64> = structure.observation_channels().iter().map(|c| frame.values[*c]).collect();
        let excitation: Vec<f64> =
            structure.excitation_channels().iter().map(|c| c.map_or(0.0, |c| frame.values[c])).collect();
        filter.step(Frame { observations: &observations, excitation: &excitation }).unwrap();
    }
    filter
}

/// Parameters of `filter` within five of its standard deviations of `truth`, and these below `largest_std`.
#[track_caller]
fn assert_identified(filter: &ExtendedKalmanFilter<StructureModel>, truth: &[f64], largest_std: f64) {
    let physical = filter.mean().len() - truth.len();
    for (index, truth) in truth.iter().enumerate() {
        let (mean, std) =
            (filter.mean()[physical + index], filter.covariance()[(physical + index, physical + index)].sqrt());
        assert!(
            (mean - truth).abs() < 5.0 * std && std < largest_std,
            "parameter {index}: expected {truth}, found {mean}, standard deviation {std}, allowed {largest_std}"
        );
    }
}

#[test]
fn the_demo_is_identified_before_and_after_its_damage() {
    let demo = example("demo.toml");
    assert_identified(&run(&demo, 59.0, 1), &[1.0; 5], 0.01);
    assert_identified(&run(&demo, 150.0, 1), &[1.0, 0.85, 1.0, 1.0, 1.0], 0.01);
}

#[test]
fn the_mast_of_matrices_is_identified() {
    assert_identified(&run(&example("matrices.toml"), 60.0, 2), &[1.0; 2], 0.02);
}
