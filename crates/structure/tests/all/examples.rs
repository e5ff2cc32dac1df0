//! Checks, simulates and estimates every example. Examples without parameters must find their noise
//! levels.

use spandrel_filter::{ExtendedKalmanFilter, Frame, Step};
use spandrel_structure::{SimulatedFrame, Structure, StructureModel};
use std::path::Path;

fn example(name: &str) -> Structure {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../docs/examples")
        .join(name)
        .with_extension("toml");
    Structure::read(&path).unwrap_or_else(|error| panic!("{error}"))
}

/// All examples except the tower, whose steps take about thirty milliseconds.
const EXAMPLES: [&str; 16] = [
    "three-pier-bridge",
    "fourteen-bay-truss",
    "dome",
    "dome-bars",
    "bouc-wen-ten",
    "bouc-wen-five",
    "hysteretic-oscillator",
    "hysteretic-particles",
    "slow-oscillator",
    "five-mass-chain",
    "vehicle",
    "dashpot-building",
    "high-rise",
    "fifty-storeys",
    "fifty-storeys-wind",
    "sixty-storeys",
];

/// A filter that processes simulated frames of a structure.
struct Run {
    filter: ExtendedKalmanFilter<StructureModel>,
    structure: Structure,
    mean_excitation: Vec<f64>,
}

impl Run {
    fn new(structure: Structure) -> Self {
        let settings = structure
            .filter_settings()
            .unwrap_or_else(|error| panic!("{error}"));
        let filter = ExtendedKalmanFilter::new(structure.model(), settings)
            .unwrap_or_else(|error| panic!("{error}"));
        let mean_excitation = structure.mean_excitation().as_slice().to_vec();
        Self {
            filter,
            structure,
            mean_excitation,
        }
    }

    fn step(&mut self, frame: &SimulatedFrame) -> Step {
        let observations: Vec<f64> = self
            .structure
            .observation_channels()
            .iter()
            .map(|channel| frame.values[*channel])
            .collect();
        let channels = self
            .structure
            .excitation_channels()
            .iter()
            .zip(&self.mean_excitation);
        let excitation: Vec<f64> = channels
            .map(|(channel, mean)| channel.map_or(*mean, |channel| frame.values[channel]))
            .collect();
        let frame = Frame {
            observations: &observations,
            excitation: &excitation,
        };
        self.filter
            .step(frame)
            .unwrap_or_else(|error| panic!("{error}"))
    }
}

#[track_caller]
fn assert_can_be_checked(name: &str, duration_s: f64) {
    let report = example(name).check(duration_s, 1);
    assert!(
        report
            .modes
            .iter()
            .all(|mode| mode.frequency_hz > 0.0 && mode.damping_ratio >= 0.0),
        "{name}"
    );
    let identification = report
        .identification
        .unwrap_or_else(|| panic!("{name} has no stationary filter"));
    assert!(
        identification
            .parameters
            .iter()
            .all(|p| p.std_after <= p.prior_std * (1.0 + 1e-9)),
        "{name}"
    );
    assert!(
        identification
            .noise_levels
            .iter()
            .all(|level| level.relative_std_after.is_finite()),
        "{name}"
    );
}

#[test]
fn every_example_can_be_checked() {
    for name in EXAMPLES {
        assert_can_be_checked(name, 0.5);
    }
}

#[test]
fn the_tower_can_be_checked() {
    assert_can_be_checked("tower", 0.1);
}

#[test]
fn every_example_can_be_simulated() {
    for name in EXAMPLES.into_iter().chain(["tower"]) {
        for frame in example(name).simulator(1).take(100) {
            assert!(
                frame.values.iter().all(|value| value.is_finite()),
                "{name}, frame {}",
                frame.index
            );
        }
    }
}

