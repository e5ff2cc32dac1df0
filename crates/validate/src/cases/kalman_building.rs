//! Chapter 2, §2.3.2: responses of a sixty-storey building from seven accelerometers, with unknown
//! ground motion.

use crate::error::ValidateError;
use crate::figure::{Figure, Required};
use crate::outcome::{Outcome, Plot, Series, SeriesKind};
use crate::run::Run;
use crate::statistics::{Accuracy, Mean, Normal, larger, rms};
use crate::systems::linear;
use nalgebra::{DMatrix, DVector};
use spandrel_filter::{KalmanFilter, LinearModel};
use std::f64::consts::PI;

const FLOORS: usize = 60;
/// Reason why figures in absolute units scatter by seed.
const OF_THE_RECORD: &str = "200 s are 33 periods of the first mode: the motion, and the noise \
                             that is 5 % of it, scatter by seed";
const STEP_S: f64 = 0.005;
const SENSED: [usize; 7] = [1, 10, 20, 30, 40, 50, 60];
const STEPS: usize = 40_000;
/// Number of steps after which errors count (20 s).
const SETTLED: usize = 4_000;
/// Number of steps after which the deviations are steady (10 s).
const STEADY: usize = 2_000;

/// Steady standard deviations of displacement (m) and velocity (m/s) of floors 1, 30 and 60. They
/// come from an independent run.
const STEADY_STD: [[f64; 2]; 3] = [[4.1e-6, 2.1e-4], [9.3e-5, 2.5e-4], [1.3e-4, 2.7e-4]];

/// `M⁻¹ K` (1/s²).
fn stiffness() -> DMatrix<f64> {
    linear::chain(FLOORS, 1632.0)
}

/// The building with sensors that have no noise yet.
fn building() -> LinearModel {
    let (system, input) = linear::under_ground_motion(&stiffness(), 0.0157, 0.0048);
    let (transition, held) = LinearModel::discretise(&system, &input, STEP_S);
    let observation = DMatrix::from_fn(SENSED.len(), 2 * FLOORS, |c, j| {
        system[(FLOORS + SENSED[c] - 1, j)]
    });
    LinearModel {
        transition,
        input: held,
        observation,
        excitation_covariance: DMatrix::from_element(1, 1, 2.0 * PI * 1.6e-5 / STEP_S),
        sensor_covariance: DMatrix::zeros(SENSED.len(), SENSED.len()),
    }
}

/// The filter of the source: it knows nothing of the start.
fn filter(mut model: LinearModel, noise_std: &DVector<f64>) -> Result<KalmanFilter, ValidateError> {
    model.sensor_covariance = DMatrix::from_diagonal(&noise_std.map(|std| std * std));
    let start = (
        DVector::zeros(2 * FLOORS),
        DMatrix::identity(2 * FLOORS, 2 * FLOORS),
    ); // (2.43), (2.44)
    KalmanFilter::new(model, start.0, start.1).map_err(ValidateError::setting)
}

