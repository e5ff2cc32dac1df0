//! Ching, Beck, Porter & Shaikhutdinov (2006): the particle filter compared with the Kalman filter.
//!
//! The systems are a building with drifting properties and a hysteretic oscillator.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test fails by panicking"
)]

mod systems;

use nalgebra::{DMatrix, DVector};
use spandrel_filter::{
    Frame, GaussianStart, ImportanceDensity, Interval, KalmanFilter, LinearModel, ParticleFilter,
    ParticleModel, ParticleSettings, Resampling,
};
use systems::numerical_ekf::NumericalEkf;
use systems::{Normal, drifting_building, hysteretic, rms};

/// A rotating state of two entries, both with disturbances, the first one observed.
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
    /// RMS of (particle mean − Kalman mean)/(Kalman standard deviation).
    error: f64,
    /// Mean ratio of the standard deviations.
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
    let mut filter = ParticleFilter::new(Turning, settings, start).unwrap();
    let (mut errors, mut ratios, mut exact_log_evidence) = (Vec::new(), Vec::new(), 0.0);
    for _ in 0..200 {
        state = [0, 1].map(|i| {
            TURNING[i][0] * state[0] + TURNING[i][1] * state[1] + LOADING[i] * normal.draw()
        });
        let datum = [state[0] + SENSOR_STD * normal.draw()];
        exact.predict(&[0.0, 0.0]);
        exact_log_evidence += exact.update(&datum).unwrap().log_evidence;
        filter
            .step(Frame {
                observations: &datum,
                excitation: &[],
            })
            .unwrap();
        for i in 0..2 {
            let deviation = exact.covariance()[(i, i)].sqrt();
            errors.push((filter.mean()[i] - exact.mean()[i]) / deviation);
            ratios.push(filter.std()[i] / deviation);
        }
    }
    LinearCheck {
        error: rms(errors.into_iter()),
        ratio: ratios.iter().sum::<f64>() / ratios.len() as f64,
        log_evidence: filter.log_evidence(),
        exact_log_evidence,
    }
}

#[test]
fn linear_gaussian_system_gives_the_kalman_filter_and_its_evidence() {
    // §5 checks 2 and 3
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
                    "seed {seed}, {resampling:?}, {density:?}, N = {particles}: error {:.3}, ratio {:.3}, evidence {:+.2}",
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
            }; // higher variance
            assert!(
                (large.log_evidence - large.exact_log_evidence).abs() <= allowed,
                "{name}"
            );
            let halves = middle.error / large.error;
            assert!(
                (1.5..2.7).contains(&halves),
                "{name}: error falls by {halves} for four times the particles"
            );
            // Prior sampling is correct too, but varies more if a datum is far from its prediction.
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

fn oscillator_filter(
    record: &hysteretic::Record,
    settings: ParticleSettings,
) -> ParticleFilter<spandrel_filter::Drifting<hysteretic::Oscillator>> {
    let (mean, covariance) = record.prior();
    let start = GaussianStart {
        mean,
        covariance,
        previous_input: None,
    };
    ParticleFilter::new(record.model().unwrap(), settings, start).unwrap()
}

fn oscillator_evidence(record: &hysteretic::Record, settings: ParticleSettings) -> f64 {
    let mut filter = oscillator_filter(record, settings);
    for (datum, input) in record.data.iter().zip(&record.input) {
        filter
            .step(Frame {
                observations: &[*datum],
                excitation: &[*input],
            })
            .unwrap();
    }
    filter.log_evidence()
}

#[test]
fn both_importance_densities_give_the_same_evidence() {
    // §5 check 4: detects a missing determinant or a wrong density of the disturbance.
    for record_seed in [1, 2, 3] {
        let record = hysteretic::Record::simulate(record_seed, 50);
        let run = |density, seed| {
            oscillator_evidence(
                &record,
                ParticleSettings {
                    density,
                    seed,
                    threads: 2,
                    ..Default::default()
                },
            )
        };
        let optimal: Vec<f64> = (1..=2)
            .map(|seed| run(ImportanceDensity::Optimal, seed))
            .collect();
        let prior: Vec<f64> = (1..=10)
            .map(|seed| run(ImportanceDensity::Prior, seed))
            .collect();
        println!("record {record_seed}: {optimal:.2?} and {prior:.2?}");
        for a in optimal.iter().chain(&prior) {
            for b in optimal.iter().chain(&prior) {
                assert!((a - b).abs() <= 3.0, "record {record_seed}: {a} and {b}");
            }
        }
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        assert!(
            (mean(&optimal) - mean(&prior)).abs() <= 1.0,
            "record {record_seed}"
        );
    }
}

