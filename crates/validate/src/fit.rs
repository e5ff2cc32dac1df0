//! The fit verdict on each example file, compared with the correct verdict.
//!
//! Each example is a [`Case`](crate::Case). Its own simulation passes through alignment and
//! identification, as on the bus. The correct verdict follows from the file alone and was fixed
//! before the first run:
//!
//! - A simulation draws from the model of its own file. If nothing happens that the filter does not
//!   know, the data support the model.
//! - A filter does not know about a sudden change of a parameter. It follows within two half-lives,
//!   in which an error of the estimate falls to a sixteenth. The verdict during this time is
//!   reported and not judged.
//! - If no parameter is identified, if particles identify, or if sensor nodes identify their own
//!   parameters, nothing judges the fit, and there is no verdict.

mod course;
mod example;
mod shares;

pub(crate) use example::CASES;

use crate::error::ValidateError;
use crate::figure::{Figure, Required};
use crate::outcome::{Outcome, Table};
use crate::run::Run;
use example::{Example, Right};
use shares::Shares;
use spandrel_bus::{FitReason, FitVerdict};
use spandrel_structure::Structure;

/// Required share of the judged time with the correct verdict.
const MOST_OF_THE_TIME: f64 = 0.95;

const VERDICTS: [FitVerdict; 3] = [
    FitVerdict::Supported,
    FitVerdict::Doubtful,
    FitVerdict::Contradicted,
];

/// Runs one example for one seed.
fn measure(run: &Run<'_>, example: &Example) -> Result<Outcome, ValidateError> {
    if !run.advance(0.0) {
        return Err(ValidateError::Stopped);
    }
    let structure = example.structure(run.seed)?;
    if structure.fusion().is_some() {
        return nodes_without_verdict(&structure);
    }
    let shares = course::run(&structure, example.seconds, run)?;
    let tables = vec![right_table(example), reasons_table(&shares)];
    Ok(Outcome {
        figures: figures(example, &shares),
        tables,
        ..Outcome::default()
    })
}

/// Counts the sensor nodes whose filter judges its fit.
fn nodes_without_verdict(structure: &Structure) -> Result<Outcome, ValidateError> {
    let mut judging = 0;
    for position in 0..structure.nodes().len() {
        let Some(filter) = structure.local_filter(position) else {
            continue;
        };
        judging += usize::from(
            !filter
                .map_err(ValidateError::setting)?
                .filter()
                .channel_fits()
                .is_empty(),
        );
    }
    let figure = Figure::new(
        "sensor nodes that judge the fit",
        judging as f64,
        Required::AtMost(0.0),
    );
    Ok(Outcome {
        figures: vec![figure],
        ..Outcome::default()
    })
}

fn figures(example: &Example, shares: &Shares) -> Vec<Figure> {
    let reported = |name: String, measured: f64| Figure::new(name, measured, Required::Reported);
    let known = |figure: Figure| match example.known_miss {
        Some(reason) => figure.known_miss(reason),
        None => figure,
    };
    let right = match example.right {
        Right::Supported => FitVerdict::Supported,
        Right::Doubtful => FitVerdict::Doubtful,
        Right::NoVerdict => {
            let name = "share of the time with a verdict that nobody has measured";
            return vec![known(Figure::new(
                name,
                shares.unmeasured(),
                Required::AtMost(0.0),
            ))];
        }
    };
    let mut figures = Vec::new();
    for verdict in VERDICTS {
        let figure = reported(
            format!("{}, share of the judged time", verdict.as_str()),
            shares.settled(verdict),
        );
        figures.push(if verdict == right {
            known(Figure {
                required: Required::AtLeast(MOST_OF_THE_TIME),
                ..figure
            })
        } else {
            figure
        });
    }
    if shares.changes() {
        for verdict in VERDICTS {
            let name = format!(
                "{}, share of the two half-lives after a change",
                verdict.as_str()
            );
            figures.push(reported(name, shares.after_a_change(verdict)));
        }
    }
    for (when, held) in ["supported", "not supported"]
        .into_iter()
        .zip(shares.held())
    {
        figures.push(reported(
            format!("95 % intervals that hold the truth while {when}"),
            held,
        ));
    }
    figures.push(reported(
        "supported before anything was measured, share of the working time".into(),
        shares.unmeasured(),
    ));
    figures
}

fn right_table(example: &Example) -> Table {
    Table {
        title: "What is right".to_owned(),
        columns: ["simulated (s)", "right", "why"]
            .map(str::to_owned)
            .to_vec(),
        rows: vec![vec![
            example.seconds.to_string(),
            example.right.words().to_owned(),
            example.why.to_owned(),
        ]],
    }
}

fn reasons_table(shares: &Shares) -> Table {
    let row =
        |(reason, share): (FitReason, f64)| vec![reason.words().to_owned(), format!("{share:.3}")];
    Table {
        title: "Reasons against the fit, outside of the time after a change".to_owned(),
        columns: ["reason", "share of the judged time"]
            .map(str::to_owned)
            .to_vec(),
        rows: shares.reasons().map(row).collect(),
    }
}
