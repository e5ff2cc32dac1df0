//! Chapter 2, §2.3.1: a vehicle that drives straight, then on two semicircles. Its position is
//! observed. Its velocity and acceleration are not.
//!
//! Not printed and therefore fixed here: `ω = π/201` rad/s, so that the semicircles last 402 s. The
//! white jerk has a variance of 0.02 m²/s⁴. The filter starts at rest at the origin with
//! `Σ = 500 I`. The source prints a noise of 2 % of the rms position and a filter noise of 3 m²,
//! which contradict each other. The case therefore runs both, and a filter with the 2 %.

use crate::error::ValidateError;
use crate::figure::{Figure, Required};
use crate::outcome::{Outcome, Plot, Series, SeriesKind};
use crate::run::Run;
use crate::statistics::{Accuracy, Normal, larger, rms};
use nalgebra::{DMatrix, DVector};
use spandrel_filter::{KalmanFilter, LinearModel};
use std::f64::consts::PI;

const STEPS: usize = 462;
const TURN: usize = 60;
const ANGULAR_VELOCITY: f64 = PI / 201.0;
const FILTER_VARIANCE: f64 = 3.0;

/// Returns position, velocity and acceleration in x, then in y, at a time (s).
fn truth(time: f64) -> [f64; 6] {
    let omega = ANGULAR_VELOCITY;
    let a = omega * (time - TURN as f64);
    if a <= 0.0 {
        return [10.0 * time, 10.0, 0.0, 0.0, 0.0, 0.0];
    }
    let (v, c) = (100.0 * omega, 100.0 * omega * omega);
    if a <= PI {
        let (sin, cos) = a.sin_cos();
        [
            600.0 + 100.0 * sin,
            v * cos,
            -c * sin,
            -100.0 + 100.0 * cos,
            -v * sin,
            -c * cos,
        ]
    } else {
        let (sin, cos) = (a - PI).sin_cos();
        [
            600.0 - 100.0 * sin,
            -v * cos,
            c * sin,
            -300.0 + 100.0 * cos,
            -v * sin,
            -c * cos,
        ]
    }
}

fn model(sensor_variance: [f64; 2]) -> LinearModel {
    let transition = DMatrix::from_row_slice(3, 3, &[1.0, 1.0, 0.5, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0]); // (2.38), Δt = 1 s
    let process =
        DMatrix::from_row_slice(3, 3, &[0.25, 0.5, 0.5, 0.5, 1.0, 1.0, 0.5, 1.0, 1.0]) * 0.02; // (2.39)
    let twice = |block: &DMatrix<f64>| {
        DMatrix::from_fn(6, 6, |i, j| {
            if i / 3 == j / 3 {
                block[(i % 3, j % 3)]
            } else {
                0.0
            }
        })
    };
    LinearModel {
        transition: twice(&transition),
        input: DMatrix::identity(6, 6),
        observation: DMatrix::from_fn(2, 6, |c, j| f64::from(u8::from(j == 3 * c))), // (2.41)
        excitation_covariance: twice(&process),
        sensor_covariance: DMatrix::from_diagonal(&DVector::from_row_slice(&sensor_variance)),
    }
}

struct Track {
    estimates: Vec<DVector<f64>>,
    deviations: Vec<DVector<f64>>,
    accuracy: [Accuracy; 6],
}

