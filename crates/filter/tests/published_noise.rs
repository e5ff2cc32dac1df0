//! Huang & Yuen (2023), §3.1 and §3.2: the effect of wrong noise levels on a filter, and their
//! identification.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test fails by panicking"
)]

mod systems;

use nalgebra::{DMatrix, DVector};
use spandrel_filter::{
    Annealing, ExtendedKalmanFilter, FadingFactor, FilterSettings, Frame, LinearModel, NoiseModel,
    NoiseParameter, NoisePhase, NoiseRule, NoiseSettings, NoiseTarget,
};
use systems::{Chain, Normal, rms};

const MASSES: usize = 5;
const STEP_S: f64 = 0.0025;
const ALPHA: f64 = 0.2998;
const BETA: f64 = 2.536e-4;

/// Accelerations of all masses under a white force on the last one (ch3 §4.0), without the direct
/// term, with sensor noise.
struct Record {
    data: Vec<DVector<f64>>,
    noise_variance: f64,
}

fn excitation_variance() -> f64 {
    2.0 * std::f64::consts::PI * 5.0e-5 / STEP_S
}

fn simulate(seed: u64, seconds: f64) -> Record {
    let stiffness = Chain::new(MASSES, 5000.0).matrix();
    let damping = DMatrix::identity(MASSES, MASSES) * ALPHA + &stiffness * BETA;
    let mut system = DMatrix::zeros(2 * MASSES, 2 * MASSES);
    system
        .view_mut((0, MASSES), (MASSES, MASSES))
        .fill_with_identity();
    system
        .view_mut((MASSES, 0), (MASSES, MASSES))
        .copy_from(&-&stiffness);
    system
        .view_mut((MASSES, MASSES), (MASSES, MASSES))
        .copy_from(&-&damping);
    let input = DMatrix::from_fn(
        2 * MASSES,
        1,
        |i, _| if i + 1 == 2 * MASSES { 1.0 } else { 0.0 },
    );
    let (transition, held) = LinearModel::discretise(&system, &input, STEP_S);
    let observation = system.rows(MASSES, MASSES).into_owned();
    let mut normal = Normal::seeded(seed);
    let mut u = DVector::zeros(2 * MASSES);
    let mut data: Vec<DVector<f64>> = (0..(seconds / STEP_S) as usize)
        .map(|_| {
            u = &transition * &u + &held * (excitation_variance().sqrt() * normal.draw());
            &observation * &u
        })
        .collect();
    let noise_std = 0.05 * rms(data.iter().map(|z| z[MASSES - 1]));
    for z in &mut data {
        z.iter_mut()
            .for_each(|value| *value += noise_std * normal.draw());
    }
    Record {
        data,
        noise_variance: noise_std * noise_std,
    }
}

fn settings(noise: NoiseModel) -> FilterSettings {
    // ch3 §4.3: a deliberately poor start
    let mut prior = DVector::zeros(2 * MASSES + 3);
    let mut std = DVector::repeat(2 * MASSES + 3, 1e-2);
    for j in 0..MASSES {
        std[MASSES + j] = 1e-1;
    }
    for (j, (mean, deviation)) in [(0.5, 0.3), (1.0, 0.3), (1e-3, 1e-3)]
        .into_iter()
        .enumerate()
    {
        prior[2 * MASSES + j] = mean;
        std[2 * MASSES + j] = deviation;
    }
    let mut settings = FilterSettings::new(STEP_S, prior, std, noise);
    settings.fading = FadingFactor::from_half_life(2000.0).unwrap();
    // The start-up aid of ch2 §3.6. Without it, the filter locks at wrong parameters in one of
    // three records.
    settings.annealing = Some(Annealing {
        amount: 100.0,
        time_constant_s: 1.0,
    });
    for j in 2 * MASSES..2 * MASSES + 3 {
        settings.lower[j] = 0.05 * settings.prior_mean[j];
    }
    settings
}

struct Outcome {
    /// Mean eᵀΣ_z⁻¹e/N_0 after 10 s.
    misfit: f64,
    /// Mean standard deviation of θ_k after 10 s.
    stiffness_std: f64,
    /// Share of the time after 10 s with θ_k and β within ± 3 standard deviations.
    coverage: [f64; 2],
}

