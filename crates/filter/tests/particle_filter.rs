//! The particle filter on systems of the Kalman filters, its checkpoints, its threads and its
//! memory.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test fails by panicking"
)]

mod systems;

use nalgebra::{DMatrix, DVector};
use spandrel_filter::{
    ExcitedSystem, ExtendedKalmanFilter, FilterError, FilterSettings, Frame, GaussianStart,
    ImportanceDensity, InputHold, NoiseModel, ObservationModel, ParticleFilter, ParticleSettings,
    ProcessModel, WarmStartedParticleFilter,
};
use systems::{Normal, Oscillator, hysteretic, rms};

const STEP_S: f64 = 0.05;
const FREQUENCY: f64 = 3.0;
const DAMPING: f64 = 0.05;

/// ẍ + 2ζω ẋ + ω² x = f + w with known ω and ζ; displacement and relative acceleration are
/// observed.
///
/// The acceleration responds directly to the force.
#[derive(Debug, Clone)]
struct Felt {
    process: [f64; 2],
    observed: [f64; 2],
    force: [f64; 2],
    direct: DMatrix<f64>,
}

impl Felt {
    fn new() -> Self {
        let direct = DMatrix::from_row_slice(2, 1, &[0.0, 1.0]);
        Self {
            process: [0.0; 2],
            observed: [0.0; 2],
            force: [0.0; 2],
            direct,
        }
    }
}

fn restoring(x: f64, v: f64) -> f64 {
    2.0 * DAMPING * FREQUENCY * v + FREQUENCY * FREQUENCY * x
}

impl ProcessModel for Felt {
    fn state_len(&self) -> usize {
        2
    }
    fn parameter_len(&self) -> usize {
        0
    }
    fn excitation_len(&self) -> usize {
        1
    }
    fn linearise_process(&mut self, state: &[f64], excitation: &[f64]) {
        self.process.copy_from_slice(state);
        self.force[0] = excitation[0];
    }
    fn derivative(&self, out: &mut [f64]) {
        let [x, v] = self.process;
        out.copy_from_slice(&[v, self.force[0] - restoring(x, v)]);
    }
    fn jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        for j in 0..columns.ncols() {
            out[(0, j)] = columns[(1, j)];
            out[(1, j)] = -restoring(columns[(0, j)], columns[(1, j)]);
        }
    }
    fn excitation_matrix(&self, out: &mut DMatrix<f64>) {
        out.copy_from_slice(&[0.0, 1.0]);
    }
    fn rate_bound(&self) -> f64 {
        FREQUENCY * (1.0 + 2.0 * DAMPING)
    }
}

impl ObservationModel for Felt {
    fn observation_len(&self) -> usize {
        2
    }
    fn linearise_observation(&mut self, state: &[f64], excitation: &[f64]) {
        self.observed.copy_from_slice(state);
        self.force[1] = excitation[0];
    }
    fn observe(&self, out: &mut [f64]) {
        let [x, v] = self.observed;
        out.copy_from_slice(&[x, self.force[1] - restoring(x, v)]);
    }
    fn observation_jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        for j in 0..columns.ncols() {
            out[(0, j)] = columns[(0, j)];
            out[(1, j)] = -restoring(columns[(0, j)], columns[(1, j)]);
        }
    }
    fn feedthrough(&self) -> Option<&DMatrix<f64>> {
        Some(&self.direct)
    }
}

/// Known and unknown force, held over each step, and the state at each frame.
struct Motion {
    known: Vec<f64>,
    unknown: Vec<f64>,
    states: Vec<[f64; 2]>,
}

fn simulate(seed: u64, steps: usize) -> Motion {
    let mut normal = Normal::seeded(seed);
    let known: Vec<f64> = (0..steps).map(|_| normal.draw()).collect();
    let unknown: Vec<f64> = (0..steps).map(|_| normal.draw()).collect();
    let substeps = 20;
    let mut state = [0.1, 0.0];
    let states = (0..steps)
        .map(|k| {
            if k > 0 {
                let h = STEP_S / f64::from(substeps);
                for _ in 0..substeps {
                    // Midpoint rule.
                    let slope =
                        |[x, v]: [f64; 2]| [v, known[k - 1] + unknown[k - 1] - restoring(x, v)];
                    let first = slope(state);
                    let second =
                        slope([state[0] + 0.5 * h * first[0], state[1] + 0.5 * h * first[1]]);
                    state = [state[0] + h * second[0], state[1] + h * second[1]];
                }
            }
            state
        })
        .collect();
    Motion {
        known,
        unknown,
        states,
    }
}

fn noises(sensor_std: [f64; 2]) -> NoiseModel {
    let sensors =
        DMatrix::from_diagonal(&DVector::from_row_slice(&sensor_std.map(|std| std * std)));
    NoiseModel::known(DMatrix::identity(1, 1), sensors)
}

