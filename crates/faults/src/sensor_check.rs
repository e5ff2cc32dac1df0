//! The check of all channels of a structure, one frame after the other.

use crate::channel::{ChannelHealth, Fault, Soundness};
use crate::clipping::Extremes;
use crate::finding::{Evidence, Finding};
use crate::hypothesis::{
    Comparison, Expected, INCOHERENT_SHARE, Relation, Responses, compare, delay_share,
};
use crate::memory::Memory;
use crate::offset::Offsets;
use crate::profile::{BandFilters, BandPowers, ProfileReference, most_probable_exchange};
use crate::reference::{ObservedRelation, SensorReference, delay_scatter_s};
use crate::resonance::Resonances;
use crate::spectrum::{Coefficients, OVERLAP, Spectrum, Windows};
use nalgebra::Complex;
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
///
/// With 0.9, more small factors are named. A sound sensor is then excluded during one of twelve
/// simulated losses of 40 % (docs/theory/sensor-faults.md).
const FAULTY: f64 = 0.99;

/// Probability of a fault below which a faulty channel counts as sound again.
const SOUND: f64 = 0.05;

/// Number of successive comparisons that make a channel faulty.
const FAULTY_AFTER: u32 = 2;

/// Number of successive comparisons that make a faulty channel sound.
const SOUND_AFTER: u32 = 2 * OVERLAP as u32;

/// Number of successive windows that show an exchange. The last one shares no sample with the
/// first.
const EXCHANGED_AFTER: u32 = OVERLAP as u32 + 1;

/// Half-life of the band powers in windows.
const PROFILE_HALF_LIFE: f64 = 6.0;

/// Maximum number of channels that are compared with each other. The effort grows with the third
/// power.
const LARGEST_GROUP: usize = 24;

/// Ratio of the power of a channel to its stated noise from which it measures some motion. The
/// others must then measure it as well.
const LOUD: f64 = 4.0;

/// Minimum power at which a motion below the stated noise is compared: as a ratio to the power of
/// the quietest window, and as a ratio to the power in the memory.
///
/// Larger ratios suspect fewer sound sensors and name fewer faults (docs/theory/sensor-faults.md).
const AGAINST_QUIET: f64 = 4.0;
const AGAINST_EARLIER: f64 = 0.1;

/// Scatter of the factors and delays of sound channels between events: standard deviations of the
/// logarithm of the factor, and of the delay in periods of the fundamental.
///
/// Painter Street: 5 to 7 % and 18 ms of 0.24 s (judging-real-structures).
const SCATTER: (f64, f64) = (0.06, 0.05);

/// Checks all channels of a structure for faults, by comparing their motion.
///
/// [`SensorCheck::take`] takes one frame after the other and returns each change of a judgement. By
/// default, the check expects the motion that the model predicts. [`SensorCheck::expect`] replaces
/// this with references from records.
///
/// A channel without common motion with others is not checked, and its health is `None`.
/// [`SensorCheck::state`] and [`SensorCheck::restore`] write and read a checkpoint.
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
    /// The most probable fault now. `None` for a channel that works.
    pub fault: Option<Fault>,
}

/// What a complete window shows of the channels of a group.
#[derive(Debug)]
struct Shown<'a> {
    group: &'a Group,
    /// Whether the window has samples of each channel.
    is_present: Vec<bool>,
    /// Fault of each channel that is found without the common motion.
    faults: Vec<Option<Fault>>,
    /// Comparison by each memory. `None` without enough motion.
    compared: Vec<Option<Comparison>>,
}