#[test]
fn every_example_can_be_estimated() {
    for (name, count) in EXAMPLES
        .map(|name| (name, 100))
        .into_iter()
        .chain([("tower", 5)])
    {
        let structure = example(name);
        let frames: Vec<_> = structure.simulator(1).take(count).collect();
        let mut run = Run::new(structure);
        for frame in &frames {
            assert!(
                run.step(frame).log_evidence.is_finite(),
                "{name}, frame {}",
                frame.index
            );
        }
    }
}

/// Estimates of the two levels of a building over a simulated record, each divided by its actual
/// value.
struct Levels {
    training_steps: usize,
    /// Number of replaced Hessians and clips in the operating stage.
    replaced: u64,
    clipped: u64,
    mean: [f64; 2],
    scatter: [f64; 2],
    /// Mean of the reported standard deviation divided by the estimate.
    stated: [f64; 2],
    /// Share of the frames in which ± 3 standard deviations contain the actual value.
    coverage: [f64; 2],
}

/// Runs the filter over a record of `seconds` and evaluates it from `from_s` on.
fn levels(name: &str, seed: u64, actual: [f64; 2], from_s: f64, seconds: f64) -> Levels {
    let structure = example(name);
    let (step_s, simulator) = (structure.step_s(), structure.simulator(seed));
    let mut run = Run::new(structure);
    let (mut training_steps, mut count) = (0, 0.0);
    let (mut sum, mut squares, mut stated, mut coverage) = ([0.0; 2], [0.0; 2], [0.0; 2], [0.0; 2]);
    for (index, frame) in simulator
        .take((seconds / step_s).round() as usize)
        .enumerate()
    {
        if run.step(&frame).training_ended {
            training_steps = index + 1;
        }
        if (index as f64) * step_s < from_s {
            continue;
        }
        count += 1.0;
        for level in 0..2 {
            let noise = run.filter.noise();
            let (estimate, std) = (noise.mean[level], noise.covariance[(level, level)].sqrt());
            let ratio = estimate / actual[level];
            sum[level] += ratio;
            squares[level] += ratio * ratio;
            stated[level] += std / estimate;
            coverage[level] += f64::from(u8::from((estimate - actual[level]).abs() <= 3.0 * std));
        }
    }
    let mean = sum.map(|sum| sum / count);
    let found = Levels {
        training_steps,
        replaced: run.filter.noise().working_fallbacks,
        clipped: run.filter.noise().limited,
        mean,
        scatter: std::array::from_fn(|level| {
            (squares[level] / count - mean[level] * mean[level]).sqrt()
        }),
        stated: stated.map(|sum| sum / count),
        coverage: coverage.map(|sum| sum / count),
    };
    let Levels {
        scatter,
        stated,
        coverage,
        ..
    } = &found;
    println!(
        "{name}, seed {seed}, {seconds} s: estimate/actual {mean:.3?}, scatter {scatter:.3?}, \
         stated {stated:.4?}, coverage {coverage:.3?}"
    );
    found
}

const SEEDS: [u64; 3] = [1, 2, 3];
/// Simulated variances of ground motion and its sensors (m²/s⁴). `WIND` contains the factor of the
/// wind and the variance of its sensors (m²/s⁴).
const GROUND: [f64; 2] = [0.27459 * 0.27459, 0.01149 * 0.01149];
const WIND: [f64; 2] = [1.0, 0.00068 * 0.00068];

/// Returns the tolerance for a mean over a shortened record: three standard deviations.
///
/// An estimate with standard deviation `s` and a memory of 7.2 s has an average over 100 s with the
/// standard deviation `s √(2·7.2/100)`. The values of `s` are recomputed from Yuen, Liang & Kuok
/// (2013), cases 1 and 3: 0.048 and 0.017 under ground motion, 0.08 and 0.07 under wind.
fn tolerance(scatter: f64) -> f64 {
    3.0 * scatter * (2.0 * 7.2_f64 / 100.0).sqrt()
}

