//! Lasting change of a highway overpass in earthquakes of four decades.
//!
//! Source of the records: docs/highway-bridge.md. The requirements are those of point 6 of the
//! acceptance list.

use crate::error::ValidateError;
use crate::figure::{Figure, Required};
use crate::outcome::Outcome;
use crate::robustness::records::{EVENTS, FILE, FIRST_STRONG};
use crate::run::{JudgedStiffness, Run};
use spandrel_earthquake::LastingLoss;
use spandrel_structure::Structure;
use std::path::{Path, PathBuf};

/// Events that soften the bridge: 25 April 1992, 20 December 2022 and 1 January 2023.
const SOFTENING: [&str; 3] = [
    "petrolia_25apr1992_ce89324p",
    FIRST_STRONG,
    "nc73827571_ce89324p",
];

/// Why the loss is not certain.
const FEW_LATER: &str = "only three later events have weak motion, and the requirement is that of \
                         the fifth";

pub(super) fn run(run: &Run<'_>) -> Result<Outcome, ValidateError> {
    let records = run.records()?;
    let folder = records.folder.join("painter-street-bridge");
    let archive = |name: &&str| folder.join(format!("{name}.zip"));
    let archives: Vec<PathBuf> = EVENTS.iter().map(archive).collect();
    let structure = Structure::parse(FILE, Path::new("bridge.toml"))?;
    let judge = records.judge_earthquakes;
    let events = judge(&structure, &archives).map_err(ValidateError::Earthquakes)?;
    let main_shock = EVENTS.iter().position(|name| *name == FIRST_STRONG);
    let main_shock = main_shock.unwrap_or(EVENTS.len());

    let before = events.iter().take(main_shock).flatten();
    let raised = before.filter(|one| one.judgement.raised().is_some());
    let named = EVENTS.iter().zip(&events);
    let softened = named.filter(|(name, stiffnesses)| {
        let whole = stiffnesses.first();
        let softening = whole.and_then(|whole| whole.judgement.softening);
        SOFTENING.contains(*name) && softening.is_some_and(|softening| softening.is_raised)
    });
    let last: &[JudgedStiffness] = events.last().map_or(&[], Vec::as_slice);
    let since_main_shock = |one: &JudgedStiffness| {
        let mut lasting = one.judgement.lasting.iter();
        lasting
            .find(|candidate| candidate.since == main_shock)?
            .loss
    };
    let loss = last.first().and_then(since_main_shock);
    let of_loss = |of: fn(&LastingLoss) -> f64| loss.as_ref().map_or(f64::NAN, of);
    let share = |one: &JudgedStiffness| one.coverage.share().unwrap_or(0.0);
    let tested = last.iter().map(|one| one.coverage.events as f64);
    Ok(Outcome {
        figures: vec![
            Figure::new(
                "point 6: lasting losses raised before 20 December 2022",
                raised.count() as f64,
                Required::AtMost(0.0),
            ),
            Figure::new(
                "point 6: softening in 1992, December 2022 and January 2023",
                softened.count() as f64,
                Required::AtLeast(SOFTENING.len() as f64),
            ),
            Figure::new(
                "point 6: probability of any loss since 20 December 2022, after the last event",
                of_loss(|loss| loss.probability_of_any),
                Required::AtLeast(0.99),
            )
            .known_miss_within(Required::AtLeast(0.95), FEW_LATER),
            Figure::new(
                "probability of a loss of more than 5 %, after the last event",
                of_loss(|loss| loss.probability),
                Required::Reported,
            ),
            Figure::new(
                "most probable loss, after the last event",
                of_loss(|loss| loss.loss),
                Required::Reported,
            ),
            Figure::new(
                "later events with weak motion",
                of_loss(|loss| loss.later as f64),
                Required::Reported,
            ),
            Figure::new(
                "point 6: leave-one-event-out coverage of each stiffness, smallest",
                last.iter().map(share).fold(f64::INFINITY, f64::min),
                Required::AtLeast(0.85),
            ),
            Figure::new(
                "events of this coverage, smallest number",
                tested.fold(f64::INFINITY, f64::min),
                Required::AtLeast(9.0),
            ),
        ],
        ..Outcome::default()
    })
}
