//! Checks that the filter identifies the parameters of the simulated structure.

use spandrel_filter::{ExtendedKalmanFilter, FilterError, Frame, ProcessModel};
use spandrel_structure::{Structure, StructureModel};
use std::path::Path;

fn example(name: &str) -> Structure {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../docs/examples")
        .join(name);
    Structure::read(&path).unwrap_or_else(|error| panic!("{error}"))
}

/// Runs the filter over `seconds` of the simulation with `seed`.
fn run(structure: &Structure, seconds: f64, seed: u64) -> ExtendedKalmanFilter<StructureModel> {
    run_from(structure, 0.0, seconds, seed)
}

/// Runs the filter with initial parameters that are alternately too high and too low by `error`.
fn run_from(
    structure: &Structure,
    error: f64,
    seconds: f64,
    seed: u64,
) -> ExtendedKalmanFilter<StructureModel> {
    run_on(structure, structure, error, seconds, seed)
}

/// Runs the filter on a simulation of another structure.
fn run_on(
    structure: &Structure,
    simulated: &Structure,
    error: f64,
    seconds: f64,
    seed: u64,
) -> ExtendedKalmanFilter<StructureModel> {
    let mut settings = structure.filter_settings().unwrap();
    let physical = settings.prior_mean.len() - structure.parameters().len();
    for (index, mean) in settings.prior_mean.iter_mut().skip(physical).enumerate() {
        *mean += if index % 2 == 0 { error } else { -error };
    }
    let mut filter = ExtendedKalmanFilter::new(structure.model(), settings).unwrap();
    let frames = (seconds * structure.sampling_rate_hz()) as usize;
    for frame in simulated.simulator(seed).take(frames) {
        let observations: Vec<f64> = structure
            .observation_channels()
            .iter()
            .map(|c| frame.values[*c])
            .collect();
        let excitation: Vec<f64> = structure
            .excitation_channels()
            .iter()
            .map(|c| c.map_or(0.0, |c| frame.values[c]))
            .collect();
        filter
            .step(Frame {
                observations: &observations,
                excitation: &excitation,
            })
            .unwrap();
    }
    filter
}

/// Asserts that the first parameters are within five standard deviations of `truth`.
///
/// Their standard deviations must be below `largest_std`.
#[track_caller]
fn assert_identified(
    filter: &ExtendedKalmanFilter<StructureModel>,
    truth: &[f64],
    largest_std: f64,
) {
    let physical = filter.mean().len() - filter.model().parameter_len();
    for (index, truth) in truth.iter().enumerate() {
        let (mean, std) = (
            filter.mean()[physical + index],
            filter.covariance()[(physical + index, physical + index)].sqrt(),
        );
        assert!(
            (mean - truth).abs() < 5.0 * std && std < largest_std,
            "parameter {index}: expected {truth}, found {mean}, standard deviation {std}, allowed \
             {largest_std}"
        );
    }
}

#[test]
fn the_demo_is_identified_before_and_after_its_damage() {
    let demo = example("demo.toml");
    assert_identified(&run(&demo, 59.0, 1), &[1.0; 5], 0.01);
    assert_identified(&run(&demo, 150.0, 1), &[1.0, 0.85, 1.0, 1.0, 1.0], 0.01);
}

/// The simulated damping is three times, or a third of, the damping in the filter's file.
#[test]
fn unknown_damping_is_identified_and_stays_positive() {
    let demo = example("demo.toml");
    for factor in [3.0, 1.0 / 3.0] {
        let text = demo
            .text()
            .replace("ratio = 0.02", &format!("ratio = {}", 0.02 * factor));
        let other = Structure::parse(&text, Path::new("other.toml"))
            .unwrap_or_else(|error| panic!("{error}"));
        let filter = run_on(&demo, &other, 0.0, 59.0, 1);
        let damping = filter.mean()[15];
        println!(
            "{factor}: {:?}, damping {damping} ± {}",
            &filter.mean().as_slice()[10..15],
            filter.covariance()[(15, 15)].sqrt()
        );
        assert_identified(&filter, &[1.0, 1.0, 1.0, 1.0, 1.0, factor], 0.5);
        for storey in 10..15 {
            assert!(
                (filter.mean()[storey] - 1.0).abs() < 0.02,
                "{factor}: {}",
                filter.mean()[storey]
            );
        }
    }
}

#[test]
fn the_mast_of_matrices_is_identified() {
    assert_identified(&run(&example("matrices.toml"), 60.0, 2), &[1.0; 2], 0.02);
}

/// Asserts that the filter finds the first parameters, the stiffnesses, from an initial error of
/// 10 %.
///
/// The error must be halved and within the reported uncertainty.
#[track_caller]
fn assert_converges(name: &str, stiffnesses: usize, seconds: f64, largest_error: f64) {
    let filter = run_from(&example(name), 0.1, seconds, 1);
    let physical = filter.mean().len() - example(name).parameters().len();
    for index in physical..physical + stiffnesses {
        let (mean, std) = (
            filter.mean()[index],
            filter.covariance()[(index, index)].sqrt(),
        );
        assert!(
            (mean - 1.0).abs() < (5.0 * std).min(largest_error),
            "{name}, parameter {}: found {mean}, standard deviation {std}, allowed error \
             {largest_error}",
            index - physical
        );
    }
}

