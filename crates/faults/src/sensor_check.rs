//! The check of all channels of a structure, one frame after the other.

use crate::channel::{ChannelHealth, Fault, Soundness};
use crate::hypothesis::{Comparison, Expected, Relation, Responses, compare};
use crate::memory::Memory;
use crate::reference::{ObservedRelation, SensorReference};
use crate::spectrum::{OVERLAP, Spectrum, Windows};
use serde::{Deserialize, Serialize};
use spandrel_structure::{CommonMotion, Structure};

/// Half-lives of the memories in windows. The short one notices a fault that begins, the long one
/// a small fault.
const HALF_LIVES: [f64; 2] = [1.0, 6.0];

/// Number of windows before the first comparison.
const FIRST: u64 = 3;

/// Probability of a fault above which a channel is in doubt.
const IN_DOUBT: f64 = 0.5;

/// Probability of a fault above which a channel is faulty.
const FAULTY: f64 = 0.99;

/// Probability of a fault below which a faulty channel counts as sound again.
const SOUND: f64 = 0.05;

/// Number of successive comparisons that make a channel faulty.
const FAULTY_AFTER: u32 = 2;

/// Number of successive comparisons that make a faulty channel sound.
const SOUND_AFTER: u32 = 2 * OVERLAP as u32;

/// Maximum number of channels that are compared with each other. The effort grows with the third
/// power.
const LARGEST_GROUP: usize = 24;

/// Ratio of the power of a channel to its stated noise from which it measures some motion. The others
/// must then measure it as well.
const LOUD: f64 = 4.0;

/// Scatter of the factors and delays of sound channels between events: standard deviations of the
/// logarithm of the factor, and of the delay in periods of the fundamental.
///
/// Painter Street: 5 to 7 % and 18 ms of 0.24 s (judging-real-structures).
const SCATTER: (f64, f64) = (0.06, 0.05);

/// The check of the channels of a structure.
#[derive(Debug, Clone)]
pub struct SensorCheck {
    groups: Vec<Group>,
    state: SensorCheckState,
}

/// The state of a check between two frames, as stored in a checkpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SensorCheckState {
    groups: Vec<GroupState>,
    /// One entry per channel of a frame. `None` for a channel without common motion.
    health: Vec<Option<ChannelHealth>>,
    /// Successive comparisons that support a change of each channel.
    support: Vec<u32>,
    /// Factors and delays of each channel so far.
    sums: Vec<Sums>,
}

/// Sums over all comparisons of the long memory.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
struct Sums {
    comparisons: u64,
    ln_gain: f64,
    delay_s: f64,
}

/// A change of the judgement of a channel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Change {
    /// The channel, as its index in a frame.
    pub channel: usize,
    /// The judgement before.
    pub before: Soundness,
    /// The judgement now.
    pub now: Soundness,
}

#[derive(Debug, Clone)]
struct Group {
    /// The ground is the first.
    channels: Vec<usize>,
    /// Stated noise of each channel (standard deviation, m/s²).
    noise_std: Vec<f64>,
    spectrum: Spectrum,
    responses: Responses,
    /// Expected without any records.
    usual: Vec<Expected>,
    expected: Vec<Expected>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct GroupState {
    windows: Windows,
    memories: Vec<Memory>,
    /// Whether a channel measures a motion that the others do not.
    is_incoherent: bool,
}

impl SensorCheck {
    /// Creates the check of a structure. Channels without a common motion are not checked.
    #[must_use]
    pub fn new(structure: &Structure) -> Self {
        let motions = structure.common_motions();
        let rate_hz = structure.sampling_rate_hz();
        let groups: Vec<Group> = motions
            .iter()
            .flat_map(|motion| Group::of(motion, rate_hz))
            .collect();
        let mut health = vec![None; structure.channel_count()];
        for channel in groups.iter().flat_map(|group| &group.channels) {
            health[*channel] = Some(ChannelHealth::default());
        }
        let state = SensorCheckState {
            groups: groups.iter().map(Group::empty).collect(),
            support: vec![0; health.len()],
            sums: vec![Sums::default(); health.len()],
            health,
        };
        Self { groups, state }
    }

    /// Returns what is known of each channel of a frame. `None` for a channel that cannot be
    /// checked.
    #[must_use]
    pub fn health(&self) -> &[Option<ChannelHealth>] {
        &self.state.health
    }

