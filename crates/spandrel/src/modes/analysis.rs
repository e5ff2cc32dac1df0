//! Chooses epochs and bands for a recording, and identifies its modes.

use super::frames::Frames;
use super::stiffness::StiffnessCourse;
use crate::error::AppError;
use serde::Serialize;
use spandrel_bus::{Name, TimeGrid};
use spandrel_modal::{
    BandLadder, CERTAIN_DAMPING, ChannelUse, EpochStream, LadderEpoch, ModalError, ModalSettings,
    ModeSummary, RecordModes, Source,
};
use spandrel_modes::{DeclaredModes, EpochOver, ModesError, ModesOutput, Stiffnesses};
use spandrel_structure::{ModalPlan, Structure};

/// What the user has chosen.
#[derive(Debug, Clone, Default)]
pub struct Choice {
    /// Length of an epoch (s).
    pub epoch_s: Option<f64>,
    /// Band (Hz).
    pub band_hz: Option<(f64, f64)>,
    /// Highest order of the models.
    pub highest_order: Option<usize>,
    /// Names of the reference channels.
    pub references: Vec<String>,
}

impl Choice {
    /// Returns `true` if the user has chosen something.
    pub fn is_some(&self) -> bool {
        self.epoch_s.is_some()
            || self.band_hz.is_some()
            || self.highest_order.is_some()
            || !self.references.is_empty()
    }
}

/// A mode recurs if it is found in this share of the epochs, and in this number of them.
///
/// The mean of its damping ratio then decides whether it is listed, and not that of one epoch,
/// because a spurious mode does not recur.
const RECURRING_SHARE: f64 = 0.8;
const RECURRING_EPOCHS: f64 = 3.0;

/// The modes of a recording.
#[derive(Debug)]
pub struct Analysis {
    /// Settings of each band, from the highest to the lowest.
    pub bands: Vec<ModalSettings>,
    /// The epochs, whose spectra the diagrams show.
    pub epochs: Vec<LadderEpoch>,
    /// Index of the recording of each epoch, from 0, in the order of `epochs`.
    pub recording: Vec<usize>,
    /// Modes of each epoch.
    pub record: RecordModes,
    /// Modes and machines of the recording.
    pub modes: Vec<ModeSummary>,
    /// Modes that are not among `modes`, because their damping ratio does not exceed
    /// [`CERTAIN_DAMPING`] times its own standard deviation. Most of these modes are spurious.
    pub uncertain: Vec<ModeSummary>,
    /// What the service `modes` would publish: the declared modes after each epoch, and events.
    pub declared: Vec<ModesOutput>,
    /// The stiffnesses that the declared modes update. `None` if they update none.
    pub stiffness: Option<StiffnessCourse>,
}

/// A channel that took no part in some epochs.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Absence {
    /// Name of the channel.
    pub channel: String,
    /// Number of epochs without the channel.
    pub epochs: usize,
    /// Reason in the first of these epochs.
    pub first: ChannelUse,
}

/// Identifies the modes of recordings of the same channels.
///
/// # Errors
/// Returns an error if a choice is not valid, or if all recordings are too short.
pub fn analyse(records: &[Frames], choice: &Choice) -> Result<Analysis, AppError> {
    let (frames, settings) = settings(records, choice)?;
    let ladder = ladder(&settings, choice).map_err(|source| failed(frames, source))?;
    let stream = EpochStream::new(ladder, frames.rate_hz);
    identify(records, &stream, settings.epoch_s, |_| {})
}

/// Identifies the modes of recordings as the service `modes` does for live frames.
///
/// # Errors
/// Returns an error if all recordings are too short, or have no usable epoch.
pub fn follow(
    records: &[Frames],
    structure: &Structure,
    plan: &ModalPlan,
) -> Result<Analysis, AppError> {
    let stream = plan.stream().map_err(ModesError::from)?;
    let declared = DeclaredModes::new(&Name::new(structure.name())?, plan)?;
    let mut declared = declared.updating(Stiffnesses::new(structure)?);
    let mut course = StiffnessCourse::new(structure);
    let mut outputs = Vec::new();
    let mut analysis = identify(records, &stream, plan.settings.epoch_s, |over| {
        declared.handle(over, &mut outputs);
        if let Some((course, stiffnesses)) = course.as_mut().zip(declared.stiffnesses()) {
            course.note(stiffnesses);
        }
    })?;
    if let Some((course, stiffnesses)) = course.as_mut().zip(declared.stiffnesses()) {
        course.finish(stiffnesses)?;
    }
    analysis.declared = outputs;
    analysis.stiffness = course;
    Ok(analysis)
}

fn failed(frames: &Frames, source: ModalError) -> AppError {
    AppError::Modal {
        path: frames.path.clone(),
        source,
    }
}