#[track_caller]
fn assert_finds_its_levels(name: &str, actual: [f64; 2], scatter: [f64; 2]) -> Vec<Levels> {
    let of_seed = |seed| {
        let found = levels(name, seed, actual, 50.0, 150.0);
        assert_eq!(
            found.training_steps, 500,
            "{name}, seed {seed}: one fundamental period"
        );
        assert_eq!(
            (found.replaced, found.clipped),
            (0, 0),
            "{name}, seed {seed}"
        );
        for level in 0..2 {
            let (mean, allowed) = (found.mean[level], tolerance(scatter[level]));
            assert!(
                (mean - 1.0).abs() <= allowed,
                "{name}, seed {seed}: level {level} {mean} ± {allowed}"
            );
            assert!(
                found.coverage[level] >= 0.99,
                "{name}, seed {seed}: level {level} {:?}",
                found.coverage
            );
        }
        found
    };
    SEEDS.into_iter().map(of_seed).collect()
}

#[test]
fn levels_of_unmeasured_ground_motion_and_sensors_converge_from_far_too_large_values() {
    for found in assert_finds_its_levels("fifty-storeys", GROUND, [0.048, 0.017]) {
        for (stated, expected) in found.stated.into_iter().zip([0.079, 0.0244]) {
            assert!(
                (stated / expected - 1.0).abs() <= 0.15,
                "{:?}",
                found.stated
            );
        }
    }
}

#[test]
fn levels_of_a_field_of_fifty_wind_forces_and_of_sensors_are_found() {
    assert_finds_its_levels("fifty-storeys-wind", WIND, [0.08, 0.07]);
}

#[test]
#[ignore = "takes minutes: the published length"]
fn levels_over_the_published_length_are_found_within_the_published_tolerances() {
    for (name, actual, allowed, scatter) in [
        ("fifty-storeys", GROUND, 0.02, Some([0.048, 0.017])),
        ("fifty-storeys-wind", WIND, 0.03, None),
    ] {
        for seed in SEEDS {
            let found = levels(name, seed, actual, 100.0, 1000.0);
            for level in 0..2 {
                assert!(
                    (found.mean[level] - 1.0).abs() <= allowed,
                    "{name}, seed {seed}: {:?}",
                    found.mean
                );
                assert!(
                    found.coverage[level] >= 0.99,
                    "{name}, seed {seed}: {:?}",
                    found.coverage
                );
                let expected = scatter.map_or(found.scatter[level], |scatter| scatter[level]);
                assert!(
                    (found.scatter[level] / expected - 1.0).abs() <= 0.3,
                    "{name}, seed {seed}: {:?}",
                    found.scatter
                );
            }
        }
    }
}

/// Errors of the sixty storeys after 20 s.
struct Followed {
    /// Maximum over the floors, relative to the root mean square of the floor's motion in the
    /// record.
    relative_displacement: f64,
    /// Minimum and maximum root mean square of the velocity error (m/s).
    velocity: (f64, f64),
    /// Share of states and frames within ± 3 standard deviations.
    inside: f64,
    misfit: f64,
}

/// Returns the sixty storeys with a sensor noise of 5 % of each channel's motion in this record.
fn sixty_storeys_with_the_noise_of(seed: u64, seconds: f64) -> Structure {
    let structure = example("sixty-storeys");
    let (mut squares, mut count) = (vec![0.0; structure.channel_count()], 0.0);
    for frame in structure
        .clean_simulator(seed)
        .take((seconds * structure.sampling_rate_hz()) as usize)
    {
        count += 1.0;
        squares
            .iter_mut()
            .zip(&frame.values)
            .for_each(|(sum, value)| *sum += value * value);
    }
    let mut stds = squares.iter().map(|sum: &f64| 0.05 * (sum / count).sqrt());
    let stated = |line: &str| match line.starts_with("noise-std") {
        true => stds
            .next()
            .map_or_else(String::new, |std| format!("noise-std = {std:e}\n")),
        false => format!("{line}\n"),
    };
    let text: String = structure.text().lines().map(stated).collect();
    Structure::parse(&text, Path::new("sixty-storeys.toml"))
        .unwrap_or_else(|error| panic!("{error}"))
}

