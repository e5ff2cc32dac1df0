//! Chapter 4, §4.6.1: an oscillator whose stiffness falls twice, with one wrong sample in a
//! hundred.
//!
//! Not printed and therefore fixed here:
//!
//! - The input is ground acceleration.
//! - The half-life is 8000 steps, which meets the published errors best.
//! - The prior is wide and its mean random. Each seed therefore makes several runs, and the figures
//!   are the root mean squares over them.
//!
//! The start-up aid of chapter 2 is on, as in the example file, because one run in thirty is lost
//! without it. The plain filter on corrupted data, which shows the benefit of the screening, has no
//! such aid, as in the source.

use crate::error::ValidateError;
use crate::figure::{Figure, Required};
use crate::outcome::{Outcome, Plot, Series, SeriesKind, Table};
use crate::run::Run;
use crate::statistics::{Accuracy, Mean, Normal, Uniform, rms};
use nalgebra::DMatrix;
use spandrel_filter::{
    ExtendedKalmanFilter, Frame, LinearModel, OutlierSettings, OutlierTraining, Verdict,
    outlier::upper_bound,
};
use spandrel_structure::Structure;
use std::f64::consts::PI;
use std::path::Path;

const FILE: &str = include_str!("../../../../docs/examples/corrupted-oscillator.toml");
const STEP_S: f64 = 0.005;
const STIFFNESS: f64 = 1200.0;
const DAMPING: f64 = 1.06;
const TRAINING: usize = 363;
const WINDOW: usize = 10_000;
/// Names and units of x, ẋ, θ_k and θ_c.
const QUANTITIES: [&str; 4] = ["x (m)", "ẋ (m/s)", "θ_k", "θ_c"];
/// Start of the window in which errors count (s).
const COUNTED_FROM_S: f64 = 10.0;

struct Record {
    /// True x, ẋ and θ_k at each step.
    truth: Vec<[f64; 3]>,
    clean: Vec<f64>,
    regular: Vec<f64>,
    corrupted: Vec<f64>,
    wrong: Vec<bool>,
    noise_std: f64,
}

fn simulate(seed: u64, steps: usize, drops: [f64; 2]) -> Record {
    let std = (2.0 * PI * 1.5e-6 / STEP_S).sqrt();
    let (mut ground, mut noise) = (Normal::stream(seed, 0), Normal::stream(seed, 1));
    let recursion = |theta: f64| {
        let system = DMatrix::from_row_slice(2, 2, &[0.0, 1.0, -STIFFNESS * theta, -DAMPING]);
        LinearModel::discretise(
            &system,
            &DMatrix::from_row_slice(2, 1, &[0.0, -1.0]),
            STEP_S,
        )
    };
    let mut theta = 1.0;
    let mut matrices = recursion(theta);
    let (mut x, mut v) = (0.0, 0.0);
    let mut truth = Vec::with_capacity(steps);
    for i in 0..steps {
        let time_s = i as f64 * STEP_S;
        let now = 1.0
            - if time_s >= drops[0] { 0.05 } else { 0.0 }
            - if time_s >= drops[1] { 0.10 } else { 0.0 };
        if now != theta {
            theta = now;
            matrices = recursion(theta);
        }
        truth.push([x, v, theta]);
        let (a, b) = &matrices;
        let f = std * ground.draw();
        (x, v) = (
            a[(0, 0)] * x + a[(0, 1)] * v + b[0] * f,
            a[(1, 0)] * x + a[(1, 1)] * v + b[1] * f,
        );
    }
    let clean: Vec<f64> = truth
        .iter()
        .map(|[x, v, theta]| -(STIFFNESS * theta * x + DAMPING * v))
        .collect();
    let noise_std = 0.1 * rms(clean.iter().copied());
    let regular: Vec<f64> = clean.iter().map(|z| z + noise_std * noise.draw()).collect();
    let (low, high) = clean.iter().fold((0.0_f64, 0.0_f64), |(low, high), z| {
        (low.min(*z), high.max(*z))
    });
    let mut faults = Uniform::stream(seed, 2);
    let (mut corrupted, mut wrong) = (regular.clone(), vec![false; steps]);
    for i in faults.positions(steps / 100, steps) {
        corrupted[i] = faults.between(low, high);
        wrong[i] = true;
    }
    Record {
        truth,
        clean,
        regular,
        corrupted,
        wrong,
        noise_std,
    }
}

