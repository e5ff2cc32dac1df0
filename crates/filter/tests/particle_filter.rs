//! The particle filter on systems of the Kalman filters, its checkpoints, its threads and its
//! memory.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that fails panics"
)]

use nalgebra::{DMatrix, DVector, Vector4};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use spandrel_filter::{
    ContinuousSystem, Drifting, ExcitedSystem, ExtendedKalmanFilter, FilterError, FilterSettings,
    Frame, GaussianStart, ImportanceDensity, IncrementTime, InputHold, Interval, KalmanFilter,
    LinearModel, NoiseModel, ObservationModel, ParticleFilter, ParticleModel, ParticleSettings,
    ProcessModel, Resampling, WarmStartedParticleFilter,
};

const STEP_S: f64 = 0.05;
const FREQUENCY: f64 = 3.0;
const DAMPING: f64 = 0.05;

/// Independent standard normal numbers.
struct Normal(ChaCha8Rng);

impl Normal {
    fn seeded(seed: u64) -> Self {
        Self(ChaCha8Rng::seed_from_u64(seed))
    }

    fn draw(&mut self) -> f64 {
        StandardNormal.sample(&mut self.0)
    }
}

fn rms(values: &[f64]) -> f64 {
    (values.iter().map(|value| value * value).sum::<f64>() / values.len() as f64).sqrt()
}

/// An oscillator: `ẍ + 2ζω ẋ + ω² x = f + w`, with the state `y = [x, ẋ, ω, ζ]`. The sensors
/// measure the displacement, and either the velocity or the acceleration. The acceleration depends
/// directly on the force.
#[derive(Debug, Clone, Default)]
struct Oscillator {
    process: [f64; 4],
    observed: [f64; 4],
    force: [f64; 2],
    /// Feedthrough of the force to the sensors, if any.
    felt: Option<DMatrix<f64>>,
}

impl Oscillator {
    fn felt() -> Self {
        Self {
            felt: Some(DMatrix::from_row_slice(2, 1, &[0.0, 1.0])),
            ..Self::default()
        }
    }
}

fn acceleration([x, v, omega, zeta]: [f64; 4], force: f64) -> f64 {
    force - 2.0 * zeta * omega * v - omega * omega * x
}

/// Derivative of the acceleration along a column.
fn along([x, v, omega, zeta]: [f64; 4], columns: &DMatrix<f64>, j: usize) -> f64 {
    let (by_x, by_v) = (-omega * omega, -2.0 * zeta * omega);
    let (by_omega, by_zeta) = (-2.0 * (omega * x + zeta * v), -2.0 * omega * v);
    columns
        .column(j)
        .dot(&Vector4::new(by_x, by_v, by_omega, by_zeta))
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
        self.force[0] = excitation[0];
    }
    fn derivative(&self, out: &mut [f64]) {
        let rate = acceleration(self.process, self.force[0]);
        out.copy_from_slice(&[self.process[1], rate, 0.0, 0.0]);
    }
    fn jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        out.fill(0.0);
        for j in 0..columns.ncols() {
            out[(0, j)] = columns[(1, j)];
            out[(1, j)] = along(self.process, columns, j);
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
    fn linearise_observation(&mut self, state: &[f64], excitation: &[f64]) {
        self.observed.copy_from_slice(state);
        self.force[1] = excitation[0];
    }
    fn observe(&self, out: &mut [f64]) {
        out.copy_from_slice(&self.observed[..2]);
        if self.felt.is_some() {
            out[1] = acceleration(self.observed, self.force[1]);
        }
    }
    fn observation_jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        out.copy_from(&columns.rows(0, 2));
        if self.felt.is_some() {
            (0..columns.ncols()).for_each(|j| out[(1, j)] = along(self.observed, columns, j));
        }
    }
    fn feedthrough(&self) -> Option<&DMatrix<f64>> {
        self.felt.as_ref()
    }
}

/// ẋ = −θ x + u with a rate and a noise level that drift; x is observed.
#[derive(Debug, Clone)]
struct Decay;

impl ContinuousSystem for Decay {
    fn mechanical_len(&self) -> usize {
        1
    }
    fn drifting_len(&self) -> usize {
        2
    }
    fn input_len(&self) -> usize {
        1
    }
    fn observation_len(&self) -> usize {
        1
    }
    fn derivative(&self, state: &[f64], input: &[f64], out: &mut [f64]) {
        out[0] = input[0] - state[1] * state[0];
    }
    fn output(&self, state: &[f64], _: &[f64], out: &mut [f64]) {
        out[0] = state[0];
    }
    fn noise_std(&self, state: &[f64], out: &mut [f64]) {
        out[0] = state[2];
    }
}

