//! Behaviour of Spandrel with a wrong model: simulated buildings that differ from their structure
//! file, and records of real structures.
//!
//! Each condition is a [`Case`](crate::Case). The run of one seed passes through the cores of
//! `identify` and `alert`. The code that simulates the true building shares nothing with the models
//! that identify it.

mod building;
mod condition;
mod file;
mod ground;
pub mod records;
mod trial;

pub(crate) use condition::CASES;

use crate::error::ValidateError;
use crate::figure::{Figure, Judgement, Required};
use crate::outcome::Outcome;
use crate::run::{Length, Run};
use condition::{Condition, Expected, right};
use trial::Trial;

/// Required share of intervals that contain the truth if the model is wrong.
const COVERAGE: f64 = 0.9;

/// Runs one condition for one seed.
fn measure(run: &Run<'_>, condition: &Condition) -> Result<Outcome, ValidateError> {
    if !run.advance(0.0) {
        return Err(ValidateError::Stopped);
    }
    let (mut building, mut stated) = right();
    (condition.change)(&mut building, &mut stated, run.seed);
    let trial = trial::run(&building, &stated, condition.duration_s, run.seed)?;
    run.advance(1.0);
    Ok(Outcome {
        figures: figures(condition.expected, &trial, run.length),
        ..Outcome::default()
    })
}

/// Returns the figures of one run. Shares are judged over the seeds of a full run, and a short run
/// only reports them.
fn figures(expected: Expected, trial: &Trial, length: Length) -> Vec<Figure> {
    let over_seeds = |name: &str, measured: f64, required: Required| {
        let required = if length == Length::Full {
            required
        } else {
            Required::Reported
        };
        Figure::new(name, measured, required).judged(Judgement::Mean)
    };
    let reported = |name: &str, measured: f64| Figure::new(name, measured, Required::Reported);
    let share = |(part, all): (u64, u64)| part as f64 / all as f64;
    let mut figures = vec![Figure::new(
        "storeys raised that are sound",
        trial.false_alerts.len() as f64,
        Required::AtMost(0.0),
    )];
    let value = "share of 95 % intervals of the stiffness that hold the truth";
    let loss =
        "share of 95 % intervals of the loss against the learnt reference that hold the truth";
    match expected {
        Expected::RightModel => {
            figures.push(over_seeds(
                value,
                share(trial.value_inside),
                Required::Between {
                    low: 0.93,
                    high: 0.99,
                },
            ));
            figures.push(over_seeds(
                "share of the time with the verdict supported",
                trial.verdict_share(0),
                Required::AtLeast(0.99),
            ));
        }
        Expected::EveryStorey => figures.push(over_seeds(
            value,
            share(trial.value_inside),
            Required::AtLeast(COVERAGE),
        )),
        Expected::WrongModel { .. } | Expected::Loss { .. } | Expected::SuddenLoss { .. } => {
            figures.push(reported(value, share(trial.value_inside)));
        }
    }
    let sudden = matches!(
        expected,
        Expected::SuddenLoss { .. } | Expected::Loss { .. }
    );
    let required = if sudden {
        Required::Reported
    } else {
        Required::AtLeast(COVERAGE)
    };
    figures.push(over_seeds(loss, share(trial.loss_inside), required));
    let decided = match expected {
        Expected::RightModel => Required::AtLeast(0.99),
        Expected::WrongModel { decided } => decided.map_or(Required::Reported, Required::AtLeast),
        Expected::EveryStorey | Expected::Loss { .. } | Expected::SuddenLoss { .. } => {
            Required::Reported
        }
    };
    figures.push(over_seeds(
        "share of the time with a decision",
        share(trial.decided),
        decided,
    ));
    for (verdict, name) in ["supported", "doubtful", "contradicted"]
        .into_iter()
        .enumerate()
    {
        figures.push(reported(
            &format!("{name}, share of the time"),
            trial.verdict_share(verdict),
        ));
    }
    if let Expected::Loss { found, within_s } = expected {
        let found = found.map_or(Required::Reported, Required::AtLeast);
        figures.push(over_seeds(
            "losses found",
            f64::from(u8::from(trial.delay_s.is_some())),
            found,
        ));
        if let Some(delay_s) = trial.delay_s {
            let within = within_s.map_or(Required::Reported, Required::AtMost);
            figures.push(over_seeds(
                "from the loss to its alert (s)",
                delay_s,
                within,
            ));
        }
    }
    if let Expected::SuddenLoss { within_s } = expected {
        figures.push(Figure::new(
            "losses found",
            f64::from(u8::from(trial.delay_s.is_some())),
            Required::AtLeast(1.0),
        ));
        figures.push(over_seeds(
            "from the loss to its alert (s)",
            trial.delay_s.unwrap_or(f64::NAN),
            Required::AtMost(within_s),
        ));
        for (inside, after_s) in trial.alert_inside.into_iter().zip(trial::AFTER_ALERT_S) {
            let name = format!("share of alerts whose interval holds the loss after {after_s} s");
            let measured = inside.map_or(f64::NAN, |inside| f64::from(u8::from(inside)));
            figures.push(over_seeds(&name, measured, Required::AtLeast(COVERAGE)));
        }
    }
    figures
}