/// Error and coverage of one component over the last three quarters of a record.
struct Track {
    component: usize,
    estimates: Vec<(f64, f64, f64)>,
    truth: Vec<f64>,
}

impl Track {
    fn new(component: usize) -> Self {
        Self {
            component,
            estimates: Vec::new(),
            truth: Vec::new(),
        }
    }

    fn take<M: ParticleModel>(&mut self, filter: &mut ParticleFilter<M>, truth: &[f64]) {
        let (low, high) = filter.credible_interval(self.component, 0.95).unwrap();
        self.estimates
            .push((filter.mean()[self.component], low, high));
        self.truth.push(truth[self.component]);
    }

    /// Returns the RMS of (mean − actual) over the RMS of the actual value, and the coverage of the
    /// interval.
    ///
    /// The coverage is the share of steps with the actual value inside the interval.
    fn summary(&self) -> (f64, f64) {
        let late = self.truth.len() / 4..self.truth.len();
        let error = rms(late.clone().map(|k| self.estimates[k].0 - self.truth[k]));
        let inside =
            |k: &usize| (self.estimates[*k].1..=self.estimates[*k].2).contains(&self.truth[*k]);
        let coverage = late.clone().filter(inside).count() as f64 / late.len() as f64;
        (error / rms(late.map(|k| self.truth[k])), coverage)
    }
}

#[test]
fn hysteretic_oscillator_is_followed_with_its_parameters() {
    // §5 check 8, and the identity of check 1
    for seed in [1, 2, 3] {
        let record = hysteretic::Record::simulate(seed, 200);
        // With differences for the Jacobian, the optimal density is ten times as expensive as the
        // prior density.
        let density = if seed == 1 {
            ImportanceDensity::Optimal
        } else {
            ImportanceDensity::Prior
        };
        let settings = ParticleSettings {
            density,
            seed,
            threads: 2,
            ..ParticleSettings::default()
        };
        let mut filter = oscillator_filter(&record, settings);
        let mut tracks: Vec<Track> = (1..hysteretic::STATE).map(Track::new).collect();
        let (mut resampled, mut effective) = (0, 0.0);
        for (k, truth) in record.truth.iter().enumerate() {
            let frame = Frame {
                observations: &[record.data[k]],
                excitation: &[record.input[k]],
            };
            let step = filter.step(frame).unwrap();
            let identity = 2000.0 / (1.0 + step.coefficient_of_variation.powi(2));
            assert!((step.effective_size / identity - 1.0).abs() < 1e-12);
            resampled += usize::from(step.resampled);
            effective += step.effective_size / 2000.0 / record.data.len() as f64;
            tracks
                .iter_mut()
                .for_each(|track| track.take(&mut filter, truth));
        }
        let found: Vec<(f64, f64)> = tracks.iter().map(Track::summary).collect();
        println!("seed {seed}: {found:.3?}, resampled {resampled} times, N_eff/N {effective:.3}");
        for (j, name) in [(0, "velocity"), (1, "force"), (2, "θ₁")] {
            assert!(
                found[j].0 <= 0.12,
                "seed {seed}: relative error of {name} is {}",
                found[j].0
            );
        }
        for (j, name) in [
            (0, "velocity"),
            (1, "force"),
            (2, "θ₁"),
            (4, "θ₃"),
            (6, "h"),
        ] {
            assert!(
                found[j].1 >= 0.89,
                "seed {seed}: coverage of {name} is {}",
                found[j].1
            );
        }
        assert!(
            (25..=40).contains(&resampled),
            "seed {seed}: resampled {resampled} times"
        );
        assert!(
            (0.38..0.50).contains(&effective),
            "seed {seed}: mean N_eff/N is {effective}"
        );
    }
}

/// Number of Kalman filter frames before the particle filter takes over, 1 s.
const WARM: usize = 50;