fn decay_filter(settings: ParticleSettings) -> ParticleFilter<Drifting<Decay>> {
    let start = GaussianStart {
        mean: DVector::from_row_slice(&[0.0, 1.0, 0.1]),
        covariance: DMatrix::from_diagonal(&DVector::from_row_slice(&[1.0, 0.04, 1e-3])),
        previous_input: None,
    };
    let (drift, lower) = (vec![0.02, 0.002], vec![0.02, 0.002]);
    let model = Drifting::new(Decay, STEP_S, 4, IncrementTime::Start, drift, lower).unwrap();
    ParticleFilter::new(model, settings, start).unwrap()
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
                    // midpoint rule
                    let force = known[k - 1] + unknown[k - 1];
                    let slope =
                        |[x, v]: [f64; 2]| [v, acceleration([x, v, FREQUENCY, DAMPING], force)];
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
        mean: rms(&errors),
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
fn sensors_with_a_direct_term_give_the_extended_kalman_filter() {
    for seed in [1, 2, 3] {
        let motion = simulate(seed, 200);
        // Prior sampling wastes many draws of a directly measured excitation. It needs noisy
        // sensors and more particles.
        let cases = [
            (ImportanceDensity::Optimal, [0.05, 0.2], 3000, 0.12, 1.0),
            (ImportanceDensity::Optimal, [0.2, 1.0], 2000, 0.12, 1.0),
            (ImportanceDensity::Prior, [0.2, 1.0], 16_000, 0.15, 1.5),
        ];
        for (density, sensor_std, particles, allowed, allowed_evidence) in cases {
            let mut normal = Normal::seeded(50 + seed);
            let frames: Vec<_> = (0..200)
                .map(|k| {
                    let [x, v] = motion.states[k];
                    let force = motion.known[k] + motion.unknown[k];
                    let clean = [x, acceleration([x, v, FREQUENCY, DAMPING], force)];
                    (
                        [0, 1].map(|j| clean[j] + sensor_std[j] * normal.draw()),
                        [motion.known[k]],
                    )
                })
                .collect();
            for frames in [frames.clone(), with_gaps(frames)] {
                let prior = DVector::from_row_slice(&[0.0, 0.0, FREQUENCY, DAMPING]);
                let std = DVector::from_row_slice(&[0.2, 0.6, 0.0, 0.0]);
                let settings = FilterSettings::new(STEP_S, prior, std, noises(sensor_std));
                let particle_settings = ParticleSettings {
                    particles,
                    density,
                    seed,
                    threads: 2,
                    ..Default::default()
                };
                let found = compare(Oscillator::felt(), settings, particle_settings, &frames);
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
        let mut filter = decay_filter(ParticleSettings {
            particles: 200,
            density,
            kernel: 0.95,
            ..ParticleSettings::default()
        });
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
            for k in 0..200 {
                let frame = Frame {
                    observations: &[(0.05 * f64::from(k)).sin()],
                    excitation: &[(0.05 * f64::from(k)).cos()],
                };
                resampled += usize::from(filter.step(frame).unwrap().resampled);
                filter.credible_interval(1, 0.95).unwrap();
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
fn impossible_datum_is_an_error_and_a_restart_is_bit_identical_to_the_first_start() {
    let mut filter = decay_filter(ParticleSettings {
        particles: 100,
        ..ParticleSettings::default()
    });
    let frame = Frame {
        observations: &[0.3],
        excitation: &[0.5],
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

/// Turning state of two entries, both disturbed, the first one observed.
#[derive(Debug, Clone)]
struct Turning;

const TURNING: [[f64; 2]; 2] = [[0.95, 0.2], [-0.2, 0.95]];
const LOADING: [f64; 2] = [0.1, 0.3];
const SENSOR_STD: f64 = 0.2;

impl ParticleModel for Turning {
    fn state_len(&self) -> usize {
        2
    }
    fn input_len(&self) -> usize {
        0
    }
    fn disturbance_len(&self) -> usize {
        2
    }
    fn observation_len(&self) -> usize {
        1
    }
    fn propagate(&mut self, interval: Interval<'_>, disturbance: &[f64], state: &mut [f64]) {
        if interval.previous.is_some() {
            let old = [state[0], state[1]];
            for i in 0..2 {
                state[i] =
                    TURNING[i][0] * old[0] + TURNING[i][1] * old[1] + LOADING[i] * disturbance[i];
            }
        }
    }
    fn observe(&mut self, _: Interval<'_>, state: &[f64], out: &mut [f64]) {
        out[0] = state[0];
    }
    fn sensor_covariance(&mut self, _: &[f64], out: &mut DMatrix<f64>) {
        out[(0, 0)] = SENSOR_STD * SENSOR_STD;
    }
}

struct LinearCheck {
    /// RMS of (particle mean − Kalman mean)/(Kalman deviation)
    error: f64,
    /// mean ratio of the deviations
    ratio: f64,
    log_evidence: f64,
    exact_log_evidence: f64,
}

fn linear_check(seed: u64, settings: ParticleSettings) -> LinearCheck {
    let mut normal = Normal::seeded(100 + seed);
    let mut state = [normal.draw(), normal.draw()];
    let linear = LinearModel {
        transition: DMatrix::from_fn(2, 2, |i, j| TURNING[i][j]),
        input: DMatrix::from_diagonal(&DVector::from_row_slice(&LOADING)),
        observation: DMatrix::from_row_slice(1, 2, &[1.0, 0.0]),
        excitation_covariance: DMatrix::identity(2, 2),
        sensor_covariance: DMatrix::from_element(1, 1, SENSOR_STD * SENSOR_STD),
    };
    let mut exact = KalmanFilter::new(linear, DVector::zeros(2), DMatrix::identity(2, 2)).unwrap();
    let start = GaussianStart {
        mean: DVector::zeros(2),
        covariance: DMatrix::identity(2, 2),
        previous_input: Some(DVector::zeros(0)),
    };
    let particles = settings.particles as f64;
    let mut filter = ParticleFilter::new(Turning, settings, start).unwrap();
    let (mut errors, mut ratios, mut exact_log_evidence) = (Vec::new(), Vec::new(), 0.0);
    for _ in 0..200 {
        state = [0, 1].map(|i| {
            TURNING[i][0] * state[0] + TURNING[i][1] * state[1] + LOADING[i] * normal.draw()
        });
        let datum = [state[0] + SENSOR_STD * normal.draw()];
        exact.predict(&[0.0, 0.0]);
        exact_log_evidence += exact.update(&datum).unwrap().log_evidence;
        let step = filter
            .step(Frame {
                observations: &datum,
                excitation: &[],
            })
            .unwrap();
        // §5 check 1
        let identity = particles / (1.0 + step.coefficient_of_variation.powi(2));
        assert!((step.effective_size / identity - 1.0).abs() < 1e-12);
        for i in 0..2 {
            let deviation = exact.covariance()[(i, i)].sqrt();
            errors.push((filter.mean()[i] - exact.mean()[i]) / deviation);
            ratios.push(filter.std()[i] / deviation);
        }
    }
    LinearCheck {
        error: rms(&errors),
        ratio: ratios.iter().sum::<f64>() / ratios.len() as f64,
        log_evidence: filter.log_evidence(),
        exact_log_evidence,
    }
}

#[test]
fn linear_gaussian_system_gives_the_kalman_filter_and_its_evidence() {
    // Ching et al. (2006), §5 checks 2 and 3
    for seed in [1, 2, 3] {
        for resampling in [Resampling::Systematic, Resampling::Multinomial] {
            let run = |density, particles| {
                let settings = ParticleSettings {
                    particles,
                    density,
                    resampling,
                    seed,
                    ..Default::default()
                };
                let check = linear_check(seed, settings);
                println!(
                    "seed {seed}, {resampling:?}, {density:?}, N = {particles}: error {:.3}, \
                     ratio {:.3}, evidence {:+.2}",
                    check.error,
                    check.ratio,
                    check.log_evidence - check.exact_log_evidence
                );
                check
            };
            let name = format!("seed {seed}, {resampling:?}");
            let middle = run(ImportanceDensity::Optimal, 2000);
            assert!(middle.error <= 0.08, "{name}: {}", middle.error);
            assert!(
                (0.98..1.02).contains(&middle.ratio),
                "{name}: {}",
                middle.ratio
            );
            assert!(
                (middle.log_evidence - middle.exact_log_evidence).abs() <= 1.0,
                "{name}"
            );
            let large = run(ImportanceDensity::Optimal, 8000);
            let allowed = if resampling == Resampling::Systematic {
                0.6
            } else {
                1.0
            }; // more variance
            assert!(
                (large.log_evidence - large.exact_log_evidence).abs() <= allowed,
                "{name}"
            );
            let halves = middle.error / large.error;
            assert!(
                (1.5..2.7).contains(&halves),
                "{name}: error falls by {halves} for four times the particles"
            );
            // prior sampling is right too, but scatters more where a datum lies far off
            let prior = run(ImportanceDensity::Prior, 8000);
            assert!(prior.error <= 0.05, "{name}: {}", prior.error);
            assert!(
                (0.98..1.02).contains(&prior.ratio),
                "{name}: {}",
                prior.ratio
            );
            assert!(
                (prior.log_evidence - prior.exact_log_evidence).abs() <= 1.0,
                "{name}"
            );
        }
    }
}
