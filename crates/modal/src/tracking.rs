//! Tracking of modes from epoch to epoch.
//!
//! A mode of an epoch belongs to the tracked mode of the smallest cost
//! (Δ ln f / s)² + ((1 − MAC) / 0.1)², if the cost is at most 12. Assignments are made in the order
//! of their cost, each mode at most once. Modes without a partner become candidates, and a
//! candidate that persists is proposed. Nothing is adopted silently.
//!
//! The predicted ln f of a tracked mode is a random walk, updated by a scalar Kalman filter. Its
//! variance grows in every epoch in which the mode is missing, so that a mode that has changed is
//! found again.

use crate::identify::{Mode, Source};
use crate::shape::mac;
use nalgebra::{Complex, DVector};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeSet, VecDeque};

/// Largest cost of an assignment, about the 0.998 quantile of χ² with two degrees of freedom.
const GATE: f64 = 12.0;
/// Distance 1 − MAC that counts as one standard deviation.
const SHAPE_SCALE: f64 = 0.1;
/// Standard deviation of ln f between two epochs from conditions, such as temperature.
const DRIFT: f64 = 0.005;
/// Share of a new shape in the tracked shape.
const SHAPE_GAIN: f64 = 0.2;
/// Number of epochs in which the presence of a mode counts.
pub const PRESENCE_WINDOW: usize = 20;
/// Smallest share of epochs in which a mode is present. Below it, nothing is stated about the mode.
pub const LEAST_PRESENCE: f64 = 0.3;
/// Number of epochs before a mode can be lost.
pub const LOST_AFTER: usize = 5;
/// Number of consecutive epochs without the mode after which a candidate is dropped.
const FORGET_AFTER: usize = 3;
/// Factor by which the cost must exceed the gate before a pair parts again.
const PARTING: f64 = 2.0;

/// Number of a tracked mode, unique within its tracker.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct ModeId(pub u32);

/// A change of the tracked modes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TrackEvent {
    /// A candidate persists. [`Tracker::adopt()`] starts its tracking.
    Proposed(ModeId),
    /// A mode is missing in more than 70 % of the last 20 epochs. Nothing is stated about it.
    Lost(ModeId),
    /// A lost mode is present again.
    Found(ModeId),
    /// Two modes can no longer be distinguished. Only their mean frequency has a meaning.
    Paired(ModeId, ModeId),
    /// The modes of a pair can be distinguished again.
    Parted(ModeId, ModeId),
}

/// A mode over several epochs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrackedMode {
    /// Number of the mode.
    pub id: ModeId,
    /// Predicted ln f, with f in Hz.
    pub ln_frequency: f64,
    /// Variance of the predicted ln f.
    pub variance: f64,
    /// Variance of ln f of one epoch, as last stated.
    epoch_variance: f64,
    channels: Vec<usize>,
    shape: DVector<Complex<f64>>,
    /// Presence in the last epochs, at most 20.
    present: VecDeque<bool>,
    /// Number of epochs with the mode.
    pub seen: u64,
    is_lost: bool,
}

impl TrackedMode {
    fn new(id: ModeId, mode: &Mode) -> Self {
        Self {
            id,
            ln_frequency: mode.frequency_hz.ln(),
            variance: ln_variance(mode),
            epoch_variance: ln_variance(mode),
            channels: mode.channels.clone(),
            shape: mode.shape.clone(),
            present: VecDeque::from([true]),
            seen: 1,
            is_lost: false,
        }
    }

    /// Returns the share of epochs with the mode, 0 to 1. It covers the last 20 epochs, or all
    /// epochs since the mode was first found.
    #[must_use]
    pub fn presence(&self) -> f64 {
        let present = self.present.iter().filter(|present| **present).count();
        present as f64 / self.present.len() as f64
    }

    /// Returns `true` if the mode is present in enough epochs to be reported.
    ///
    /// The required share is [`LEAST_PRESENCE`]. It applies after [`LOST_AFTER`] epochs.
    #[must_use]
    pub fn has_statement(&self) -> bool {
        !self.is_lost
    }

    fn cost(
        &self,
        ln_frequency: f64,
        variance: f64,
        channels: &[usize],
        shape: &DVector<Complex<f64>>,
    ) -> f64 {
        let difference = ln_frequency - self.ln_frequency;
        let s2 = self.variance + variance + DRIFT * DRIFT;
        let distance = 1.0 - common_mac(&self.channels, &self.shape, channels, shape);
        difference * difference / s2 + (distance / SHAPE_SCALE).powi(2)
    }

