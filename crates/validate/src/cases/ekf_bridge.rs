//! Chapter 2, §2.4.2: a three-pier bridge with seven groups of members. Two groups lose 5 %, one
//! after the other.
//!
//! Not printed and therefore fixed here: the size of the damage (from chapter 3), the start values
//! (30 % too high and too low in turn) and the start-up aid.

use crate::error::ValidateError;
use crate::figure::{Figure, Required};
use crate::outcome::{Outcome, Plot};
use crate::run::Run;
use crate::scene::{self, Course, Plan, Scene};
use crate::statistics::Accuracy;
use spandrel_filter::FilterSettings;

const FILE: &str = include_str!("../../../../docs/examples/three-pier-bridge.toml");
const GROUPS: usize = 7;
/// Indices of the two damaged groups.
const DAMAGED: [usize; 2] = [1, 5];
/// Watched responses: rotation of node 4, horizontal motion of node 8 and vertical motion of node
/// 11.
const RESPONSES: [&str; 3] = ["node-4-r", "node-8-x", "node-11-y"];

/// The settings of the file from a start 30 % off.
fn settings(scene: &Scene) -> Result<FilterSettings, ValidateError> {
    let mut settings = scene.settings()?;
    let first = settings.prior_mean.len() - GROUPS - 2;
    for group in 0..GROUPS {
        settings.prior_mean[first + group] = if group % 2 == 0 { 1.3 } else { 0.7 };
    }
    (
        settings.prior_mean[first + GROUPS],
        settings.prior_mean[first + GROUPS + 1],
    ) = (1.5, 0.5);
    Ok(settings)
}