struct Comparison {
    mean: f64,
    ratio: f64,
    log_evidence: f64,
    /// Sum of the normalised innovations squared of the particle filter, relative to that of the
    /// Kalman filter.
    misfit: f64,
}

/// Runs both filters on the same frames and compares the first two entries of the state.
fn compare<M: ProcessModel + ObservationModel + Clone + Send>(
    model: M,
    settings: FilterSettings,
    particle_settings: ParticleSettings,
    frames: &[([f64; 2], [f64; 1])],
) -> Comparison {
    let parameters = model.parameter_len();
    let system = ExcitedSystem::new(model.clone(), &settings, DVector::zeros(parameters)).unwrap();
    let start = system.start_at_prior(&settings);
    let mut particles = ParticleFilter::new(system, particle_settings, start).unwrap();
    let mut kalman = ExtendedKalmanFilter::new(model, settings).unwrap();
    let (mut errors, mut ratios, mut log_evidence) = (Vec::new(), Vec::new(), 0.0);
    let mut misfits = [0.0; 2];
    for (observations, excitation) in frames {
        let frame = Frame {
            observations,
            excitation,
        };
        let (of_kalman, of_particles) =
            (kalman.step(frame).unwrap(), particles.step(frame).unwrap());
        log_evidence += of_particles.log_evidence - of_kalman.log_evidence;
        misfits[0] += of_particles.normalised_innovation_squared;
        misfits[1] += of_kalman.normalised_innovation_squared;
        let missing = |innovation: &[f64]| {
            innovation
                .iter()
                .map(|value| value.is_nan())
                .collect::<Vec<_>>()
        };
        assert_eq!(
            missing(particles.innovation()),
            missing(kalman.innovation().as_slice())
        );
        for j in 0..2 {
            let deviation = kalman.covariance()[(j, j)].sqrt();
            errors.push((particles.mean()[j] - kalman.mean()[j]) / deviation);
            ratios.push(particles.std()[j] / deviation);
        }
    }
    let ratio = ratios.iter().sum::<f64>() / ratios.len() as f64;
    Comparison {
        mean: rms(errors.into_iter()),
        ratio,
        log_evidence,
        misfit: misfits[0] / misfits[1],
    }
}

fn with_gaps(mut frames: Vec<([f64; 2], [f64; 1])>) -> Vec<([f64; 2], [f64; 1])> {
    for (k, (observations, excitation)) in frames.iter_mut().enumerate() {
        if k % 7 == 3 {
            observations[0] = f64::NAN;
        }
        if k % 20 == 9 {
            observations.fill(f64::NAN);
        }
        if k % 11 == 5 {
            excitation[0] = f64::NAN;
        }
    }
    frames
}

#[test]
fn known_linear_system_gives_the_extended_kalman_filter() {
    for seed in [1, 2, 3] {
        let motion = simulate(seed, 200);
        let mut normal = Normal::seeded(50 + seed);
        let sensor_std = [0.05, 0.2];
        let frames: Vec<_> = (0..200)
            .map(|k| {
                let state = motion.states[k];
                (
                    [0, 1].map(|j| state[j] + sensor_std[j] * normal.draw()),
                    [motion.known[k]],
                )
            })
            .collect();
        let prior = DVector::from_row_slice(&[0.0, 0.0, FREQUENCY, DAMPING]);
        let std = DVector::from_row_slice(&[0.2, 0.6, 0.0, 0.0]);
        for (hold, frames) in [
            (InputHold::Zero, frames.clone()),
            (InputHold::First, with_gaps(frames)),
        ] {
            let mut settings =
                FilterSettings::new(STEP_S, prior.clone(), std.clone(), noises(sensor_std));
            settings.input_hold = hold;
            for density in [ImportanceDensity::Optimal, ImportanceDensity::Prior] {
                let particle_settings = ParticleSettings {
                    density,
                    seed,
                    ..ParticleSettings::default()
                };
                let found = compare(
                    Oscillator::default(),
                    settings.clone(),
                    particle_settings,
                    &frames,
                );
                let Comparison {
                    mean,
                    ratio,
                    log_evidence,
                    misfit,
                } = found;
                println!(
                    "seed {seed}, {hold:?}, {density:?}: {mean:.3}, {ratio:.3}, {log_evidence:.2}"
                );
                assert!(mean <= 0.12, "seed {seed}, {hold:?}, {density:?}: {mean}");
                assert!(
                    (0.97..1.03).contains(&ratio),
                    "seed {seed}, {hold:?}, {density:?}: {ratio}"
                );
                assert!(
                    log_evidence.abs() <= 1.0,
                    "seed {seed}, {hold:?}, {density:?}: {log_evidence}"
                );
                // The covariance of the predictions comes from a few hundred effective draws.
                assert!(
                    (misfit - 1.0).abs() <= 0.03,
                    "seed {seed}, {hold:?}, {density:?}: {misfit}"
                );
            }
        }
    }
}

