//! `spandrel judge --example`: writes a simulated series for practice.

use crate::cli::ExampleArguments;
use crate::commands::{counted, in_place_of, print};
use crate::error::AppError;
use spandrel_record::RecordError;
use spandrel_validate::{StiffnessLoss, seasons, seasons_csv};
use std::path::Path;

/// Writes the series to a file.
///
/// # Errors
/// Returns an error if the days of loss and repair do not match the length of the series, or if the
/// file cannot be written.
pub fn run(file: &Path, arguments: &ExampleArguments) -> Result<(), AppError> {
    let rows = seasons(arguments.seed, arguments.days, loss(arguments)?);
    let replacing = in_place_of(file);
    std::fs::write(file, seasons_csv(&rows)).map_err(|source| RecordError::Open {
        path: file.to_owned(),
        source,
    })?;
    print(&format!(
        "{}: {}, {}, seed {}{replacing}\n",
        file.display(),
        counted(rows.len(), "epoch", "epochs"),
        counted(arguments.days as usize, "day", "days"),
        arguments.seed
    ))
}

/// Returns the loss that the options describe.
fn loss(arguments: &ExampleArguments) -> Result<Option<StiffnessLoss>, AppError> {
    let Some((share, day)) = arguments.loss.zip(arguments.loss_day) else {
        return Ok(None); // the command line requires both or none
    };
    let invalid = |option, found: u32, allowed| AppError::Annotation {
        option,
        found: found.to_string(),
        allowed,
    };
    if day >= arguments.days {
        let allowed = "below --days; the series would contain no loss";
        return Err(invalid("--loss-day", day, allowed));
    }
    if let Some(repair) = arguments.repair_day
        && !(day + 1..arguments.days).contains(&repair)
    {
        let allowed = "above --loss-day and below --days";
        return Err(invalid("--repair-day", repair, allowed));
    }
    Ok(Some(StiffnessLoss {
        share,
        day,
        repair_day: arguments.repair_day,
    }))
}
