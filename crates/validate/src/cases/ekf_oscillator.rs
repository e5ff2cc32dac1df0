//! Chapter 2, §2.4.1: an oscillator whose frequency and damping ratio start far off, with fading
//! memory.

use crate::error::ValidateError;
use crate::figure::{Figure, Required};
use crate::outcome::{Outcome, Plot, Series, SeriesKind};
use crate::run::Run;
use crate::statistics::{Accuracy, Mean, Normal, rms};
use crate::systems::oscillator::Oscillator;
use nalgebra::{DMatrix, DVector};
use spandrel_filter::{
    ExtendedKalmanFilter, FadingFactor, FilterSettings, Frame, LinearModel, NoiseModel,
};
use std::f64::consts::PI;

const STEP_S: f64 = 0.005;
#[expect(clippy::approx_constant, reason = "the printed value")]
const FREQUENCY: f64 = 0.7071;
const DAMPING: f64 = 0.01;

/// Displacement and velocity under white noise of intensity 1e-4 m²/s³, with 5 % rms noise.
struct Record {
    truth: Vec<[f64; 2]>,
    data: Vec<[f64; 2]>,
    noise_std: [f64; 2],
    excitation_variance: f64,
}

fn simulate(seed: u64, steps: usize) -> Record {
    let excitation_variance = 2.0 * PI * 1e-4 / STEP_S;
    let system = DMatrix::from_row_slice(
        2,
        2,
        &[0.0, 1.0, -FREQUENCY * FREQUENCY, -2.0 * DAMPING * FREQUENCY],
    );
    let (a, b) =
        LinearModel::discretise(&system, &DMatrix::from_row_slice(2, 1, &[0.0, 1.0]), STEP_S);
    let mut force = Normal::stream(seed, 0);
    let mut noise = Normal::stream(seed, 1);
    let mut u = DVector::zeros(2);
    let truth: Vec<[f64; 2]> = (0..steps)
        .map(|_| {
            u = &a * &u + &b * (excitation_variance.sqrt() * force.draw());
            [u[0], u[1]]
        })
        .collect();
    let noise_std = [0, 1].map(|j| 0.05 * rms(truth.iter().map(|u| u[j])));
    let data = truth
        .iter()
        .map(|u| [0, 1].map(|j| u[j] + noise_std[j] * noise.draw()))
        .collect();
    Record {
        truth,
        data,
        noise_std,
        excitation_variance,
    }
}

/// Results of the filter on one record, with or without a half-life.
struct Tracked {
    /// Accuracy of x, ẋ, ω and ζ after 50 s.
    late: [Accuracy; 4],
    last: [(f64, f64); 4],
    /// Share of the steps with a negative frequency, which is the mirrored solution.
    mirrored: f64,
    curves: [Vec<[f32; 3]>; 2],
}

fn filter(
    record: &Record,
    half_life_steps: Option<f64>,
) -> Result<ExtendedKalmanFilter<Oscillator>, ValidateError> {
    let noise = NoiseModel::known(
        DMatrix::from_element(1, 1, record.excitation_variance),
        DMatrix::from_diagonal(&DVector::from_row_slice(
            &record.noise_std.map(|std| std * std),
        )),
    );
    let prior = DVector::from_row_slice(&[0.0, 0.0, 1.0, 1.0]);
    let mut settings = FilterSettings::new(STEP_S, prior, DVector::repeat(4, 1.0), noise);
    if let Some(steps) = half_life_steps {
        settings.fading = FadingFactor::from_half_life(steps).map_err(ValidateError::setting)?;
    }
    ExtendedKalmanFilter::new(Oscillator::default(), settings).map_err(ValidateError::setting)
}

fn track(record: &Record, half_life_steps: Option<f64>) -> Result<Tracked, ValidateError> {
    let mut filter = filter(record, half_life_steps)?;
    let mut tracked = Tracked {
        late: Default::default(),
        last: [(0.0, 0.0); 4],
        mirrored: 0.0,
        curves: Default::default(),
    };
    for (i, (datum, response)) in record.data.iter().zip(&record.truth).enumerate() {
        let time_s = (i + 1) as f64 * STEP_S;
        filter
            .step(Frame {
                observations: datum,
                excitation: &[0.0],
            })
            .map_err(ValidateError::at(time_s))?;
        let truth = [response[0], response[1], FREQUENCY, DAMPING];
        let estimate = [0, 1, 2, 3].map(|j| {
            (
                filter.mean()[j],
                filter.covariance()[(j, j)].max(0.0).sqrt(),
            )
        });
        tracked.mirrored += f64::from(u8::from(estimate[2].0 < 0.0)) / record.data.len() as f64;
        if time_s > 50.0 {
            for ((accuracy, (mean, std)), truth) in tracked.late.iter_mut().zip(estimate).zip(truth)
            {
                accuracy.take(mean, std, truth);
            }
        }
        if i % 20 == 0 {
            for (curve, (mean, std)) in tracked.curves.iter_mut().zip(&estimate[2..]) {
                curve.push([time_s as f32, *mean as f32, *std as f32]);
            }
        }
        tracked.last = estimate;
    }
    Ok(tracked)
}

