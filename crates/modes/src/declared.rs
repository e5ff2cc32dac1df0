//! Follows declared modes from epoch to epoch, and proposes others.
//!
//! A declared mode starts with the nearest mode of an epoch within its tolerance, and then belongs
//! to a tracked mode of [`Tracker`]. It may move away from its declared frequency, as a damaged
//! structure does. If it is lost and another mode persists near the declared frequency, this other
//! mode replaces it. Further modes that persist are proposed, and never adopted.

use crate::error::ModesError;
use crate::stiffness::Stiffnesses;
use serde::{Deserialize, Serialize};
use spandrel_bus::{
    Event, EventKind, ModeDisplay, ModeEstimate, ModeState, Name, ParameterDisplay, ShapeValue,
};
use spandrel_modal::{
    Assignment, CERTAIN_DAMPING, LEAST_PRESENCE, LOST_AFTER, LadderEpoch, LadderModes, Mode,
    ModeId, PRESENCE_WINDOW, SAME_MACHINE, Source, TrackEvent, Tracker, UpdateState,
};
use spandrel_structure::{DeclaredMode, ModalPlan};
use std::collections::VecDeque;

/// Number of epochs with a mode before it is proposed, or replaces a lost one.
const BIRTH_EPOCHS: u64 = 3;
/// Relative difference of the frequencies of modes that count as one proposal.
const SAME_PROPOSAL: f64 = 0.02;
/// Number of proposals that are remembered, so that each is made once.
const MOST_PROPOSALS: usize = 64;

/// A complete epoch with the modes that were identified in it.
#[derive(Debug, Clone, Copy)]
pub struct EpochOver<'e> {
    /// Measurement time of the last frame of the epoch, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// The epoch in all frequency bands, from the highest to the lowest.
    pub epoch: &'e LadderEpoch,
    /// Modes that [`LadderEpoch::identify()`] has found in the epoch.
    pub found: &'e LadderModes,
}

/// A message to publish.
#[derive(Debug, Clone, PartialEq)]
pub enum ModesOutput {
    /// A declared mode after an epoch.
    Mode(Box<ModeDisplay>),
    /// A parameter that the modes have updated.
    Parameter(Box<ParameterDisplay>),
    /// A mode was proposed, lost, found, paired or parted.
    Event(Event),
}

/// The declared modes of one structure.
#[derive(Debug, Clone)]
pub struct DeclaredModes {
    structure: Name,
    names: Vec<Name>,
    modes: Vec<DeclaredMode>,
    channels: Vec<String>,
    stiffnesses: Option<Stiffnesses>,
    state: DeclaredState,
}

/// What changes from epoch to epoch.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct DeclaredState {
    tracker: Tracker,
    /// In the order of the structure file.
    modes: Vec<Followed>,
    /// Frequencies of the last proposals (Hz).
    proposals: VecDeque<f64>,
    epochs: u64,
    displays: Vec<ModeDisplay>,
    parameters: Vec<ParameterDisplay>,
    /// Number of epochs that have failed to update the stiffnesses.
    failed_updates: u64,
    /// Only in a checkpoint. [`Stiffnesses`] has it otherwise.
    update: Option<UpdateState>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Followed {
    id: Option<ModeId>,
    /// Whether the mode was found, in at most [`PRESENCE_WINDOW`] epochs.
    present: VecDeque<bool>,
    is_lost: bool,
    /// Last frequency (Hz). `None` before the mode was found for the first time.
    last_hz: Option<f64>,
    /// Last frequency in the former runs of the frames (Hz).
    former_hz: Option<f64>,
}

impl DeclaredState {
    fn new(modes: usize) -> Self {
        let unknown = Followed {
            id: None,
            present: VecDeque::new(),
            is_lost: false,
            last_hz: None,
            former_hz: None,
        };
        Self {
            tracker: Tracker::new(BIRTH_EPOCHS),
            modes: vec![unknown; modes],
            proposals: VecDeque::new(),
            epochs: 0,
            displays: Vec::new(),
            parameters: Vec::new(),
            failed_updates: 0,
            update: None,
        }
    }
}

impl Followed {
    /// Returns the last frequency in any run (Hz).
    fn known_hz(&self) -> Option<f64> {
        self.last_hz.or(self.former_hz)
    }

