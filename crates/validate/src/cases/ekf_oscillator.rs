//! Chapter 2, §2.4.1: an oscillator whose frequency and damping ratio start far off, with fading
//! memory.

use crate::error::ValidateError;
use crate::figure::{Figure, Required};
use crate::outcome::{Outcome, Plot, Series, SeriesKind};
use crate::run::Run;
use crate::statistics::{Accuracy, Normal, rms};
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

fn track(record: &Record, half_life_steps: Option<f64>) -> Result<Tracked, ValidateError> {
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
    let mut filter = ExtendedKalmanFilter::new(Oscillator::default(), settings)
        .map_err(ValidateError::setting)?;
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
    run.advance(0.4);
    let endless = track(&record, None)?;
    run.advance(0.7);
    let short = track(&record, Some(400.0))?;

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
    for (j, name, truth) in [(2, "ω (rad/s)", FREQUENCY), (3, "ζ", DAMPING)] {
        let (mean, std) = endless.last[j];
        figures.push(Figure::new(
            format!("{name} without forgetting: error at the end over its deviation"),
            (mean - truth).abs() / std,
            Required::AtMost(4.0),
        ));
        figures.push(Figure::new(
            format!("{name} without forgetting: deviation at the end"),
            std,
            Required::Between {
                low: 0.006,
                high: 0.034,
            },
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