    fn see(&mut self, mode: &Mode) {
        let variance = ln_variance(mode);
        let gain = self.variance / (self.variance + variance);
        self.ln_frequency += gain * (mode.frequency_hz.ln() - self.ln_frequency);
        self.variance *= 1.0 - gain;
        self.epoch_variance = variance;
        self.seen += 1;
        if self.channels == mode.channels {
            let turn = mode.shape.dotc(&self.shape);
            if turn.norm() > 0.0 {
                let aligned = &mode.shape * (turn / turn.norm());
                self.shape = &self.shape * Complex::from(1.0 - SHAPE_GAIN)
                    + aligned * Complex::from(SHAPE_GAIN);
            }
        } else if mode.channels.len() >= self.channels.len() {
            self.channels.clone_from(&mode.channels);
            self.shape.clone_from(&mode.shape);
        }
        self.note(true);
    }

    fn note(&mut self, present: bool) {
        if self.present.len() == PRESENCE_WINDOW {
            self.present.pop_front();
        }
        self.present.push_back(present);
    }

    fn missing_for(&self) -> usize {
        self.present
            .iter()
            .rev()
            .take_while(|present| !**present)
            .count()
    }
}

/// Assigns the modes of each epoch to tracked modes.
///
/// [`Tracker::update`] takes the modes of one epoch. Modes without a partner become candidates, and
/// a candidate that persists is proposed. The caller decides: [`Tracker::adopt`] starts the
/// tracking of a candidate, and [`Tracker::release`] ends it.
///
/// The tracker starts without modes and can be serialised between two epochs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Tracker {
    birth_epochs: u64,
    modes: Vec<TrackedMode>,
    candidates: Vec<TrackedMode>,
    proposed: BTreeSet<ModeId>,
    pairs: BTreeSet<(ModeId, ModeId)>,
    next_id: u32,
}

/// The assignment of one epoch.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Assignment {
    /// For each mode of the epoch, the tracked mode or candidate to which it belongs. `None` for a
    /// machine.
    pub of_mode: Vec<Option<ModeId>>,
    /// Changes of the tracked modes.
    pub events: Vec<TrackEvent>,
}

impl Tracker {
    /// Creates a tracker without modes. A candidate is proposed when it has been present in
    /// `birth_epochs` epochs.
    #[must_use]
    pub fn new(birth_epochs: u64) -> Self {
        Self {
            birth_epochs,
            modes: Vec::new(),
            candidates: Vec::new(),
            proposed: BTreeSet::new(),
            pairs: BTreeSet::new(),
            next_id: 0,
        }
    }

    /// Returns the adopted modes, in the order of their adoption.
    #[must_use]
    pub fn modes(&self) -> &[TrackedMode] {
        &self.modes
    }

    /// Returns the modes that are proposed and not yet adopted.
    pub fn proposed(&self) -> impl Iterator<Item = &TrackedMode> {
        self.candidates
            .iter()
            .filter(|candidate| self.proposed.contains(&candidate.id))
    }

    /// Returns a mode that is not adopted. `None` if there is no such candidate.
    #[must_use]
    pub fn candidate(&self, id: ModeId) -> Option<&TrackedMode> {
        self.candidates.iter().find(|mode| mode.id == id)
    }

    /// Returns the pairs of modes that cannot be distinguished.
    pub fn pairs(&self) -> impl Iterator<Item = (ModeId, ModeId)> {
        self.pairs.iter().copied()
    }

    /// Starts the tracking of a candidate. Returns `false` if there is no such candidate.
    pub fn adopt(&mut self, id: ModeId) -> bool {
        let Some(at) = self.candidates.iter().position(|mode| mode.id == id) else {
            return false;
        };
        self.modes.push(self.candidates.remove(at));
        self.proposed.remove(&id);
        true
    }

    /// Ends the tracking of an adopted mode. Returns `false` if there is no such mode.
    pub fn release(&mut self, id: ModeId) -> bool {
        let before = self.modes.len();
        self.modes.retain(|mode| mode.id != id);
        self.pairs.retain(|(a, b)| *a != id && *b != id);
        self.modes.len() < before
    }