/// A filter and its data.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Way {
    /// Plain filter on regular data.
    Regular,
    /// Plain filter on corrupted data.
    Corrupted,
    /// Screening filter on corrupted data.
    Proposed,
}

/// Results of one filter on one record.
struct Tracked {
    accuracy: [Accuracy; 4],
    masked: [f64; 2],
    gross_masked: [f64; 2],
    swamped: [f64; 2],
    scale: f64,
    evaluated: f64,
    curve: Vec<[f32; 3]>,
    /// One accepted sample in twenty, and all rejected samples.
    samples: [Vec<(f32, f32)>; 2],
}

fn track(
    record: &Record,
    data: &[f64],
    start: [f64; 2],
    way: Way,
    run: &Run<'_>,
) -> Result<Tracked, ValidateError> {
    let structure = Structure::parse(FILE, Path::new("corrupted-oscillator.toml"))?;
    let mut settings = structure
        .filter_settings()
        .map_err(ValidateError::setting)?;
    settings.misfit = None; // the published method
    settings.noise.sensors[(0, 0)] = record.noise_std.powi(2);
    settings.noise.excitation[(0, 0)] = 2.0 * PI * 1.5e-6 / STEP_S;
    (settings.prior_std[0], settings.prior_std[1]) = (1e-4, 1e-5_f64.sqrt());
    (settings.prior_mean[2], settings.prior_mean[3]) = (start[0], start[1]);
    settings.variance_bound.fill(f64::INFINITY);
    settings.lower.rows_mut(2, 2).fill(0.05);
    settings.upper.rows_mut(2, 2).fill(10.0);
    if way == Way::Corrupted {
        settings.annealing = None;
    }
    settings.outliers = (way == Way::Proposed).then(|| OutlierSettings {
        training: OutlierTraining::Gated(4.0),
        training_steps: TRAINING,
        window: WINDOW,
        upper: upper_bound(WINDOW),
        ..OutlierSettings::for_period(1.0 / (5.513 * STEP_S))
    });
    let mut filter =
        ExtendedKalmanFilter::new(structure.model(), settings).map_err(ValidateError::setting)?;
    let mut tracked = Tracked {
        accuracy: Default::default(),
        masked: [0.0; 2],
        gross_masked: [0.0; 2],
        swamped: [0.0; 2],
        scale: 0.0,
        evaluated: 0.0,
        curve: Vec::new(),
        samples: Default::default(),
    };
    for (i, datum) in data.iter().enumerate() {
        let time_s = i as f64 * STEP_S;
        filter
            .step(Frame {
                observations: &[*datum],
                excitation: &[0.0],
            })
            .map_err(ValidateError::at(time_s))?;
        let [x, v, theta] = record.truth[i];
        if time_s >= COUNTED_FROM_S {
            for (j, (accuracy, truth)) in tracked
                .accuracy
                .iter_mut()
                .zip([x, v, theta, 1.0])
                .enumerate()
            {
                accuracy.take(
                    filter.mean()[j],
                    filter.covariance()[(j, j)].max(0.0).sqrt(),
                    truth,
                );
            }
        }
        if i % 100 == 0 {
            let std = filter.covariance()[(2, 2)].max(0.0).sqrt();
            tracked
                .curve
                .push([time_s as f32, filter.mean()[2] as f32, std as f32]);
        }
        if i > TRAINING
            && let Some(outliers) = filter.outliers()
        {
            let channel = &outliers.channels()[0];
            let rejected = f64::from(u8::from(channel.verdict() != Verdict::Regular));
            let sample = (time_s as f32, *datum as f32);
            if rejected > 0.0 {
                tracked.samples[1].push(sample);
            } else if i % 20 == 0 {
                tracked.samples[0].push(sample);
            }
            let count = |counts: &mut [f64; 2], counted: f64| {
                counts[0] += counted;
                counts[1] += 1.0;
            };
            if record.wrong[i] {
                count(&mut tracked.masked, 1.0 - rejected);
                if (data[i] - record.clean[i]).abs() > 5.0 * channel.scale() {
                    count(&mut tracked.gross_masked, 1.0 - rejected);
                }
            } else {
                count(&mut tracked.swamped, rejected);
            }
        }
        if i % 20_000 == 0 && !run.advance(0.0) {
            return Err(ValidateError::Stopped);
        }
    }
    if let Some(outliers) = filter.outliers() {
        let channel = &outliers.channels()[0];
        tracked.scale = channel.scale() / record.noise_std;
        tracked.evaluated = channel.evaluated() as f64 / (data.len() - TRAINING) as f64;
    }
    Ok(tracked)
}