#[test]
fn the_bridge_converges_from_wrong_stiffnesses() {
    assert_converges("three-pier-bridge.toml", 7, 5.0, 0.05);
}

#[test]
fn the_truss_converges_from_wrong_stiffnesses() {
    assert_converges("fourteen-bay-truss.toml", 6, 10.0, 0.05);
}

#[test]
fn the_dome_converges_from_wrong_stiffnesses() {
    assert_converges("dome.toml", 6, 4.0, 0.05);
}

#[test]
fn the_hysteretic_chain_of_ten_converges_from_wrong_stiffnesses() {
    assert_converges("bouc-wen-ten.toml", 6, 20.0, 0.02);
}

/// All parameters, including the constants of the hysteresis, start 20 % off.
#[test]
fn the_hysteretic_chain_of_five_is_identified() {
    let filter = run_from(&example("bouc-wen-five.toml"), 0.2, 40.0, 1);
    assert_identified(&filter, &[1.0; 10], 0.2);
}

/// The same with springs that the drift between two floors drives.
#[test]
fn springs_that_are_driven_by_their_drift_are_identified() {
    let text = example("bouc-wen-five.toml")
        .text()
        .replace("drive = \"floor\"", "drive = \"drift\"");
    let chain =
        Structure::parse(&text, Path::new("chain.toml")).unwrap_or_else(|error| panic!("{error}"));
    assert_identified(&run_from(&chain, 0.2, 40.0, 1), &[1.0; 10], 0.2);
}

#[test]
fn the_hysteretic_oscillator_is_identified() {
    let filter = run_from(&example("hysteretic-oscillator.toml"), 0.1, 200.0, 1);
    assert_identified(&filter, &[1.0; 4], 0.2);
}

#[test]
fn stiffnesses_and_dashpots_of_a_building_are_identified() {
    // The memory of the example follows a sudden loss and is too short for dashpots, so this test
    // uses a longer memory. The second storey begins to soften after 8 s.
    let text = example("dashpot-building.toml")
        .text()
        .replace("half-life-s = 1\n", "half-life-s = 10\n");
    let building = Structure::parse(&text, Path::new("building.toml"))
        .unwrap_or_else(|error| panic!("{error}"));
    assert_identified(&run_from(&building, 0.1, 7.9, 1), &[1.0; 8], 0.2);
}

#[test]
fn the_high_rise_converges_from_wrong_stiffnesses() {
    assert_converges("high-rise.toml", 7, 4.0, 0.05);
}

/// The tower has 12 beams instead of 37, because a step of the full tower takes too long for a
/// test.
#[test]
fn the_tower_converges_from_wrong_stiffnesses() {
    let mut text = example("tower.toml")
        .text()
        .replace("elements = 27", "elements = 8")
        .replace("elements = 10", "elements = 4");
    for (node, nearest) in [
        (4, 1),
        (8, 2),
        (13, 4),
        (18, 5),
        (23, 7),
        (27, 8),
        (32, 10),
        (37, 12),
    ] {
        text = text.replace(&format!("\"node-{node}-"), &format!("\"node-{nearest}-"));
    }
    let tower =
        Structure::parse(&text, Path::new("tower.toml")).unwrap_or_else(|error| panic!("{error}"));
    assert_identified(&run_from(&tower, 0.2, 1.0, 1), &[1.0; 2], 0.01);
}

/// Steps a filter of the demo over a frame without samples and returns the last parameter's
/// variance.
///
/// A checkpoint sets this variance to `variance` before the step.
fn step_with_variance(variance: f64) -> Result<f64, FilterError> {
    let demo = example("demo.toml");
    let mut filter = run(&demo, 1.0, 1);
    let last = filter.mean().len() - 1;
    let mut checkpoint = serde_json::to_value(filter.state()).unwrap();
    // The covariance is stored by columns; the parameter gets zero covariances.
    let entries = checkpoint["covariance"][0].as_array_mut().unwrap();
    for index in 0..=last {
        entries[last * (last + 1) + index] = 0.0.into();
        entries[index * (last + 1) + last] = 0.0.into();
    }
    entries[last * (last + 1) + last] = variance.into();
    filter
        .restore(serde_json::from_value(checkpoint).unwrap())
        .unwrap();
    let missing = vec![f64::NAN; demo.observation_channels().len()];
    let excitation = vec![f64::NAN; demo.excitation_channels().len()];
    filter.step(Frame {
        observations: &missing,
        excitation: &excitation,
    })?;
    Ok(filter.covariance()[(last, last)])
}

#[test]
fn negative_variance_is_an_error_with_its_position() {
    let last = run(&example("demo.toml"), 0.1, 1).mean().len() - 1;
    let found = step_with_variance(-0.01);
    assert!(
        matches!(found, Err(FilterError::NegativeVariance { index, variance }) if index == last && variance < -0.0099),
        "{found:?}"
    );
}

/// A negative variance is rounding if its magnitude is below 1e-12 times the largest variance,
/// which far exceeds 1e-6 here.
#[test]
fn variance_below_zero_by_rounding_is_zero() {
    assert_eq!(step_with_variance(-1e-20), Ok(0.0));
}