#[test]
fn sensors_that_feel_the_excitation_give_the_extended_kalman_filter() {
    for seed in [1, 2, 3] {
        let motion = simulate(seed, 200);
        // Prior sampling wastes many draws of a directly measured excitation. It needs noisy
        // sensors and more particles.
        let cases = [
            (ImportanceDensity::Optimal, [0.05, 0.2], 2000, 0.12, 1.0),
            (ImportanceDensity::Optimal, [0.2, 1.0], 2000, 0.12, 1.0),
            (ImportanceDensity::Prior, [0.2, 1.0], 16_000, 0.15, 1.5),
        ];
        for (density, sensor_std, particles, allowed, allowed_evidence) in cases {
            let mut normal = Normal::seeded(50 + seed);
            let frames: Vec<_> = (0..200)
                .map(|k| {
                    let [x, v] = motion.states[k];
                    let clean = [x, motion.known[k] + motion.unknown[k] - restoring(x, v)];
                    (
                        [0, 1].map(|j| clean[j] + sensor_std[j] * normal.draw()),
                        [motion.known[k]],
                    )
                })
                .collect();
            for frames in [frames.clone(), with_gaps(frames)] {
                let std = DVector::from_row_slice(&[0.2, 0.6]);
                let settings =
                    FilterSettings::new(STEP_S, DVector::zeros(2), std, noises(sensor_std));
                let particle_settings = ParticleSettings {
                    particles,
                    density,
                    seed,
                    threads: 2,
                    ..Default::default()
                };
                let found = compare(Felt::new(), settings, particle_settings, &frames);
                let Comparison {
                    mean,
                    ratio,
                    log_evidence,
                    misfit,
                } = found;
                let name = format!("seed {seed}, {density:?}, {sensor_std:?}");
                println!("{name}: {mean:.3}, {ratio:.3}, {log_evidence:.2}");
                assert!(mean <= allowed, "{name}: {mean}");
                assert!((0.97..1.03).contains(&ratio), "{name}: {ratio}");
                assert!(
                    log_evidence.abs() <= allowed_evidence,
                    "{name}: {log_evidence}"
                );
                assert!((misfit - 1.0).abs() <= 0.03, "{name}: {misfit}");
            }
        }
    }
}

/// Returns an oscillator with unknown frequency, with a Kalman filter over the first 40 frames.
fn warm_started(
    particles: usize,
    seed: u64,
    threads: usize,
) -> WarmStartedParticleFilter<Oscillator> {
    let prior = DVector::from_row_slice(&[0.0, 0.0, 1.15 * FREQUENCY, 2.0 * DAMPING]);
    let std = DVector::from_row_slice(&[0.2, 0.6, 0.5, 0.05]);
    let mut settings = FilterSettings::new(STEP_S, prior, std, noises([0.02, 0.1]));
    settings.lower = DVector::from_row_slice(&[f64::NEG_INFINITY, f64::NEG_INFINITY, 0.1, 1e-3]);
    let particle_settings = ParticleSettings {
        particles,
        seed,
        threads,
        kernel: 0.98,
        ..Default::default()
    };
    let drift = DVector::from_row_slice(&[0.003, 0.0005]);
    WarmStartedParticleFilter::new(
        Oscillator::default(),
        settings,
        drift,
        particle_settings,
        40,
    )
    .unwrap()
}

fn oscillator_frames(seed: u64, steps: usize) -> Vec<([f64; 2], [f64; 1])> {
    let motion = simulate(seed, steps);
    let mut normal = Normal::seeded(50 + seed);
    let frames = (0..steps).map(|k| {
        let state = motion.states[k];
        (
            [
                state[0] + 0.02 * normal.draw(),
                state[1] + 0.1 * normal.draw(),
            ],
            [motion.known[k]],
        )
    });
    frames.collect()
}

#[test]
fn unknown_frequency_is_found_after_a_warm_start() {
    for seed in [1, 2, 3] {
        let mut filter = warm_started(2000, seed, 2);
        for (observations, excitation) in with_gaps(oscillator_frames(seed, 600)) {
            filter
                .step(Frame {
                    observations: &observations,
                    excitation: &excitation,
                })
                .unwrap();
        }
        let (mean, std) = (filter.mean()[2], filter.std(2).unwrap());
        let (low, high) = filter
            .particles()
            .unwrap()
            .credible_interval(2, 0.95)
            .unwrap();
        println!(
            "seed {seed}: ω {mean:.3} ± {std:.3} [{low:.3}, {high:.3}], ζ {:.3}",
            filter.mean()[3]
        );
        assert!(
            (mean - FREQUENCY).abs() < 3.0 * std && std < 0.2,
            "seed {seed}: {mean} ± {std}"
        );
        assert!(
            low < mean && mean < high && high - low < 5.0 * std,
            "seed {seed}: [{low}, {high}]"
        );
    }
}

