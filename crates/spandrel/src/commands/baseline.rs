//! `spandrel baseline`: learns the baseline values of the parameters from recordings.

use super::{counted, print, refuse_overwriting};
use crate::cli::BaselineArguments;
use crate::error::AppError;
use crate::offline;
use spandrel_alert::{Baseline, BetweenRecords, RecordSummary};
use spandrel_bus::{FitVerdict, Phase};
use spandrel_faults::{ObservedRelation, SensorCheck};
use spandrel_identify::Identification;
use spandrel_sensor::{open_record, recorded_rows};
use spandrel_structure::{Reference, Structure};
use std::fmt::Write as _;
use std::path::Path;

/// Largest share of the frames of a recording in which the data may contradict the model.
///
/// Above this share, little remains except the start, when the filter has not yet detected the
/// contradiction.
const LARGEST_CONTRADICTED: f64 = 0.95;

/// Largest number of channels that are left out one after the other. Each costs one more
/// identification of every recording.
const MOST_LEFT_OUT: usize = 12;

/// Identifies each recording from its start and writes the mean and scatter of each parameter.
///
/// # Errors
/// A file is not valid, or a recording is too short to learn from.
pub fn run(arguments: &BaselineArguments) -> Result<(), AppError> {
    let inputs = std::iter::once(&arguments.structure).chain(&arguments.record);
    refuse_overwriting(&arguments.output, inputs.map(|path| path.as_path()))?;
    let structure = Structure::read_with_model(&arguments.structure)?;
    if structure.parameters().is_empty() {
        return Err(AppError::NoParameters {
            path: arguments.structure.clone(),
        });
    }
    let skipped = (arguments.skip * structure.sampling_rate_hz()) as u64;
    let mut records = Vec::new();
    let mut observed = Vec::new();
    let mut left_out = String::new();
    for path in &arguments.record {
        let learnt = learn(&structure, path, skipped, None)?;
        let contradicted = learnt.contradicted;
        if contradicted > 0 {
            let share = contradicted as f64 / (contradicted + learnt.frames.len()) as f64;
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
        let nothing = || AppError::NothingLearnt {
            path: path.clone(),
            skip_s: arguments.skip,
        };
        records.push(RecordSummary::from_estimates(learnt.frames).ok_or_else(nothing)?);
        for channel in learnt.suspected {
            let _ = writeln!(
                left_out,
                "{}: the sensor {} is in doubt or faulty at the end, so nothing is learnt about it",
                path.display(),
                structure
                    .channels()
                    .nth(channel)
                    .map_or("", |one| one.name())
            );
        }
        observed.push(learnt.observed);
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
    let baseline = with_sensors(baseline, &structure, arguments, &records, &observed)?;
    baseline.write(&arguments.output)?;
    print(&(left_out + &report(&structure, &baseline)))
}

/// What one recording shows.
struct Learnt {
    /// Mean and standard deviation of each parameter, per frame.
    frames: Vec<Vec<(f64, f64)>>,
    /// Number of frames that contradict the model, which are not among them.
    contradicted: usize,
    /// Relation of each sound channel to the others.
    observed: Vec<Option<ObservedRelation>>,
    /// Channels that are in doubt or faulty at the end, as indices in a frame.
    suspected: Vec<usize>,
}

/// Identifies a recording, without the channel `left_out` if there is one.
fn learn(
    structure: &Structure,
    path: &Path,
    skipped: u64,
    left_out: Option<&str>,
) -> Result<Learnt, AppError> {
    let recording = open_record(structure, path)?;
    let mut frames: Vec<Vec<(f64, f64)>> = Vec::new();
    let mut contradicted = 0_usize;
    let mut identification = Identification::new(structure, "identify")?;
    if let Some(left_out) = left_out {
        identification.leave_out(left_out);
    }
    let collected = offline::identify(
        structure,
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
                    let means = estimate.mean.iter().enumerate();
                    frames.push(means.map(|(index, mean)| (*mean, std(index))).collect());
                }
            }
            Ok(())
        },
    )?;
    // The relation of a faulty sensor would later make a sound one faulty.
    let suspected = collected.suspected().to_vec();
    let of_sound = |(channel, relation): (usize, &Option<ObservedRelation>)| {
        relation.filter(|_| !suspected.contains(&channel))
    };
    let observed = collected.observed().iter().enumerate();
    Ok(Learnt {
        frames,
        contradicted,
        observed: observed.map(of_sound).collect(),
        suspected,
    })
}

/// Adds what the sensors show, and how the parameters change without each of them.
fn with_sensors(
    baseline: Baseline,
    structure: &Structure,
    arguments: &BaselineArguments,
    records: &[RecordSummary],
    observed: &[Vec<Option<ObservedRelation>>],
) -> Result<Baseline, AppError> {
    let names: Vec<&str> = structure.channels().map(|channel| channel.name()).collect();
    let check = SensorCheck::new(structure);
    let mut baseline = baseline.with_sensors(check.learn(&names, observed));
    let checked = |channel: &&usize| check.health()[**channel].is_some();
    let channels: Vec<usize> = structure
        .observation_channels()
        .iter()
        .filter(checked)
        .copied()
        .collect();
    if channels.len() > MOST_LEFT_OUT {
        return Ok(baseline);
    }
    let skipped = (arguments.skip * structure.sampling_rate_hz()) as u64;
    for channel in channels {
        let without = arguments.record.iter().map(|path| {
            let learnt = learn(structure, path, skipped, Some(names[channel]))?;
            Ok(RecordSummary::from_estimates(learnt.frames))
        });
        let without = without.collect::<Result<Vec<_>, AppError>>()?;
        baseline = baseline.with_left_out(names[channel], records, &without);
    }
    Ok(baseline)
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

#[cfg(test)]
mod tests {
    use super::*;

    const TABLE: &str = include_str!("../../../../docs/examples/shake-table-stiff.toml");

    /// Channel of the second floor.
    const FLOOR_2: usize = 2;

    /// Learns from a recording of the simulated frame, whose second floor has this scale.
    fn learnt(scale: f64) -> Learnt {
        let structure = Structure::parse(TABLE, Path::new("table.toml")).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("record.csv");
        let mut text = "time_s,ground_mps2,floor1_mps2,floor2_mps2,floor3_mps2\n".to_owned();
        for (number, frame) in structure.simulator(3).take(60 * 120).enumerate() {
            let mut values = frame.values.clone();
            values[FLOOR_2] *= scale;
            let time_s = number as f64 / 120.0;
            let values: Vec<String> = values.iter().map(f64::to_string).collect();
            text += &format!("{time_s:.6},{}\n", values.join(","));
        }
        std::fs::write(&path, text).unwrap();
        learn(&structure, &path, 0, None).unwrap()
    }

    #[test]
    fn sensors_that_are_not_sound_are_named_and_teach_nothing() {
        let sound = learnt(1.0);
        assert!(sound.suspected.is_empty());
        assert!(sound.observed.iter().all(Option::is_some));
        let dead = learnt(0.0);
        assert_eq!(dead.suspected, [FLOOR_2]);
        let known: Vec<bool> = dead.observed.iter().map(Option::is_some).collect();
        assert_eq!(known, [true, true, false, true]);
    }
}