pub(super) fn run(run: &Run<'_>) -> Result<Outcome, ValidateError> {
    let model = building();
    let variance = model.excitation_covariance[(0, 0)];
    let mut normal = Normal::stream(run.seed, 0);
    let mut u = DVector::zeros(2 * FLOORS);
    let mut truth = Vec::with_capacity(STEPS);
    for _ in 0..STEPS {
        u = &model.transition * &u + &model.input * (variance.sqrt() * normal.draw());
        truth.push(u.clone());
    }
    let clean: Vec<DVector<f64>> = truth.iter().map(|u| &model.observation * u).collect();
    let noise_std = DVector::from_fn(SENSED.len(), |c, _| 0.05 * rms(clean.iter().map(|z| z[c])));
    let mut filter = filter(model, &noise_std)?;
    let mut noise = Normal::stream(run.seed, 1);
    let mut accuracy = vec![Accuracy::default(); 2 * FLOORS];
    let mut chi_squared = Mean::default();
    let mut first_std = [0.0; 3];
    // For each state, its deviation at the start of the steady phase, and the largest later
    // difference from that.
    let (mut steady_std, mut drift) = (vec![0.0; 2 * FLOORS], 0.0_f64);
    // True and estimated displacement and velocity of three floors.
    let mut responses: [[Vec<(f32, f32)>; 2]; 3] = Default::default();
    let mut curves: [[Vec<(f32, f32)>; 2]; 3] = Default::default();
    let mut deviations: [Vec<(f32, f32)>; 6] = Default::default();
    for (i, (u, z)) in truth.iter().zip(&clean).enumerate() {
        let datum = DVector::from_fn(SENSED.len(), |c, _| z[c] + noise_std[c] * noise.draw());
        filter.predict(&[0.0]);
        let time_s = (i + 1) as f64 * STEP_S;
        let step = filter
            .update(datum.as_slice())
            .map_err(ValidateError::at(time_s))?;
        let std = |j: usize| filter.covariance()[(j, j)].max(0.0).sqrt();
        if i == 0 {
            first_std = [1, 30, 60].map(|floor| std(floor - 1));
        }
        if i < 2_000 && i % 4 == 0 {
            for (curve, (floor, shift)) in
                deviations
                    .iter_mut()
                    .zip([(1, 0), (30, 0), (60, 0), (1, 1), (30, 1), (60, 1)])
            {
                curve.push((
                    time_s as f32,
                    std(shift * FLOORS + floor - 1).log10() as f32,
                ));
            }
        }
        match i {
            STEADY => steady_std = (0..2 * FLOORS).map(std).collect(),
            _ if i > STEADY && i % 100 == 0 => {
                let change = steady_std
                    .iter()
                    .enumerate()
                    .map(|(j, steady)| (std(j) / steady - 1.0).abs());
                drift = change.fold(drift, larger);
            }
            _ => {}
        }
        if i >= SETTLED {
            if i % 20 == 0 {
                for (points, floor) in responses.iter_mut().zip([1, 30, 60]) {
                    for (points, j) in points.iter_mut().zip([floor - 1, FLOORS + floor - 1]) {
                        points.push((u[j] as f32, filter.mean()[j] as f32));
                    }
                }
            }
            if i < SETTLED + 4_000 && i % 4 == 0 {
                for (curve, floor) in curves.iter_mut().zip([1, 30, 60]) {
                    curve[0].push((time_s as f32, u[FLOORS + floor - 1] as f32));
                    curve[1].push((time_s as f32, filter.mean()[FLOORS + floor - 1] as f32));
                }
            }
            chi_squared.take(step.normalised_innovation_squared / SENSED.len() as f64);
            for (j, accuracy) in accuracy.iter_mut().enumerate() {
                accuracy.take(filter.mean()[j], std(j), u[j]);
            }
        }
        if i % 1_000 == 0 && !run.advance(i as f64 / STEPS as f64) {
            return Err(ValidateError::Stopped);
        }
    }

    let omega = stiffness().symmetric_eigenvalues().map(f64::sqrt);
    let mut frequencies: Vec<f64> = omega.iter().map(|omega| omega / (2.0 * PI)).collect();
    frequencies.sort_by(f64::total_cmp);
    let damping = |mode: usize| {
        let omega = 2.0 * PI * frequencies[mode];
        0.5 * (0.0157 / omega + 0.0048 * omega)
    };
    let velocity_error = |name: String, error: f64| {
        let between = |low, high| Required::Between { low, high };
        Figure::new(name, error, between(2.1e-4, 2.8e-4))
            .known_miss_within(between(2.05e-4, 2.85e-4), OF_THE_RECORD)
    };
    let mut figures = vec![
        Figure::new(
            "f1 (Hz)",
            frequencies[0],
            Required::Within {
                of: 0.1669,
                by: 1e-4,
            },
        )
        .published(0.1669),
        Figure::new(
            "f2 (Hz)",
            frequencies[1],
            Required::Within {
                of: 0.5007,
                by: 1e-4,
            },
        ),
        Figure::new(
            "damping ratio of mode 1",
            damping(0),
            Required::Within {
                of: 0.0100,
                by: 1e-4,
            },
        )
        .published(0.01),
        Figure::new(
            "damping ratio of mode 2",
            damping(1),
            Required::Within {
                of: 0.0101,
                by: 1e-4,
            },
        )
        .published(0.01),
    ];
    for floor in [1, 10, 30, 60] {
        let (displacement, velocity) = (&accuracy[floor - 1], &accuracy[FLOORS + floor - 1]);
        figures.extend([
            Figure::new(
                format!("floor {floor}: relative error of the displacement after 20 s"),
                displacement.relative_error(),
                Required::AtMost(0.005),
            ),
            Figure::new(
                format!("floor {floor}: relative error of the velocity after 20 s"),
                velocity.relative_error(),
                Required::AtMost(0.10),
            )
            .known_miss_within(Required::AtMost(0.12), OF_THE_RECORD),
            velocity_error(
                format!("floor {floor}: rms error of the velocity after 20 s (m/s)"),
                velocity.rms_error(),
            ),
        ]);
    }
    let (displacements, velocities) = accuracy.split_at(FLOORS);
    let largest =
        |of: &[Accuracy], what: fn(&Accuracy) -> f64| of.iter().map(what).fold(0.0, larger);
    let least_velocity = velocities
        .iter()
        .map(Accuracy::rms_error)
        .fold(f64::INFINITY, f64::min);
    figures.extend([
        Figure::new(
            "every floor: largest relative error of the displacement after 20 s",
            largest(displacements, Accuracy::relative_error),
            Required::AtMost(0.005),
        ),
        Figure::new(
            "every floor: largest relative error of the velocity after 20 s",
            largest(velocities, Accuracy::relative_error),
            Required::AtMost(0.10),
        )
        .known_miss_within(Required::AtMost(0.12), OF_THE_RECORD),
        velocity_error(
            "every floor: least rms error of the velocity (m/s)".to_owned(),
            least_velocity,
        ),
        velocity_error(
            "every floor: largest rms error of the velocity (m/s)".to_owned(),
            largest(velocities, Accuracy::rms_error),
        ),
        Figure::new(
            "every state: largest change of its deviation from 10 s on, over its value",
            drift,
            Required::AtMost(0.001),
        ),
    ]);
    let inside = rms(accuracy.iter().map(|a| a.coverage().sqrt())).powi(2);
    figures.extend([
        Figure::new(
            "share inside 3 sd, all states",
            inside,
            Required::AtLeast(0.995),
        ),
        Figure::new(
            "rms of error over deviation, all states",
            rms(accuracy.iter().map(Accuracy::normalised_error)),
            Required::Within { of: 1.0, by: 0.03 },
        )
        .known_miss_within(Required::Within { of: 1.0, by: 0.06 }, OF_THE_RECORD),
        Figure::new(
            "mean χ² per channel",
            chi_squared.value(),
            Required::Within { of: 1.0, by: 0.02 },
        ),
    ]);
    for (k, (floor, [displacement, velocity])) in
        [1, 30, 60].into_iter().zip(STEADY_STD).enumerate()
    {
        figures.extend([
            Figure::new(
                format!("floor {floor}: deviation of the displacement after one sample (m)"),
                first_std[k],
                Required::Between {
                    low: 0.4,
                    high: 0.7,
                },
            ),
            // The deviation follows the rms of the record through the 5 % rule, and one record has
            // only 33 periods of the first mode.
            Figure::new(
                format!("floor {floor}: steady deviation of the displacement (m)"),
                accuracy[floor - 1].mean_std(),
                Required::relative(displacement, 0.05),
            )
            .known_miss(OF_THE_RECORD),
            Figure::new(
                format!("floor {floor}: steady deviation of the velocity (m/s)"),
                accuracy[FLOORS + floor - 1].mean_std(),
                Required::relative(velocity, 0.05),
            )
            .known_miss_within(Required::relative(velocity, 0.10), OF_THE_RECORD),
        ]);
    }
    let mut plots: Vec<Plot> = curves
        .into_iter()
        .zip([1, 30, 60])
        .map(|([truth, estimate], floor)| {
            let series = vec![
                Series::new("true", SeriesKind::Truth, truth),
                Series::new("estimated", SeriesKind::Estimate, estimate),
            ];
            Plot::over_time(format!("Velocity of floor {floor}"), "m/s", series)
        })
        .collect();
    let names = ["x, 1", "x, 30", "x, 60", "v, 1", "v, 30", "v, 60"];
    let series = deviations
        .into_iter()
        .zip(names)
        .map(|(points, name)| Series::new(name, SeriesKind::Estimate, points));
    for (points, floor) in responses.into_iter().zip([1, 30, 60]) {
        for (points, (what, unit)) in points
            .into_iter()
            .zip([("Displacement", "m"), ("Velocity", "m/s")])
        {
            plots.push(Plot::against_truth(
                format!("{what} of floor {floor} after 20 s"),
                unit,
                points,
            ));
        }
    }
    plots.push(Plot::over_time(
        "Deviations of displacement (x) and velocity (v), by floor",
        "log10",
        series.collect(),
    ));
    Ok(Outcome {
        figures,
        tables: Vec::new(),
        plots,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use spandrel_filter::steady::lyapunov_by_doubling;

    #[test]
    fn one_mode_amplitude_gives_all_six_published_deviations() {
        // Chapter 2, §5 check 6: 4.1e-6, 9.3e-5, 1.3e-4 m and 2.1, 2.5, 2.7e-4 m/s, ± 5 %, reached
        // within 10 s. They depend on the record only through the noise, which is 5 % of the
        // response. A record of 200 s contains only 33 periods of the first mode. This mode
        // therefore differs most from the stationary response. Its strength is unknown. The test
        // finds it from the displacement of the roof. The other five deviations must then agree.
        let model = building();
        let excited = &model.input * &model.excitation_covariance * model.input.transpose();
        let covariance = lyapunov_by_doubling(model.transition.clone(), excited).unwrap();
        let modes = stiffness().symmetric_eigen();
        let shape = modes.eigenvectors.column(modes.eigenvalues.imin());
        let projection = DMatrix::identity(2, 2).kronecker(&(shape * shape.transpose()));
        let first_mode = &projection * &covariance * &projection;
        let shown = |covariance: &DMatrix<f64>| {
            (&model.observation * covariance * model.observation.transpose()).diagonal()
        };
        let (all, first) = (shown(&covariance), shown(&first_mode));
        let steady = |strength: f64| {
            let noise_std = (&all + &first * (strength * strength - 1.0))
                .map(|variance| 0.05 * variance.sqrt());
            let mut filter = filter(model.clone(), &noise_std).unwrap();
            for _ in 0..STEADY {
                filter.predict(&[0.0]);
                filter.update(&[0.0; SENSED.len()]).unwrap();
            }
            let std = |j: usize| filter.covariance()[(j, j)].sqrt();
            [1, 30, 60].map(|floor| [std(floor - 1), std(FLOORS + floor - 1)])
        };
        let (mut weak, mut strong) = (0.8, 1.6);
        for _ in 0..8 {
            let middle = 0.5 * (weak + strong);
            (weak, strong) = if steady(middle)[2][0] < STEADY_STD[2][0] {
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
        // This is the scatter of records of 200 s.
        assert!((0.8..=1.5).contains(&weak), "strength {weak}");
        for (found, expected) in found.iter().flatten().zip(STEADY_STD.iter().flatten()) {
            assert!(
                (found / expected - 1.0).abs() <= 0.05,
                "{found:e}, expected {expected:e}"
            );
        }
    }
}