/// Tracks a record from 1 s on. Accuracy counts after `from` s.
fn track(
    record: &[[f64; 2]],
    sensor_variance: [f64; 2],
    from: usize,
) -> Result<Track, ValidateError> {
    let start = (DVector::zeros(6), DMatrix::identity(6, 6) * 500.0);
    let mut filter = KalmanFilter::new(model(sensor_variance), start.0, start.1)
        .map_err(ValidateError::setting)?;
    let mut track = Track {
        estimates: Vec::new(),
        deviations: Vec::new(),
        accuracy: [Accuracy::default(); 6],
    };
    for (second, datum) in (1..).zip(record) {
        filter.predict(&[0.0; 6]);
        filter
            .update(datum)
            .map_err(ValidateError::at(f64::from(second)))?;
        let deviation = filter
            .covariance()
            .diagonal()
            .map(|variance| variance.max(0.0).sqrt());
        if second > from as i32 {
            let truth = truth(f64::from(second));
            for (j, accuracy) in track.accuracy.iter_mut().enumerate() {
                accuracy.take(filter.mean()[j], deviation[j], truth[j]);
            }
        }
        track.estimates.push(filter.mean().clone());
        track.deviations.push(deviation);
    }
    Ok(track)
}

fn observe(seed: u64, std: [f64; 2]) -> Vec<[f64; 2]> {
    let mut normal = Normal::stream(seed, 1);
    (1..=STEPS)
        .map(|second| {
            let truth = truth(second as f64);
            [
                truth[0] + std[0] * normal.draw(),
                truth[3] + std[1] * normal.draw(),
            ]
        })
        .collect()
}

/// Returns the root mean square of the position errors in both coordinates.
fn position_error(track: &Track) -> f64 {
    rms([track.accuracy[0].rms_error(), track.accuracy[3].rms_error()].into_iter())
}

pub(super) fn run(run: &Run<'_>) -> Result<Outcome, ValidateError> {
    let std = FILTER_VARIANCE.sqrt();
    let record = observe(run.seed, [std; 2]);
    let matched = track(&record, [FILTER_VARIANCE; 2], 120)?;
    let everywhere = track(&record, [FILTER_VARIANCE; 2], 0)?;
    let printed_std = [0, 3].map(|j| 0.02 * rms((1..=STEPS).map(|second| truth(second as f64)[j])));
    let printed = observe(run.seed, printed_std);
    let too_sure = track(&printed, [FILTER_VARIANCE; 2], 0)?;
    let honest = track(&printed, printed_std.map(|std| std * std), 0)?;
    run.advance(1.0);

    let end = truth(STEPS as f64);
    let mut figures = vec![
        Figure::new(
            "end of the path, x (m)",
            end[0],
            Required::Within {
                of: 600.0,
                by: 1e-6,
            },
        ),
        Figure::new(
            "end of the path, y (m)",
            end[3],
            Required::Within {
                of: -400.0,
                by: 1e-6,
            },
        ),
    ];
    let steady = &matched.deviations[STEPS - 1];
    for (name, j, of) in [
        ("position (m)", 0, 1.319),
        ("velocity (m/s)", 1, 0.750),
        ("acceleration (m/s²)", 2, 0.271),
    ] {
        figures.push(Figure::new(
            format!("steady deviation of the {name}"),
            steady[j],
            Required::relative(of, 0.005),
        ));
    }
    figures.push(Figure::new(
        "rms position error after 120 s (m)",
        position_error(&matched),
        Required::relative(1.24, 0.10),
    ));
    let raw = rms((120..STEPS).flat_map(|i| {
        let truth = truth(i as f64 + 1.0);
        [record[i][0] - truth[0], record[i][1] - truth[3]]
    }));
    figures.push(Figure::new(
        "rms error of the raw positions after 120 s (m)",
        raw,
        Required::Reported,
    ));
    let least = everywhere
        .accuracy
        .iter()
        .map(Accuracy::coverage)
        .fold(f64::INFINITY, f64::min);
    figures.push(Figure::new(
        "least share inside 3 sd, six states",
        least,
        Required::AtLeast(0.97),
    ));
    let turn = TURN..TURN + 40;
    let largest = |states: [usize; 2]| {
        let error = |i: usize| {
            let (estimate, truth) = (&everywhere.estimates[i], truth(i as f64 + 1.0));
            states
                .map(|j| (estimate[j] - truth[j]).abs())
                .into_iter()
                .fold(0.0, larger)
        };
        turn.clone().map(error).fold(0.0, larger)
    };
    let valley = turn
        .clone()
        .map(|i| everywhere.estimates[i][2])
        .fold(f64::INFINITY, f64::min);
    figures.extend([
        Figure::new(
            "largest position error in the turn (m)",
            largest([0, 3]),
            Required::Within { of: 4.7, by: 1.5 },
        ),
        Figure::new(
            "largest velocity error in the turn (m/s)",
            largest([1, 4]),
            Required::Within { of: 6.2, by: 1.0 },
        ),
        Figure::new(
            "deepest x acceleration in the turn (m/s²)",
            valley,
            Required::Within { of: -1.6, by: 0.4 },
        ),
        Figure::new(
            "2 % noise, filter with 3 m²: rms error in x (m)",
            too_sure.accuracy[0].rms_error(),
            Required::relative(8.2, 0.10),
        ),
        Figure::new(
            "2 % noise, filter with 3 m²: share of x inside 3 sd",
            too_sure.accuracy[0].coverage(),
            Required::Within { of: 0.38, by: 0.08 },
        ),
        Figure::new(
            "2 % noise, filter with 3 m²: share of y inside 3 sd",
            too_sure.accuracy[3].coverage(),
            Required::Within { of: 0.79, by: 0.08 },
        ),
        Figure::new(
            "2 % noise, filter that knows it: rms error in x (m)",
            honest.accuracy[0].rms_error(),
            Required::relative(6.4, 0.15),
        ),
        Figure::new(
            "2 % noise, filter that knows it: share of x inside 3 sd",
            honest.accuracy[0].coverage(),
            Required::AtLeast(0.98),
        ),
    ]);
    Ok(Outcome {
        figures,
        tables: Vec::new(),
        plots: plots(&record, &everywhere),
    })
}

