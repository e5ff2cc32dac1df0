//! Chapter 6, §6.4: a forty-storey building and a bridge whose sensor nodes identify their own
//! parameters.
//!
//! The requirements are the values that the reference runs of the specification reach at a reduced
//! rate, applied to the same rule at the published rate. The cases compare this rule with a
//! centralised filter on the same record, with the published rule, and with nodes that exchange ten
//! samples a second.

use crate::error::ValidateError;
use crate::figure::{Figure, Required};
use crate::network::{Fused, settled};
use crate::outcome::{Outcome, Table};
use crate::run::Run;
use crate::scene::{self, Course, Plan, Scene};
use crate::statistics::{Accuracy, Mean, larger, least};
use spandrel_structure::Structure;

const BUILDING: &str = include_str!("../../../../docs/examples/forty-storey-building.toml");
const BRIDGE: &str = include_str!("../../../../docs/examples/two-pier-bridge.toml");

/// Start of the window in which errors count (s): the specification allows ten seconds for the
/// start.
const COUNTED_FROM_S: f64 = 10.0;
/// Time after a damage in which intervals need not hold (s).
const AFTER_DAMAGE_S: f64 = 20.0;

/// Length of the record for the published rule (s), whatever the length of the others. Its
/// estimates are frozen by the time of the damage.
const PUBLISHED_S: f64 = 30.0;
const PUBLISHED_DAMAGES: [f64; 2] = [20.0, 25.0];

/// An example with its requirements.
struct Example {
    text: &'static str,
    /// Number of stiffness parameters, and the two damaged ones with their losses.
    groups: usize,
    damaged: [(usize, f64); 2],
    /// Sampling rate (Hz), length (s) and damage times (s), full and shortened.
    full: (f64, f64, [f64; 2]),
    quick: (f64, f64, [f64; 2]),
    /// Largest allowed mean and largest allowed single rms error.
    errors: (f64, f64),
    /// Largest allowed error of the damaged parameters at the end.
    end: f64,
    /// Samples of each channel that nodes exchange per second, full and shortened.
    told: (usize, usize),
    /// Frequencies (Hz) as printed, and their tolerance.
    frequencies: (&'static [f64], f64),
    /// Number of values in a message and its share of the raw samples, as published, with this
    /// number of modes.
    traffic: (usize, usize, f64),
    /// Largest allowed ratio of the fused error to the centralised error, and the largest
    /// centralised error if the specification gives one.
    ratio: f64,
    central: Option<f64>,
    /// Degrees of freedom whose fused motion is compared, and the smallest allowed correlations of
    /// displacements and velocities.
    watched: &'static [&'static str],
    correlations: (f64, f64),
}

const OF_BUILDING: Example = Example {
    text: BUILDING,
    groups: 8,
    damaged: [(0, 0.92), (1, 0.94)],
    full: (250.0, 300.0, [100.0, 200.0]),
    quick: (50.0, 30.0, [12.0, 20.0]),
    errors: (0.02, 0.06),
    end: 0.03,
    told: (50, 10),
    frequencies: (&[0.2530, 0.7586, 1.2631, 1.7656, 2.2656], 1e-4),
    traffic: (5, 85, 0.170),
    ratio: 1.5,
    central: Some(0.015),
    watched: &["floor-10", "floor-20", "floor-30", "floor-40"],
    correlations: (0.99, 0.98),
};

const OF_BRIDGE: Example = Example {
    text: BRIDGE,
    groups: 6,
    damaged: [(0, 0.95), (5, 0.95)],
    full: (500.0, 300.0, [100.0, 200.0]),
    quick: (100.0, 16.0, [11.0, 13.0]),
    errors: (0.02, 0.02),
    end: 0.015,
    told: (10, 10),
    frequencies: (&[0.315, 0.790, 0.968, 1.087, 1.110], 1e-3),
    traffic: (6, 68, 0.068),
    ratio: 1.5,
    central: None,
    watched: &["node-6-r", "node-12-y", "node-15-x"],
    correlations: (0.95, 0.9),
};

pub(super) fn building(run: &Run<'_>) -> Result<Outcome, ValidateError> {
    example(run, &OF_BUILDING)
}

pub(super) fn bridge(run: &Run<'_>) -> Result<Outcome, ValidateError> {
    example(run, &OF_BRIDGE)
}

