//! Repeats a past judgement from the saved epochs, with the configuration that was in force.

use crate::configurations::{Configuration, Record, read};
use crate::epoch_log::{FILE, Known, SavedEpochs};
use crate::error::{JudgingError, NoPast};
use crate::judging::Judging;
use spandrel_bus::{JudgementDisplay, Name};
use std::path::Path;

/// A judgement as the service stated it at an earlier time.
#[derive(Debug, Clone, PartialEq)]
pub struct PastJudgement {
    /// Name of the configuration that was in force.
    pub name: String,
    /// Wall-clock time since which it was in force (ns since 1970-01-01 UTC).
    pub since_ns: i64,
    /// The configuration that was in force.
    pub configuration: Configuration,
    /// Number of epochs that were judged.
    pub epochs: u64,
    /// Middle of the last epoch (ns since 1970-01-01 UTC).
    pub epoch_ns: i64,
    /// State of each quantity after the last epoch, with the same bits. The time of each is that of
    /// the question, and nobody has seen a change.
    pub displays: Vec<JudgementDisplay>,
}

/// Judges the epochs in a folder of the service up to a time (ns since 1970-01-01 UTC), with the
/// configuration that was in force when the last of them was judged first.
///
/// With `wanted`, the name of a configuration, the epoch may be the last one before it came into
/// force: the service then judged this epoch twice.
///
/// No file is changed, so the service may run.
///
/// # Errors
/// The epochs or configurations of that time are not known, or a file cannot be read.
pub fn judge_past(
    folder: &Path,
    structure: &Name,
    at_ns: i64,
    wanted: Option<&str>,
) -> Result<PastJudgement, JudgingError> {
    let records = read(folder)?;
    let no_past = |why| JudgingError::NoPast {
        structure: structure.to_string(),
        at_ns,
        why,
    };
    let mut first_ns = None;
    let mut is_judged = false;
    // The epochs before a record with `aside` are in this file, those after the last one in `FILE`.
    let mut file = FILE;
    let parts: Vec<&[Record]> = records.chunk_by(|_, next| next.aside.is_none()).collect();
    for part in parts.into_iter().rev() {
        let Some(first) = part.first() else {
            continue;
        };
        let saved = SavedEpochs::read(folder.join(file), &first.configuration.judge)?;
        file = first.aside.as_deref().unwrap_or(FILE);
        let known = saved.until(at_ns)?;
        first_ns = known.first_ns.or(first_ns);
        is_judged |= known.epochs > 0;
        let Some(record) = in_force(part, known.epochs, wanted).map_err(no_past)? else {
            continue;
        };
        check(&saved, &known, record, at_ns).map_err(no_past)?;
        return repeat(&saved, &known, record, structure, at_ns);
    }
    Err(no_past(match (first_ns, records.first()) {
        (Some(_), Some(first)) if is_judged => NoPast::BeforeConfigurations {
            from_ns: first.time_ns,
        },
        (Some(first_ns), _) => NoPast::BeforeEpochs { first_ns },
        (None, _) => NoPast::NoEpochs,
    }))
}

/// Returns the record that was in force for the last one of a number of epochs. `None` if an
/// earlier record was.
fn in_force<'r>(
    part: &'r [Record],
    epochs: u64,
    wanted: Option<&str>,
) -> Result<Option<&'r Record>, NoPast> {
    let first_judged = part.iter().rfind(|record| record.since.epochs < epochs);
    let Some(wanted) = wanted else {
        return Ok(first_judged);
    };
    let ends = part.iter().skip(1).map(|next| next.since.epochs);
    let ends = ends.chain([u64::MAX]);
    let all = part.iter().zip(ends).filter(|(record, end)| {
        let span = record.since.epochs..=*end;
        record.name == wanted && epochs > 0 && span.contains(&epochs)
    });
    let found = all.last();
    match (found, first_judged) {
        (Some((record, _)), _) => Ok(Some(record)),
        (None, Some(in_force)) => Err(NoPast::NotInForce {
            found: wanted.to_owned(),
            in_force: in_force.name.clone(),
        }),
        (None, None) => Ok(None),
    }
}

/// Checks that the saved epochs are those that were judged.
fn check(
    saved: &SavedEpochs<'_>,
    known: &Known,
    record: &Record,
    at_ns: i64,
) -> Result<(), NoPast> {
    let path = saved.path().to_owned();
    match known.last_ns {
        Some(last_ns) if saved.is_damaged() && !known.is_followed && last_ns < at_ns => {
            Err(NoPast::DamagedEpochs { path, last_ns })
        }
        _ if !saved.contains(&record.since) => Err(NoPast::OtherEpochs { path }),
        _ if !record.is_complete => Err(NoPast::UnsavedEpochs),
        _ => Ok(()),
    }
}

fn repeat(
    saved: &SavedEpochs<'_>,
    known: &Known,
    record: &Record,
    structure: &Name,
    at_ns: i64,
) -> Result<PastJudgement, JudgingError> {
    let configuration = record.configuration.clone();
    let mut judging = Judging::of_plan(structure.clone(), &configuration.judge)?;
    let references = configuration.references.iter();
    references.for_each(|annotation| judging.annotate(annotation.clone()));
    let mut left = known.epochs;
    saved.each(|closed| {
        if left > 0 {
            left -= 1;
            // The service has rejected the same epochs.
            let _ = judging.handle(&closed, &mut Vec::new());
        }
    })?;
    judging.set_configuration(record.name.clone());
    Ok(PastJudgement {
        name: record.name.clone(),
        since_ns: record.time_ns,
        configuration,
        epochs: known.epochs,
        epoch_ns: known.last_ns.unwrap_or_default(),
        displays: judging.displays(at_ns),
    })
}

#[cfg(test)]
mod tests;
