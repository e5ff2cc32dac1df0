//! `spandrel baseline`: learns the baseline values of the parameters from recordings.

use super::{counted, print, refuse_overwriting};
use crate::cli::BaselineArguments;
use crate::error::AppError;
use crate::offline;
use spandrel_alert::{AlertError, Baseline, BetweenRecords, RecordSummary};
use spandrel_bus::{EstimateFlags, FitVerdict, Phase};
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

/// Largest share of the time in which the excitation, or the whole response, may be missing, faulty
/// or in doubt.
///
/// Above this share, the estimate is mostly the prior value. Such recordings would all agree, and
/// the scatter between recordings would look too small.
const LARGEST_UNMEASURED: f64 = 0.5;

/// Largest number of channels that are left out one after the other. Each costs one more
/// identification of every recording.
const MOST_LEFT_OUT: usize = 12;

/// Identifies each recording from its start and writes the mean and scatter of each parameter.
///
/// Leaves out recordings from which nothing can be learnt, and names them.
///
/// # Errors
/// Returns an error if a file is not valid, or if no recording is usable.
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
    let mut used = Vec::new();
    let mut unusable = Vec::new();
    let mut left_out = String::new();
    for path in &arguments.record {
        let learnt = learn(&structure, path, skipped, None)?;
        match usable(&structure, path, learnt, arguments.skip, &mut left_out) {
            Ok(recording) => used.push(recording),
            Err(error) => {
                let _ = writeln!(left_out, "left out: {error}");
                unusable.push(error);
            }
        }
    }
    if used.is_empty() && unusable.len() == 1 {
        return unusable.pop().map_or(Ok(()), Err);
    }
    if used.is_empty() {
        let reasons: Vec<String> = unusable.iter().map(AppError::to_string).collect();
        return Err(AppError::NoUsableRecordings { reasons });
    }
    let between = arguments
        .between_std
        .map_or(BetweenRecords::Estimated, BetweenRecords::Stated);
    let known = known_parameters(&structure, &used, between, &mut left_out);
    let names: Vec<&str> = (known.iter())
        .filter_map(|index| structure.parameters().get(*index))
        .map(|parameter| parameter.name())
        .collect();
    let records = { used.iter() }.map(|recording| recording.summary.of_parameters(&known));
    let records: Vec<RecordSummary> = records.collect();
    let baseline = Baseline::from_records(structure.name(), &names, &records, between)?;
    let baseline = with_sensors(baseline, &structure, &used, skipped, &records, &known)?;
    baseline.write(&arguments.output)?;
    print(&(left_out + &report(&structure, &baseline)))
}

/// A recording that the baseline uses.
struct Used<'p> {
    path: &'p Path,
    /// Mean and scatter of each parameter of the structure.
    summary: RecordSummary,
    /// Relation of each sound channel to the others.
    observed: Vec<Option<ObservedRelation>>,
}