    fn note(&mut self, is_present: bool) {
        if self.present.len() == PRESENCE_WINDOW {
            self.present.pop_front();
        }
        self.present.push_back(is_present);
    }

    fn presence(&self) -> f64 {
        let present = self.present.iter().filter(|present| **present).count();
        present as f64 / self.present.len().max(1) as f64
    }
}

impl DeclaredModes {
    /// Creates the modes of a structure before its first epoch.
    ///
    /// # Errors
    /// Returns an error if the name of a mode cannot be a key, which reading the structure file has
    /// excluded.
    pub fn new(structure: &Name, plan: &ModalPlan) -> Result<Self, ModesError> {
        let names = plan.modes.iter().map(|mode| {
            Name::new(&mode.name).map_err(|source| ModesError::Name {
                found: mode.name.clone(),
                source,
            })
        });
        Ok(Self {
            structure: structure.clone(),
            names: names.collect::<Result<_, _>>()?,
            modes: plan.modes.clone(),
            channels: plan.names.clone(),
            stiffnesses: None,
            state: DeclaredState::new(plan.modes.len()),
        })
    }

    /// Lets the modes update stiffnesses, if there are any.
    #[must_use]
    pub fn updating(self, stiffnesses: Option<Stiffnesses>) -> Self {
        Self {
            stiffnesses,
            ..self
        }
    }

    /// Returns the stiffnesses that the modes update.
    #[must_use]
    pub fn stiffnesses(&self) -> Option<&Stiffnesses> {
        self.stiffnesses.as_ref()
    }

    /// Returns the parameters after the last epoch. Empty during the commissioning.
    #[must_use]
    pub fn parameters(&self) -> &[ParameterDisplay] {
        &self.state.parameters
    }

    /// Returns the number of epochs that have failed to update the stiffnesses.
    #[must_use]
    pub fn failed_updates(&self) -> u64 {
        self.state.failed_updates
    }

    /// Returns the names of the modes.
    #[must_use]
    pub fn names(&self) -> &[Name] {
        &self.names
    }

    /// Returns the messages after the last epoch. Empty before the first one.
    #[must_use]
    pub fn displays(&self) -> &[ModeDisplay] {
        &self.state.displays
    }

    /// Returns the number of epochs.
    #[must_use]
    pub fn epochs(&self) -> u64 {
        self.state.epochs
    }

    pub(crate) fn state(&self) -> DeclaredState {
        DeclaredState {
            update: self.stiffnesses.as_ref().map(|of| of.state().clone()),
            ..self.state.clone()
        }
    }

    /// Returns `false`, and changes nothing, if the state belongs to other modes.
    pub(crate) fn restore(&mut self, mut state: DeclaredState) -> bool {
        let fits = state.modes.len() == self.modes.len();
        if fits {
            if let Some((stiffnesses, update)) = self.stiffnesses.as_mut().zip(state.update.take())
            {
                stiffnesses.restore(update);
            }
            self.state = state;
        }
        fits
    }

    /// Forgets all epochs, except for the commissioning of the stiffnesses and the last
    /// frequencies. The structure is the same in another run of its frames.
    pub(crate) fn clear(&mut self) {
        let former = std::mem::replace(&mut self.state, DeclaredState::new(self.modes.len()));
        for (followed, former) in self.state.modes.iter_mut().zip(former.modes) {
            followed.former_hz = former.known_hz();
        }
    }

    /// Processes an epoch, and appends its messages and events to `outputs`.
    pub fn handle(&mut self, over: EpochOver<'_>, outputs: &mut Vec<ModesOutput>) {
        let found = &over.found.modes;
        let Assignment { of_mode, events } = self.state.tracker.update(found);
        self.state.epochs += 1;
        let seen = Seen { found, of_mode };
        self.release_lost(&seen);
        self.acquire(&seen);
        let mut told = Vec::new();
        let estimates: Vec<Option<ModeEstimate>> = (0..self.modes.len())
            .map(|index| self.look(index, &seen, over, &mut told))
            .collect();
        for event in events {
            told.extend(self.pairing(event));
        }
        told.extend(self.propose(&seen));
        self.state.displays = estimates
            .into_iter()
            .enumerate()
            .map(|(index, estimate)| self.display(index, estimate, over))
            .collect();
        let displays = self.state.displays.iter().cloned();
        outputs.extend(displays.map(|display| ModesOutput::Mode(Box::new(display))));
        self.update_stiffnesses(outputs);
        outputs.extend(told.into_iter().map(|told| {
            ModesOutput::Event(Event {
                structure: self.structure.clone(),
                time_ns: over.time_ns,
                kind: told.kind,
                subject: told.subject,
                what: told.what,
                why: told.why,
            })
        }));
    }