fn run_fixed(record: &Record, excitation: f64, sensors: f64) -> Outcome {
    let noise = NoiseModel::known(
        DMatrix::from_element(1, 1, excitation),
        DMatrix::identity(MASSES, MASSES) * sensors,
    );
    let mut filter =
        ExtendedKalmanFilter::new(Chain::new(MASSES, 5000.0), settings(noise)).unwrap();
    let (mut misfit, mut std, mut inside, mut count) = (0.0, 0.0, [0.0; 2], 0.0);
    for (i, datum) in record.data.iter().enumerate() {
        let step = filter
            .step(Frame {
                observations: datum.as_slice(),
                excitation: &[0.0],
            })
            .unwrap();
        if i < 4000 {
            continue;
        }
        count += 1.0;
        misfit += step.normalised_innovation_squared / MASSES as f64;
        let deviation = |j: usize| filter.covariance()[(j, j)].sqrt();
        std += deviation(2 * MASSES);
        for (share, (j, truth)) in inside
            .iter_mut()
            .zip([(2 * MASSES, 1.0), (2 * MASSES + 2, BETA)])
        {
            *share += f64::from(u8::from(
                (filter.mean()[j] - truth).abs() <= 3.0 * deviation(j),
            ));
        }
    }
    Outcome {
        misfit: misfit / count,
        stiffness_std: std / count,
        coverage: inside.map(|share| share / count),
    }
}

#[test]
fn white_noise_intensity_becomes_the_tabulated_variance() {
    // ch3 §5 A1, table 3.1: 0.126
    assert!((excitation_variance() - 0.12566).abs() < 1e-5);
    let omega = Chain::new(MASSES, 5000.0)
        .matrix()
        .symmetric_eigenvalues()
        .min()
        .sqrt();
    assert!((omega / std::f64::consts::TAU - 3.203).abs() < 1e-3);
}

#[test]
fn wrong_noise_levels_show_in_the_innovations_and_the_intervals() {
    // ch3 §5 A20, cases 1 to 3 of table 3.1
    for seed in [1, 2, 3] {
        let record = simulate(seed, 20.0);
        let right = run_fixed(&record, excitation_variance(), record.noise_variance);
        let weak = run_fixed(&record, 0.001, record.noise_variance);
        let noisy = run_fixed(&record, excitation_variance(), 10.0 * record.noise_variance);
        println!(
            "seed {seed}: misfit {:.3} {:.3} {:.3}, sd ratio {:.2}, coverage of θ, β in case 2 {:.2?}",
            right.misfit,
            weak.misfit,
            noisy.misfit,
            noisy.stiffness_std / right.stiffness_std,
            weak.coverage
        );
        assert!(
            (right.misfit - 1.0).abs() <= 0.05,
            "seed {seed}: case 1 has a misfit of {}",
            right.misfit
        );
        assert!(
            weak.misfit > 3.0,
            "seed {seed}: case 2 has a misfit of {}",
            weak.misfit
        );
        assert!(
            noisy.misfit < 0.2,
            "seed {seed}: case 3 has a misfit of {}",
            noisy.misfit
        );
        let ratio = noisy.stiffness_std / right.stiffness_std;
        assert!(
            (2.0..=3.5).contains(&ratio),
            "seed {seed}: sd of θ grows by {ratio}"
        );
        assert!(
            weak.coverage[1] < 0.5,
            "seed {seed}: case 2 covers β {} of the time",
            weak.coverage[1]
        );
    }
}

#[test]
fn scaling_all_noises_scales_the_covariances_and_not_the_estimates() {
    // ch3 §5 A4 with ρ = 7: on a linear system, with fading
    let record = simulate(4, 2.0);
    let rho = 7.0_f64;
    let noise = |scale: f64| {
        NoiseModel::known(
            DMatrix::from_element(1, 1, scale * excitation_variance()),
            DMatrix::identity(MASSES, MASSES) * (scale * record.noise_variance),
        )
    };
    let filter = |scale: f64| {
        let mut settings = settings(noise(scale));
        settings.prior_std *= scale.sqrt();
        for (j, known) in [1.0, ALPHA, BETA].into_iter().enumerate() {
            // Known parameters make the system linear.
            settings.prior_mean[2 * MASSES + j] = known;
            settings.prior_std[2 * MASSES + j] = 0.0;
        }
        ExtendedKalmanFilter::new(Chain::new(MASSES, 5000.0), settings).unwrap()
    };
    let (mut plain, mut scaled) = (filter(1.0), filter(rho));
    for datum in &record.data {
        let frame = Frame {
            observations: datum.as_slice(),
            excitation: &[0.0],
        };
        plain.step(frame).unwrap();
        scaled.step(frame).unwrap();
    }
    let n = 2 * MASSES;
    for j in 0..n {
        for i in 0..n {
            let (small, large) = (plain.covariance()[(i, j)], scaled.covariance()[(i, j)]);
            let scale = (plain.covariance()[(i, i)] * plain.covariance()[(j, j)]).sqrt();
            assert!(
                (large - rho * small).abs() < 1e-9 * rho * scale,
                "covariance ({i}, {j})"
            );
        }
        assert!((plain.mean()[j] - scaled.mean()[j]).abs() < 1e-9 * plain.mean().rows(0, n).amax());
    }
}

