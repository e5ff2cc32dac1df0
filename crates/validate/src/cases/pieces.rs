//! Chapter 7, §7.4: the building with spikes and biased nodes, with one part of the method removed
//! at a time.
//!
//! The reference runs of the specification keep ten modes. Here the structure has all its degrees
//! of freedom, and the nodes exchange their responses, as in `hierarchical.building`. The rate and
//! the length are those of the specification: 50 Hz, and 150 s after the training. It requires the
//! following:
//!
//! - A healthy node restarts at most once, or two to fourteen times if it was trained on raw
//!   samples.
//! - Without feedback, 6 to 62 % of the fusions leave a healthy node out.

use super::hierarchical::{
    AFTER_DAMAGE_S, BIASED, COUNTED_FROM_S, FILE, GROUPS, TRAINING_S, corrupt,
};
use crate::error::ValidateError;
use crate::figure::{Figure, Required};
use crate::network::settled;
use crate::outcome::Outcome;
use crate::run::Run;
use crate::scene::{Plan, Scene};
use crate::statistics::{Mean, larger};
use spandrel_structure::Structure;

const RATE_HZ: f64 = 50.0;
/// Variants: the name, the text replaced in the file and its replacement. The requirements apply to
/// the largest share of fusions that leave a healthy node out, and to the largest number of
/// restarts.
const VARIANTS: [(&str, &str, &str, Required, Required); 5] = [
    (
        "all pieces",
        "",
        "",
        Required::AtMost(0.02),
        Required::AtMost(1.0),
    ),
    (
        "weights of nodes graded",
        DETECTOR,
        "detector = \"one-at-a-time\"\nweighting = \"graded\"",
        Required::Reported,
        Required::Reported,
    ),
    (
        "no feedback",
        DETECTOR,
        "detector = \"one-at-a-time\"\nfeedback = \"none\"",
        Required::AtLeast(0.06),
        Required::Reported,
    ),
    (
        "no test of nodes",
        DETECTOR,
        "detector = \"none\"",
        Required::Reported,
        Required::Reported,
    ),
    (
        "training on raw samples",
        "[outliers]",
        "[outliers]\ntraining = \"raw\"",
        Required::Reported,
        Required::Between {
            low: 2.0,
            high: 14.0,
        },
    ),
];
const DETECTOR: &str = "detector = \"one-at-a-time\"";

pub(super) fn building(run: &Run<'_>) -> Result<Outcome, ValidateError> {
    let (seconds, damages) = run.pick((150.0, [60.0, 100.0]), (30.0, [22.0, 26.0]));
    let damages = damages.map(|at_s| at_s + TRAINING_S);
    let text = FILE
        .replacen(
            "sampling-rate-hz = 250",
            &format!("sampling-rate-hz = {RATE_HZ}"),
            1,
        )
        .replacen("at-s = 200", &format!("at-s = {}", damages[0]), 1)
        .replacen("at-s = 350", &format!("at-s = {}", damages[1]), 1);
    let judged = |required: Required| run.pick(required, Required::Reported);
    let mut figures = Vec::new();
    for (number, (name, piece, other, left_out, anew)) in VARIANTS.into_iter().enumerate() {
        let text = text.replacen(piece, other, 1);
        let watched = |_: &Structure| Vec::new();
        let plan = Plan {
            text: &text,
            seconds: TRAINING_S + seconds,
            noise_share: 0.05,
            watched: &watched,
        };
        let scene = Scene::simulate(&plan, run)?;
        let (corrupted, _) = corrupt(&scene, run.seed);
        let channels = scene.noise_std.len();
        let data = |frame: usize, channel: usize| corrupted[frame * channels + channel];
        let share = |number: usize| number as f64 / VARIANTS.len() as f64;
        let fused =
            scene
                .network(&data)
                .fuse((share(number), share(number + 1)), run, |_, _, _| {})?;

        let mut error = Mean::default();
        for course in &fused.courses[..GROUPS] {
            let accuracy = settled(
                course,
                TRAINING_S + COUNTED_FROM_S,
                &damages,
                AFTER_DAMAGE_S,
            );
            error.take(accuracy.mean_absolute_error());
        }
        let working = fused
            .reports
            .iter()
            .zip(&fused.courses[0].points)
            .filter(|(_, point)| point[0] > TRAINING_S);
        let working: Vec<_> = working.map(|(reports, _)| reports).collect();
        let nodes = 0..scene.structure.nodes().len();
        let excluded = |node: usize| {
            working
                .iter()
                .filter(|reports| reports[node].excluded)
                .count() as f64
                / working.len() as f64
        };
        let is_healthy = |node: &usize| BIASED.iter().all(|(biased, _)| biased != node);
        let healthy: Vec<usize> = nodes.filter(is_healthy).collect();
        let largest =
            |of: &dyn Fn(usize) -> f64| healthy.iter().map(|node| of(*node)).fold(0.0, larger);
        let biased = BIASED
            .iter()
            .map(|(node, _)| excluded(*node))
            .fold(1.0, f64::min);
        figures.extend([
            Figure::new(
                format!("{name}: mean error of stiffness"),
                error.value(),
                Required::Reported,
            ),
            Figure::new(
                format!("{name}: least share of the fusions that leave a biased node out"),
                biased,
                Required::Reported,
            ),
            Figure::new(
                format!("{name}: largest share of the fusions that leave a healthy node out"),
                largest(&excluded),
                judged(left_out),
            ),
            Figure::new(
                format!("{name}: times a healthy node started anew, at most"),
                largest(&|node| fused.restarts[node] as f64),
                judged(anew),
            ),
        ]);
    }
    Ok(Outcome {
        figures,
        tables: Vec::new(),
        plots: Vec::new(),
    })
}