#[derive(Debug, Clone)]
struct Group {
    /// The ground is the first.
    channels: Vec<usize>,
    /// Stated noise of each channel (standard deviation, m/s²).
    noise_std: Vec<f64>,
    spectrum: Spectrum,
    /// Whether the windows contain a second series of each channel, without spikes.
    is_screened: bool,
    responses: Responses,
    resonances: Resonances,
    /// Expected without any records.
    usual: Vec<Expected>,
    expected: Vec<Expected>,
    /// Acceleration of each channel for a slow ground acceleration of 1.
    rigid: Vec<f64>,
    filters: BandFilters,
    /// Learnt profile of each channel. Exchanges are only found if all are known.
    profiles: Vec<Option<ProfileReference>>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct GroupState {
    /// Motion of the quietest window (power per bin, relative to the ground).
    quietest: f64,
    /// The channels as measured, and then without spikes if the structure screens outliers.
    windows: Windows,
    memories: Vec<Memory>,
    /// Whether a channel measures a motion that the others do not.
    is_incoherent: bool,
    offsets: Offsets,
    powers: BandPowers,
    extremes: Vec<Extremes>,
    findings: Vec<Findings>,
}

/// The faults of a channel that are found without the common motion.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
struct Findings {
    exchange: Finding,
    drift: Finding,
    clipping: Finding,
}

impl SensorCheck {
    /// Creates the check of a structure. Channels without a common motion are not checked.
    #[must_use]
    pub fn new(structure: &Structure) -> Self {
        let motions = structure.common_motions();
        let rate_hz = structure.sampling_rate_hz();
        let groups: Vec<Group> = motions
            .iter()
            .flat_map(|motion| Group::of(motion, rate_hz, structure.screens_outliers()))
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

    /// Returns the health of each channel of a frame. `None` for a channel that cannot be checked.
    #[must_use]
    pub fn health(&self) -> &[Option<ChannelHealth>] {
        &self.state.health
    }

    /// Takes the values of a frame (SI units), NaN for missing ones. Returns the changes that it
    /// causes.
    pub fn take(&mut self, values: &[f64]) -> Vec<Change> {
        self.take_screened(values, values)
    }

    /// Takes the values of a frame as measured, and without the spikes that a screening has found.
    /// Otherwise like [`SensorCheck::take`].
    ///
    /// A screening with a wrong model takes motion for spikes. A spike that remains and a motion
    /// that is missing both disturb the low band. Of the two series of a channel, each window
    /// therefore uses the one that follows the other channels better. The first series counts alone
    /// if the structure has no screening.
    pub fn take_screened(&mut self, measured: &[f64], without_spikes: &[f64]) -> Vec<Change> {
        let groups = self.groups.iter().zip(&mut self.state.groups);
        let shown: Vec<Shown> = groups
            .filter_map(|(group, state)| group.take(state, measured, without_spikes))
            .collect();
        self.state.judge(&shown)
    }

    /// Returns the length of data (s) that the first comparison of a channel requires, if the data
    /// since the last gap are shorter. `None` if they are long enough, or if the channel is not
    /// checked.
    ///
    /// `channel` is an index in a frame.
    #[must_use]
    pub fn required_s(&self, channel: usize) -> Option<f64> {
        let groups = self.groups.iter().zip(&self.state.groups);
        let required = groups
            .filter(|(group, _)| group.channels.contains(&channel))
            .map(|(group, state)| {
                // Windows without motion are not in the memories.
                let is_short = state.memories.iter().all(|memory| memory.added() < FIRST)
                    && u64::from(state.powers.windows()) < FIRST;
                let windows = 1.0 + (FIRST - 1) as f64 / OVERLAP as f64;
                is_short.then_some(windows * group.spectrum.window_s())
            });
        let required = required.collect::<Option<Vec<f64>>>()?;
        required.into_iter().reduce(f64::min)
    }

    /// Returns the channels that are in doubt or faulty, as indices in a frame.
    pub fn suspected(&self) -> impl Iterator<Item = usize> {
        let health = self.state.health.iter().enumerate();
        let is_suspected = |health: ChannelHealth| {
            health.soundness == Soundness::Faulty || health.probability > IN_DOUBT
        };
        health
            .filter(move |(_, health)| health.is_some_and(is_suspected))
            .map(|(channel, _)| channel)
    }

    /// Returns `true` if a used channel is suspected, but does not count as faulty yet. `is_used`
    /// receives the index of a channel in a frame.
    ///
    /// This is also the case if a channel measures a motion that no other channel follows.
    #[must_use]
    pub fn is_in_doubt(&self, is_used: impl Fn(usize) -> bool) -> bool {
        let suspected = |health: &ChannelHealth| {
            health.soundness != Soundness::Faulty && health.probability > IN_DOUBT
        };
        let mut health = self.state.health.iter().enumerate();
        health.any(|(channel, health)| health.as_ref().is_some_and(suspected) && is_used(channel))
            || self.state.groups.iter().any(|group| group.is_incoherent)
    }

    /// Returns the mean relation of each channel of a frame to the others so far. `None` without a
    /// comparison.
    #[must_use]
    pub fn observed(&self) -> Vec<Option<ObservedRelation>> {
        let mut observed: Vec<Option<ObservedRelation>> =
            self.state.sums.iter().map(Sums::mean).collect();
        for (group, state) in self.groups.iter().zip(&self.state.groups) {
            let profiles = state.powers.mean_profiles();
            for (member, channel) in group.channels.iter().enumerate() {
                if let Some(relation) = &mut observed[*channel] {
                    relation.profile = profiles.as_ref().map(|all| all[member]);
                }
            }
        }
        observed
    }

    /// Learns a reference for each channel from `records`, each as returned by
    /// [`SensorCheck::observed`]. `names` contains the names of the channels in frame order.
    ///
    /// The result omits channels that no record has observed. It is empty if there are no records.
    ///
    /// The scatter between the records is pooled with the usual scatter, which has the weight of
    /// half a record. The scatter of the delays is limited by an upper bound of what all channels
    /// of the same motion have shown in the records.
    ///
    /// # Panics
    /// Panics if `names` does not contain a name for an observed channel.
    #[must_use]
    pub fn learn(
        &self,
        names: &[&str],
        records: &[Vec<Option<ObservedRelation>>],
    ) -> Vec<SensorReference> {
        let mut learnt = Vec::new();
        for group in &self.groups {
            let of_channel = |channel: &usize| -> Vec<ObservedRelation> {
                let records = records.iter();
                records
                    .filter_map(|record| *record.get(*channel)?)
                    .collect()
            };
            let found: Vec<Vec<ObservedRelation>> = group.channels.iter().map(of_channel).collect();
            let delays_s = |found: &Vec<ObservedRelation>| -> Vec<f64> {
                found.iter().map(|one| one.delay_s).collect()
            };
            let delays_s: Vec<Vec<f64>> = found.iter().map(delays_s).collect();
            let period_s = 1.0 / group.responses.fundamental_hz();
            let of_group_s = delay_scatter_s(&delays_s, period_s);
            let of_channels = group.channels.iter().zip(&group.usual).zip(&found);
            for ((channel, usual), found) in of_channels {
                let name = names[*channel];
                let is_new = |one: &SensorReference| one.channel != name;
                if !found.is_empty() && learnt.iter().all(is_new) {
                    learnt.push(SensorReference::of(name, found, usual, of_group_s));
                }
            }
        }
        learnt
    }

    /// Replaces the expected behaviour of the channels, predicted by the model, with `references`.
    /// `names` contains the names of the channels in frame order.
    pub fn expect(&mut self, names: &[&str], references: &[SensorReference]) {
        for group in &mut self.groups {
            let fundamental_hz = group.responses.fundamental_hz();
            let of_channels = group.expected.iter_mut().zip(&mut group.profiles);
            for (channel, (expected, profile)) in group.channels.iter().zip(of_channels) {
                let known = references.iter().find(|one| one.channel == names[*channel]);
                if let Some(known) = known {
                    *profile = known.profile;
                    *expected = Expected {
                        ln_gain: (libm::log(known.gain), known.ln_gain_std),
                        delay_s: (known.delay_s, known.delay_std_s),
                        delay_share: delay_share(known.delay_std_s * fundamental_hz),
                    };
                }
            }
        }
    }

    /// Discards the samples so far, but keeps the judgements.
    pub fn forget_motion(&mut self) {
        for (group, state) in self.groups.iter().zip(&mut self.state.groups) {
            state.powers.forget();
            let empty = group.empty();
            *state = GroupState {
                powers: state.powers.clone(),
                quietest: state.quietest,
                findings: std::mem::take(&mut state.findings),
                ..empty
            };
        }
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
            group.spectrum.fits(&state.windows, group.series())
                && state.memories.len() == HALF_LIVES.len()
                && state.memories.iter().all(|memory| memory.fits(count))
                && state.offsets.fits(count)
                && state.powers.fits(count)
                && state.extremes.len() == count
                && state.findings.len() == count
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

impl Shown<'_> {
    /// Returns the channel of the ground.
    fn ground(&self) -> usize {
        self.group.channels[0]
    }

    /// Returns `true` if the channels move differently, and the structure without the ground. Wind
    /// and traffic do this.
    fn is_without_ground(&self) -> bool {
        let mut compared = self.compared.iter().flatten();
        compared.any(Comparison::is_without_first)
    }
}

impl SensorCheckState {
    /// Judges the channels of the groups that have completed a window. Returns the changes.
    fn judge(&mut self, shown: &[Shown]) -> Vec<Change> {
        let mut changes = Vec::new();
        for (number, own) in shown.iter().enumerate() {
            if let Some(Some(long)) = own.compared.last() {
                for (relation, channel) in long.relations.iter().zip(&own.group.channels) {
                    if let Some(relation) = relation {
                        self.sums[*channel].add(relation);
                    }
                }
            }
            // The ground belongs to all groups of a motion. The first one judges it with the
            // results of all of them. Otherwise, their judgements would alternate.
            let has_ground = |other: &&Shown| other.ground() == own.ground();
            let (earlier, present) = shown.split_at(number);
            if !earlier.iter().any(|other| has_ground(&other)) {
                let all: Vec<&Shown> = present.iter().filter(has_ground).collect();
                changes.extend(self.judge_member(0, &all));
            }
            for member in 1..own.group.channels.len() {
                changes.extend(self.judge_member(member, &[own]));
            }
        }
        changes
    }

    /// Judges a channel by what the groups with this channel show. It is the same member of each.
    fn judge_member(&mut self, member: usize, shown: &[&Shown]) -> Option<Change> {
        let channel = *shown.first()?.group.channels.get(member)?;
        let health = self.health[channel].as_mut()?;
        let support = &mut self.support[channel];
        let before = health.soundness;
        let found = shown.iter().find_map(|one| one.faults[member]);
        let is_present = shown.iter().any(|one| one.is_present[member]);
        if settle(health, found, is_present) {
            *support = 0;
            return Change::between(channel, before, health);
        }
        if member > 0 && shown.iter().any(|one| one.is_without_ground()) {
            return None;
        }
        let compared = shown.iter().flat_map(|one| {
            // If probabilities are equal, the short memory describes the present fault better.
            let of_group = one.compared.iter().flatten().rev();
            of_group.map(|compared| (one.group, compared))
        });
        let (group, worst) = compared
            .max_by(|(_, a), (_, b)| a.probabilities[member].total_cmp(&b.probabilities[member]))?;
        group.judge(worst, member, health, support);
        Change::between(channel, before, health)
    }
}

impl Change {
    fn between(channel: usize, before: Soundness, health: &ChannelHealth) -> Option<Self> {
        (health.soundness != before).then_some(Self {
            channel,
            before,
            now: health.soundness,
            fault: health.fault,
        })
    }
}

impl Findings {
    fn fault(&self) -> Option<Fault> {
        let all = [self.exchange, self.drift, self.clipping];
        all.iter().find_map(Finding::fault)
    }
}

/// Updates what is known of a channel without the common motion. Returns `false` if the common
/// motion must decide.
fn settle(health: &mut ChannelHealth, found: Option<Fault>, is_present: bool) -> bool {
    let had_finding = matches!(
        health.fault,
        Some(Fault::Exchanged | Fault::Drift(_) | Fault::Clipped(_))
    );
    match found {
        Some(_) => {
            (health.soundness, health.probability) = (Soundness::Faulty, 1.0);
            health.fault = found;
        }
        None if had_finding => {
            (health.soundness, health.probability) = (Soundness::Sound, 0.0);
            health.fault = None;
        }
        // A channel without samples cannot be compared any more.
        None if !is_present && health.soundness != Soundness::Faulty => {
            *health = ChannelHealth::default();
        }
        None => return false,
    }
    true
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
            profile: None,
        })
    }
}