    /// Updates the stiffnesses by the modes of an epoch.
    fn update_stiffnesses(&mut self, outputs: &mut Vec<ModesOutput>) {
        let Some(stiffnesses) = &mut self.stiffnesses else {
            return;
        };
        match stiffnesses.handle(&self.state.displays) {
            Ok(parameters) if parameters.is_empty() => {} // the last ones stay the newest
            Ok(parameters) => {
                let messages = parameters.iter().cloned().map(Box::new);
                outputs.extend(messages.map(ModesOutput::Parameter));
                self.state.parameters = parameters;
            }
            Err(_) => self.state.failed_updates += 1,
        }
    }

    /// Replaces a lost mode if another one persists near its declared frequency.
    fn release_lost(&mut self, seen: &Seen<'_>) {
        let DeclaredState { tracker, modes, .. } = &mut self.state;
        for (followed, declared) in modes.iter_mut().zip(&self.modes) {
            let Some(id) = followed.id.filter(|_| followed.is_lost) else {
                continue;
            };
            let near = seen.starts(tracker, declared, None, BIRTH_EPOCHS);
            if near.count() > 0 {
                tracker.release(id);
                followed.id = None;
            }
        }
    }

    /// Starts modes that are not tracked, the nearest first.
    fn acquire(&mut self, seen: &Seen<'_>) {
        let DeclaredState { tracker, modes, .. } = &mut self.state;
        let mut starts: Vec<(f64, usize, ModeId)> = Vec::new();
        for (index, (followed, declared)) in modes.iter().zip(&self.modes).enumerate() {
            if followed.id.is_some() {
                continue;
            }
            let least_seen = match followed.last_hz {
                Some(_) => BIRTH_EPOCHS,
                None => 1,
            };
            let near = seen.starts(tracker, declared, followed.known_hz(), least_seen);
            starts.extend(near.map(|(distance, id)| (distance, index, id)));
        }
        starts.sort_by(|a, b| a.0.total_cmp(&b.0));
        for (_, index, id) in starts {
            if let Some(followed) = modes.get_mut(index)
                && followed.id.is_none()
                && tracker.adopt(id)
            {
                followed.id = Some(id);
            }
        }
    }

    /// Looks for a declared mode in the epoch, and notes whether it is lost or found.
    fn look(
        &mut self,
        index: usize,
        seen: &Seen<'_>,
        over: EpochOver<'_>,
        told: &mut Vec<Told>,
    ) -> Option<ModeEstimate> {
        let followed = self.state.modes.get_mut(index)?;
        let declared = self.modes.get(index)?;
        let mode = followed.id.and_then(|id| seen.of(id));
        let estimate = mode.and_then(|mode| estimate(mode, over.epoch, &self.channels));
        followed.note(estimate.is_some());
        let (was_lost, was_known) = (followed.is_lost, followed.last_hz.is_some());
        let presence = followed.presence();
        followed.is_lost = followed.present.len() >= LOST_AFTER && presence < LEAST_PRESENCE;
        if let Some(estimate) = &estimate {
            followed.last_hz = Some(estimate.frequency_hz);
        }
        let (name, near_hz) = (&declared.name, declared.frequency_hz);
        let subject = name.clone();
        match (was_lost, followed.is_lost, &estimate) {
            (false, true, _) => told.push(Told {
                kind: EventKind::ModeLost,
                subject,
                what: format!("mode {name} is lost, and its values are not published"),
                why: match followed.last_hz {
                    Some(last_hz) => format!(
                        "it was found in {:.0} % of the last {} epochs, last at {last_hz:.4} Hz",
                        100.0 * presence,
                        followed.present.len(),
                    ),
                    None => format!(
                        "it was not found near {near_hz} Hz in {} epochs",
                        followed.present.len()
                    ),
                },
            }),
            (true, false, _) => told.push(Told {
                kind: EventKind::ModeFound,
                subject,
                what: format!("mode {name} is found again"),
                why: format!(
                    "it was found in {:.0} % of the last {} epochs",
                    100.0 * presence,
                    followed.present.len(),
                ),
            }),
            (false, false, Some(estimate)) if !was_known => told.push(Told {
                kind: EventKind::ModeFound,
                subject,
                what: format!("mode {name} is tracked at {}", frequency(estimate)),
                why: format!(
                    "it is the nearest mode within {} % of {near_hz} Hz",
                    100.0 * declared.within
                ),
            }),
            _ => {}
        }
        estimate.filter(|_| !followed.is_lost)
    }

