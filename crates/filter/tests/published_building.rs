//! Huang & Yuen (2023), §2.3.2: Kalman filter of a sixty-storey shear building with unknown ground
//! motion.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test fails by panicking"
)]

mod systems;

use nalgebra::{DMatrix, DVector};
use spandrel_filter::{KalmanFilter, LinearModel};
use systems::{Chain, Normal, rms};

const FLOORS: usize = 60;
const STEP_S: f64 = 0.005;

struct Errors {
    /// For each state: Σ error², Σ signal², Σ (error/sd)², number of times within 3 sd.
    sums: Vec<[f64; 4]>,
    count: f64,
    chi_squared: f64,
    floors_std: [[f64; 2]; 3],
    first_displacement_std: Vec<f64>,
}

/// Floors with accelerometers.
const SENSED: [usize; 7] = [1, 10, 20, 30, 40, 50, 60];
/// Stationary standard deviations of displacement (m) and velocity (m/s) of floors 1, 30, 60 in an
/// independent run.
const REFERENCE: [[f64; 2]; 3] = [[4.1e-6, 2.1e-4], [9.3e-5, 2.5e-4], [1.3e-4, 2.7e-4]];

/// Returns the building with noise-free sensors.
fn building() -> LinearModel {
    let stiffness = Chain::new(FLOORS, 1632.0).matrix();
    let damping = DMatrix::identity(FLOORS, FLOORS) * 0.0157 + &stiffness * 0.0048;
    let mut system = DMatrix::zeros(2 * FLOORS, 2 * FLOORS);
    system
        .view_mut((0, FLOORS), (FLOORS, FLOORS))
        .fill_with_identity();
    system
        .view_mut((FLOORS, 0), (FLOORS, FLOORS))
        .copy_from(&-&stiffness);
    system
        .view_mut((FLOORS, FLOORS), (FLOORS, FLOORS))
        .copy_from(&-&damping);
    let input = DMatrix::from_fn(2 * FLOORS, 1, |i, _| if i < FLOORS { 0.0 } else { -1.0 });
    let (transition, held) = LinearModel::discretise(&system, &input, STEP_S);
    let observation = DMatrix::from_fn(SENSED.len(), 2 * FLOORS, |c, j| {
        system[(FLOORS + SENSED[c] - 1, j)]
    });
    let variance = 2.0 * std::f64::consts::PI * 1.6e-5 / STEP_S;
    LinearModel {
        transition,
        input: held,
        observation,
        excitation_covariance: DMatrix::from_element(1, 1, variance),
        sensor_covariance: DMatrix::zeros(SENSED.len(), SENSED.len()),
    }
}

/// Returns the filter of the source, without knowledge of the initial state.
fn filter(mut model: LinearModel, noise_std: &DVector<f64>) -> KalmanFilter {
    model.sensor_covariance = DMatrix::from_diagonal(&noise_std.map(|std| std * std));
    KalmanFilter::new(
        model,
        DVector::zeros(2 * FLOORS),
        DMatrix::identity(2 * FLOORS, 2 * FLOORS),
    )
    .unwrap()
}

/// Returns the standard deviations of displacement and velocity of floors 1, 30, 60.
fn deviations(filter: &KalmanFilter) -> [[f64; 2]; 3] {
    let std = |j: usize| filter.covariance()[(j, j)].sqrt();
    [1, 30, 60].map(|floor| [std(floor - 1), std(FLOORS + floor - 1)])
}

