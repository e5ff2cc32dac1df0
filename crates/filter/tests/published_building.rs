//! Huang & Yuen (2023), §2.3.2: Kalman filter of a sixty-storey shear building, ground motion unknown.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

mod systems;

use nalgebra::{DMatrix, DVector};
use spandrel_filter::{KalmanFilter, LinearModel};
use systems::{Chain, Normal, rms};

const FLOORS: usize = 60;
const STEP_S: f64 = 0.005;

struct Errors {
    /// per state: Σ error², Σ signal², Σ (error/sd)², times inside 3 sd
    sums: Vec<[f64; 4]>,
    count: f64,
    chi_squared: f64,
    floors_std: Vec<[f64; 2]>,
    first_displacement_std: Vec<f64>,
}

fn run(seed: u64) -> Errors {
    let stiffness = Chain::new(FLOORS, 1632.0).matrix();
    let damping = DMatrix::identity(FLOORS, FLOORS) * 0.0157 + &stiffness * 0.0048;
    let mut system = DMatrix::zeros(2 * FLOORS, 2 * FLOORS);
    system.view_mut((0, FLOORS), (FLOORS, FLOORS)).fill_with_identity();
    system.view_mut((FLOORS, 0), (FLOORS, FLOORS)).copy_from(&-&stiffness);
    system.view_mut((FLOORS, FLOORS), (FLOORS, FLOORS)).copy_from(&-&damping);
    let input = DMatrix::from_fn(2 * FLOORS, 1, |i, _| if i < FLOORS { 0.0 } else { -1.0 });
    let (transition, held) = LinearModel::discretise(&system, &input, STEP_S);
    let sensed = [1, 10, 20, 30, 40, 50, 60];
    let observation = DMatrix::from_fn(sensed.len(), 2 * FLOORS, |c, j| system[(FLOORS + sensed[c] - 1, j)]);
    let variance = 2.0 * std::f64::consts::PI * 1.6e-5 / STEP_S;

    let mut normal = Normal::seeded(seed);
    let mut u = DVector::zeros(2 * FLOORS);
    let mut truth = Vec::with_capacity(40_000);
    for _ in 0..40_000 {
        u = &transition * &u + &held * (variance.sqrt() * normal.draw());
        truth.push(u.clone());
    }
    let clean: Vec<DVector<f64>> = truth.iter().map(|u| &observation * u).collect();
    let noise_std = DVector::from_fn(sensed.len(), |c, _| 0.05 * rms(clean.iter().map(|z| z[c])));
    let model = LinearModel {
        transition,
        input: held,
        observation,
        excitation_covariance: DMatrix::from_element(1, 1, variance),
        sensor_covariance: DMatrix::from_diagonal(&noise_std.map(|std| std * std)),
    };
    let mut filter =
        KalmanFilter::new(model, DVector::zeros(2 * FLOORS), DMatrix::identity(2 * FLOORS, 2 * FLOORS)).unwrap();
    let mut errors = Errors {
        sums: vec![[0.0; 4]; 2 * FLOORS],
        count: 0.0,
        chi_squared: 0.0,
        floors_std: Vec::new(),
        first_displacement_std: Vec::new(),
    };
    for (i, (u, z)) in truth.iter().zip(&clean).enumerate() {
        let datum = DVector::from_fn(sensed.len(), |c, _| z[c] + noise_std[c] * normal.draw());
        filter.predict(&[0.0]);
        let step = filter.update(datum.as_slice()).unwrap();
        if i == 0 {
            errors.first_displacement_std = [1, 30, 60].map(|f| filter.covariance()[(f - 1, f - 1)].sqrt()).to_vec();
        }
        if i < 4_000 {
            continue; // 20 s
        }
        errors.count += 1.0;
        errors.chi_squared += step.normalised_innovation_squared;
        for (j, sums) in errors.sums.iter_mut().enumerate() {
            let error = filter.mean()[j] - u[j];
            let normalised = error * error / filter.covariance()[(j, j)];
            sums[0] += error * error;
            sums[1] += u[j] * u[j];
            sums[2] += normalised;
            sums[3] += f64::from(u8::from(normalised <= 9.0));
        }
    }
    let std = |j: usize| filter.covariance()[(j, j)].sqrt();
    errors.floors_std = [1, 30, 60].map(|f| [std(f - 1), std(FLOORS + f - 1)]).to_vec();
    errors
}

#[test]
fn sixty_storeys_reach_the_published_accuracy() {
    // spec of chapter 2, §5 check 6. Sensor noise is 5 % of the rms of the record at hand, and 200 s are only 33 periods
    // of the first mode: over seeds the rms of a record, and with it the noise and every displacement deviation, scatters
    // by 20 %. Figures that follow the record are therefore compared in the mean over the seeds or with that scatter.
    let seeds = [1, 2, 3];
    let mut relative_velocity = [0.0; 4];
    for seed in seeds {
        let errors = run(seed);
        let relative = |j: usize| (errors.sums[j][0] / errors.sums[j][1]).sqrt();
        for (mean, floor) in relative_velocity.iter_mut().zip([1, 10, 30, 60]) {
            let displacement = relative(floor - 1);
            assert!(displacement <= 0.005, "seed {seed} floor {floor}: displacement off by {displacement}");
            *mean += relative(FLOORS + floor - 1) / seeds.len() as f64;
            let velocity = (errors.sums[FLOORS + floor - 1][0] / errors.count).sqrt();
            assert!((2.05e-4..2.85e-4).contains(&velocity), "seed {seed} floor {floor}: velocity off by {velocity}");
        }
        let states = errors.sums.len() as f64;
        let normalised = (errors.sums.iter().map(|s| s[2]).sum::<f64>() / errors.count / states).sqrt();
        let inside = errors.sums.iter().map(|s| s[3]).sum::<f64>() / errors.count / states;
        let chi_squared = errors.chi_squared / errors.count / 7.0;
        println!("seed {seed}: normalised error {normalised:.4}, inside 3 sd {inside:.4}, mean χ²/7 {chi_squared:.4}");
        assert!((0.97..=1.03).contains(&normalised), "seed {seed}: normalised error {normalised}");
        assert!(inside >= 0.995, "seed {seed}: inside 3 sd {inside}");
        assert!((chi_squared - 1.0).abs() <= 0.02, "seed {seed}: mean innovation χ²/7 {chi_squared}");
        let published = [[4.1e-6, 2.1e-4], [9.3e-5, 2.5e-4], [1.3e-4, 2.7e-4]];
        for ([displacement, velocity], [published_displacement, published_velocity]) in
            errors.floors_std.iter().zip(published)
        {
            let ratio = displacement / published_displacement;
            assert!((0.75..=1.25).contains(&ratio), "seed {seed}: displacement sd {displacement:e}");
            // 5 %, and half a unit of the last printed digit
            let ratio = velocity / published_velocity;
            assert!((ratio - 1.0).abs() < 0.07, "seed {seed}: velocity sd {velocity:e}");
        }
        for std in &errors.first_displacement_std {
            assert!((0.35..=0.75).contains(std), "seed {seed}: displacement sd after one sample {std}");
        }
    }
    println!("relative rms error of the velocities of floors 1, 10, 30, 60: {relative_velocity:.4?}");
    assert!(relative_velocity.iter().all(|&velocity| velocity <= 0.10), "velocities off by {relative_velocity:?}");
}