    /// Returns the event of a pair that has formed or parted.
    fn pairing(&self, event: TrackEvent) -> Option<Told> {
        let (kind, first, second) = match event {
            TrackEvent::Paired(first, second) => (EventKind::ModePaired, first, second),
            TrackEvent::Parted(first, second) => (EventKind::ModeParted, first, second),
            // The tracker does not know modes that were never found.
            TrackEvent::Proposed(_) | TrackEvent::Lost(_) | TrackEvent::Found(_) => return None,
        };
        let (first, second) = (self.name_of(first)?, self.name_of(second)?);
        let (what, why) = match kind {
            EventKind::ModePaired => (
                format!("modes {first} and {second} cannot be distinguished"),
                "their frequencies and shapes are too similar; only their mean frequency has a \
                 meaning",
            ),
            _ => (
                format!("modes {first} and {second} can be distinguished again"),
                "their frequencies or shapes differ",
            ),
        };
        Some(Told {
            kind,
            subject: first.to_string(),
            what,
            why: why.to_owned(),
        })
    }

    /// Returns an event for each mode that persists and is not declared. Each is proposed once.
    fn propose(&mut self, seen: &Seen<'_>) -> Vec<Told> {
        let DeclaredState {
            tracker, proposals, ..
        } = &mut self.state;
        let mut told = Vec::new();
        for candidate in tracker.proposed() {
            let Some(mode) = seen.of(candidate.id).filter(|mode| is_certain(mode)) else {
                continue;
            };
            let hz = mode.frequency_hz;
            let is_same = |known: &f64| (known - hz).abs() < SAME_PROPOSAL * hz;
            if proposals.iter().any(is_same) {
                continue;
            }
            if proposals.len() == MOST_PROPOSALS {
                proposals.pop_front();
            }
            proposals.push_back(hz);
            told.push(Told {
                kind: EventKind::ModeProposed,
                subject: format!("{hz:.4} Hz"),
                what: format!(
                    "a mode at {hz:.4} ± {:.4} Hz with a damping ratio of {:.2} ± {:.2} % is not \
                     declared",
                    mode.frequency_std_hz,
                    100.0 * mode.damping,
                    100.0 * mode.damping_std,
                ),
                why: format!(
                    "it was found in {} epochs; [[modal.mode]] declares it",
                    candidate.seen
                ),
            });
        }
        told
    }

    fn display(
        &self,
        index: usize,
        estimate: Option<ModeEstimate>,
        over: EpochOver<'_>,
    ) -> ModeDisplay {
        let followed = &self.state.modes[index];
        let declared = &self.modes[index];
        let partner = followed.id.and_then(|id| self.partner_of(id)).cloned();
        let state = match (&estimate, &partner) {
            _ if followed.is_lost => ModeState::Lost,
            (None, _) => ModeState::Missing,
            (Some(_), Some(_)) => ModeState::Paired,
            (Some(_), None) => ModeState::Tracked,
        };
        // A mode that a machine hides is looked for where it was, or is declared.
        let (near_hz, within) = match &estimate {
            Some(estimate) => (estimate.frequency_hz, SAME_MACHINE),
            None => (
                followed.known_hz().unwrap_or(declared.frequency_hz),
                declared.within,
            ),
        };
        let is_machine = |mode: &Mode| {
            mode.source == Source::Machine
                && (mode.frequency_hz - near_hz).abs() <= within * near_hz
        };
        ModeDisplay {
            structure: self.structure.clone(),
            mode: self.names[index].clone(),
            time_ns: over.time_ns,
            epoch_s: over.epoch.bands.first().map_or(0.0, |band| band.length_s),
            epochs: self.state.epochs,
            state,
            partner: partner.filter(|_| state == ModeState::Paired),
            estimate,
            presence: followed.presence(),
            machine: over.found.modes.iter().any(is_machine),
            declared_hz: declared.frequency_hz,
        }
    }