    /// Assigns the modes of an epoch.
    pub fn update(&mut self, modes: &[Mode]) -> Assignment {
        for tracked in self.modes.iter_mut().chain(&mut self.candidates) {
            tracked.variance += DRIFT * DRIFT;
        }
        let mut of_mode = vec![None; modes.len()];
        assign(&mut self.modes, modes, &mut of_mode);
        assign(&mut self.candidates, modes, &mut of_mode);
        let mut events = Vec::new();
        for (mode, of_mode) in modes.iter().zip(&mut of_mode) {
            if of_mode.is_none() && mode.source == Source::Mode {
                let id = ModeId(self.next_id);
                self.next_id += 1;
                self.candidates.push(TrackedMode::new(id, mode));
                *of_mode = Some(id);
            }
        }
        self.candidates
            .retain(|candidate| candidate.missing_for() < FORGET_AFTER);
        let kept: BTreeSet<ModeId> = self.candidates.iter().map(|mode| mode.id).collect();
        self.proposed.retain(|id| kept.contains(id));
        for candidate in &self.candidates {
            if candidate.seen >= self.birth_epochs && self.proposed.insert(candidate.id) {
                events.push(TrackEvent::Proposed(candidate.id));
            }
        }
        self.note_losses(&mut events);
        self.note_pairs(&mut events);
        Assignment { of_mode, events }
    }

    fn note_losses(&mut self, events: &mut Vec<TrackEvent>) {
        for mode in &mut self.modes {
            let is_lost = mode.present.len() >= LOST_AFTER && mode.presence() < LEAST_PRESENCE;
            match (mode.is_lost, is_lost) {
                (false, true) => events.push(TrackEvent::Lost(mode.id)),
                (true, false) => events.push(TrackEvent::Found(mode.id)),
                (true, true) | (false, false) => {}
            }
            mode.is_lost = is_lost;
        }
    }

    fn note_pairs(&mut self, events: &mut Vec<TrackEvent>) {
        for (position, first) in self.modes.iter().enumerate() {
            for second in &self.modes[position + 1..] {
                let cost = first.cost(
                    second.ln_frequency,
                    second.epoch_variance,
                    &second.channels,
                    &second.shape,
                );
                let pair = (first.id.min(second.id), first.id.max(second.id));
                if cost <= GATE && self.pairs.insert(pair) {
                    events.push(TrackEvent::Paired(pair.0, pair.1));
                } else if cost > PARTING * GATE && self.pairs.remove(&pair) {
                    events.push(TrackEvent::Parted(pair.0, pair.1));
                }
            }
        }
    }
}

/// Assigns modes that have no partner yet, the smallest cost first.
fn assign(tracked: &mut [TrackedMode], modes: &[Mode], of_mode: &mut [Option<ModeId>]) {
    let mut costs: Vec<(f64, usize, usize)> = Vec::new();
    for (position, mode) in modes.iter().enumerate() {
        if of_mode[position].is_some() || mode.source != Source::Mode {
            continue;
        }
        for (row, known) in tracked.iter().enumerate() {
            let cost = known.cost(
                mode.frequency_hz.ln(),
                ln_variance(mode),
                &mode.channels,
                &mode.shape,
            );
            if cost <= GATE {
                costs.push((cost, row, position));
            }
        }
    }
    costs.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut present = vec![false; tracked.len()];
    for (_, row, position) in costs {
        if !present[row] && of_mode[position].is_none() {
            present[row] = true;
            of_mode[position] = Some(tracked[row].id);
            tracked[row].see(&modes[position]);
        }
    }
    for (known, present) in tracked.iter_mut().zip(present) {
        if !present {
            known.note(false);
        }
    }
}

fn ln_variance(mode: &Mode) -> f64 {
    (mode.frequency_std_hz / mode.frequency_hz).powi(2)
}

/// Returns the assurance criterion of two shapes over the channels that both have. Returns 0 with
/// fewer than two common channels.
fn common_mac(
    first_channels: &[usize],
    first: &DVector<Complex<f64>>,
    second_channels: &[usize],
    second: &DVector<Complex<f64>>,
) -> f64 {
    if first_channels == second_channels {
        return mac(first, second);
    }
    let common: Vec<(usize, usize)> = first_channels
        .iter()
        .enumerate()
        .filter_map(|(at, channel)| {
            let other = second_channels.iter().position(|other| other == channel)?;
            Some((at, other))
        })
        .collect();
    if common.len() < 2 {
        return 0.0;
    }
    let first = DVector::from_iterator(common.len(), common.iter().map(|(at, _)| first[*at]));
    let second = DVector::from_iterator(common.len(), common.iter().map(|(_, at)| second[*at]));
    mac(&first, &second)
}

#[cfg(test)]
mod tests;