fn run(seed: u64) -> Errors {
    let model = building();
    let variance = model.excitation_covariance[(0, 0)];
    let mut normal = Normal::seeded(seed);
    let mut u = DVector::zeros(2 * FLOORS);
    let mut truth = Vec::with_capacity(40_000);
    for _ in 0..40_000 {
        u = &model.transition * &u + &model.input * (variance.sqrt() * normal.draw());
        truth.push(u.clone());
    }
    let clean: Vec<DVector<f64>> = truth.iter().map(|u| &model.observation * u).collect();
    let noise_std = DVector::from_fn(SENSED.len(), |c, _| 0.05 * rms(clean.iter().map(|z| z[c])));
    let mut filter = filter(model, &noise_std);
    let mut errors = Errors {
        sums: vec![[0.0; 4]; 2 * FLOORS],
        count: 0.0,
        chi_squared: 0.0,
        floors_std: [[0.0; 2]; 3],
        first_displacement_std: Vec::new(),
    };
    for (i, (u, z)) in truth.iter().zip(&clean).enumerate() {
        let datum = DVector::from_fn(SENSED.len(), |c, _| z[c] + noise_std[c] * normal.draw());
        filter.predict(&[0.0]);
        let step = filter.update(datum.as_slice()).unwrap();
        if i == 0 {
            errors.first_displacement_std = [1, 30, 60]
                .map(|f| filter.covariance()[(f - 1, f - 1)].sqrt())
                .to_vec();
        }
        if i < 4_000 {
            continue; // the first 20 s do not count
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
    errors.floors_std = deviations(&filter);
    errors
}

#[test]
fn sixty_storeys_reach_the_published_accuracy() {
    // Spec of chapter 2, §5 check 6. Sensor noise is 5 % of the rms of the record, and 200 s are
    // only 33 periods of the first mode. The rms of a record varies by 20 % between seeds, and so
    // do the noise and every standard deviation of a displacement. Figures that depend on the
    // record are therefore compared as the mean over the seeds. The standard deviations of the
    // displacement, which depend most on it, have their own test.
    let seeds = [1, 2, 3];
    let mut relative_velocity = [0.0; 4];
    let mut velocity_std = [0.0; 3];
    for seed in seeds {
        let errors = run(seed);
        let relative = |j: usize| (errors.sums[j][0] / errors.sums[j][1]).sqrt();
        for (mean, floor) in relative_velocity.iter_mut().zip([1, 10, 30, 60]) {
            let displacement = relative(floor - 1);
            assert!(
                displacement <= 0.005,
                "seed {seed} floor {floor}: displacement off by {displacement}"
            );
            *mean += relative(FLOORS + floor - 1) / seeds.len() as f64;
            let velocity = (errors.sums[FLOORS + floor - 1][0] / errors.count).sqrt();
            assert!(
                (2.05e-4..2.85e-4).contains(&velocity),
                "seed {seed} floor {floor}: velocity off by {velocity}"
            );
        }
        let states = errors.sums.len() as f64;
        let normalised =
            (errors.sums.iter().map(|s| s[2]).sum::<f64>() / errors.count / states).sqrt();
        let inside = errors.sums.iter().map(|s| s[3]).sum::<f64>() / errors.count / states;
        let chi_squared = errors.chi_squared / errors.count / 7.0;
        println!(
            "seed {seed}: normalised error {normalised:.4}, inside 3 sd {inside:.4}, mean χ²/7 {chi_squared:.4}"
        );
        assert!(
            (0.97..=1.03).contains(&normalised),
            "seed {seed}: normalised error {normalised}"
        );
        assert!(inside >= 0.995, "seed {seed}: inside 3 sd {inside}");
        assert!(
            (chi_squared - 1.0).abs() <= 0.02,
            "seed {seed}: mean innovation χ²/7 {chi_squared}"
        );
        for (mean, [_, velocity]) in velocity_std.iter_mut().zip(errors.floors_std) {
            *mean += velocity / seeds.len() as f64;
        }
        for std in &errors.first_displacement_std {
            assert!(
                (0.35..=0.75).contains(std),
                "seed {seed}: displacement sd after one sample {std}"
            );
        }
    }
    println!(
        "relative rms error of the velocities of floors 1, 10, 30, 60: {relative_velocity:.4?}"
    );
    assert!(
        relative_velocity.iter().all(|&velocity| velocity <= 0.10),
        "velocities off by {relative_velocity:?}"
    );
    for (found, [_, expected]) in velocity_std.iter().zip(REFERENCE) {
        assert!(
            (found / expected - 1.0).abs() <= 0.05,
            "velocity sd {found:e}, expected {expected:e}"
        );
    }
}

/// Returns the stationary covariance of the state: `P = A P Aᵀ + B q Bᵀ`, by doubling.
fn stationary_covariance(model: &LinearModel) -> DMatrix<f64> {
    let mut transition = model.transition.clone();
    let mut covariance = &model.input * &model.excitation_covariance * model.input.transpose();
    // 2²⁰ steps are 5000 s, fifty times the decay time of the first mode.
    for _ in 0..20 {
        covariance += &transition * &covariance * transition.transpose();
        transition = &transition * &transition;
    }
    covariance
}

#[test]
fn one_strength_of_the_first_mode_gives_all_six_deviations() {
    // Chapter 2, §5 check 6: 4.1e-6, 9.3e-5, 1.3e-4 m and 2.1, 2.5, 2.7e-4 m/s, ± 5 %, reached
    // within 10 s. These figures depend on the record only through the noise, which is 5 % of its
    // signal. A record of 200 s differs from the stationary response mainly in the first mode,
    // because it contains only 33 periods of it. The strength of this mode is the unknown.
    // Determined from the displacement of the roof, it must reproduce the other five figures.
    let model = building();
    let covariance = stationary_covariance(&model);
    let modes = Chain::new(FLOORS, 1632.0).matrix().symmetric_eigen();
    let shape = modes.eigenvectors.column(modes.eigenvalues.imin());
    let onto_shape = shape * shape.transpose();
    let mut projection = DMatrix::zeros(2 * FLOORS, 2 * FLOORS);
    projection
        .view_mut((0, 0), (FLOORS, FLOORS))
        .copy_from(&onto_shape);
    projection
        .view_mut((FLOORS, FLOORS), (FLOORS, FLOORS))
        .copy_from(&onto_shape);
    let first_mode = &projection * &covariance * &projection;
    let shown = |covariance: &DMatrix<f64>| {
        (&model.observation * covariance * model.observation.transpose()).diagonal()
    };
    let (all, first) = (shown(&covariance), shown(&first_mode));
    let steady = |strength: f64| {
        let noise_std =
            (&all + &first * (strength * strength - 1.0)).map(|variance| 0.05 * variance.sqrt());
        let mut filter = filter(model.clone(), &noise_std);
        for _ in 0..2_000 {
            filter.predict(&[0.0]);
            filter.update(&[0.0; SENSED.len()]).unwrap();
        }
        deviations(&filter)
    };
    let roof = REFERENCE[2][0];
    let (mut weak, mut strong) = (0.8, 1.6);
    for _ in 0..8 {
        let middle = 0.5 * (weak + strong);
        (weak, strong) = if steady(middle)[2][0] < roof {
            (middle, strong)
        } else {
            (weak, middle)
        };
    }
    let found = steady(weak);
    println!(
        "strength {weak:.3}: {found:?}; of the stationary response {:?}",
        steady(1.0)
    );
    // The range is the variation between records of 200 s.
    assert!((0.8..=1.5).contains(&weak), "strength {weak}");
    for (found, expected) in found.iter().flatten().zip(REFERENCE.iter().flatten()) {
        assert!(
            (found / expected - 1.0).abs() <= 0.05,
            "{found:e}, expected {expected:e}"
        );
    }
}
