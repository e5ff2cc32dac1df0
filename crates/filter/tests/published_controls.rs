//! Huang & Yuen (2023), §2.4: the failures of a filter without its guards, as negative controls of
//! the method.

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
    ProcessModel,
};
use systems::bouc_wen::{self, BoucWen, Displacements, MASSES};
use systems::bridge::{self, Bridge};
use systems::{Normal, rms};

fn diagonal(std: &[f64]) -> DMatrix<f64> {
    DMatrix::from_diagonal(&DVector::from_iterator(
        std.len(),
        std.iter().map(|std| std * std),
    ))
}

/// Runs 150 000 steps of the Bouc-Wen chain; returns the filter and the growth of its first
/// standard deviation.
fn hysteresis(displacements: Displacements) -> (ExtendedKalmanFilter<BoucWen>, f64) {
    let step_s = 0.002;
    let excitation = (2.0 * std::f64::consts::PI * 5e-3_f64 / step_s).sqrt();
    let mut normal = Normal::seeded(11);
    let clean = bouc_wen::simulate(&mut normal, 150_000, step_s, excitation);
    let noise: Vec<f64> = (0..5)
        .map(|c| 0.05 * rms(clean.iter().map(|z| z[c])))
        .collect();
    let model = BoucWen::new(displacements);
    let n = model.state_len();
    let first = model.first_velocity();
    let mut mean = DVector::zeros(n);
    let mut std = DVector::repeat(n, 1e-5);
    for j in first..first + MASSES {
        std[j] = 1e-4;
    }
    for (j, sign) in [1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, -1.0, 1.0, -1.0]
        .into_iter()
        .enumerate()
    {
        mean[first + 2 * MASSES + j] = 1.0 + 0.2 * sign;
        std[first + 2 * MASSES + j] = 0.2;
    }
    let noises = NoiseModel::known(
        DMatrix::from_element(1, 1, excitation * excitation),
        diagonal(&noise),
    );
    let mut settings = FilterSettings::new(step_s, mean, std, noises);
    settings.fading = FadingFactor::from_half_life(2000.0).unwrap();
    settings.annealing = Some(Annealing {
        amount: 100.0,
        time_constant_s: 2.0,
    });
    for j in first + 2 * MASSES..n {
        settings.lower[j] = 0.05;
        settings.upper[j] = 5.0;
    }
    let mut filter = ExtendedKalmanFilter::new(model, settings).unwrap();
    let mut start = 0.0;
    for (k, z) in clean.iter().enumerate() {
        let datum: Vec<f64> = z
            .iter()
            .zip(&noise)
            .map(|(z, std)| z + std * normal.draw())
            .collect();
        filter
            .step(Frame {
                observations: &datum,
                excitation: &[0.0],
            })
            .unwrap();
        if k == 0 {
            start = filter.covariance()[(0, 0)].sqrt();
        }
    }
    let growth = filter.covariance()[(0, 0)].sqrt() / start;
    (filter, growth)
}

#[test]
fn displacements_that_nothing_observes_wind_up_alone() {
    // Spec of chapter 2, §5 check 12: growth by 5.8e22 in 150 000 steps (2^75 = 3.8e22 by fading
    // alone). The other entries stay correct.
    let (kept, left_out) = std::thread::scope(|scope| {
        let kept = scope.spawn(|| hysteresis(Displacements::Kept));
        let left_out = hysteresis(Displacements::LeftOut);
        (kept.join().unwrap(), left_out)
    });
    let ((with, growth), (without, _)) = (kept, left_out);
    println!("the standard deviation of a displacement grew by {growth:.2e}");
    assert!((1e22..1e24).contains(&growth), "grew by {growth:e}");
    let (n, m) = (with.mean().len(), without.mean().len());
    for p in 0..11 {
        let (a, b) = (with.mean()[n - 11 + p], without.mean()[m - 11 + p]);
        let std = without.covariance()[(m - 11 + p, m - 11 + p)].sqrt();
        assert!(
            (a - b).abs() < 0.05 * std,
            "parameter {p}: {a} with displacements, {b} ± {std} without"
        );
        assert!((b - 1.0).abs() < 5.0 * std, "parameter {p}: {b} ± {std}");
    }
}

