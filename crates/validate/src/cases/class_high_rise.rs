//! Chapter 5, §5.6.1: a fifty-storey building with five predefined classes, which model more and
//! more of the lowest storeys individually.
//!
//! Not printed and therefore fixed here: a prior deviation of 0.05, a building at rest and absolute
//! accelerations. The second damage is in storey 3, which all printed results agree with. A
//! building of twenty storeys, which is cheap to run, is compared as well.

use super::classes::{Comparison, compare, published_settings, rayleigh};
use crate::error::ValidateError;
use crate::figure::{Figure, Required};
use crate::outcome::{Outcome, Plot};
use crate::run::Run;
use crate::scene::{Plan, Scene, states_of};
use crate::statistics::larger;
use spandrel_filter::{ClassId, ClassPlan, ClassSettings};
use std::f64::consts::PI;

const FILE: &str = include_str!("../../../../docs/examples/high-rise.toml");
const PRIOR_STD: f64 = 0.05;
const WATCHED_FLOORS: [&str; 3] = ["floor-1", "floor-10", "floor-20"];

/// Reason why the class named by the source does not always lead after the second damage.
const NESTED: &str =
    "the jump of the acceleration at the damage may favour C(5), which contains C(4)";

/// A building and its damage times.
struct Building {
    storeys: usize,
    text: String,
    seconds: f64,
    damage_s: [f64; 2],
}

fn fifty() -> Building {
    Building {
        storeys: 50,
        text: FILE.to_owned(),
        seconds: 200.0,
        damage_s: [80.0, 150.0],
    }
}

/// Returns the building with twenty storeys. The last group has storeys 11 to 20, and two modes
/// have a damping ratio of 1 %.
fn twenty() -> Building {
    let omega = |mode: f64| 80.0 * ((2.0 * mode - 1.0) * PI / 82.0).sin();
    let [alpha, beta] = rayleigh([omega(1.0), omega(2.0)], 0.01);
    let mut text = FILE
        .replace("storeys = 50\n", "storeys = 20\n")
        .replace("storeys = [11, 50]", "storeys = [11, 20]")
        .replace("alpha-per-s = 0.019\n", &format!("alpha-per-s = {alpha}\n"))
        .replace("beta-s = 0.004\n", &format!("beta-s = {beta}\n"))
        .replace("at-s = 80\n", "at-s = 40\n")
        .replace("at-s = 150\n", "at-s = 75\n");
    for floor in [30, 40, 50] {
        // Remove the node of each missing floor, up to the next table.
        let begin = text
            .find(&format!("[[node]]\nname = \"floor-{floor}\""))
            .unwrap_or(text.len());
        let end = text[begin..]
            .find("noise-std")
            .and_then(|at| Some(begin + at + text[begin + at..].find('\n')? + 1));
        text.replace_range(begin..end.unwrap_or(text.len()), "");
    }
    Building {
        storeys: 20,
        text,
        seconds: 110.0,
        damage_s: [40.0, 75.0],
    }
}

pub(super) fn run(run: &Run<'_>) -> Result<Outcome, ValidateError> {
    let (mut figures, mut plots) = (Vec::new(), Vec::new());
    if let Some(building) = run.pick(Some(fifty()), None) {
        measure(&building, (0.0, 0.85), run, &mut figures, &mut plots)?;
    }
    measure(
        &twenty(),
        (run.pick(0.85, 0.0), 1.0),
        run,
        &mut figures,
        &mut plots,
    )?;
    Ok(Outcome {
        figures,
        tables: Vec::new(),
        plots,
    })
}