pub(super) fn run(run: &Run<'_>) -> Result<Outcome, ValidateError> {
    let record = simulate(run.seed, 40_000);
    let published = track(&record, Some(2000.0))?;
    run.advance(0.1);
    let endless = track(&record, None)?;
    run.advance(0.2);
    let short = track(&record, Some(400.0))?;
    run.advance(0.3);
    let mut mean_stds = [Mean::default(); 2];
    for seed in 1..=8 {
        let tracked = track(&simulate(seed, 40_000), Some(2000.0))?;
        for (mean, accuracy) in mean_stds.iter_mut().zip(&tracked.late[2..]) {
            mean.take(accuracy.mean_std());
        }
    }

    let lambda: f64 = 2f64.powf(1e-3);
    let mut figures = vec![
        Figure::new(
            "λ for a half-life of 2000 steps",
            lambda,
            Required::Within {
                of: 1.000_693_387,
                by: 5e-10,
            },
        )
        .published(1.000_693_387),
        Figure::new(
            "relative error of the displacement after 50 s",
            published.late[0].relative_error(),
            Required::AtMost(0.004),
        ),
        Figure::new(
            "relative error of the velocity after 50 s",
            published.late[1].relative_error(),
            Required::AtMost(0.04),
        ),
    ];
    let late = || record.truth[10_000..].iter();
    let power = [0, 1].map(|j| rms(late().map(|u| u[j])).powi(2));
    // The deviations are inversely proportional to the rms of the record. That rms varies by a
    // factor of two and a half, because a record of 200 s contains few independent vibrations. The
    // deviations are therefore judged for each record, as a mean over eight records, and against
    // the bound of the record.
    for (j, name, low, high) in [(2, "ω (rad/s)", 0.05, 0.08), (3, "ζ", 0.07, 0.12)] {
        let accuracy = &published.late[j];
        let bound =
            (record.excitation_variance * lambda.ln() / power[j - 2]).sqrt() / (2.0 * FREQUENCY);
        figures.extend([
            Figure::new(
                format!("{name}: share inside 3 sd after 50 s"),
                accuracy.coverage(),
                Required::AtLeast(0.99),
            ),
            Figure::new(
                format!("{name}: mean deviation after 50 s"),
                accuracy.mean_std(),
                Required::Between { low, high },
            )
            .known_miss("inverse to the rms of the record, which scatters by seed"),
            Figure::new(
                format!("{name}: mean deviation after 50 s, mean of the records 1 to 8"),
                mean_stds[j - 2].value(),
                Required::Between { low, high },
            ),
            Figure::new(
                format!("{name}: deviation over the information bound"),
                accuracy.mean_std() / bound,
                Required::Between {
                    low: 0.8,
                    high: 2.0,
                },
            ),
            // The theoretical rms ratio of error to deviation is 0.71: fading memory states
            // variances that are twice too large for constant parameters.
            Figure::new(
                format!("{name}: rms of error over deviation after 50 s"),
                accuracy.normalised_error(),
                Required::Reported,
            ),
            Figure::new(
                format!("{name}: rms error with a half-life of 400 steps"),
                short.late[j].rms_error(),
                Required::Reported,
            ),
        ]);
    }
    for (j, name, truth, low, high) in [
        (2, "ω (rad/s)", FREQUENCY, 0.006, 0.024),
        (3, "ζ", DAMPING, 0.008, 0.034),
    ] {
        let (mean, std) = endless.last[j];
        figures.push(Figure::new(
            format!("{name} without forgetting: error at the end over its deviation"),
            (mean - truth).abs() / std,
            Required::AtMost(4.0),
        ));
        figures.push(Figure::new(
            format!("{name} without forgetting: deviation at the end"),
            std,
            Required::Between { low, high },
        ));
    }
    figures.push(Figure::new(
        "share of time at the mirrored solution, ω < 0",
        published.mirrored,
        Required::Reported,
    ));

    let plots = [
        ("Frequency", "rad/s", FREQUENCY, 1.5),
        ("Damping ratio", "1", DAMPING, 1.0),
    ]
    .into_iter()
    .zip(&published.curves)
    .map(|((title, unit, truth, range), curve)| {
        let of = |factor: f32| {
            curve
                .iter()
                .map(|[t, mean, std]| (*t, mean + factor * std))
                .collect()
        };
        let series = vec![
            Series::new("99.7 %", SeriesKind::Bound, of(-3.0)),
            Series::new("", SeriesKind::Bound, of(3.0)),
            Series::new(
                "true",
                SeriesKind::Truth,
                curve.iter().map(|[t, ..]| (*t, truth as f32)).collect(),
            ),
            Series::new("estimated", SeriesKind::Estimate, of(0.0)),
        ];
        Plot::over_time(title, unit, series).within(-range, range)
    });
    Ok(Outcome {
        figures,
        tables: Vec::new(),
        plots: plots.collect(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Estimates of [x, ẋ, ω, ζ] at every step.
    fn estimates(record: &Record, half_life_steps: Option<f64>) -> Vec<DVector<f64>> {
        let mut filter = filter(record, half_life_steps).unwrap();
        let estimates = record.data.iter().map(|datum| {
            let frame = Frame {
                observations: datum,
                excitation: &[0.0],
            };
            filter.step(frame).unwrap();
            filter.mean().clone()
        });
        estimates.collect()
    }

    /// Returns the estimates of the same filter with dense matrices, (2.60) to (2.65). With
    /// `misprinted`, `B_i` and `δ_i` contain `A_y` instead of `A_y⁻¹`, as in (2.78) and (2.81).
    fn estimates_by_dense_matrices(
        record: &Record,
        lambda: f64,
        misprinted: bool,
    ) -> Vec<DVector<f64>> {
        let mut y = DVector::from_row_slice(&[0.0, 0.0, 1.0, 1.0]);
        let mut sigma = DMatrix::<f64>::identity(4, 4);
        let observation = DMatrix::<f64>::identity(2, 4);
        let variances = record.noise_std.map(|std| std * std);
        let sensors = DMatrix::from_diagonal(&DVector::from_row_slice(&variances));
        let mut estimates = Vec::new();
        for (i, datum) in record.data.iter().enumerate() {
            if i > 0 {
                let (x, v, omega, zeta) = (y[0], y[1], y[2], y[3]);
                let [stiff, damped] = [omega * omega, 2.0 * zeta * omega];
                let [by_omega, by_zeta] = [-2.0 * (omega * x + zeta * v), -2.0 * omega * v];
                let rate = -stiff * x - damped * v;
                // [A_y B_y g; 0], whose exponential holds A_i, Γ B_y and Γ g
                let mut augmented = DMatrix::zeros(6, 6);
                augmented
                    .row_mut(0)
                    .copy_from_slice(&[0.0, 1.0, 0.0, 0.0, 0.0, v]);
                augmented
                    .row_mut(1)
                    .copy_from_slice(&[-stiff, -damped, by_omega, by_zeta, 1.0, rate]);
                let exponential = (&augmented * STEP_S).exp();
                let transition = exponential.view((0, 0), (4, 4)).into_owned();
                let (input, step) = if misprinted {
                    let a_y = augmented.view((0, 0), (4, 4));
                    let factor = a_y * (&transition - DMatrix::identity(4, 4));
                    let delta = &factor * (augmented.view((0, 5), (4, 1)) - a_y * &y);
                    (factor.column(1).into_owned(), &transition * &y + delta - &y)
                } else {
                    let column = |j| exponential.view((0, j), (4, 1)).column(0).into_owned();
                    (column(4), column(5))
                };
                y += step;
                sigma = (&transition * sigma * transition.transpose()
                    + &input * record.excitation_variance * input.transpose())
                    * lambda;
            }
            let s = &observation * &sigma * observation.transpose() + &sensors;
            let gain = &sigma * observation.transpose() * s.try_inverse().unwrap();
            y += &gain * (DVector::from_row_slice(datum) - &observation * &y);
            sigma = &sigma - &gain * &observation * &sigma;
            sigma = (&sigma + sigma.transpose()) * 0.5;
            estimates.push(y.clone());
        }
        estimates
    }

    #[test]
    fn filter_without_fading_is_the_plain_extended_filter() {
        // Chapter 2, §5 check 3, by another computation. The results agree except for rounding,
        // which differs between series and exponential.
        for seed in [1, 2, 3] {
            let record = simulate(seed, 2_000);
            let dense = estimates_by_dense_matrices(&record, 1.0, false);
            for (i, (mean, expected)) in estimates(&record, None).iter().zip(&dense).enumerate() {
                for j in 0..4 {
                    let error = (mean[j] - expected[j]).abs();
                    assert!(
                        error < 1e-8 * (1.0 + expected[j].abs()),
                        "seed {seed}, step {i}, state {j}: {error:e}"
                    );
                }
            }
        }
    }

    #[test]
    fn misprinted_discretisation_changes_the_parameters() {
        // chapter 2, §5 check 12: by 0.4 to 0.6 in the second half of a 40 to 50 s record
        for seed in [1, 2, 3] {
            let record = simulate(seed, 9_000);
            let right = estimates(&record, Some(2000.0));
            let wrong = estimates_by_dense_matrices(&record, 2f64.powf(1.0 / 1000.0), true);
            let moved = right.iter().zip(&wrong).skip(4_500);
            let moved = moved
                .map(|(right, wrong)| (right - wrong).rows(2, 2).amax())
                .fold(0.0, f64::max);
            println!("seed {seed}: moved by {moved}");
            assert!(
                moved > 0.4,
                "seed {seed}: the misprint moves the parameters by {moved} only"
            );
        }
    }
}
