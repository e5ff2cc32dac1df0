//! Chapter 2, §2.4.3: a chain of ten masses with yielding springs. Two springs are damaged.
//!
//! Not printed and therefore fixed here: masses of 1000 kg, which alone give the printed damping,
//! start values 20 % too high and too low in turn, and the start-up aid. With the printed intensity
//! of the ground motion the springs hardly yield, and their constants cannot be identified. The
//! case therefore uses a thousand times that intensity, as chapter 3 does for the same device. It
//! also reports the printed intensity.

use crate::error::ValidateError;
use crate::figure::{Figure, Required};
use crate::outcome::{Outcome, Plot};
use crate::run::Run;
use crate::scene::Course;
use crate::statistics::{Accuracy, Normal, rms};
use crate::systems::bouc_wen::{BoucWenChain, BoucWenModel, SHAPE_PARAMETERS};
use crate::systems::hysteretic::{Events, Motion, spring_force};
use nalgebra::{DMatrix, DVector};
use spandrel_filter::{
    Annealing, ExtendedKalmanFilter, FadingFactor, FilterSettings, Frame, NoiseModel,
};
use std::f64::consts::PI;

const MASSES: usize = 10;
const GROUPS: usize = 6;
const STEP_S: f64 = 0.002;
const SENSED: [usize; 5] = [0, 2, 4, 7, 9];
const NAMES: [&str; GROUPS + SHAPE_PARAMETERS] = [
    "θ1", "θ2", "θ3", "θ4", "θ5", "θ6", "alpha", "beta", "mu", "kappa", "eta",
];
/// Reason why the yielding constants are missed with the printed intensity.
const HARDLY_YIELDS: &str =
    "the springs hardly yield, and some records lock these constants at a tenth of their values";
/// Springs whose forces are compared (from 0).
const SPRINGS: [usize; 4] = [0, 1, 4, 9];

fn chain() -> BoucWenChain {
    BoucWenChain {
        masses_kg: vec![1000.0; MASSES],
        stiffnesses_n_per_m: vec![2.0e6; MASSES],
        groups: vec![
            vec![0],
            vec![1],
            vec![2],
            vec![3],
            vec![4],
            vec![5, 6, 7, 8, 9],
        ],
        alpha_per_s: 0.100,
        beta_s: 7.526e-4,
        mu: 1000.0,
        kappa: 1500.0,
        eta: 2.0,
        sensed: SENSED.to_vec(),
    }
}

struct Tracked {
    courses: Vec<Course>,
    forces: [[Accuracy; 2]; SPRINGS.len()],
    limited: usize,
}

