//! Chapter 7, §7.2 and §7.3: sensors whose clocks disagree, with one filter and with a filter per
//! node.
//!
//! The source prints curves and no numbers. The requirements are the values that the reference runs
//! of the specification reach. Those runs of the truss keep eight modes at 250 Hz. Here the
//! structure has all its degrees of freedom and the published 1000 Hz.

use crate::error::ValidateError;
use crate::figure::{Figure, Required};
use crate::network::{Network, settled};
use crate::outcome::Outcome;
use crate::run::Run;
use crate::scene::{Course, Plan, Scene};
use crate::statistics::{Accuracy, Mean, larger, least};
use spandrel_structure::Structure;
use std::path::Path;

const TWO_DOF: &str = include_str!("../../../../docs/examples/two-degrees-of-freedom.toml");
const TRUSS: &str = include_str!("../../../../docs/examples/sixteen-bay-truss.toml");

pub(super) fn simulate(text: &str, seconds: f64, run: &Run<'_>) -> Result<Scene, ValidateError> {
    Scene::simulate(
        &Plan {
            text,
            seconds,
            noise_share: 0.05,
            watched: &|_: &Structure| Vec::new(),
        },
        run,
    )
}

/// Index of the factor of β among the parameters, and its upper bound in the file.
const BETA: usize = 2;
const BETA_BOUND: f64 = 20.0;

/// Runs two channels. The second channel is synchronous, one sample late, or ten samples late.
pub(super) fn two_dof(run: &Run<'_>) -> Result<Outcome, ValidateError> {
    let seconds = run.pick(100.0, 40.0);
    let scene = simulate(TWO_DOF, seconds, run)?;
    let frequencies = scene.structure.natural_frequencies_hz();
    let mut figures = vec![
        Figure::new(
            "frequency 1 (Hz)",
            frequencies[0],
            Required::Within {
                of: 3.11,
                by: 0.005,
            },
        )
        .published(3.11),
        Figure::new(
            "damping ratio of mode 1",
            damping(frequencies[0]),
            Required::Within { of: 0.01, by: 5e-5 },
        )
        .published(0.01),
        Figure::new(
            "damping ratio of mode 2",
            damping(frequencies[1]),
            Required::Within { of: 0.01, by: 5e-5 },
        )
        .published(0.01),
    ];
    let late = |samples: usize| {
        let scene = &scene;
        move |frame: usize, channel: usize| {
            scene.data(frame.saturating_sub(samples * channel))[channel]
        }
    };
    let mut plots = Vec::new();
    let mut errors = Vec::new();
    for (name, samples) in [
        ("synchronous", 0),
        ("one sample late", 1),
        ("ten samples late", 10),
    ] {
        let share = errors.len() as f64 * 0.2;
        let mut courses = scene
            .network(&late(samples))
            .in_one_filter((share, share + 0.2), run)?;
        let beta = courses.swap_remove(BETA);
        let course = courses.swap_remove(0);
        let accuracy = course.accuracy(seconds / 2.0);
        let (error, coverage) = (accuracy.mean_absolute_error(), accuracy.coverage());
        let (error_required, coverage_required) = match samples {
            0 => (Required::AtMost(0.003), Required::AtLeast(1.0)),
            1 => (Required::AtLeast(4.0 * errors[0]), Required::AtMost(0.6)),
            _ => (Required::AtLeast(0.03), Required::Reported),
        };
        figures.push(Figure::new(
            format!("{name}, one filter: mean error of θ"),
            error,
            error_required,
        ));
        figures.push(Figure::new(
            format!("{name}, one filter: share of θ within 3 deviations"),
            coverage,
            coverage_required,
        ));
        let beta_error = beta.accuracy(seconds / 2.0).mean_absolute_error();
        let required = match samples {
            1 => run.pick(Required::AtLeast(7.0), Required::Reported),
            _ => Required::Reported,
        };
        figures.push(Figure::new(
            format!("{name}, one filter: mean error of the factor of β"),
            beta_error,
            required,
        ));
        if samples > 1 {
            let largest = beta.points.iter().map(|point| point[1]).fold(0.0, larger);
            let required = Required::Within {
                of: BETA_BOUND,
                by: 0.0,
            };
            figures.push(Figure::new(
                format!("{name}, one filter: largest factor of β, bounded by {BETA_BOUND}"),
                largest,
                run.pick(required, Required::Reported),
            ));
        }
        plots.push(course.plot(
            &format!("θ in one filter, {name}"),
            "ratio to nominal",
            (0.8, 1.2),
        ));
        errors.push(error);
    }
    let fused = scene
        .network(&late(10))
        .fuse((0.6, 1.0), run, |_, _, _| {})?;
    let accuracy = fused.courses[0].accuracy(seconds / 2.0);
    figures.extend([
        Figure::new(
            "ten samples late, a filter for each channel: mean error of θ from 20 to 40 s",
            fused.courses[0].error(20.0, 40.0),
            Required::AtMost(0.02),
        ),
        Figure::new(
            "ten samples late, a filter for each channel: mean error of θ",
            accuracy.mean_absolute_error(),
            Required::AtMost(0.02),
        ),
        Figure::new(
            "ten samples late, a filter for each channel: share of θ within 3 deviations",
            accuracy.coverage(),
            Required::AtLeast(0.95),
        ),
    ]);
    plots.push(fused.courses[0].plot(
        "θ of a filter for each channel, ten samples late",
        "ratio to nominal",
        (0.8, 1.2),
    ));
    Ok(Outcome {
        figures,
        tables: Vec::new(),
        plots,
    })
}

