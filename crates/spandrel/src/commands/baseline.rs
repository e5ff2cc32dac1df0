//! `spandrel baseline`: learns the baseline values of the parameters from recordings.

use super::{counted, print, refuse_overwriting};
use crate::cli::BaselineArguments;
use crate::error::AppError;
use crate::offline;
use spandrel_alert::{Baseline, BetweenRecords, RecordSummary};
use spandrel_bus::{FitVerdict, Phase};
use spandrel_identify::Identification;
use spandrel_sensor::{open_record, recorded_rows};
use spandrel_structure::{Reference, Structure};
use std::fmt::Write as _;

/// Largest share of the frames of a recording in which the data may contradict the model.
///
/// Above this share, little remains except the start, when the filter has not yet detected the
/// contradiction.
const LARGEST_CONTRADICTED: f64 = 0.95;

/// Identifies each recording from its start and writes the mean and scatter of each parameter.
///
/// # Errors
/// A file is not valid, or a recording is too short to learn from.
pub fn run(arguments: &BaselineArguments) -> Result<(), AppError> {
    let inputs = std::iter::once(&arguments.structure).chain(&arguments.record);
    refuse_overwriting(&arguments.output, inputs.map(|path| path.as_path()))?;
    let structure = Structure::read(&arguments.structure)?;
    if structure.parameters().is_empty() {
        return Err(AppError::NoParameters {
            path: arguments.structure.clone(),
        });
    }
    let skipped = (arguments.skip * structure.sampling_rate_hz()) as u64;
    let mut records = Vec::new();
    let mut left_out = String::new();
    for path in &arguments.record {
        let recording = open_record(&structure, path)?;
        let mut frames: Vec<Vec<(f64, f64)>> = Vec::new();
        let mut contradicted = 0_usize;
        let identification = Identification::new(&structure, "identify")?;
        offline::identify(
            &structure,
            identification,
            recorded_rows(recording, 0),
            None,
            |block, _| {
                for (number, estimate) in block.iter() {
                    if number < skipped || estimate.flags.phase != Phase::Working {
                        continue;
                    }
                    if estimate.flags.fit == Some(FitVerdict::Contradicted) {
                        contradicted += 1; // such an estimate has no meaning
                    } else {
                        let std = |index| estimate.variance(index).unwrap_or(0.0).max(0.0).sqrt();
                        frames.push(
                            estimate
                                .mean
                                .iter()
                                .enumerate()
                                .map(|(index, mean)| (*mean, std(index)))
                                .collect(),
                        );
                    }
                }
                Ok(())
            },
        )?;
        let nothing = || AppError::NothingLearnt {
            path: path.clone(),
            skip_s: arguments.skip,
        };
        if contradicted > 0 {
            let share = contradicted as f64 / (contradicted + frames.len()) as f64;
            if share > LARGEST_CONTRADICTED {
                return Err(AppError::BaselineContradicted {
                    path: path.clone(),
                    share,
                    largest: LARGEST_CONTRADICTED,
                });
            }
            let _ = writeln!(
                left_out,
                "{}: the data contradict the model in {:.0} % of the frames, which are left out",
                path.display(),
                100.0 * share
            );
        }
        records.push(RecordSummary::from_estimates(frames).ok_or_else(nothing)?);
    }
    let names: Vec<&str> = structure
        .parameters()
        .iter()
        .map(|parameter| parameter.name())
        .collect();
    let between = arguments
        .between_std
        .map_or(BetweenRecords::Estimated, BetweenRecords::Stated);
    let baseline = Baseline::from_records(structure.name(), &names, &records, between)?;
    baseline.write(&arguments.output)?;
    print(&(left_out + &report(&structure, &baseline)))
}

/// Returns the contents of the baseline and the losses that the rules can detect with it, as text.
fn report(structure: &Structure, baseline: &Baseline) -> String {
    let recordings = counted(baseline.records(), "recording", "recordings");
    let mut text = format!("baseline of {} from {recordings}\n", structure.name());
    for (index, parameter) in structure.parameters().iter().enumerate() {
        let name = parameter.name();
        // Writing to a string cannot fail.
        let _ = match (baseline.claim(name), baseline.parameter(name)) {
            (Some(Ok(reference)), _) => {
                let support = reference.scatter().map_or(
                    "scatter between records as stated".to_owned(),
                    |scatter| {
                        counted(
                            scatter.degrees_of_freedom.round() as usize,
                            "degree of freedom",
                            "degrees of freedom",
                        )
                    },
                );
                writeln!(
                    text,
                    "  {name:<24} {:.4} ± {:.4} ({support})",
                    reference.mean(),
                    reference.std()
                )
            }
            (Some(Err(error)), Some(found)) => writeln!(
                text,
                "  {name:<24} {:.4} ± {:.4} within a record\n    no reference for other records: {error}",
                found.mean, found.within_std
            ),
            _ => Ok(()),
        };
        for line in claims(structure, baseline, index) {
            let _ = writeln!(text, "    {line}");
        }
    }
    text
}

/// Returns the smallest loss that each rule with a learnt reference can raise for a parameter, in
/// words.
fn claims(structure: &Structure, baseline: &Baseline, index: usize) -> Vec<String> {
    let Some(parameter) = structure.parameters().get(index) else {
        return Vec::new();
    };
    let Some(reference) = baseline.reference(parameter.name()) else {
        return Vec::new();
    };
    let rules = structure.alert_rules().iter();
    let learning = rules.filter(|rule| matches!(rule.reference, Reference::Baseline { .. }));
    let of_rule = |rule: &spandrel_structure::AlertRule| {
        let asked = format!(
            "more than {:.0} % with probability {}",
            100.0 * rule.loss,
            rule.credibility
        );
        match reference.largest_credible(rule.loss, rule.credibility) {
            Some(estimate) => {
                let loss = 100.0 * (1.0 - estimate / reference.mean());
                format!("{asked}: raised for a loss of at least {loss:.0} %")
            }
            None => format!("{asked}: never raised, because there are too few records"),
        }
    };
    learning
        .filter(|rule| rule.parameters.contains(&index))
        .map(of_rule)
        .collect()
}