/// Returns the file with another rate, other damage times and another `[fusion]`.
fn variant(text: &str, rate_hz: f64, damages: [f64; 2], fusion: &str) -> String {
    let rate = text
        .lines()
        .find(|line| line.starts_with("sampling-rate-hz"))
        .unwrap_or_default();
    let (start, end) = (
        text.find("[fusion]").unwrap_or(0),
        text.find("[simulation]").unwrap_or(0),
    );
    let mut text = format!(
        "{}[fusion]\nrate-hz = 1\ndetector = \"none\"\n{fusion}\n\n{}",
        &text[..start],
        &text[end..]
    );
    text = text.replacen(rate, &format!("sampling-rate-hz = {rate_hz}"), 1);
    text.replacen("at-s = 100", &format!("at-s = {}", damages[0]), 1)
        .replacen("at-s = 200", &format!("at-s = {}", damages[1]), 1)
}

fn example(run: &Run<'_>, example: &Example) -> Result<Outcome, ValidateError> {
    let (rate_hz, seconds, damages) = run.pick(example.full, example.quick);
    let modes = format!("motion = \"modes\"\nmodes = {}", example.traffic.0);
    let [marginal, samples, published] = [
        modes.clone(),
        format!(
            "motion = \"samples\"\nsamples-per-period = {}",
            run.pick(example.told.0, example.told.1)
        ),
        format!("{modes}\nrule = \"published\"\nfeedback = \"reset\""),
    ];
    let [marginal, samples] =
        [marginal, samples].map(|fusion| variant(example.text, rate_hz, damages, &fusion));
    let published = variant(example.text, rate_hz, PUBLISHED_DAMAGES, &published);
    let watched = |structure: &Structure| {
        let mut states = scene::states_of(structure, example.watched, false);
        states.extend(scene::states_of(structure, example.watched, true));
        states
    };
    let simulate = |text: &str, seconds: f64| {
        Scene::simulate(
            &Plan {
                text,
                seconds,
                noise_share: 0.05,
                watched: &watched,
            },
            run,
        )
    };
    let scene = simulate(&marginal, seconds)?;
    let fuse = |scene: &Scene, shares| {
        let data = |frame: usize, channel: usize| scene.data(frame)[channel];
        scene.network(&data).fuse(shares, run, |_, _, _| {})
    };
    let by_marginal = fuse(&scene, (0.0, 0.4))?;
    let scene_of_samples = simulate(&samples, seconds)?;
    let with_samples = fuse(&scene_of_samples, (0.4, 0.8))?;
    let scene_of_published = simulate(&published, PUBLISHED_S)?;
    let as_published = fuse(&scene_of_published, (0.8, 0.85))?;
    let data = |frame: usize, channel: usize| scene.data(frame)[channel];
    let central = scene.network(&data).in_one_filter((0.85, 1.0), run)?;

    let mut figures = Vec::new();
    let modes_of = scene.structure.natural_frequencies_hz();
    for (number, frequency) in example.frequencies.0.iter().enumerate() {
        let found = modes_of.get(number).copied().unwrap_or(f64::NAN);
        let required = Required::Within {
            of: *frequency,
            by: example.frequencies.1,
        };
        figures.push(
            Figure::new(format!("frequency {} (Hz)", number + 1), found, required)
                .published(*frequency),
        );
    }
    let sent = scene
        .structure
        .numbers_per_period(0)
        .unwrap_or_default()
        .sent;
    let channels = scene.structure.nodes()[0].channels().len() as f64;
    let published_rate = example.full.0;
    figures.extend([
        Figure::new(
            "numbers in a message, published modes",
            sent as f64,
            Required::Within {
                of: example.traffic.1 as f64,
                by: 0.0,
            },
        )
        .published(example.traffic.1 as f64),
        Figure::new(
            "message over the raw samples that it replaces",
            sent as f64 / (channels * published_rate),
            Required::Within {
                of: example.traffic.2,
                by: 5e-4,
            },
        )
        .published(example.traffic.2),
    ]);
    let judged = |required: Required| run.pick(required, Required::Reported);
    let mut error_of = Vec::new();
    for (name, fused) in [
        ("densities", &by_marginal.courses),
        ("densities and samples", &with_samples.courses),
    ] {
        let errors: Vec<f64> = fused[..example.groups]
            .iter()
            .map(|course| course.accuracy(COUNTED_FROM_S).rms_error())
            .collect();
        let mean = errors.iter().sum::<f64>() / errors.len() as f64;
        error_of.push(mean);
        let worst = errors.iter().copied().fold(0.0, larger);
        figures.push(Figure::new(
            format!("{name}: rms error of stiffness, mean"),
            mean,
            judged(Required::AtMost(example.errors.0)),
        ));
        figures.push(Figure::new(
            format!("{name}: rms error of stiffness, worst"),
            worst,
            judged(Required::AtMost(example.errors.1)),
        ));
        figures.push(Figure::new(
            format!(
                "{name}: least share of a stiffness within 3 deviations, outside of 20 s \
                     after a damage"
            ),
            coverage(&fused[..example.groups], &damages),
            judged(Required::AtLeast(0.95)),
        ));
        figures.push(
            Figure::new(
                format!("{name}: share of the fusions with all stiffnesses within 3 deviations"),
                all_covered(&fused[..example.groups]),
                judged(Required::AtLeast(0.95)),
            )
            .known_miss("an interval does not hold the truth while the estimate follows a damage"),
        );
        for ((group, truth), at_s) in example.damaged.iter().zip(damages) {
            let name_of = scene.structure.parameters()[*group].name();
            let end = fused[*group]
                .points
                .last()
                .map_or(f64::NAN, |point| point[1]);
            figures.push(Figure::new(
                format!("{name}: {name_of} at the end"),
                end,
                judged(Required::Within {
                    of: *truth,
                    by: example.end,
                }),
            ));
            let before = fused[*group].mean(at_s - 10.0, at_s);
            let after = fused[*group].mean(at_s + 9.0, at_s + 12.0);
            figures.push(Figure::new(
                format!("{name}: share of the drop of {name_of} seen 10 s after it"),
                (before - after) / (1.0 - truth),
                judged(Required::AtLeast(0.5)),
            ));
        }
    }
    let centrally = central[..example.groups]
        .iter()
        .map(|course| course.accuracy(COUNTED_FROM_S).rms_error());
    let centrally = centrally.sum::<f64>() / example.groups as f64;
    figures.extend([
        Figure::new(
            "one filter with all samples: rms error of stiffness, mean",
            centrally,
            judged(example.central.map_or(Required::Reported, Required::AtMost)),
        ),
        Figure::new(
            "densities: error over that of one filter with all samples",
            error_of[0] / centrally,
            Required::Reported,
        ),
        Figure::new(
            "densities and samples: error over that of one filter with all samples",
            error_of[1] / centrally,
            judged(Required::AtMost(example.ratio)),
        ),
    ]);
    figures.extend(motion(&scene, &by_marginal, example, rate_hz));
    figures.extend(freezing(
        &as_published,
        &scene_of_published.structure,
        example,
    ));

    let mut plots = Vec::new();
    for (group, _) in example.damaged {
        let name = scene.structure.parameters()[group].name();
        let last = scene.structure.nodes().len() - 1;
        plots.push(by_marginal.local[last][group].plot(
            &format!("{name}, last node, before the station's answer"),
            "ratio to nominal",
            (0.6, 1.4),
        ));
        plots.push(by_marginal.courses[group].plot(
            &format!("{name}, fused densities"),
            "ratio to nominal",
            (0.85, 1.1),
        ));
        plots.push(with_samples.courses[group].plot(
            &format!("{name}, fused densities and samples"),
            "ratio to nominal",
            (0.85, 1.1),
        ));
        plots.push(central[group].plot(
            &format!("{name}, one filter with all samples"),
            "ratio to nominal",
            (0.85, 1.1),
        ));
    }
    let variants = [
        ("densities and modes", &scene.structure),
        ("densities and samples", &scene_of_samples.structure),
        (
            "densities and modes, published rule",
            &scene_of_published.structure,
        ),
    ];
    Ok(Outcome {
        figures,
        tables: vec![traffic_table(example, variants, rate_hz)],
        plots,
    })
}

