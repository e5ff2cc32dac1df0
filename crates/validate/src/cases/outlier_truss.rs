//! Chapter 4, §4.6.2: a fourteen-bay truss with twelve accelerometers, with up to one sample in a
//! hundred wrong in each.
//!
//! The geometry and the groups are lost with a figure of the source. The geometry here has the five
//! published frequencies. A half-life of 2000 steps reproduces the published level of errors. The
//! rows of the published error table are mislabelled, so the case does not compare with them.
//!
//! The filters start with the start-up aid. Without it they lock within a second at values a
//! hundred of their deviations off. The errors from 10 s on would then show how long each filter
//! took to recover, and not the effect of wrong samples.

use crate::error::ValidateError;
use crate::figure::{Figure, Required};
use crate::outcome::{Outcome, Plot, Series, SeriesKind};
use crate::run::Run;
use crate::scene::{self, Course, Plan, Scene};
use crate::statistics::{Accuracy, Uniform, larger};
use spandrel_filter::{FadingFactor, OutlierSettings, Verdict, outlier::upper_bound};

const FILE: &str = include_str!("../../../../docs/examples/fourteen-bay-truss.toml");
const GROUPS: usize = 6;
const RESPONSES: [&str; 4] = ["node-8-x", "node-8-y", "node-15-x", "node-15-y"];
/// Start of the window in which errors count (s).
const COUNTED_FROM_S: f64 = 10.0;
/// End of the run of the filter without the start-up aid (s).
const UNAIDED_S: f64 = 20.0;

/// Replaces samples by draws from the range of the clean response. Returns the record, and which
/// samples are wrong.
fn corrupt(scene: &Scene, seed: u64) -> (Vec<f64>, Vec<bool>) {
    let channels = scene.noise_std.len();
    let mut random = Uniform::stream(seed, 8);
    let mut data: Vec<f64> = (0..scene.frames)
        .flat_map(|frame| scene.data(frame).to_vec())
        .collect();
    let mut wrong = vec![false; data.len()];
    for channel in 0..channels {
        let of_channel = (0..scene.frames).map(|frame| scene.clean(frame)[channel]);
        let (low, high) = of_channel.fold((0.0_f64, 0.0_f64), |(low, high), value| {
            (low.min(value), high.max(value))
        });
        let share = random.between(0.005, 0.01);
        for frame in random.positions((share * scene.frames as f64).round() as usize, scene.frames)
        {
            data[frame * channels + channel] = random.between(low, high);
            wrong[frame * channels + channel] = true;
        }
    }
    (data, wrong)
}

struct Tracked {
    courses: Vec<Course>,
    parameters: Vec<Accuracy>,
    responses: Vec<Accuracy>,
    /// For each channel: rejected and all regular samples, kept and all outliers, kept and all
    /// gross outliers.
    swamped: Vec<[f64; 2]>,
    masked: Vec<[f64; 2]>,
    gross_masked: Vec<[f64; 2]>,
    /// Some of the accepted samples and all rejected samples of the first channel.
    samples: [Vec<(f32, f32)>; 2],
}