/// Returns what the baseline uses of a recording, and names what it does not use.
///
/// # Errors
/// Returns an error if the recording is unusable as a whole.
fn usable<'p>(
    structure: &Structure,
    path: &'p Path,
    learnt: Learnt,
    skip_s: f64,
    left_out: &mut String,
) -> Result<Used<'p>, AppError> {
    for (what, share) in [
        ("the measured excitation is", learnt.without_excitation),
        ("all sensors on the structure are", learnt.without_response),
    ] {
        if share > LARGEST_UNMEASURED {
            return Err(AppError::BaselineUnmeasured {
                path: path.to_owned(),
                what,
                share,
                largest: LARGEST_UNMEASURED,
            });
        }
    }
    let contradicted = learnt.contradicted;
    if contradicted > 0 {
        let share = contradicted as f64 / (contradicted + learnt.frames.len()) as f64;
        if share > LARGEST_CONTRADICTED {
            return Err(AppError::BaselineContradicted {
                path: path.to_owned(),
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
        path: path.to_owned(),
        skip_s,
    };
    let summary = RecordSummary::from_estimates(learnt.frames).ok_or_else(nothing)?;
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
    Ok(Used {
        path,
        summary,
        observed: learnt.observed,
    })
}

/// Returns the parameters that the baseline contains, as indices. Names the others: no rule watches
/// them, and their reference is too uncertain.
fn known_parameters(
    structure: &Structure,
    used: &[Used],
    between: BetweenRecords,
    left_out: &mut String,
) -> Vec<usize> {
    let rules = structure.alert_rules().iter();
    let watched: Vec<usize> = rules.flat_map(|rule| rule.parameters.clone()).collect();
    let mut known = Vec::new();
    let mut unknown = String::new();
    for (index, parameter) in structure.parameters().iter().enumerate() {
        let alone: Vec<RecordSummary> = { used.iter() }
            .map(|recording| recording.summary.of_parameters(&[index]))
            .collect();
        let name = parameter.name();
        let too_uncertain = match Baseline::from_records(structure.name(), &[name], &alone, between)
        {
            Err(AlertError::Parameter { source, .. }) => {
                Some(source).filter(|source| matches!(**source, AlertError::Reference { .. }))
            }
            Ok(_) | Err(_) => None,
        };
        match too_uncertain.filter(|_| !watched.contains(&index)) {
            Some(error) => {
                let _ = writeln!(
                    unknown,
                    "left out: parameter {name}, which no rule watches: {error}; use recordings \
                     with more motion, or a std below {} in its [[parameter]]",
                    parameter.std()
                );
            }
            None => known.push(index),
        }
    }
    if known.is_empty() {
        // A baseline without parameters is none: the first of them is the error.
        return (0..structure.parameters().len()).collect();
    }
    left_out.push_str(&unknown);
    known
}

/// What one recording shows.
struct Learnt {
    /// Mean and standard deviation of each parameter, per frame.
    frames: Vec<Vec<(f64, f64)>>,
    /// Number of frames that contradict the model, which are not among them.
    contradicted: usize,
    /// Share of the time without a usable measured excitation, 0 to 1.
    without_excitation: f64,
    /// Share of the time without a usable sensor on the structure, 0 to 1.
    without_response: f64,
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
    let mut times = Times::default();
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
                if number < skipped {
                    continue;
                }
                times.take(&estimate.flags);
                if estimate.flags.phase != Phase::Working {
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
    let excitation = structure.excitation_channels().iter().flatten().copied();
    let most_suspected = excitation
        .map(|channel| collected.suspected_frames(channel))
        .max();
    let response = structure.observation_channels().iter().copied();
    let all_suspected = response
        .map(|channel| collected.suspected_frames(channel))
        .min();
    // The relation of a faulty sensor would later make a sound one faulty.
    let suspected = collected.suspected().to_vec();
    let of_sound = |(channel, relation): (usize, &Option<ObservedRelation>)| {
        relation.filter(|_| !suspected.contains(&channel))
    };
    let observed = collected.observed().iter().enumerate();
    Ok(Learnt {
        frames,
        contradicted,
        without_excitation: times.without_excitation(most_suspected.unwrap_or(0)),
        without_response: times
            .without_response(all_suspected.unwrap_or(0), frames_per_sample(structure)),
        observed: observed.map(of_sound).collect(),
        suspected,
    })
}

/// Numbers of frames of a recording after the start.
#[derive(Debug, Default)]
struct Times {
    all: u64,
    /// Frames in which a measured excitation delivers no usable samples.
    silent: u64,
    /// Frames in which a sensor in use is in doubt, or that of the excitation is faulty.
    doubtful: u64,
    /// Frames in which at least one sensor on the structure was used.
    observed: u64,
}

impl Times {
    fn take(&mut self, flags: &EstimateFlags) {
        self.all += 1;
        self.silent += u64::from(flags.phase == Phase::ExcitationSilent);
        self.doubtful += u64::from(flags.phase == Phase::SensorInDoubt);
        self.observed += u64::from(!flags.prediction_only);
    }

    /// Returns the share of the time without a usable excitation, whose sensor was suspected in
    /// `suspected` frames.
    fn without_excitation(&self, suspected: u64) -> f64 {
        self.share(self.silent + self.doubtful.min(suspected))
    }

    /// Returns the share of the time without a usable sensor on the structure. All of them were
    /// suspected in at most `suspected` frames, and the fastest one has a sample in every
    /// `frames_per_sample` frames.
    fn without_response(&self, suspected: u64, frames_per_sample: f64) -> f64 {
        let missing = 1.0 - self.share(self.observed) * frames_per_sample;
        missing.max(self.share(self.doubtful.min(suspected)))
    }

    fn share(&self, frames: u64) -> f64 {
        frames as f64 / self.all.max(1) as f64
    }
}

/// Returns the number of frames per sample of the fastest node with a sensor on the structure.
fn frames_per_sample(structure: &Structure) -> f64 {
    let rate_hz = structure.sampling_rate_hz();
    let of_node = structure.nodes().iter().flat_map(|node| {
        let of_node_hz = node.sampling_rate_hz().unwrap_or(rate_hz);
        std::iter::repeat_n(of_node_hz, node.channels().len())
    });
    let rates: Vec<f64> = of_node.collect();
    let response = structure.observation_channels().iter();
    let fastest_hz = response.filter_map(|channel| rates.get(*channel));
    rate_hz / fastest_hz.copied().reduce(f64::max).unwrap_or(rate_hz)
}

/// Adds what the sensors show, and how the parameters `known` change without each of them.
fn with_sensors(
    baseline: Baseline,
    structure: &Structure,
    used: &[Used],
    skipped: u64,
    records: &[RecordSummary],
    known: &[usize],
) -> Result<Baseline, AppError> {
    let names: Vec<&str> = structure.channels().map(|channel| channel.name()).collect();
    let check = SensorCheck::new(structure);
    let observed: Vec<_> = used.iter().map(|one| one.observed.clone()).collect();
    let mut baseline = baseline.with_sensors(check.learn(&names, &observed));
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
    for channel in channels {
        let without = used.iter().map(|recording| {
            let learnt = learn(structure, recording.path, skipped, Some(names[channel]))?;
            let summary = RecordSummary::from_estimates(learnt.frames);
            Ok(summary.map(|summary| summary.of_parameters(known)))
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
                "  {name:<24} {:.4} ± {:.4} within a record\n    no reference for other records: \
                 {error}",
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
    fn shares_of_the_time_count_what_is_missing_or_suspected() {
        let flags = |phase, prediction_only| EstimateFlags {
            phase,
            prediction_only,
            ..EstimateFlags::working()
        };
        let mut times = Times::default();
        for (phase, prediction_only, frames) in [
            (Phase::Working, false, 2),
            (Phase::Working, true, 2),
            (Phase::ExcitationSilent, false, 1),
            (Phase::SensorInDoubt, false, 5),
        ] {
            (0..frames).for_each(|_| times.take(&flags(phase, prediction_only)));
        }
        // A doubt about one sensor on the structure is none about the excitation.
        assert_eq!(times.without_excitation(0), 0.1);
        assert_eq!(times.without_excitation(3), 0.4);
        assert_eq!(times.without_excitation(9), 0.6);
        assert!((times.without_response(0, 1.0) - 0.2).abs() < 1e-12);
        assert_eq!(times.without_response(9, 1.0), 0.5);
        // A slow node has no samples in the frames between its own.
        assert!(times.without_response(0, 1.25) <= 0.0);
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