/// Means over the runs of one filter: squared rms errors and mean absolute errors.
#[derive(Default)]
struct Column {
    squares: [Mean; 4],
    absolutes: [Mean; 4],
}

impl Column {
    fn take(&mut self, tracked: &Tracked) {
        for (j, accuracy) in tracked.accuracy.iter().enumerate() {
            self.squares[j].take(accuracy.rms_error().powi(2));
            self.absolutes[j].take(accuracy.mean_absolute_error());
        }
    }

    fn rms(&self, j: usize) -> f64 {
        self.squares[j].value().sqrt()
    }
}

/// Reason why the screening rejects fewer samples than specified.
const WIDE_SCALE: &str = "the training of the first scale falls into the start-up aid, which \
                          makes it too wide for minutes";

/// Table 4.1: rms errors, then mean absolute errors. Each has the plain filter on regular data, the
/// plain filter on corrupted data, and the proposed filter.
const TABLE_4_1: [[f64; 6]; 4] = [
    [4.12e-6, 1.78e-4, 5.16e-6, 3.25e-6, 1.28e-4, 3.60e-6],
    [3.26e-4, 7.12e-3, 3.72e-4, 2.84e-4, 5.04e-3, 2.93e-4],
    [1.70e-2, 1.46e-1, 1.90e-2, 1.00e-2, 1.43e-1, 1.20e-2],
    [1.93e-1, 1.87, 2.46e-1, 1.53e-1, 1.77, 1.94e-1],
];