fn measure(
    building: &Building,
    shares: (f64, f64),
    run: &Run<'_>,
    figures: &mut Vec<Figure>,
    plots: &mut Vec<Plot>,
) -> Result<(), ValidateError> {
    let watched = |structure: &spandrel_structure::Structure| {
        let mut states = states_of(structure, &WATCHED_FLOORS, false);
        states.extend(states_of(structure, &WATCHED_FLOORS, true));
        states
    };
    let plan = Plan {
        text: &building.text,
        seconds: building.seconds,
        noise_share: 0.05,
        watched: &watched,
    };
    let scene = Scene::simulate(&plan, run)?;
    let named = |what: &str| format!("{} storeys: {what}", building.storeys);
    let classes = ClassPlan::Predefined {
        classes: match scene
            .structure
            .class_settings()
            .map(|settings| settings.plan)
        {
            Some(ClassPlan::Predefined { classes }) => classes,
            _ => Vec::new(),
        },
    };
    let settings = published_settings(&scene, PRIOR_STD)?;
    // The source uses two fundamental periods. Nothing acts on the result here, so this value only
    // sets when a lead is announced.
    let classes = ClassSettings::published(classes, (1.0 / scene.step_s) as usize);
    let mut single = [f64::NAN; 3];
    let mut ends = [f64::NAN; 2];
    let seen = compare(&scene, settings, classes, shares, run, |frame, bank| {
        if frame + 1 == scene.frames {
            let motion = bank.motion().len();
            let multipliers =
                |class: usize, group: usize| bank.filter(class).mean()[motion + group];
            single = [0, 1, 2].map(|group| multipliers(3, group));
            ends = [multipliers(0, 0), bank.plausibilities().of(3)];
        }
    })?;

    let modes = scene.structure.check(1.0, run.seed).modes;
    let fifty = building.storeys == 50;
    if let [first, second, ..] = &modes[..] {
        if fifty {
            figures.push(
                Figure::new(
                    named("f1 (Hz)"),
                    first.frequency_hz,
                    Required::relative(0.198, 0.01),
                )
                .published(0.198),
            );
        }
        for (mode, report) in [(1, first), (2, second)] {
            let required = Required::relative(0.01, 0.01);
            let figure = Figure::new(
                named(&format!("damping ratio of mode {mode}")),
                report.damping_ratio,
                required,
            );
            figures.push(if fifty {
                figure.published(0.01)
            } else {
                figure
            });
        }
    }
    lead_figures(building, &seen, figures);
    let plausibility = Figure::new(
        named("plausibility of C(4) at the end"),
        ends[1],
        Required::AtLeast(0.85),
    );
    figures.push(plausibility.known_miss(NESTED));
    for (storey, truth) in [0.95, 1.0, 0.92].into_iter().enumerate() {
        figures.push(Figure::new(
            named(&format!("storey {} by C(4) at the end", storey + 1)),
            single[storey],
            Required::Within {
                of: truth,
                by: 0.01,
            },
        ));
    }
    let diluted = if fifty {
        Required::AtLeast(0.99)
    } else {
        Required::Reported
    };
    figures.push(Figure::new(
        named("the multiplier of C(1) at the end"),
        ends[0],
        diluted,
    ));
    let worst = (0..6)
        .map(|j| {
            (
                seen.courses[j].mean(building.seconds - 0.2, building.seconds),
                [0.95, 1.0, 0.92, 1.0, 1.0, 1.0][j],
            )
        })
        .map(|(mean, truth): (f64, f64)| (mean - truth).abs())
        .fold(0.0, larger);
    figures.push(Figure::new(
        named("largest error of the weighted estimate of storeys 1 to 6 at the end"),
        worst,
        Required::AtMost(0.01),
    ));
    for (state, accuracy) in seen.responses.iter().enumerate() {
        let what = if state < WATCHED_FLOORS.len() {
            "displacement"
        } else {
            "velocity"
        };
        let floor = WATCHED_FLOORS[state % WATCHED_FLOORS.len()];
        let name = named(&format!(
            "{floor}: relative error of the {what} from 5 s on"
        ));
        figures.push(Figure::new(
            name,
            accuracy.relative_error(),
            Required::Reported,
        ));
    }
    plots.push(seen.plausibility_plot(&named("plausibilities")));
    for storey in [0, 2] {
        plots.push(seen.parameter_plot(
            storey,
            &named(&format!("storey {}, weighted", storey + 1)),
            (0.85, 1.1),
        ));
    }
    Ok(())
}

/// Adds the figures that state which class leads at which time.
fn lead_figures(building: &Building, seen: &Comparison, figures: &mut Vec<Figure>) {
    let named = |what: &str| format!("{} storeys: {what}", building.storeys);
    let [first_s, second_s] = building.damage_s;
    let fifty = building.storeys == 50;
    let is = |number: usize| move |class: ClassId| class == ClassId::Predefined(number - 1);
    // The next richer class may lead if the acceleration jumps at the damage. It also has storey 1
    // on its own.
    let has_storey_1 = move |class| is(2)(class) || (fifty && is(3)(class));
    let published = |figure: Figure, value: f64| {
        if fifty {
            figure.published(value)
        } else {
            figure
        }
    };
    figures.push(Figure::new(
        named("share of the second half of the undamaged record in which C(1) leads"),
        seen.share(first_s / 2.0, first_s, is(1)),
        Required::AtLeast(0.95),
    ));
    let delay = Figure::new(
        named("C(2) leads after the first damage (s)"),
        seen.first_lead(first_s, has_storey_1),
        Required::Between {
            low: 0.0,
            high: 10.0,
        },
    );
    figures.push(published(delay, 2.110));
    figures.push(Figure::new(
        named("share in which it leads from 10 s after the first damage on"),
        seen.share(first_s + 10.0, second_s, has_storey_1),
        Required::AtLeast(0.99),
    ));
    let delay = Figure::new(
        named("C(4) leads after the second damage (s)"),
        seen.first_lead(second_s, is(4)),
        Required::Between {
            low: 0.0,
            high: 8.0,
        },
    );
    figures.push(published(delay, 5.135).known_miss(NESTED));
    let share = Figure::new(
        named("share in which C(4) leads from 8 s after the second damage on"),
        seen.share(second_s + 8.0, building.seconds, is(4)),
        Required::AtLeast(0.95),
    );
    figures.push(share.known_miss(NESTED));
    figures.push(Figure::new(
        named(
            "share in which C(4) or C(5), which has storey 3 singly as well, leads from there on",
        ),
        seen.share(second_s + 8.0, building.seconds, |class| {
            is(4)(class) || is(5)(class)
        }),
        Required::AtLeast(0.95),
    ));
}