fn follow_sixty_storeys(structure: Structure, seed: u64, seconds: f64) -> Followed {
    let (floors, rate_hz) = (
        structure.degrees_of_freedom().len(),
        structure.sampling_rate_hz(),
    );
    let mut simulator = structure.simulator(seed);
    let mut run = Run::new(structure);
    let (mut errors, mut squares) = (vec![0.0; 2 * floors], vec![0.0; 2 * floors]);
    let (mut inside, mut misfit, mut count) = (0.0, 0.0, 0.0);
    for index in 0..(seconds * rate_hz) as usize {
        let truth = simulator.state().to_vec();
        let Some(frame) = simulator.next() else { break };
        let step = run.step(&frame);
        if (index as f64) < 20.0 * rate_hz {
            continue;
        }
        count += 1.0;
        misfit += step.normalised_innovation_squared / step.used_channels as f64;
        for (j, (truth, estimate)) in truth.iter().zip(run.filter.mean()).enumerate() {
            let error = estimate - truth;
            errors[j] += error * error;
            squares[j] += truth * truth;
            inside += f64::from(u8::from(
                error.abs() <= 3.0 * run.filter.covariance()[(j, j)].sqrt(),
            ));
        }
    }
    let relative = |j: usize| (errors[j] / squares[j]).sqrt();
    let worst = |entries: std::ops::Range<usize>| entries.map(relative).fold(0.0, f64::max);
    let velocity = errors[floors..].iter().map(|sum| (sum / count).sqrt());
    let relative_velocity = worst(floors..2 * floors);
    let followed = Followed {
        relative_displacement: worst(0..floors),
        velocity: velocity.fold((f64::INFINITY, 0.0), |(low, high), error| {
            (error.min(low), error.max(high))
        }),
        inside: inside / (count * 2.0 * floors as f64),
        misfit: misfit / count,
    };
    let Followed {
        relative_displacement,
        velocity: (low, high),
        inside,
        misfit,
    } = &followed;
    println!(
        "sixty-storeys, seed {seed}, {seconds} s: relative errors {relative_displacement:.4} and \
         {relative_velocity:.4}, velocity {low:.3e} to {high:.3e} m/s, inside {inside:.4}, misfit \
         {misfit:.4}"
    );
    followed
}

/// Asserts the values of Huang & Yuen (2023), §2.3.2, as recomputed, for any record.
///
/// The velocity errors are 2.1 to 2.8·10⁻⁴ m/s everywhere, 99.5 % of the states are within their
/// intervals, and the mean innovation χ²/7 is 1.00 ± 0.02.
#[track_caller]
fn assert_follows(followed: &Followed) {
    let (low, high) = followed.velocity;
    // The limits are those of the printed digits.
    assert!(low >= 2.05e-4 && high < 2.85e-4, "{low:e} to {high:e} m/s");
    assert!(followed.inside >= 0.995, "{}", followed.inside);
    assert!((followed.misfit - 1.0).abs() <= 0.02, "{}", followed.misfit);
}

#[test]
fn motion_of_the_sixty_storeys_is_followed_from_seven_sensors() {
    for seed in SEEDS {
        assert_follows(&follow_sixty_storeys(example("sixty-storeys"), seed, 50.0));
    }
}

/// Relative displacement errors, at most 0.5 %, refer to the motion of 200 s from rest.
///
/// The first mode, with a period of 6 s and 1 % damping, hardly moves at first. Relative velocity
/// errors, at most 10 %, depend on the strength of the record at the lowest floor. The case
/// `kalman.building-60` evaluates them; docs/validation.md names the record that exceeds them.
#[test]
#[ignore = "takes minutes: the published length"]
fn motion_of_the_sixty_storeys_is_followed_over_the_published_length() {
    for seed in SEEDS {
        let followed =
            follow_sixty_storeys(sixty_storeys_with_the_noise_of(seed, 200.0), seed, 200.0);
        assert_follows(&followed);
        let relative = followed.relative_displacement;
        assert!(relative <= 0.005, "seed {seed}: {relative}");
    }
}