/// Runs twelve seconds of the bridge from a start with 30 % error.
fn start_of_the_bridge(identity_prior: bool) -> (Vec<f64>, Vec<f64>) {
    let step_s = 0.004;
    let model = Bridge::new();
    let n = model.freedoms();
    let std = [5.0e-5_f64, 3.2e-5].map(|s| (2.0 * std::f64::consts::PI * s / step_s).sqrt());
    let (system, input, rows) = model.nominal();
    let (transition, held) = LinearModel::discretise(&system, &input, step_s);
    let mut normal = Normal::seeded(21);
    let mut u = DVector::zeros(2 * n);
    let clean: Vec<DVector<f64>> = (0..3000)
        .map(|_| {
            let f = DVector::from_row_slice(&[std[0] * normal.draw(), std[1] * normal.draw()]);
            u = &transition * &u + &held * f;
            &rows * &u
        })
        .collect();
    let noise: Vec<f64> = (0..8)
        .map(|c| 0.05 * rms(clean.iter().map(|z| z[c])))
        .collect();
    let mut mean = DVector::zeros(2 * n + bridge::GROUPS + 2);
    let mut prior = DVector::repeat(mean.len(), 1e-5);
    for j in 0..n {
        prior[n + j] = 1e-4;
    }
    if identity_prior {
        prior.fill(1.0);
    }
    for (j, sign) in [1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0]
        .into_iter()
        .enumerate()
    {
        mean[2 * n + j] = 1.0 + 0.3 * sign;
        prior[2 * n + j] = 0.3;
    }
    for (j, start) in [1.5, 0.5].into_iter().enumerate() {
        mean[2 * n + bridge::GROUPS + j] = start;
        prior[2 * n + bridge::GROUPS + j] = 0.5;
    }
    let noises = NoiseModel::known(diagonal(&std), diagonal(&noise));
    let mut settings = FilterSettings::new(step_s, mean, prior, noises);
    settings.fading = FadingFactor::from_half_life(2000.0).unwrap();
    settings.annealing = (!identity_prior).then_some(Annealing {
        amount: 100.0,
        time_constant_s: 2.0,
    });
    for j in 2 * n..2 * n + bridge::GROUPS + 2 {
        settings.lower[j] = 0.05;
        settings.upper[j] = 20.0;
    }
    let mut filter = ExtendedKalmanFilter::new(model, settings).unwrap();
    for z in &clean {
        let datum: Vec<f64> = z
            .iter()
            .zip(&noise)
            .map(|(z, std)| z + std * normal.draw())
            .collect();
        filter
            .step(Frame {
                observations: &datum,
                excitation: &[0.0, 0.0],
            })
            .unwrap();
    }
    let factors = (2 * n..2 * n + bridge::GROUPS)
        .map(|j| (filter.mean()[j], filter.covariance()[(j, j)].sqrt()));
    factors.unzip()
}

#[test]
fn wide_prior_of_the_motion_locks_the_bridge_at_wrong_factors() {
    // Spec of chapter 2, §5 check 12 and §3.6: with an identity prior, the filter locks with
    // standard deviations of 0.001 to 0.003 at 12 s. With a start at rest and annealing, all
    // factors are within 0.4 %.
    let (locked, guarded) = std::thread::scope(|scope| {
        let locked = scope.spawn(|| start_of_the_bridge(true));
        let guarded = start_of_the_bridge(false);
        (locked.join().unwrap(), guarded)
    });
    println!("identity prior: {:.3?} ± {:.4?}", locked.0, locked.1);
    println!("at rest, annealed: {:.4?} ± {:.4?}", guarded.0, guarded.1);
    let worst = |factors: &[f64]| {
        factors
            .iter()
            .map(|factor| (factor - 1.0).abs())
            .fold(0.0, f64::max)
    };
    assert!(
        worst(&locked.0) > 0.1,
        "the wide prior did not lock: {:?}",
        locked.0
    );
    assert!(
        locked.1.iter().all(|std| *std < 0.01),
        "and is not sure of it: {:?}",
        locked.1
    );
    assert!(
        worst(&guarded.0) < 0.008,
        "the guarded start is off: {:?}",
        guarded.0
    );
}

#[test]
fn bridge_has_the_published_frequencies() {
    // Spec of chapter 2, §5 check 4
    let bridge = Bridge::new();
    assert_eq!(bridge.freedoms(), 59);
    let lower = nalgebra::Cholesky::new(bridge.mass.clone()).unwrap().l();
    let half = lower.solve_lower_triangular(&bridge.stiffness).unwrap();
    let standard = lower.solve_lower_triangular(&half.transpose()).unwrap();
    let mut eigenvalues: Vec<f64> = standard.symmetric_eigenvalues().iter().copied().collect();
    eigenvalues.sort_by(f64::total_cmp);
    let found: Vec<f64> = eigenvalues[..5]
        .iter()
        .map(|value| value.sqrt() / std::f64::consts::TAU)
        .collect();
    for (found, published) in found.iter().zip([0.466, 0.531, 0.699, 0.890, 1.332]) {
        assert!(
            (found - published).abs() < 0.001,
            "{found} Hz, published {published}"
        );
    }
}