pub(super) fn run(run: &Run<'_>) -> Result<Outcome, ValidateError> {
    let (seconds, jumps) = run.pick((200.0, [100.0, 150.0]), (30.0, [14.0, 22.0]));
    let text = FILE
        .replace("at-s = 100", &format!("at-s = {}", jumps[0]))
        .replace("at-s = 150", &format!("at-s = {}", jumps[1]));
    let watched = |structure: &_| {
        let mut states = scene::states_of(structure, &RESPONSES, false);
        states.extend(scene::states_of(structure, &RESPONSES, true));
        states
    };
    let scene = Scene::simulate(
        &Plan {
            text: &text,
            seconds,
            noise_share: 0.05,
            watched: &watched,
        },
        run,
    )?;
    let settings = settings(&scene)?;
    let first = settings.prior_mean.len() - GROUPS - 2;
    let mut courses = vec![Course::default(); GROUPS + 2];
    let mut responses = vec![[Accuracy::default(); 2]; 2 * RESPONSES.len()];
    let mut limited = 0;
    // True and estimated values of each watched state.
    let mut clouds: Vec<Vec<(f32, f32)>> = vec![Vec::new(); 2 * RESPONSES.len()];
    scene.filter(
        settings,
        |frame| scene.data(frame),
        (0.0, 1.0),
        run,
        |frame, filter, step| {
            let time_s = scene.time_s(frame);
            let truth = scene.structure.true_parameters(frame as u64);
            for (j, course) in courses.iter_mut().enumerate() {
                course.take(
                    time_s,
                    filter.mean()[first + j],
                    filter.covariance()[(first + j, first + j)],
                    truth[j],
                );
            }
            for ((accuracy, state), truth) in responses
                .iter_mut()
                .zip(scene.watched())
                .zip(scene.states(frame))
            {
                let std = filter.covariance()[(*state, *state)].max(0.0).sqrt();
                accuracy[usize::from(time_s >= 5.0)].take(filter.mean()[*state], std, *truth);
            }
            if time_s >= 5.0 && frame % 10 == 0 {
                for ((points, state), truth) in clouds
                    .iter_mut()
                    .zip(scene.watched())
                    .zip(scene.states(frame))
                {
                    points.push((*truth as f32, filter.mean()[*state] as f32));
                }
            }
            limited += step.limited_states;
        },
    )?;

    let names: Vec<&str> = scene
        .structure
        .parameters()
        .iter()
        .map(|parameter| parameter.name())
        .collect();
    let windows = run.pick(
        [[60.0, 100.0], [130.0, 150.0], [180.0, 200.0]],
        [[10.0, 14.0], [20.0, 22.0], [28.0, 30.0]],
    );
    let mut figures = vec![Figure::new(
        "steps at which a state was clipped",
        limited as f64,
        Required::AtMost(0.0),
    )];
    let modes = scene.structure.check(0.1, run.seed).modes;
    for (mode, (report, of)) in modes
        .iter()
        .zip([0.466, 0.531, 0.699, 0.890, 1.332])
        .enumerate()
    {
        let required = Required::Within { of, by: 0.001 };
        figures.push(
            Figure::new(format!("f{} (Hz)", mode + 1), report.frequency_hz, required).published(of),
        );
    }
    for (mode, report) in modes.iter().take(2).enumerate() {
        let name = format!("damping ratio of mode {}", mode + 1);
        let required = Required::Within {
            of: 0.0195,
            by: 5e-5,
        };
        figures.push(Figure::new(name, report.damping_ratio, required).published(0.02));
    }
    // A half-life of 8 s leaves a tenth of the gap open, which a shortened record is too short to
    // close.
    let settled = run.pick(0.004, 0.025);
    for (k, [from, to]) in windows.into_iter().enumerate() {
        let of_window = format!("{from} to {to} s");
        for group in 0..GROUPS {
            let truth = scene
                .structure
                .true_parameters((from / scene.step_s) as u64)[group];
            figures.push(Figure::new(
                format!("{}: mean over {of_window}", names[group]),
                courses[group].mean(from, to),
                Required::Within {
                    of: truth,
                    by: settled,
                },
            ));
        }
        if k == 0 {
            let ratio = |j: usize| courses[GROUPS + j].mean(from, to);
            figures.extend([
                Figure::new(
                    format!("alpha (1/s): mean over {of_window}"),
                    0.063 * ratio(0),
                    run.pick(
                        Required::Within {
                            of: 0.0647,
                            by: 0.010,
                        },
                        Required::Reported,
                    ),
                )
                .published(0.063),
                Figure::new(
                    format!("beta (s): mean over {of_window}"),
                    0.006 * ratio(1),
                    Required::Within {
                        of: 0.00600,
                        by: run.pick(1e-4, 3e-4),
                    },
                )
                .published(0.006),
            ]);
        }
    }
    let [from, to] = windows[0];
    let stds: Vec<f64> = courses[..GROUPS]
        .iter()
        .map(|course| course.std(from, to))
        .collect();
    let (least, most) = stds
        .iter()
        .fold((f64::INFINITY, 0.0_f64), |(low, high), std| {
            (low.min(*std), high.max(*std))
        });
    let full = |required: Required| run.pick(required, Required::Reported);
    figures.extend([
        Figure::new(
            "least deviation of a stiffness",
            least,
            full(Required::relative(0.0013, 0.3)),
        ),
        Figure::new(
            "largest deviation of a stiffness",
            most,
            full(Required::relative(0.0019, 0.3)),
        ),
        Figure::new(
            "deviation of alpha over its value",
            courses[GROUPS].std(from, to),
            full(Required::relative(0.07, 0.3)),
        ),
        Figure::new(
            "deviation of beta over its value",
            courses[GROUPS + 1].std(from, to),
            full(Required::relative(0.0035, 0.3)),
        ),
    ]);
    for (group, jump) in DAMAGED.into_iter().zip(jumps) {
        figures.extend([
            Figure::new(
                format!("{}: half of the drop seen after (s)", names[group]),
                courses[group].delay(jump, 1.0, 0.95, 0.5),
                Required::Between {
                    low: 2.5,
                    high: 7.0,
                },
            ),
            Figure::new(
                format!("{}: 90 % of the drop seen after (s)", names[group]),
                courses[group].delay(jump, 1.0, 0.95, 0.9),
                full(Required::Between {
                    low: 9.0,
                    high: 18.0,
                }),
            ),
        ]);
    }
    for (j, name) in names.iter().enumerate() {
        let coverage = courses[j].accuracy(run.pick(20.0, 8.0)).coverage();
        let required = if DAMAGED.contains(&j) {
            Required::Reported
        } else {
            full(Required::AtLeast(0.97))
        };
        figures.push(Figure::new(
            format!("{name}: share inside 3 sd after the start"),
            coverage,
            required,
        ));
    }
    for (j, name) in RESPONSES.iter().enumerate() {
        for (what, accuracy, most) in [
            ("displacement", &responses[j], 0.025),
            ("velocity", &responses[RESPONSES.len() + j], 0.045),
        ] {
            figures.push(Figure::new(
                format!("{name}: relative error of the {what} in the first 5 s"),
                accuracy[0].relative_error(),
                Required::Reported,
            ));
            figures.push(Figure::new(
                format!("{name}: relative error of the {what} afterwards"),
                accuracy[1].relative_error(),
                full(Required::AtMost(most)),
            ));
            figures.push(Figure::new(
                format!("{name}: correlation of the {what} with the truth afterwards"),
                accuracy[1].correlation(),
                full(Required::AtLeast(0.998)),
            ));
        }
    }
    let mut plots: Vec<Plot> = courses
        .iter()
        .zip(&names)
        .map(|(course, name)| course.plot(name, "ratio to nominal", (0.85, 1.15)))
        .collect();
    for (j, points) in clouds.into_iter().enumerate() {
        let what = if j < RESPONSES.len() {
            "displacement"
        } else {
            "velocity"
        };
        let name = RESPONSES[j % RESPONSES.len()];
        let unit = match (name.ends_with('r'), j < RESPONSES.len()) {
            (true, true) => "rad",
            (true, false) => "rad/s",
            (false, true) => "m",
            (false, false) => "m/s",
        };
        plots.push(Plot::against_truth(
            format!("{name}: {what} from 5 s on"),
            unit,
            points,
        ));
    }
    Ok(Outcome {
        figures,
        tables: Vec::new(),
        plots,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run::Length;
    use spandrel_filter::ExtendedKalmanFilter;
    use std::sync::atomic::AtomicBool;

    /// Largest error of a factor and largest deviation of one, after twelve seconds.
    fn start(wide_prior: bool) -> [f64; 2] {
        let run = Run {
            seed: 21,
            length: Length::Quick,
            records: None,
            advanced: &|_| {},
            stopped: &AtomicBool::new(false),
        };
        let plan = Plan {
            text: FILE,
            seconds: 12.0,
            noise_share: 0.05,
            watched: &|_| Vec::new(),
        };
        let scene = Scene::simulate(&plan, &run).unwrap();
        let mut settings = settings(&scene).unwrap();
        let first = settings.prior_mean.len() - GROUPS - 2;
        if wide_prior {
            settings.prior_std.rows_mut(0, first).fill(1.0);
            settings.annealing = None;
        }
        let mut worst = [0.0; 2];
        let data = |frame| scene.data(frame);
        let look = |_, filter: &ExtendedKalmanFilter<_>, _: &_| {
            let covariance = filter.covariance().diagonal();
            worst = [
                filter.mean().rows(first, GROUPS).add_scalar(-1.0).amax(),
                covariance.rows(first, GROUPS).map(f64::sqrt).max(),
            ];
        };
        scene
            .filter(settings, data, (0.0, 1.0), &run, look)
            .unwrap();
        worst
    }

    #[test]
    fn bridge_converges_to_wrong_factors_with_a_wide_prior_of_the_motion() {
        // Chapter 2, §5 check 12 and §3.6. With a wide prior, the filter is locked at 12 s, with
        // deviations of 0.001 to 0.003. With a start at rest and annealing, all factors are within
        // 0.4 %.
        let (locked, guarded) = (start(true), start(false));
        println!("wide prior: {locked:.4?}; at rest, annealed: {guarded:.4?}");
        assert!(locked[0] > 0.1, "the wide prior did not lock: {locked:?}");
        assert!(locked[1] < 0.01, "and is not sure of it: {locked:?}");
        assert!(guarded[0] < 0.008, "the guarded start is off: {guarded:?}");
    }
}