/// Simulates and identifies a record with damage at two times.
fn track(
    intensity: f64,
    seconds: f64,
    jumps: [f64; 2],
    shares: (f64, f64),
    run: &Run<'_>,
) -> Result<Tracked, ValidateError> {
    let variance = 2.0 * PI * intensity / STEP_S;
    let stiffness = |time_s: f64| {
        let mut theta = vec![1.0; GROUPS];
        theta[0] -= if time_s >= jumps[0] { 0.10 } else { 0.0 };
        theta[1] -= if time_s >= jumps[1] { 0.05 } else { 0.0 };
        theta
    };
    let events = Events {
        step_s: STEP_S,
        seconds,
        substeps: 1,
        ground_std: &|_| variance.sqrt(),
        stiffness: &stiffness,
    };
    let motion = Motion::simulate(&chain(), &events, run)?;
    let noise_std = SENSED.map(|dof| 0.05 * rms(motion.states.iter().map(|state| state[dof])));
    let sensors = DMatrix::from_diagonal(&DVector::from_row_slice(&noise_std.map(|std| std * std)));
    let n = 2 * MASSES + GROUPS + SHAPE_PARAMETERS;
    let first = 2 * MASSES;
    let (mut mean, mut std) = (DVector::zeros(n), DVector::repeat(n, 1e-5));
    std.rows_mut(0, MASSES).fill(1e-4);
    for (j, sign) in [1, -1, 1, -1, 1, -1, 1, -1, -1, 1, -1]
        .into_iter()
        .enumerate()
    {
        mean[first + j] = 1.0 + 0.2 * f64::from(sign);
        std[first + j] = 0.2;
    }
    let noise = NoiseModel::known(DMatrix::from_element(1, 1, variance), sensors);
    let mut settings = FilterSettings::new(STEP_S, mean, std, noise);
    settings.fading = FadingFactor::from_half_life(2000.0).map_err(ValidateError::setting)?;
    settings.annealing = Some(Annealing {
        amount: 100.0,
        time_constant_s: 2.0,
    });
    let bounds = |j: usize| match j {
        8 | 9 => (0.02, 10.0),
        10 => (0.5, 3.0),
        _ => (0.05, 5.0),
    };
    for j in 0..GROUPS + SHAPE_PARAMETERS {
        (settings.lower[first + j], settings.upper[first + j]) = bounds(j);
    }
    let model = BoucWenModel::new(chain()).ok_or(ValidateError::Example { what: "chain" })?;
    let mut filter = ExtendedKalmanFilter::new(model, settings).map_err(ValidateError::setting)?;
    let mut sensor_noise = Normal::stream(run.seed, 1);
    let mut tracked = Tracked {
        courses: vec![Course::default(); GROUPS + SHAPE_PARAMETERS],
        forces: Default::default(),
        limited: 0,
    };
    for (i, state) in motion.states.iter().enumerate() {
        let time_s = motion.time_s(i);
        let datum: Vec<f64> = SENSED
            .iter()
            .zip(noise_std)
            .map(|(dof, std)| state[*dof] + std * sensor_noise.draw())
            .collect();
        let step = filter
            .step(Frame {
                observations: &datum,
                excitation: &[0.0],
            })
            .map_err(ValidateError::at(time_s))?;
        tracked.limited += step.limited_states;
        let truth = stiffness(time_s - STEP_S);
        if i % 10 == 0 {
            for (j, course) in tracked.courses.iter_mut().enumerate() {
                let truth = truth.get(j).copied().unwrap_or(1.0);
                course.take(
                    time_s,
                    filter.mean()[first + j],
                    filter.covariance()[(first + j, first + j)],
                    truth,
                );
            }
        }
        for (accuracy, spring) in tracked.forces.iter_mut().zip(SPRINGS) {
            let group = spring.min(GROUPS - 1);
            let estimated = &filter.mean().as_slice()[MASSES..2 * MASSES];
            let (estimate, true_force) = (
                spring_force(filter.mean()[first + group], estimated, spring),
                spring_force(truth[group], &state[MASSES..], spring),
            );
            accuracy[usize::from(time_s > 10.0)].take(estimate, 1.0, true_force);
        }
        if i % 2000 == 0 {
            let done = i as f64 / motion.states.len() as f64;
            if !run.advance(shares.0 + (shares.1 - shares.0) * done) {
                return Err(ValidateError::Stopped);
            }
        }
    }
    Ok(tracked)
}