/// Returns the damping ratio of a mode of the two degrees of freedom, from the printed
/// coefficients.
fn damping(frequency_hz: f64) -> f64 {
    let omega = 2.0 * std::f64::consts::PI * frequency_hz;
    0.283 / (2.0 * omega) + 2.828e-4 * omega / 2.0
}

/// Frequencies of the truss as printed (Hz).
const FREQUENCIES: [f64; 5] = [2.188, 2.359, 5.233, 5.586, 8.338];
/// Clock offset of each node relative to the input (ms), table 7.1.
pub(super) const SHIFTS_MS: [usize; 10] = [32, 10, 19, 18, 28, 5, 24, 1, 29, 22];
pub(super) const GROUPS: usize = 6;
const DAMAGED: [usize; 2] = [1, 5];
/// Rate at which the clean channels are simulated (Hz), so that a shift of 1 ms is one sample.
pub(super) const FINE_HZ: f64 = 1000.0;
/// Start of the window in which errors count, and time left out after each damage (s).
pub(super) const COUNTED_FROM_S: f64 = 20.0;
pub(super) const AFTER_DAMAGE_S: f64 = 15.0;

/// Returns the truss file with another rate and other damage times.
pub(super) fn truss_at(rate_hz: f64, damages: [f64; 2]) -> String {
    TRUSS
        .replacen(
            "sampling-rate-hz = 1000",
            &format!("sampling-rate-hz = {rate_hz}"),
            1,
        )
        .replacen("at-s = 100", &format!("at-s = {}", damages[0]), 1)
        .replacen("at-s = 150", &format!("at-s = {}", damages[1]), 1)
}