pub(super) fn run(run: &Run<'_>) -> Result<Outcome, ValidateError> {
    let (seconds, jumps) = run.pick((300.0, [100.0, 200.0]), (26.0, [13.0, 18.0]));
    let text = FILE
        .replace("at-s = 100", &format!("at-s = {}", jumps[0]))
        .replace("at-s = 200", &format!("at-s = {}", jumps[1]));
    let watched = |structure: &_| scene::states_of(structure, &RESPONSES, false);
    let scene = Scene::simulate(
        &Plan {
            text: &text,
            seconds,
            noise_share: 0.10,
            watched: &watched,
        },
        run,
    )?;
    let (corrupted, wrong) = corrupt(&scene, run.seed);
    let channels = scene.noise_std.len();
    let mut random = Uniform::stream(run.seed, 9);
    let start: Vec<f64> = (0..GROUPS + 2)
        .map(|j| {
            if j < GROUPS {
                random.between(0.8, 1.2)
            } else {
                random.between(0.5, 1.5)
            }
        })
        .collect();

    let track = |screened: bool,
                 clean: bool,
                 aided: bool,
                 shares|
     -> Result<Tracked, ValidateError> {
        let mut settings = scene.settings()?;
        let first = settings.prior_mean.len() - GROUPS - 2;
        let displacements = first / 2;
        for j in 0..first {
            settings.prior_std[j] = if j < displacements {
                1e-3_f64.sqrt()
            } else {
                0.1
            };
        }
        settings
            .prior_mean
            .rows_mut(first, GROUPS + 2)
            .copy_from_slice(&start);
        if !aided {
            settings.annealing = None;
        }
        settings.fading = FadingFactor::from_half_life(2000.0).map_err(ValidateError::setting)?;
        settings.variance_bound.fill(f64::INFINITY);
        settings.lower.rows_mut(first, GROUPS).fill(0.05);
        settings.upper.rows_mut(first, GROUPS).fill(10.0);
        (
            settings.lower[first + GROUPS],
            settings.upper[first + GROUPS],
        ) = (1e-4 / 0.083, 2.0 / 0.083);
        (
            settings.lower[first + GROUPS + 1],
            settings.upper[first + GROUPS + 1],
        ) = (1e-5 / 0.003, 0.1 / 0.003);
        settings.outliers = screened.then(|| {
            let window = run.pick(94_112, 10_000);
            OutlierSettings {
                training_steps: run.pick(9_411, 3_000),
                window,
                upper: upper_bound(window),
                ..OutlierSettings::for_period(1.0 / (0.425 * scene.step_s))
            }
        });
        let mut tracked = Tracked {
            courses: vec![Course::default(); GROUPS + 2],
            parameters: vec![Accuracy::default(); GROUPS + 2],
            responses: vec![Accuracy::default(); RESPONSES.len()],
            swamped: vec![[0.0; 2]; channels],
            masked: vec![[0.0; 2]; channels],
            gross_masked: vec![[0.0; 2]; channels],
            samples: Default::default(),
        };
        let data = |frame: usize| {
            if clean {
                scene.data(frame)
            } else {
                &corrupted[frame * channels..(frame + 1) * channels]
            }
        };
        let frames = if aided {
            scene.frames
        } else {
            scene.frames.min((UNAIDED_S / scene.step_s) as usize)
        };
        scene.filter_for(frames, settings, data, shares, run, |frame, filter, _| {
            let time_s = scene.time_s(frame);
            let truth = scene.structure.true_parameters(frame as u64);
            for j in 0..GROUPS + 2 {
                let variance = filter.covariance()[(first + j, first + j)];
                if frame % 20 == 0 {
                    tracked.courses[j].take(time_s, filter.mean()[first + j], variance, truth[j]);
                }
                if time_s >= COUNTED_FROM_S {
                    tracked.parameters[j].take(
                        filter.mean()[first + j],
                        variance.max(0.0).sqrt(),
                        truth[j],
                    );
                }
            }
            if time_s >= COUNTED_FROM_S {
                let watched = tracked
                    .responses
                    .iter_mut()
                    .zip(scene.watched())
                    .zip(scene.states(frame));
                for ((accuracy, state), truth) in watched {
                    accuracy.take(
                        filter.mean()[*state],
                        filter.covariance()[(*state, *state)].sqrt(),
                        *truth,
                    );
                }
            }
            let Some(outliers) = filter.outliers() else {
                return;
            };
            for (c, channel) in outliers
                .channels()
                .iter()
                .enumerate()
                .filter(|(_, channel)| channel.trained())
            {
                let rejected = f64::from(u8::from(channel.verdict() != Verdict::Regular));
                let at = frame * channels + c;
                let count = |counts: &mut [f64; 2], counted: f64| {
                    counts[0] += counted;
                    counts[1] += 1.0;
                };
                if wrong[at] {
                    count(&mut tracked.masked[c], 1.0 - rejected);
                    if (corrupted[at] - scene.clean(frame)[c]).abs() > 5.0 * channel.scale() {
                        count(&mut tracked.gross_masked[c], 1.0 - rejected);
                    }
                } else {
                    count(&mut tracked.swamped[c], rejected);
                }
                let sample = (time_s as f32, corrupted[at] as f32);
                match rejected > 0.0 {
                    true if c == 0 => tracked.samples[1].push(sample),
                    false if c == 0 && frame % 20 == 0 => tracked.samples[0].push(sample),
                    _ => {}
                }
            }
        })?;
        Ok(tracked)
    };
    let regular = track(false, true, true, (0.0, 0.3))?;
    let plain = track(false, false, true, (0.3, 0.6))?;
    let proposed = track(true, false, true, (0.6, 0.9))?;
    let unaided = track(false, true, false, (0.9, 1.0))?;

    let names: Vec<&str> = scene
        .structure
        .parameters()
        .iter()
        .map(|parameter| parameter.name())
        .collect();
    let mut figures = Vec::new();
    let last = seconds - 0.1;
    for time_s in [jumps[0] - 0.1, jumps[1] - 0.1, last] {
        for group in 0..GROUPS {
            let truth = scene
                .structure
                .true_parameters((time_s / scene.step_s) as u64)[group];
            let estimate = proposed.courses[group].mean(time_s - 0.06, time_s + 0.06);
            // The filter still converges in the shortened record.
            let required = run.pick(
                Required::Within {
                    of: truth,
                    by: 0.015,
                },
                Required::Reported,
            );
            figures.push(Figure::new(
                format!("{}: proposed at {:.0} s", names[group], time_s + 0.1),
                estimate,
                required,
            ));
        }
    }
    for (j, of, by) in [(GROUPS, 1.0, 0.10), (GROUPS + 1, 1.0, 0.02)] {
        let estimate = proposed.courses[j].mean(last - 0.06, last + 0.06);
        let required = run.pick(Required::Within { of, by }, Required::Reported);
        figures.push(Figure::new(
            format!("{} over its value at the end", names[j]),
            estimate,
            required,
        ));
    }
    let full = |required: Required| run.pick(required, Required::Reported);
    for (j, name) in names.iter().enumerate() {
        let ratio = proposed.parameters[j].rms_error() / regular.parameters[j].rms_error();
        figures.push(Figure::new(
            format!("{name}: rms error, proposed over regular"),
            ratio,
            full(Required::AtMost(1.1)),
        ));
        let ratio = plain.parameters[j].rms_error() / regular.parameters[j].rms_error();
        let required = if j < GROUPS {
            Required::Reported
        } else {
            full(Required::AtLeast(1.7))
        };
        figures.push(Figure::new(
            format!("{name}: rms error, plain filter on corrupted data over regular"),
            ratio,
            required,
        ));
    }
    for (j, name) in RESPONSES.iter().enumerate() {
        let error = |tracked: &Tracked| tracked.responses[j].rms_error();
        figures.extend([
            Figure::new(
                format!("{name}: rms error on regular data (m)"),
                error(&regular),
                Required::Reported,
            ),
            Figure::new(
                format!("{name}: rms error, proposed over regular"),
                error(&proposed) / error(&regular),
                Required::AtMost(1.1),
            ),
            Figure::new(
                format!("{name}: rms error, plain filter on corrupted data over regular"),
                error(&plain) / error(&regular),
                full(Required::AtLeast(1.5)),
            ),
        ]);
    }
    let (from_s, until_s) = (run.pick(COUNTED_FROM_S, 3.0), UNAIDED_S.min(jumps[0]));
    for (name, tracked) in [("with", &regular), ("without", &unaided)] {
        let off = tracked.courses[..GROUPS]
            .iter()
            .flat_map(|course| &course.points);
        let off = off
            .filter(|point| (from_s..until_s).contains(&point[0]))
            .map(|[_, mean, std, truth]| (mean - truth).abs() / std);
        figures.push(Figure::new(
            format!(
                "regular data, {name} the start-up aid: largest error over its deviation from \
                 {from_s} to {until_s} s"
            ),
            off.fold(0.0, larger),
            Required::Reported,
        ));
    }
    let before_second = jumps[1] - 0.1;
    figures.push(Figure::new(
        format!(
            "{}: plain filter on corrupted data off by, before the second drop",
            names[0]
        ),
        (plain.courses[0].mean(before_second - 0.06, before_second + 0.06) - 0.95).abs(),
        full(Required::AtLeast(0.015)),
    ));
    let share = |counts: &[f64; 2]| counts[0] / counts[1];
    let swamped: Vec<f64> = proposed.swamped.iter().map(share).collect();
    let largest = |counts: &[[f64; 2]]| counts.iter().map(share).fold(0.0, larger);
    figures.extend([
        Figure::new(
            "mean swamping over the channels",
            swamped.iter().sum::<f64>() / channels as f64,
            Required::AtMost(run.pick(0.0025, 0.008)),
        )
        .published(0.001),
        // Wrong samples are spread over the range of the response. Some coincide with possible
        // regular samples and must be accepted.
        Figure::new(
            "largest masking of a channel, raw: of all wrong \
                     samples",
            largest(&proposed.masked),
            Required::Reported,
        )
        .published(0.0001),
        Figure::new(
            "largest masking of a channel, of wrong samples farther than five scales of the \
             residuals from the clean one",
            largest(&proposed.gross_masked),
            full(Required::AtMost(0.006)),
        ),
    ]);
    let mut plots = Vec::new();
    for (what, tracked) in [
        ("regular data", &regular),
        ("corrupted data, plain filter", &plain),
        ("corrupted data, proposed", &proposed),
    ] {
        for group in [0, 5] {
            plots.push(tracked.courses[group].plot(
                &format!("{}, {what}", names[group]),
                "ratio to nominal",
                (0.85, 1.1),
            ));
        }
    }
    let [accepted, rejected] = proposed.samples;
    let series = vec![
        Series::new("accepted, one in twenty", SeriesKind::Points, accepted),
        Series::new("rejected", SeriesKind::Points, rejected),
    ];
    plots.push(Plot::over_time(
        "Samples of the first channel after the training, proposed filter",
        "m/s²",
        series,
    ));
    Ok(Outcome {
        figures,
        tables: Vec::new(),
        plots,
    })
}