#[test]
fn resumed_filter_gives_the_same_bits_with_any_number_of_threads() {
    let frames = with_gaps(oscillator_frames(2, 300));
    let run = |filter: &mut WarmStartedParticleFilter<Oscillator>, part: std::ops::Range<usize>| {
        let steps = part.map(|k| {
            filter
                .step(Frame {
                    observations: &frames[k].0,
                    excitation: &frames[k].1,
                })
                .unwrap()
        });
        steps
            .map(|step| step.log_evidence.to_bits())
            .collect::<Vec<_>>()
    };
    let mut straight = warm_started(300, 2, 1);
    let expected = run(&mut straight, 0..300);
    for (threads, stop) in [(1, 20), (2, 40), (3, 41), (7, 177)] {
        let mut first = warm_started(300, 2, threads);
        let mut found = run(&mut first, 0..stop);
        let bytes = postcard::to_stdvec(&first.state()).unwrap();
        // Once the particles run, the seed comes from the checkpoint.
        let mut second = warm_started(300, 9, 1);
        if stop < 40 {
            second = warm_started(300, 2, 1);
        }
        second
            .restore(postcard::from_bytes(&bytes).unwrap())
            .unwrap();
        found.extend(run(&mut second, stop..300));
        assert_eq!(found, expected, "{threads} threads, stopped after {stop}");
        assert_eq!(second.mean(), straight.mean());
        assert_eq!(second.state(), straight.state());
    }
}

#[test]
fn step_allocates_nothing() {
    for density in [ImportanceDensity::Optimal, ImportanceDensity::Prior] {
        let record = hysteretic::Record::simulate(1, 200);
        let (mean, covariance) = record.prior();
        let start = GaussianStart {
            mean,
            covariance,
            previous_input: None,
        };
        let settings = ParticleSettings {
            particles: 200,
            density,
            kernel: 0.95,
            ..ParticleSettings::default()
        };
        let mut filter = ParticleFilter::new(record.model().unwrap(), settings, start).unwrap();
        let frames = with_gaps(oscillator_frames(1, 200));
        let mut excited = warm_started(300, 1, 1);
        for (observations, excitation) in &frames[..40] {
            excited
                .step(Frame {
                    observations,
                    excitation,
                })
                .unwrap();
        }
        let mut resampled = 0;
        let counted = allocation_counter::measure(|| {
            for (datum, input) in record.data.iter().zip(&record.input) {
                let step = filter
                    .step(Frame {
                        observations: &[*datum],
                        excitation: &[*input],
                    })
                    .unwrap();
                filter.credible_interval(3, 0.95).unwrap();
                resampled += usize::from(step.resampled);
            }
            for (observations, excitation) in &frames[40..] {
                resampled += usize::from(
                    excited
                        .step(Frame {
                            observations,
                            excitation,
                        })
                        .unwrap()
                        .resampled,
                );
            }
        });
        assert_eq!(counted.count_total, 0, "{density:?}");
        assert!(resampled > 5, "{density:?}: the resampling was hardly seen");
    }
}

#[test]
fn impossible_datum_is_an_error_and_a_restart_gives_the_first_bits_again() {
    let record = hysteretic::Record::simulate(3, 20);
    let (mean, covariance) = record.prior();
    let start = GaussianStart {
        mean,
        covariance,
        previous_input: None,
    };
    let settings = ParticleSettings {
        particles: 100,
        ..ParticleSettings::default()
    };
    let mut filter = ParticleFilter::new(record.model().unwrap(), settings, start).unwrap();
    let frame = Frame {
        observations: &[record.data[0]],
        excitation: &[record.input[0]],
    };
    let first = filter.step(frame).unwrap();
    let missing = filter
        .step(Frame {
            observations: &[f64::NAN],
            excitation: &[f64::NAN],
        })
        .unwrap();
    assert_eq!(missing.used_channels, 0);
    assert!(
        missing.log_evidence.abs() < 1e-12,
        "a frame without data says nothing: {}",
        missing.log_evidence
    );
    let wrong = Frame {
        observations: &[1.0, 2.0],
        excitation: &[0.0],
    };
    assert!(matches!(
        filter.step(wrong),
        Err(FilterError::Dimension {
            found: 2,
            expected: 1,
            ..
        })
    ));
    let impossible = Frame {
        observations: &[f64::INFINITY],
        excitation: &[0.0],
    };
    assert!(matches!(
        filter.step(impossible),
        Err(FilterError::Depleted { particles: 100 })
    ));
    filter.restart();
    assert_eq!(filter.step(frame).unwrap(), first);
}