pub(super) fn run(run: &Run<'_>) -> Result<Outcome, ValidateError> {
    let (seconds, jumps) = run.pick((300.0, [100.0, 200.0]), (60.0, [28.0, 44.0]));
    let tracked = track(5.0e-3, seconds, jumps, (0.0, run.pick(0.8, 1.0)), run)?;
    let Tracked {
        courses,
        forces,
        limited,
    } = &tracked;
    let windows = run.pick(
        [[60.0, 100.0], [160.0, 200.0], [260.0, 300.0]],
        [[20.0, 28.0], [38.0, 44.0], [54.0, 60.0]],
    );
    // A shortened record leaves 10 s after each drop. The filter needs 5 to 6 s of them.
    let within = run.pick(0.005, 0.015);
    let mut figures = vec![Figure::new(
        "steps at which a state was clipped",
        *limited as f64,
        Required::AtMost(0.0),
    )];
    let [from, to] = windows[0];
    for (j, name) in NAMES.into_iter().enumerate() {
        let by = match j {
            6 => 0.3,
            7 => 0.03,
            8 | 9 => run.pick(0.08, 0.2),
            10 => run.pick(0.015, 0.03),
            _ => within,
        };
        figures.push(Figure::new(
            format!("{name}: mean over {from} to {to} s, over the truth"),
            courses[j].mean(from, to),
            Required::Within { of: 1.0, by },
        ));
    }
    let expected = [(1, 0, 0.900), (2, 0, 0.900), (2, 1, 0.949)];
    for (window, group, of) in expected {
        let [from, to] = windows[window];
        figures.push(Figure::new(
            format!("{}: mean over {from} to {to} s", NAMES[group]),
            courses[group].mean(from, to),
            Required::Within { of, by: within },
        ));
    }
    let full = |required: Required| run.pick(required, Required::Reported);
    let stds: Vec<f64> = courses[..GROUPS]
        .iter()
        .map(|course| course.std(from, to))
        .collect();
    let (least, most) = stds
        .iter()
        .fold((f64::INFINITY, 0.0_f64), |(low, high), std| {
            (low.min(*std), high.max(*std))
        });
    figures.extend([
        Figure::new(
            "least deviation of a stiffness",
            least,
            full(Required::AtLeast(0.0007)),
        ),
        Figure::new(
            "largest deviation of a stiffness",
            most,
            full(Required::AtMost(0.0039)),
        ),
    ]);
    for (j, of) in [(6, 0.11), (7, 0.007), (8, 0.03), (9, 0.03), (10, 0.004)] {
        let required = full(Required::relative(of, 0.3));
        figures.push(Figure::new(
            format!("{}: deviation over its value", NAMES[j]),
            courses[j].std(from, to),
            required,
        ));
    }
    for (j, name) in NAMES.into_iter().enumerate() {
        let coverage = courses[j].accuracy(20.0).coverage();
        // The 5 s after each drop weigh five times as much in the shortened record.
        let least = if j < 2 { run.pick(0.95, 0.75) } else { 0.95 };
        figures.push(Figure::new(
            format!("{name}: share inside 3 sd after 20 s"),
            coverage,
            Required::AtLeast(least),
        ));
    }
    for (group, to) in [(0, 0.90), (1, 0.95)] {
        for (share, what, most) in [(0.5, "half", 4.0), (0.9, "90 %", 9.0)] {
            figures.push(Figure::new(
                format!("{}: {what} of the drop seen after (s)", NAMES[group]),
                courses[group].delay(jumps[group], 1.0, to, share),
                Required::AtMost(most),
            ));
        }
    }
    for (accuracy, spring) in forces.iter().zip(SPRINGS) {
        figures.push(Figure::new(
            format!(
                "spring {}: relative error of its force in the first 10 s",
                spring + 1
            ),
            accuracy[0].relative_error(),
            Required::Reported,
        ));
        figures.push(Figure::new(
            format!(
                "spring {}: relative error of its force afterwards",
                spring + 1
            ),
            accuracy[1].relative_error(),
            Required::AtMost(0.02),
        ));
    }
    let mut plots: Vec<Plot> = courses
        .iter()
        .zip(NAMES)
        .enumerate()
        .map(|(j, (course, name))| {
            let range = if j < GROUPS { (0.8, 1.1) } else { (0.5, 1.5) };
            course.plot(name, "ratio to nominal", range)
        })
        .collect();
    if run.pick(true, false) {
        let printed = track(5.0e-6, 70.0, [30.0, 50.0], (0.8, 1.0), run)?;
        for (j, name) in NAMES.into_iter().enumerate() {
            let course = &printed.courses[j];
            // The stiffnesses are as good as with the larger intensity, with deviations of 0.002 to
            // 0.006 ± 30 %. The filter learns little about the yielding constants.
            let deviation = Required::Between {
                low: 0.7 * 0.002,
                high: 1.3 * 0.006,
            };
            let constant = Required::Between {
                low: 0.88,
                high: 1.39,
            };
            let (required, of_std) = match j {
                0 => (
                    Required::Within {
                        of: 0.901,
                        by: within,
                    },
                    deviation,
                ),
                1 => (
                    Required::Within {
                        of: 0.954,
                        by: within,
                    },
                    deviation,
                ),
                _ if j < GROUPS => (
                    Required::Within {
                        of: 1.0,
                        by: within,
                    },
                    deviation,
                ),
                6 => (Required::Within { of: 1.0, by: 0.3 }, Required::Reported),
                7 => (Required::Within { of: 1.0, by: 0.03 }, Required::Reported),
                8 => (
                    constant,
                    Required::Between {
                        low: 0.45,
                        high: 0.93,
                    },
                ),
                9 => (
                    constant,
                    Required::Between {
                        low: 0.35,
                        high: 0.75,
                    },
                ),
                _ => (
                    constant,
                    Required::Between {
                        low: 0.04,
                        high: 0.07,
                    },
                ),
            };
            let mean = Figure::new(
                format!("printed intensity, {name}: mean over 60 to 70 s"),
                course.mean(60.0, 70.0),
                required,
            );
            let deviation = Figure::new(
                format!("printed intensity, {name}: its deviation"),
                course.std(60.0, 70.0),
                of_std,
            );
            let inside = Figure::new(
                format!("printed intensity, {name}: share inside 3 sd after 20 s"),
                course.accuracy(20.0).coverage(),
                if j > 7 {
                    Required::AtLeast(0.91)
                } else {
                    Required::Reported
                },
            );
            let known = |figure: Figure| {
                if j > 7 {
                    figure.known_miss(HARDLY_YIELDS)
                } else {
                    figure
                }
            };
            figures.extend([mean, deviation, inside].map(known));
        }
        plots.push(printed.courses[8].plot(
            "mu with the printed intensity",
            "ratio to nominal",
            (0.0, 3.0),
        ));
    }
    Ok(Outcome {
        figures,
        tables: Vec::new(),
        plots,
    })
}