/// Returns the smallest coverage of the parameters.
fn coverage(courses: &[Course], damages: &[f64]) -> f64 {
    least(
        courses
            .iter()
            .map(|course| settled(course, COUNTED_FROM_S, damages, AFTER_DAMAGE_S).coverage()),
    )
}

/// Returns the share of the fusions after the start in which every parameter is within three
/// deviations. Fusions right after a damage count too.
fn all_covered(courses: &[Course]) -> f64 {
    let mut share = Mean::default();
    for fusion in 0..courses.first().map_or(0, |course| course.points.len()) {
        let points = courses.iter().map(|course| course.points[fusion]);
        if courses[0].points[fusion][0] > COUNTED_FROM_S {
            let mut inside = points.map(|[_, mean, std, truth]| (mean - truth).abs() <= 3.0 * std);
            share.take(f64::from(u8::from(inside.all(|inside| inside))));
        }
    }
    share.value()
}

/// Tabulates the values that nodes send and receive, next to the samples that they replace.
fn traffic_table(example: &Example, variants: [(&str, &Structure); 3], rate_hz: f64) -> Table {
    let rows = variants.map(|(what, structure)| {
        let numbers = structure.numbers_per_period(0).unwrap_or_default();
        let raw = structure.nodes()[0].channels().len() as f64 * example.full.0;
        vec![
            what.to_owned(),
            numbers.sent.to_string(),
            numbers.received.to_string(),
            format!("{raw}"),
            format!("{:.3}", numbers.sent as f64 / raw),
            format!("{:.3}", (numbers.sent + numbers.received) as f64 / raw),
        ]
    });
    let title = match rate_hz == example.full.0 {
        true => "Numbers a second of the first node, and of its raw samples".to_owned(),
        false => format!(
            "Numbers a second of the first node, and of its raw samples at {} Hz",
            example.full.0
        ),
    };
    let columns = [
        "nodes send",
        "up",
        "down",
        "raw samples",
        "up over raw",
        "both over raw",
    ]
    .map(str::to_owned);
    Table {
        title,
        columns: columns.to_vec(),
        rows: rows.to_vec(),
    }
}