/// Identifies noise levels of the chain from ψ = 1 as in the source, with equal levels for all
/// sensors.
///
/// `targets` selects the levels of the sensors and of the force.
fn identify(
    record: &Record,
    rule: NoiseRule,
    targets: &[NoiseTarget],
) -> ExtendedKalmanFilter<Chain> {
    let mut noise = NoiseModel::known(
        DMatrix::from_element(1, 1, excitation_variance()),
        DMatrix::zeros(MASSES, MASSES),
    );
    for &target in targets {
        let size = match target {
            NoiseTarget::Excitation => 1,
            NoiseTarget::Sensors => MASSES,
        };
        noise.parameters.push(NoiseParameter {
            name: format!("{target:?}"),
            target,
            pattern: DMatrix::identity(size, size),
            start: 1.0,
            start_std: 1.0 / 3.0,
        });
        if target == NoiseTarget::Excitation {
            noise.excitation.fill(0.0);
        }
    }
    let mut settings = settings(noise);
    let period_s = 1.0 / 3.203;
    settings.noise_settings = NoiseSettings {
        rule,
        training_steps: (10.0 * period_s / STEP_S) as u64,
        training_limit_steps: (40.0 * period_s / STEP_S) as u64,
        ..NoiseSettings::default()
    };
    let mut filter = ExtendedKalmanFilter::new(Chain::new(MASSES, 5000.0), settings).unwrap();
    for datum in &record.data {
        filter
            .step(Frame {
                observations: datum.as_slice(),
                excitation: &[0.0],
            })
            .unwrap();
    }
    filter
}

#[test]
fn working_phase_needs_no_fallback_and_no_shortened_step() {
    // ch3 §5 A21 on the chain
    for rule in [NoiseRule::Published, NoiseRule::Fisher] {
        for seed in [1, 2, 3] {
            let record = simulate(seed, 60.0);
            let filter = identify(&record, rule, &[NoiseTarget::Sensors]);
            let noise = filter.noise();
            let ratio = noise.mean[0] / record.noise_variance;
            println!(
                "{rule:?} seed {seed}: {:?}, fallbacks {} in training, {} later, shortened {}, ψ/true {ratio:.3} ± {:.3}",
                noise.phase,
                noise.fallbacks,
                noise.working_fallbacks,
                noise.limited,
                noise.largest_relative_std(),
            );
            assert_eq!(noise.phase, NoisePhase::Working, "{rule:?} seed {seed}");
            assert_eq!(
                (noise.working_fallbacks, noise.limited),
                (0, 0),
                "{rule:?} seed {seed}"
            );
            assert!(
                (ratio - 1.0).abs() < 0.1,
                "{rule:?} seed {seed}: sensors {ratio} of the truth"
            );
        }
    }
}

#[test]
fn level_that_the_data_hardly_inform_stays_uncertain() {
    // ch3 §5, failure signatures: a force reaches the sensors after more than one sample, but the
    // likelihood covers one step. The published rule treats a level as known after training, so it
    // must stay in training. The scoring rule continues to learn. Its training therefore ends at
    // the limit of 40 periods = 12.5 s, and the level keeps its uncertainty.
    for (rule, seconds, phase) in [
        (NoiseRule::Published, 20.0, NoisePhase::Training),
        (NoiseRule::Fisher, 12.0, NoisePhase::Training),
        (NoiseRule::Fisher, 20.0, NoisePhase::Working),
    ] {
        let record = simulate(1, seconds);
        let filter = identify(
            &record,
            rule,
            &[NoiseTarget::Excitation, NoiseTarget::Sensors],
        );
        let noise = filter.noise();
        println!(
            "{rule:?}, {seconds} s: relative sd {:.3}",
            noise.largest_relative_std()
        );
        assert_eq!(noise.phase, phase, "{rule:?}, {seconds} s");
        assert!(noise.largest_relative_std() > 0.1, "{rule:?}, {seconds} s");
    }
}