    /// Takes the values of a frame (SI units), NaN for missing ones. Returns the changes that it
    /// causes.
    pub fn take(&mut self, values: &[f64]) -> Vec<Change> {
        let mut changes = Vec::new();
        for (group, state) in self.groups.iter().zip(&mut self.state.groups) {
            let of_group = group.channels.iter().map(|channel| values[*channel]);
            let Some(window) = group.spectrum.take(&mut state.windows, of_group) else {
                continue;
            };
            for memory in &mut state.memories {
                memory.add(&window);
            }
            let compared = state
                .memories
                .iter()
                .map(|memory| {
                    let is_filled = memory.added() >= FIRST;
                    let compared = || compare(memory, &group.responses, &group.expected);
                    is_filled.then(compared).flatten()
                })
                .collect::<Vec<_>>();
            if let (Some(None), Some(short)) = (compared.first(), state.memories.first()) {
                state.is_incoherent = short.added() >= FIRST && group.is_loud(short);
            } else {
                state.is_incoherent = false;
            }
            if let Some(Some(long)) = compared.last() {
                for (relation, channel) in long.relations.iter().zip(&group.channels) {
                    if let Some(relation) = relation {
                        self.state.sums[*channel].add(relation);
                    }
                }
            }
            // Wind and traffic move a structure without the ground, and the channels differently.
            let is_without_ground = compared.iter().flatten().any(Comparison::is_without_first);
            let judged = if is_without_ground {
                1
            } else {
                group.channels.len()
            };
            for (member, channel) in group.channels.iter().enumerate().take(judged) {
                let Some(health) = &mut self.state.health[*channel] else {
                    continue;
                };
                // If probabilities are equal, the short memory describes the present fault better.
                let worst = compared
                    .iter()
                    .flatten()
                    .rev()
                    .max_by(|a, b| a.probabilities[member].total_cmp(&b.probabilities[member]));
                let Some(found) = worst else { continue };
                let support = &mut self.state.support[*channel];
                let before = health.soundness;
                group.judge(found, member, health, support);
                if health.soundness != before {
                    changes.push(Change {
                        channel: *channel,
                        before,
                        now: health.soundness,
                    });
                }
            }
        }
        changes
    }

    /// Returns `true` if a channel is suspected that does not count as faulty yet.
    ///
    /// This is also the case if a channel measures a motion that no other channel follows.
    #[must_use]
    pub fn is_in_doubt(&self) -> bool {
        let suspected = |health: &ChannelHealth| {
            health.soundness != Soundness::Faulty && health.probability > IN_DOUBT
        };
        self.state.health.iter().flatten().any(suspected)
            || self.state.groups.iter().any(|group| group.is_incoherent)
    }

    /// Returns the mean relation of each channel of a frame to the others so far. `None` without a
    /// comparison.
    #[must_use]
    pub fn observed(&self) -> Vec<Option<ObservedRelation>> {
        self.state.sums.iter().map(Sums::mean).collect()
    }

    /// Learns what sound sensors show from several records, each as returned by
    /// [`SensorCheck::observed`]. `names` contains the names of the channels of a frame.
    ///
    /// The scatter between the records is combined with the usual scatter, which counts as half a
    /// record.
    #[must_use]
    pub fn learn(
        &self,
        names: &[&str],
        records: &[Vec<Option<ObservedRelation>>],
    ) -> Vec<SensorReference> {
        let mut learnt = Vec::new();
        for group in &self.groups {
            for (channel, usual) in group.channels.iter().zip(&group.usual) {
                let of_channel = records.iter().filter_map(|record| *record.get(*channel)?);
                let found: Vec<ObservedRelation> = of_channel.collect();
                let is_new = |one: &SensorReference| one.channel != names[*channel];
                if !found.is_empty() && learnt.iter().all(is_new) {
                    learnt.push(SensorReference::of(names[*channel], &found, usual));
                }
            }
        }
        learnt
    }

    /// Expects what sound sensors have shown before, instead of the motion that the model predicts.
    pub fn expect(&mut self, names: &[&str], references: &[SensorReference]) {
        for group in &mut self.groups {
            for (channel, expected) in group.channels.iter().zip(&mut group.expected) {
                let known = references.iter().find(|one| one.channel == names[*channel]);
                if let Some(known) = known {
                    *expected = Expected {
                        ln_gain: (libm::log(known.gain), known.ln_gain_std),
                        delay_s: (known.delay_s, known.delay_std_s),
                    };
                }
            }
        }
    }

    /// Discards the samples so far, but keeps the judgements.
    pub fn forget_motion(&mut self) {
        self.state.groups = self.groups.iter().map(Group::empty).collect();
    }

    /// Returns the longest time that a comparison needs (s), 0 without any.
    #[must_use]
    pub fn window_s(&self) -> f64 {
        let windows = self.groups.iter().map(|group| group.spectrum.window_s());
        windows.fold(0.0, f64::max)
    }

    /// Returns the state for a checkpoint.
    #[must_use]
    pub fn state(&self) -> &SensorCheckState {
        &self.state
    }