impl Group {
    /// Splits a common motion into groups of limited size. The ground belongs to each.
    fn of(motion: &CommonMotion, rate_hz: f64, is_screened: bool) -> Vec<Self> {
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
                delay_share: INCOHERENT_SHARE,
            };
            Self {
                channels: own.iter().map(|member| members[*member]).collect(),
                noise_std: own.iter().map(|member| noise_std[*member]).collect(),
                responses: Responses::new(
                    own.len(),
                    spectrum.low_hz(),
                    motion.fundamental_hz(),
                    |member, hz| motion.response(own[member], hz),
                ),
                resonances: Resonances::new(motion, &own, &spectrum.wide_hz()),
                usual: vec![expected; own.len()],
                expected: vec![expected; own.len()],
                rigid: own
                    .iter()
                    .map(|member| motion.response(*member, 0.0).re)
                    .collect(),
                filters: BandFilters::new(motion.fundamental_hz(), rate_hz),
                profiles: vec![None; own.len()],
                spectrum: spectrum.clone(),
                is_screened,
            }
        };
        parts.map(group).collect()
    }

    /// Processes the values of a frame. Returns the result of a window once it is complete.
    fn take(
        &self,
        state: &mut GroupState,
        measured: &[f64],
        without_spikes: &[f64],
    ) -> Option<Shown<'_>> {
        let of_channels = |values: &'_ [f64]| -> Vec<f64> {
            let values = self.channels.iter().map(|channel| values[*channel]);
            values.collect()
        };
        let measured = of_channels(measured);
        let without_spikes = of_channels(without_spikes);
        let of_group = || without_spikes.iter().copied();
        let weight = self.spectrum.weight_in_quarter(&state.windows);
        state.offsets.take(of_group(), weight);
        state.powers.take(&self.filters, of_group());
        for (extremes, value) in state.extremes.iter_mut().zip(of_group()) {
            extremes.take(value);
        }
        let both = measured.iter().copied().chain(of_group());
        let series = both.take(self.series());
        let mut window = self.spectrum.take(&mut state.windows, series)?;
        if self.is_screened {
            window = window.most_coherent();
        }
        self.find(state, &window);
        // Noise would take the place of an earlier motion, and noise of sound sensors differs.
        let longest = state.memories.last();
        let shows_motion =
            longest.is_some_and(|memory| self.shows_motion(&window, memory, &mut state.quietest));
        if shows_motion {
            for memory in &mut state.memories {
                memory.add(&window);
            }
        }
        let compared: Vec<Option<Comparison>> = state
            .memories
            .iter()
            .map(|memory| {
                let has_news = shows_motion && memory.added() >= FIRST;
                let compared = || self.compare(memory);
                has_news.then(compared).flatten()
            })
            .collect();
        if let (Some(None), Some(short)) = (compared.first(), state.memories.first()) {
            state.is_incoherent = shows_motion && short.added() >= FIRST && self.is_loud(short);
        } else {
            state.is_incoherent = false;
        }
        Some(Shown {
            group: self,
            is_present: window.of_channels.iter().map(Option::is_some).collect(),
            faults: state.findings.iter().map(Findings::fault).collect(),
            compared,
        })
    }

    /// Returns the number of series in a window.
    fn series(&self) -> usize {
        self.channels.len() * if self.is_screened { 2 } else { 1 }
    }

    fn empty(&self) -> GroupState {
        let count = self.channels.len();
        GroupState {
            quietest: f64::INFINITY,
            windows: self.spectrum.windows(self.series()),
            memories: HALF_LIVES
                .iter()
                .map(|half_life| Memory::new(count, *half_life))
                .collect(),
            is_incoherent: false,
            offsets: Offsets::new(count),
            powers: BandPowers::new(count),
            extremes: vec![Extremes::default(); count],
            findings: vec![Findings::default(); count],
        }
    }

    fn compare(&self, memory: &Memory) -> Option<Comparison> {
        compare(memory, &self.responses, &self.resonances, &self.expected)
    }

    /// Searches a window for faults that the common motion does not show.
    fn find(&self, state: &mut GroupState, window: &Coefficients) {
        let step_s = self.spectrum.window_s() / OVERLAP as f64;
        let offsets = state.offsets.close(step_s, &self.rigid, &self.noise_std);
        let is_complete = window.of_channels.iter().all(Option::is_some);
        let kept = libm::exp2(-1.0 / (PROFILE_HALF_LIFE * OVERLAP as f64));
        state.powers.close(kept, is_complete);
        let exchanges = self.exchanges(&state.powers);
        for (member, findings) in state.findings.iter_mut().enumerate() {
            findings
                .drift
                .take(offsets[member], FAULTY_AFTER, SOUND_AFTER);
            let clipping = state.extremes[member].close();
            findings.clipping.take(clipping, FAULTY_AFTER, SOUND_AFTER);
            findings
                .exchange
                .take(exchanges[member], EXCHANGED_AFTER, SOUND_AFTER);
        }
    }

    /// Returns for each channel whether it is exchanged.
    fn exchanges(&self, powers: &BandPowers) -> Vec<Evidence> {
        let references: Option<Vec<ProfileReference>> = self.profiles.iter().copied().collect();
        let Some(references) = references.filter(|_| powers.windows() >= OVERLAP as u32) else {
            return vec![Evidence::Open; self.channels.len()];
        };
        let profiles = powers.profiles();
        let own = references.iter().zip(&profiles);
        let of_own = own.map(|(reference, profile)| match reference.agrees(profile) {
            true => Evidence::Sound,
            false => Evidence::Open,
        });
        let mut evidence: Vec<Evidence> = of_own.collect();
        if let Some(exchange) = most_probable_exchange(&profiles, &references) {
            let (first, second) = exchange.channels;
            if exchange.probability > FAULTY {
                evidence[first] = Evidence::Fault(Fault::Exchanged);
                evidence[second] = Evidence::Fault(Fault::Exchanged);
            }
        }
        evidence
    }

    /// Returns the power per bin of the stated noise of a channel.
    fn noise_power(&self, member: usize) -> f64 {
        self.noise_std[member].powi(2) * self.spectrum.noise_power()
    }

    /// Returns `true` if the motion of a window is large enough for a comparison.
    ///
    /// Motion below the stated noise of half of the channels must stand out from the quietest
    /// window, and must not be much smaller than that in `memory`. The channel with the largest
    /// motion counts, because the others can be dead.
    fn shows_motion(&self, window: &Coefficients, memory: &Memory, quietest: &mut f64) -> bool {
        let of_ground = |member: usize| self.rigid[member].powi(2).recip();
        let (mut motion, mut noises) = (0.0_f64, Vec::new());
        for member in 0..self.channels.len() {
            if let Some(bins) = window.low(member) {
                let power: f64 = bins.iter().map(Complex::norm_sqr).sum();
                motion = motion.max(of_ground(member) * power / bins.len() as f64);
                noises.push(of_ground(member) * self.noise_power(member));
            }
        }
        noises.sort_unstable_by(f64::total_cmp);
        let Some(noise) = noises.get(noises.len().saturating_sub(1) / 2) else {
            return false;
        };
        let members = (0..self.channels.len()).filter(|member| memory.present()[*member]);
        let earlier = members.map(|member| of_ground(member) * memory.mean_power(member));
        let earlier = earlier.fold(0.0, f64::max);
        *quietest = quietest.min(motion);
        motion > *noise
            || (motion > AGAINST_EARLIER * earlier && motion > AGAINST_QUIET * *quietest)
    }

    /// Returns `true` if a channel measures much more than its stated noise, and there are others
    /// to measure it as well.
    fn is_loud(&self, memory: &Memory) -> bool {
        if memory.present().iter().filter(|present| **present).count() < 2 {
            return false;
        }
        let mut members = 0..self.channels.len();
        members.any(|member| memory.mean_power(member) > LOUD * self.noise_power(member))
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