fn plots(record: &[[f64; 2]], track: &Track) -> Vec<Plot> {
    let point = |x: f64, y: f64| (x as f32, y as f32);
    let seconds = || 1..=STEPS;
    let path = Plot {
        title: "Path".to_owned(),
        abscissa: "x (m)".to_owned(),
        ordinate: "y (m)".to_owned(),
        range: None,
        series: vec![
            Series::new(
                "observed",
                SeriesKind::Points,
                record.iter().map(|z| point(z[0], z[1])).collect(),
            ),
            Series::new(
                "true",
                SeriesKind::Truth,
                seconds()
                    .map(|i| truth(i as f64))
                    .map(|t| point(t[0], t[3]))
                    .collect(),
            ),
            Series::new(
                "estimated",
                SeriesKind::Estimate,
                track.estimates.iter().map(|u| point(u[0], u[3])).collect(),
            ),
        ],
    };
    let over_time = |title: &str, ordinate: &str, j: usize, range: (f32, f32)| {
        let bound = |sign: f64| {
            let value =
                move |i: usize| track.estimates[i - 1][j] + sign * 3.0 * track.deviations[i - 1][j];
            seconds().map(move |i| point(i as f64, value(i)))
        };
        let series = vec![
            Series::new("99.7 %", SeriesKind::Bound, bound(-1.0).collect()),
            Series::new("", SeriesKind::Bound, bound(1.0).collect()),
            Series::new(
                "true",
                SeriesKind::Truth,
                seconds()
                    .map(|i| point(i as f64, truth(i as f64)[j]))
                    .collect(),
            ),
            Series::new(
                "estimated",
                SeriesKind::Estimate,
                seconds()
                    .map(|i| point(i as f64, track.estimates[i - 1][j]))
                    .collect(),
            ),
        ];
        Plot::over_time(title, ordinate, series).within(range.0, range.1)
    };
    vec![
        path,
        over_time("Velocity in x", "m/s", 1, (-10.0, 20.0)),
        over_time("Acceleration in x", "m/s²", 2, (-3.0, 3.0)),
    ]
}