/// Compares the fused motion at the fusions with the true motion.
fn motion(scene: &Scene, fused: &Fused, example: &Example, rate_hz: f64) -> Vec<Figure> {
    let mut accuracies = vec![Accuracy::default(); 2 * example.watched.len()];
    for (fusion, motion) in fused.motion.iter().enumerate() {
        let frame = (fusion + 1) * rate_hz as usize - 1;
        let state = motion
            .as_ref()
            .and_then(|motion| scene.structure.extract_motion(motion));
        let Some(state) = state.filter(|_| scene.time_s(frame) >= COUNTED_FROM_S) else {
            continue;
        };
        for ((accuracy, number), truth) in accuracies
            .iter_mut()
            .zip(scene.watched())
            .zip(scene.states(frame))
        {
            accuracy.take(state[*number], f64::NAN, *truth);
        }
    }
    let (displacements, velocities) = accuracies.split_at(example.watched.len());
    let least = |of: &[Accuracy]| least(of.iter().map(Accuracy::correlation));
    let (of_displacements, of_velocities) = example.correlations;
    let degrees = example.watched.join(", ");
    vec![
        Figure::new(
            format!("{degrees}: least correlation of fused and true displacements at the fusions"),
            least(displacements),
            Required::AtLeast(of_displacements),
        ),
        Figure::new(
            format!("{degrees}: least correlation of fused and true velocities at the fusions"),
            least(velocities),
            Required::AtLeast(of_velocities),
        ),
    ]
}

/// Returns the figures of the published product rule, which counts the shared prior once for every
/// node. Each fusion shrinks the deviations by `√(N_s λ⁻ⁿ)`, so the rule does not detect later
/// changes.
fn freezing(published: &Fused, structure: &Structure, example: &Example) -> Vec<Figure> {
    let (damaged, truth) = example.damaged[0];
    let course = &published.courses[damaged];
    let name = structure.parameters()[damaged].name();
    let point = |second: usize| {
        course
            .points
            .get(second - 1)
            .copied()
            .unwrap_or([f64::NAN; 4])
    };
    let growth = 2_f64.powf(2.0 / 8.0); // half-life of 8 s
    let expected = (structure.nodes().len() as f64 / growth).sqrt();
    let ratio = (point(3)[2] / point(8)[2]).powf(0.2);
    let last = course.points.len();
    vec![
        Figure::new(
            "published rule: factor by which the deviation of the first stiffness shrinks in a \
             fusion",
            ratio,
            Required::Within {
                of: expected,
                by: 0.3,
            },
        ),
        Figure::new(
            "published rule: deviation of the first stiffness after 5 s",
            point(5)[2],
            Required::Reported,
        ),
        Figure::new(
            "published rule: deviation of the first stiffness after 30 s",
            point(last)[2],
            Required::AtMost(1e-15),
        ),
        Figure::new(
            format!("published rule: change of {name} from 5 s on"),
            (point(last)[1] - point(5)[1]).abs(),
            Required::Reported,
        ),
        Figure::new(
            format!("published rule: share of the drop of {name} seen 10 s after it"),
            (point(PUBLISHED_DAMAGES[0] as usize)[1] - point(last)[1]) / (1.0 - truth),
            Required::AtMost(0.01),
        ),
    ]
}