    /// Restores the state of a checkpoint. Returns `false`, and changes nothing, if it belongs to
    /// other channels.
    #[must_use]
    pub fn restore(&mut self, state: SensorCheckState) -> bool {
        let fits = |(group, state): (&Group, &GroupState)| {
            let count = group.channels.len();
            state.windows.fits(count)
                && state.memories.len() == HALF_LIVES.len()
                && state.memories.iter().all(|memory| memory.fits(count))
        };
        let is_ours = state.groups.len() == self.groups.len()
            && state.health.len() == self.state.health.len()
            && state.support.len() == self.state.support.len()
            && state.sums.len() == self.state.sums.len()
            && self.groups.iter().zip(&state.groups).all(fits);
        if is_ours {
            self.state = state;
        }
        is_ours
    }
}

impl Sums {
    fn add(&mut self, relation: &Relation) {
        self.comparisons += 1;
        self.ln_gain += libm::log(relation.gain.abs().max(f64::MIN_POSITIVE));
        self.delay_s += relation.delay_s;
    }

    fn mean(&self) -> Option<ObservedRelation> {
        let count = self.comparisons as f64;
        (self.comparisons > 0).then(|| ObservedRelation {
            gain: libm::exp(self.ln_gain / count),
            delay_s: self.delay_s / count,
        })
    }
}

impl Group {
    /// Splits a common motion into groups of limited size. The ground belongs to each.
    fn of(motion: &CommonMotion, rate_hz: f64) -> Vec<Self> {
        let members: Vec<usize> = motion.channels().collect();
        let noise_std: Vec<f64> = motion.noise_std().collect();
        let Some(spectrum) = Spectrum::new(motion.fundamental_hz(), rate_hz) else {
            return Vec::new();
        };
        let others: Vec<usize> = (1..members.len()).collect();
        let parts = others.chunks(LARGEST_GROUP - 1);
        let group = |others: &[usize]| {
            let own: Vec<usize> = std::iter::once(0).chain(others.iter().copied()).collect();
            let expected = Expected {
                ln_gain: (0.0, SCATTER.0),
                delay_s: (0.0, SCATTER.1 / motion.fundamental_hz()),
            };
            Self {
                channels: own.iter().map(|member| members[*member]).collect(),
                noise_std: own.iter().map(|member| noise_std[*member]).collect(),
                responses: Responses::new(
                    own.len(),
                    spectrum.frequencies_hz().collect(),
                    motion.fundamental_hz(),
                    |member, hz| motion.response(own[member], hz),
                ),
                usual: vec![expected; own.len()],
                expected: vec![expected; own.len()],
                spectrum: spectrum.clone(),
            }
        };
        parts.map(group).collect()
    }

    fn empty(&self) -> GroupState {
        let count = self.channels.len();
        GroupState {
            windows: Windows::new(count),
            memories: HALF_LIVES
                .iter()
                .map(|half_life| Memory::new(count, *half_life))
                .collect(),
            is_incoherent: false,
        }
    }

    /// Returns `true` if a channel measures much more than its stated noise, and there are others to
    /// measure it as well.
    fn is_loud(&self, memory: &Memory) -> bool {
        if memory.present().iter().filter(|present| **present).count() < 2 {
            return false;
        }
        let of_noise = |noise_std: &f64| LOUD * noise_std * noise_std * self.spectrum.noise_power();
        let mut all = self.noise_std.iter().enumerate();
        all.any(|(member, noise_std)| memory.mean_power(member) > of_noise(noise_std))
    }

    /// Updates what is known of a member by a comparison.
    fn judge(
        &self,
        found: &Comparison,
        member: usize,
        health: &mut ChannelHealth,
        support: &mut u32,
    ) {
        let Some(relation) = &found.relations[member] else {
            return;
        };
        let probability = found.probabilities[member];
        // A single suspicious comparison can be a transient, such as the start of a motion.
        let was_suspected = health.probability > IN_DOUBT;
        *health = ChannelHealth {
            probability,
            gain: Some(relation.gain),
            delay_s: Some(relation.delay_s),
            coherence: Some(relation.coherence),
            ..*health
        };
        let is_faulty = health.soundness == Soundness::Faulty;
        let supports_change = match is_faulty {
            true => probability < SOUND,
            false => probability > FAULTY,
        };
        *support = if supports_change { *support + 1 } else { 0 };
        let needed = if is_faulty { SOUND_AFTER } else { FAULTY_AFTER };
        let changes = *support >= needed;
        health.soundness = match (is_faulty, changes) {
            (true, false) | (false, true) => Soundness::Faulty,
            (true, true) => Soundness::Sound,
            (false, false) if probability <= IN_DOUBT => Soundness::Sound,
            (false, false) if was_suspected => Soundness::InDoubt,
            (false, false) => health.soundness,
        };
        if changes {
            *support = 0;
        }
        let fault: Option<Fault> = match health.soundness {
            Soundness::Sound | Soundness::Unchecked => None,
            Soundness::InDoubt | Soundness::Faulty if probability > IN_DOUBT => {
                Some(relation.fault(&self.expected[member]))
            }
            Soundness::InDoubt | Soundness::Faulty => health.fault,
        };
        health.fault = fault;
    }
}

#[cfg(test)]
mod tests;