/// Identifies the modes of each epoch, and passes them to `handle`. Each recording begins an epoch.
fn identify(
    records: &[Frames],
    fresh: &EpochStream,
    epoch_s: f64,
    mut handle: impl FnMut(EpochOver<'_>),
) -> Result<Analysis, AppError> {
    let mut record = RecordModes::default();
    let mut epochs = Vec::new();
    let mut recording = Vec::new();
    // An epoch with too few complete channels does not make the others useless.
    let mut skipped = None;
    for (position, frames) in records.iter().enumerate() {
        let mut stream = fresh.clone();
        let grid = TimeGrid::new(frames.start_ns, frames.rate_hz);
        for (number, frame) in (0..).zip(frames.iter()) {
            let epoch = stream
                .push(frame)
                .map_err(|source| failed(frames, source))?;
            let Some(epoch) = epoch else {
                continue;
            };
            let found = match epoch.identify() {
                Ok(found) => found,
                Err(error @ ModalError::Channels { .. }) => {
                    skipped = Some(failed(frames, error));
                    continue;
                }
                Err(error) => return Err(failed(frames, error)),
            };
            handle(EpochOver {
                time_ns: grid.map_or(frames.start_ns, |grid| grid.time_ns(number)),
                epoch: &epoch,
                found: &found,
            });
            record.take(&epoch, found);
            epochs.push(epoch);
            recording.push(position);
        }
    }
    let longest = records
        .iter()
        .max_by(|a, b| a.length_s().total_cmp(&b.length_s()));
    if let (Some(longest), true) = (longest, epochs.is_empty()) {
        return Err(skipped.unwrap_or_else(|| AppError::NoEpoch {
            path: longest.path.clone(),
            found_s: longest.length_s(),
            epoch_s,
        }));
    }
    let is_certain = |mode: &ModeSummary| {
        let found = mode.epochs * epochs.len() as f64;
        let recurs = mode.epochs >= RECURRING_SHARE && found >= RECURRING_EPOCHS;
        let std = match recurs {
            true => mode.damping_of_mean_std,
            false => mode.damping_std,
        };
        mode.source == Source::Machine || mode.damping > CERTAIN_DAMPING * std
    };
    let (modes, uncertain): (Vec<_>, Vec<_>) = record.summary().into_iter().partition(is_certain);
    Ok(Analysis {
        bands: fresh.settings().cloned().collect(),
        modes,
        uncertain,
        epochs,
        recording,
        record,
        declared: Vec::new(),
        stiffness: None,
    })
}

fn ladder(settings: &ModalSettings, choice: &Choice) -> Result<BandLadder, ModalError> {
    match choice.band_hz {
        Some(_) => BandLadder::single(settings),
        None => BandLadder::new(settings),
    }
}

/// Returns the channels that took no part in some epochs, with the number of these epochs and the
/// reason of the first.
pub fn absent(names: &[String], analysis: &Analysis) -> Vec<Absence> {
    let named = names.iter().enumerate();
    named
        .filter_map(|(position, name)| {
            let mut reasons = analysis.epochs.iter().filter_map(|epoch| {
                let used = epoch.bands.first()?.channels.get(position)?;
                (*used != ChannelUse::Used).then_some(*used)
            });
            let first = reasons.next()?;
            Some(Absence {
                channel: name.clone(),
                epochs: 1 + reasons.count(),
                first,
            })
        })
        .collect()
}

/// Returns the settings for recordings: the choice of the user, and epochs that fill the shortest
/// recording that is long enough. Also returns this recording.
fn settings<'f>(
    records: &'f [Frames],
    choice: &Choice,
) -> Result<(&'f Frames, ModalSettings), AppError> {
    let Some(first) = records.first() else {
        return Err(AppError::FilesOfModes {
            found: "no recording is given",
        });
    };
    let mut settings = ModalSettings::new(first.names.len(), first.rate_hz);
    if let Some((lowest_hz, highest_hz)) = choice.band_hz {
        (settings.lowest_hz, settings.highest_hz) = (lowest_hz, highest_hz);
    }
    if let Some(highest_order) = choice.highest_order {
        settings.highest_order = highest_order;
    }
    if !choice.references.is_empty() {
        let positions = choice.references.iter().map(|name| first.position(name));
        settings.references = positions.collect::<Result<_, _>>()?;
    }
    if let Some(epoch_s) = choice.epoch_s {
        settings.epoch_s = epoch_s;
        return Ok((first, settings));
    }
    let at_least_s = settings.shortest_epoch_s() + settings.start_up_s();
    let by_length = |a: &&Frames, b: &&Frames| a.length_s().total_cmp(&b.length_s());
    let long = records
        .iter()
        .filter(|frames| frames.length_s() >= at_least_s);
    let Some(frames) = long.min_by(by_length) else {
        let longest = records.iter().max_by(by_length).unwrap_or(first);
        return Err(AppError::TooShort {
            path: longest.path.clone(),
            found_s: longest.length_s(),
            at_least_s,
        });
    };
    // The start-up of the lowest band leaves less for the epochs, which may remove this band.
    let mut start_up_s = settings.start_up_s();
    for _ in 0..2 {
        let usable_s = frames.length_s() - start_up_s;
        let epochs = (usable_s / ModalSettings::EPOCH_S).round().max(1.0);
        settings.epoch_s = (usable_s / epochs).max(settings.shortest_epoch_s());
        let bands = ladder(&settings, choice).map_err(|source| failed(frames, source))?;
        let all = bands.settings().map(ModalSettings::start_up_s);
        start_up_s = all.fold(0.0, f64::max);
    }
    Ok((frames, settings))
}