    fn partner_of(&self, id: ModeId) -> Option<&Name> {
        let partners = self.state.tracker.pairs().filter_map(|(first, second)| {
            let is_first = (first == id).then_some(second);
            is_first.or_else(|| (second == id).then_some(first))
        });
        partners.filter_map(|partner| self.name_of(partner)).next()
    }

    fn name_of(&self, id: ModeId) -> Option<&Name> {
        let mut modes = self.state.modes.iter().zip(&self.names);
        let (_, name) = modes.find(|(followed, _)| followed.id == Some(id))?;
        Some(name)
    }
}

/// An event without its structure and time.
struct Told {
    kind: EventKind,
    subject: String,
    what: String,
    why: String,
}

/// The modes of an epoch with their tracked modes and candidates.
struct Seen<'e> {
    found: &'e [Mode],
    of_mode: Vec<Option<ModeId>>,
}

impl Seen<'_> {
    fn of(&self, id: ModeId) -> Option<&Mode> {
        let mut modes = self.found.iter().zip(&self.of_mode);
        let (mode, _) = modes.find(|(_, of_mode)| **of_mode == Some(id))?;
        Some(mode)
    }

    /// Returns the candidates with which a declared mode can start, with their distances |Δ ln f|
    /// from its last frequency `last_hz`, or from the declared one.
    ///
    /// The mode can have drifted far from the declared frequency before a gap.
    fn starts(
        &self,
        tracker: &Tracker,
        declared: &DeclaredMode,
        last_hz: Option<f64>,
        least_seen: u64,
    ) -> impl Iterator<Item = (f64, ModeId)> {
        let near_hz = last_hz.unwrap_or(declared.frequency_hz);
        let modes = self.found.iter().zip(&self.of_mode);
        modes.filter_map(move |(mode, id)| {
            let id = (*id)?;
            let is_known = tracker.candidate(id)?.seen >= least_seen;
            let is_near = [near_hz, declared.frequency_hz]
                .iter()
                .any(|hz| (mode.frequency_hz - hz).abs() <= declared.within * hz);
            let distance = (mode.frequency_hz / near_hz).ln().abs();
            (is_known && is_near && is_certain(mode)).then_some((distance, id))
        })
    }
}

/// Returns `true` if a mode probably exists, as in the table of a recording.
fn is_certain(mode: &Mode) -> bool {
    mode.source == Source::Mode && mode.damping > CERTAIN_DAMPING * mode.damping_std
}

/// Returns a mode for its message, or `None` if a number is not possible.
fn estimate(mode: &Mode, epoch: &LadderEpoch, names: &[String]) -> Option<ModeEstimate> {
    let shape = mode
        .channels
        .iter()
        .zip(mode.shape.iter())
        .zip(&mode.shape_std);
    let shape = shape.map(|((channel, value), std)| {
        Some(ShapeValue {
            channel: names.get(*channel)?.clone(),
            value: [value.re, value.im],
            std: *std,
        })
    });
    let largest = mode.channels.iter().zip(mode.shape.iter());
    let largest = largest.max_by(|(_, a), (_, b)| a.norm_sqr().total_cmp(&b.norm_sqr()));
    let mut bands = epoch.bands.iter();
    let band = bands.find(|band| band.band_hz == mode.band_hz)?;
    let estimate = ModeEstimate {
        frequency_hz: mode.frequency_hz,
        frequency_std_hz: mode.frequency_std_hz,
        damping: mode.damping,
        damping_std: mode.damping_std,
        shape: shape.collect::<Option<_>>()?,
        amplitude: band.covariances.channel_std(*largest?.0)?,
    };
    estimate.check().is_ok().then_some(estimate)
}

fn frequency(estimate: &ModeEstimate) -> String {
    let (hz, std_hz) = (estimate.frequency_hz, estimate.frequency_std_hz);
    format!("{hz:.4} ± {std_hz:.4} Hz")
}

#[cfg(test)]
mod tests;