#[test]
fn drifting_building_is_followed_through_a_loss_that_the_model_does_not_know() {
    // §5 checks 5, 6 and 7. With 2000 particles, single records vary: the error of a storey with a
    // large loss by drift is 0.14. It decreases to 0.11 with 8000 or 32 000 particles. The test
    // therefore compares the figures of the theory page with the mean over three records.
    use drifting_building::{DAMPING, NOISE, Record, STIFFNESS, STOREYS};
    const SEEDS: [u64; 3] = [1, 2, 3];
    let (mut mean_errors, mut mean_noise, mut mean_second) = ([0.0; STOREYS], 0.0, [0.0; 3]);
    for seed in SEEDS {
        let record = Record::simulate(seed, 1000);
        let (mean, covariance) = record.prior();
        let mut warm = NumericalEkf::new(record.model().unwrap(), mean, covariance);
        for k in 0..=WARM {
            let previous = (k > 0).then(|| [record.input[k - 1]]);
            warm.step(
                previous.as_ref().map(|input| &input[..]),
                &[record.input[k]],
                &record.data[k],
            );
        }
        let start = GaussianStart {
            mean: warm.mean,
            covariance: warm.covariance,
            previous_input: Some(DVector::from_element(1, record.input[WARM])),
        };
        let settings = ParticleSettings {
            kernel: 0.9,
            seed,
            threads: 2,
            ..ParticleSettings::default()
        };
        let mut filter = ParticleFilter::new(record.model().unwrap(), settings, start).unwrap();
        let mut tracks: Vec<Track> = (STIFFNESS..NOISE + STOREYS)
            .chain([STOREYS - 1])
            .map(Track::new)
            .collect();
        let (mut resampled, mut effective) = (0, 0.0);
        for k in WARM + 1..=1000 {
            let frame = Frame {
                observations: &record.data[k],
                excitation: &[record.input[k]],
            };
            let step = filter.step(frame).unwrap();
            resampled += usize::from(step.resampled);
            effective += step.effective_size / 2000.0 / (1000 - WARM) as f64;
            tracks
                .iter_mut()
                .for_each(|track| track.take(&mut filter, &record.truth[k]));
        }
        let found: Vec<(f64, f64)> = tracks.iter().map(Track::summary).collect();
        let ancestors = filter.surviving_ancestors();
        let (stiffness, rest) = found.split_at(DAMPING - STIFFNESS);
        let (damping, rest) = rest.split_at(STOREYS);
        let (noise, roof) = rest.split_at(STOREYS);
        println!("k {stiffness:.3?}\nc {damping:.3?}\nσ {noise:.3?}\nroof {roof:.3?}");
        println!("resampled {resampled} times, N_eff/N {effective:.3}, {ancestors} ancestors");
        let second = |k: usize| tracks[1].estimates[k - WARM - 1];
        println!(
            "k₂ {:.1?} at 10 s, {:.1?} at 15 s, {:.1?} at 20 s",
            second(500),
            second(750),
            second(1000)
        );

        for (sum, (error, _)) in mean_errors.iter_mut().zip(stiffness) {
            *sum += error / SEEDS.len() as f64;
        }
        let coverage = stiffness.iter().map(|(_, coverage)| coverage).sum::<f64>() / STOREYS as f64;
        assert!(
            coverage >= 0.85,
            "seed {seed}: coverage of stiffness {coverage}"
        );
        for (sum, k) in mean_second.iter_mut().zip([500, 750, 1000]) {
            let (mean, low, high) = second(k);
            assert!(
                low < 155.0 && high > 145.0,
                "seed {seed}: {mean} [{low}, {high}]"
            );
            *sum += mean / SEEDS.len() as f64;
        }
        mean_noise +=
            noise.iter().map(|(error, _)| error).sum::<f64>() / (STOREYS * SEEDS.len()) as f64;
        let worst = |tracks: &[(f64, f64)]| {
            tracks
                .iter()
                .fold(0.0_f64, |worst, track| worst.max(track.0))
        };
        assert!(
            worst(damping) > worst(stiffness),
            "damping is less accurate than stiffness"
        );
        assert!(
            roof[0].0 <= 0.06,
            "relative error of the roof displacement {}",
            roof[0].0
        );
        assert!(
            (300..=420).contains(&resampled),
            "resampled {resampled} times"
        );
        assert!(
            (0.27..0.36).contains(&effective),
            "mean N_eff/N {effective}"
        );
        assert!(ancestors <= 3, "{ancestors} ancestors");
    }
    println!("means: k {mean_errors:.3?}, σ {mean_noise:.3}, k₂ {mean_second:.1?}");
    assert!(
        mean_errors.iter().all(|error| *error <= 0.12),
        "relative errors of stiffness {mean_errors:.3?}"
    );
    assert!(
        (0.07..=0.14).contains(&mean_noise),
        "relative error of the noise levels {mean_noise}"
    );
    let [at_the_loss, later @ ..] = mean_second;
    assert!(
        (137.0..=172.0).contains(&at_the_loss),
        "k₂ right after its loss {at_the_loss}"
    );
    assert!(
        later.iter().all(|mean| (150.0..=158.0).contains(mean)),
        "k₂ afterwards {later:.1?}"
    );
}