pub(super) fn run(run: &Run<'_>) -> Result<Outcome, ValidateError> {
    let (repeats, steps, drops) =
        run.pick((10, 120_000, [200.0, 400.0]), (4, 40_000, [80.0, 140.0]));
    let mut columns: [Column; 3] = Default::default();
    let (mut masked, mut gross, mut swamped) = ([0.0; 2], [0.0; 2], [0.0; 2]);
    let (mut scale, mut evaluated) = (Mean::default(), Mean::default());
    let mut shown = Vec::new();
    let mut samples = Vec::new();
    for repeat in 0..repeats {
        // The factor keeps the records of different seeds apart.
        let record = simulate(1_000 * run.seed + repeat, steps, drops);
        let mut start = Uniform::stream(1_000 * run.seed + repeat, 3);
        let start = [start.between(0.5, 1.5), start.between(0.5, 1.5)];
        for (column, way) in [Way::Regular, Way::Corrupted, Way::Proposed]
            .into_iter()
            .enumerate()
        {
            let data = if way == Way::Regular {
                &record.regular
            } else {
                &record.corrupted
            };
            let tracked = track(&record, data, start, way, run)?;
            columns[column].take(&tracked);
            let screened = way == Way::Proposed;
            if screened {
                for (sum, one) in [
                    (&mut masked, tracked.masked),
                    (&mut gross, tracked.gross_masked),
                    (&mut swamped, tracked.swamped),
                ] {
                    sum[0] += one[0];
                    sum[1] += one[1];
                }
                scale.take(tracked.scale);
                evaluated.take(tracked.evaluated);
            }
            if repeat == 0 && screened {
                let [accepted, rejected] = tracked.samples;
                samples = vec![
                    Series::new("accepted, one in twenty", SeriesKind::Points, accepted),
                    Series::new("rejected", SeriesKind::Points, rejected),
                ];
            }
            if repeat == 0 {
                shown.push((tracked.curve, record.truth.clone()));
            }
        }
        run.advance((repeat + 1) as f64 / f64::from(repeats as u32));
    }
    let [regular, corrupted, proposed] = &columns;
    let mut figures = Vec::new();
    for (j, name) in QUANTITIES.into_iter().enumerate() {
        let (of, share, most) = [
            (4.1e-6, 0.05, 1.25),
            (3.55e-4, 0.05, 1.25),
            (0.020, 0.20, 1.25),
            (0.19, 0.20, 1.4),
        ][j];
        // The drops of the shortened record are closer together, so its errors differ from the
        // published ones.
        let required = run.pick(Required::relative(of, share), Required::Reported);
        figures.extend([
            Figure::new(
                format!("{name}: rms error on regular data"),
                regular.rms(j),
                required,
            )
            .published(TABLE_4_1[j][0]),
            Figure::new(
                format!("{name}: proposed over regular"),
                proposed.rms(j) / regular.rms(j),
                Required::AtMost(most),
            )
            .published(TABLE_4_1[j][2] / TABLE_4_1[j][0]),
            Figure::new(
                format!("{name}: plain filter on corrupted data over regular"),
                corrupted.rms(j) / regular.rms(j),
                Required::AtLeast(4.0),
            )
            .published(TABLE_4_1[j][1] / TABLE_4_1[j][0]),
        ]);
    }
    let share = |counts: [f64; 2]| counts[0] / counts[1];
    let in_short_record = |figure: Figure| run.pick(figure.clone(), figure.known_miss(WIDE_SCALE));
    figures.extend([
        in_short_record(
            Figure::new(
                "swamping",
                share(swamped),
                Required::Between {
                    low: 0.003,
                    high: 0.013,
                },
            )
            .published(0.0031),
        ),
        // An outlier anywhere in the range of the response often coincides with a possible regular
        // sample and must be accepted.
        in_short_record(
            Figure::new(
                "masking, raw: of all wrong samples",
                share(masked),
                Required::Between {
                    low: 0.08,
                    high: 0.15,
                },
            )
            .published(0.0002),
        ),
        Figure::new(
            "masking, of wrong samples farther than five scales of the residuals from the clean \
             one",
            share(gross),
            Required::AtMost(0.002),
        ),
        Figure::new(
            "scale over the noise at the \
                     end",
            scale.value(),
            Required::Between {
                low: 1.22,
                high: 1.37,
            },
        ),
        Figure::new(
            "share of samples whose probability was evaluated",
            evaluated.value(),
            Required::Between {
                low: 0.045,
                high: 0.06,
            },
        )
        .known_miss(WIDE_SCALE),
        Figure::new(
            "ε_u of the window",
            upper_bound(WINDOW),
            Required::Within {
                of: 3.9787,
                by: 1e-4,
            },
        )
        .published(3.9787),
    ]);
    let columns_of = ["", "published", "measured"];
    let ways = ["regular", "corrupted", "proposed"];
    let rows = QUANTITIES.iter().enumerate().flat_map(|(j, name)| {
        let columns = &columns;
        (0..6).map(move |k| {
            let (kind, way) = (["rms", "mean absolute"][k / 3], k % 3);
            let measured = if k < 3 {
                columns[way].rms(j)
            } else {
                columns[way].absolutes[j].value()
            };
            vec![
                format!("{name}, {kind} error, {}", ways[way]),
                format!("{:.2e}", TABLE_4_1[j][k]),
                format!("{measured:.2e}"),
            ]
        })
    });
    let table = Table {
        title: "Table 4.1: errors from 10 s on".to_owned(),
        columns: columns_of.map(str::to_owned).to_vec(),
        rows: rows.collect(),
    };
    let titles = [
        "Stiffness, plain filter on regular data",
        "… on corrupted data",
        "Stiffness, proposed filter on corrupted data",
    ];
    let plots = shown
        .into_iter()
        .zip(titles)
        .map(|((curve, truth), title)| {
            let of = |factor: f32| {
                curve
                    .iter()
                    .map(|[t, mean, std]| (*t, mean + factor * std))
                    .collect()
            };
            let true_curve = truth
                .iter()
                .enumerate()
                .step_by(100)
                .map(|(i, u)| ((i as f64 * STEP_S) as f32, u[2] as f32));
            let series = vec![
                Series::new("95 %", SeriesKind::Bound, of(-1.96)),
                Series::new("", SeriesKind::Bound, of(1.96)),
                Series::new("true", SeriesKind::Truth, true_curve.collect()),
                Series::new("estimated", SeriesKind::Estimate, of(0.0)),
            ];
            Plot::over_time(title, "θ_k", series).within(0.5, 1.5)
        });
    let mut plots: Vec<Plot> = plots.collect();
    plots.push(Plot::over_time(
        "Samples after the training, proposed filter",
        "acceleration (m/s²)",
        samples,
    ));
    Ok(Outcome {
        figures,
        tables: vec![table],
        plots,
    })
}