/// Runs the truss with sixteen bays and ten nodes, each with its own clock.
pub(super) fn truss(run: &Run<'_>) -> Result<Outcome, ValidateError> {
    let (rate_hz, seconds, damages) = run.pick(
        (FINE_HZ, 200.0, [100.0, 150.0]),
        (200.0, 60.0, [24.0, 41.0]),
    );
    let fine = simulate(&truss_at(FINE_HZ, damages), seconds + 0.04, run)?;
    let structure = Structure::parse(&truss_at(rate_hz, damages), Path::new("example.toml"))?;
    let every = (FINE_HZ / rate_hz).round() as usize;
    let synchronous = |frame: usize, channel: usize| fine.data(frame * every)[channel];
    let asynchronous =
        |frame: usize, channel: usize| fine.data(frame * every + SHIFTS_MS[channel / 2])[channel];
    let network = |data, seconds: f64| Network {
        structure: &structure,
        frames: (seconds * rate_hz).round() as usize,
        noise_std: &fine.noise_std,
        data,
    };
    let in_one = network(&synchronous, seconds).in_one_filter((0.0, 0.1), run)?;
    let in_one_shifted = network(&asynchronous, seconds).in_one_filter((0.1, 0.2), run)?;
    let fused = network(&asynchronous, seconds).fuse((0.2, 0.8), run, |_, _, _| {})?;
    let first_damage = network(&synchronous, damages[0]).fuse((0.8, 1.0), run, |_, _, _| {})?;

    let judged = |required: Required| run.pick(required, Required::Reported);
    let mut figures = Vec::new();
    let modes = structure.natural_frequencies_hz();
    for (number, frequency) in FREQUENCIES.iter().enumerate() {
        let required = Required::Within {
            of: *frequency,
            by: 0.007 * frequency,
        };
        figures.push(
            Figure::new(
                format!("frequency {} (Hz)", number + 1),
                modes[number],
                required,
            )
            .published(*frequency),
        );
    }
    let of_groups = |courses: &[Course]| -> Vec<Accuracy> {
        courses[..GROUPS]
            .iter()
            .map(|course| settled(course, COUNTED_FROM_S, &damages, AFTER_DAMAGE_S))
            .collect()
    };
    let error = |courses: &[Course]| {
        let mut mean = Mean::default();
        of_groups(courses)
            .iter()
            .for_each(|accuracy| mean.take(accuracy.mean_absolute_error()));
        mean.value()
    };
    let coverage = |courses: &[Course]| least(of_groups(courses).iter().map(Accuracy::coverage));
    let difference = {
        let mut accuracy = Accuracy::default();
        for (with, without) in fused.courses[..GROUPS]
            .iter()
            .zip(&first_damage.courses[..GROUPS])
        {
            let both = with
                .points
                .iter()
                .zip(&without.points)
                .filter(|(point, _)| point[0] > COUNTED_FROM_S);
            both.for_each(|(with, without)| accuracy.take(with[1], with[2], without[1]));
        }
        accuracy.rms_error()
    };
    figures.extend([
        Figure::new(
            "synchronous, one filter: mean error of \
                     stiffness",
            error(&in_one),
            Required::Reported,
        ),
        Figure::new(
            "synchronous, one filter: least share of a stiffness within 3 deviations",
            coverage(&in_one),
            Required::Reported,
        ),
        Figure::new(
            "asynchronous, one filter: mean error of \
                     stiffness",
            error(&in_one_shifted),
            Required::Reported,
        ),
        Figure::new(
            "asynchronous, one filter: least share of a stiffness within 3 deviations",
            coverage(&in_one_shifted),
            Required::Reported,
        ),
        Figure::new(
            "asynchronous, a filter a node: mean error of stiffness",
            error(&fused.courses),
            Required::AtMost(0.025),
        ),
        Figure::new(
            "asynchronous: error with a filter a node over that with one filter",
            error(&fused.courses) / error(&in_one_shifted),
            Required::AtMost(0.4),
        ),
        Figure::new(
            "asynchronous, a filter a node: least share of a stiffness within 3 deviations",
            coverage(&fused.courses),
            judged(Required::AtLeast(0.95)),
        ),
        Figure::new(
            "a filter a node, before the first damage: rms difference of asynchronous and \
             synchronous",
            difference,
            judged(Required::AtMost(0.015)),
        ),
        Figure::new(
            "nodes started anew, \
                     times",
            fused.restarts.iter().sum::<u64>() as f64,
            Required::Reported,
        ),
    ]);
    let mut plots = Vec::new();
    for (group, at_s) in DAMAGED.into_iter().zip(damages) {
        let name = structure.parameters()[group].name();
        let course = &fused.courses[group];
        let after = run.pick((25.0, 50.0), (14.0, 19.0));
        figures.extend([
            Figure::new(
                format!(
                    "{name}, a filter a node: {} to {} s after its damage",
                    after.0, after.1
                ),
                course.mean(at_s + after.0, at_s + after.1),
                judged(Required::Within { of: 0.95, by: 0.02 }),
            ),
            Figure::new(
                format!("{name}, a filter a node: half of the drop is seen after (s)"),
                course.delay(at_s, 1.0, 0.95, 0.5),
                judged(Required::AtMost(20.0)),
            ),
        ]);
        for (what, course) in [
            ("one filter, clocks agree", &in_one[group]),
            ("one filter, clocks disagree", &in_one_shifted[group]),
            (
                "last node, clocks disagree",
                &fused.local[SHIFTS_MS.len() - 1][group],
            ),
            ("fused, clocks disagree", course),
        ] {
            plots.push(course.plot(&format!("{name}, {what}"), "ratio to nominal", (0.8, 1.2)));
        }
    }
    Ok(Outcome {
        figures,
        tables: Vec::new(),
        plots,
    })
}
