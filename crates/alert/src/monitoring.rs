//! Whether the present data would reveal damage, per structure, parameter and channel.
//!
//! An old estimate does not show whether a part is still sound. This module therefore looks at what
//! arrives now: the share of samples that the filter uses, and the rate at which it learns about
//! each parameter. It has no clock: the passage of time is an argument.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Duration;

use spandrel_bus::{
    Block, ChannelMonitoring, EstimateBlock, MonitoringDisplay, MonitoringState as State, Name,
    ParameterMonitoring, Phase, REFERENCE_IS_LEARNT, SensorHealthDisplay, Soundness, Status,
    StreamState, UndecidedBecause,
};
use spandrel_structure::Structure;

use crate::decision::Vigilance;
use crate::wording::{RESPONSE_IS_SILENT, SENSORS_DISAGREE};
use crate::{AlertError, Watch};

/// Span of measurement time over which shares of used samples are computed, s.
const SPAN_S: f64 = 5.0;
/// Number of segments of this span.
const SEGMENTS: usize = 10;
/// Share of the expected samples below which a channel is degraded.
const DEGRADED_BELOW: f64 = 0.9;
/// Share of the expected samples below which a channel is blind.
const BLIND_BELOW: f64 = 0.05;
/// Time without estimates after which the structure is blind.
const SILENT_AFTER: Duration = Duration::from_secs(3);
/// Number of estimates that may be missing before the structure is blind. A station publishes
/// estimates at the fusion rate only.
const ESTIMATES_MISSED: f64 = 3.0;
/// Maximum number of names in a reason.
const NAMES_SHOWN: usize = 6;

/// The monitoring of one structure.
#[derive(Debug)]
pub(crate) struct Monitoring {
    structure: Name,
    parameters: Vec<WatchedParameter>,
    /// The response channels.
    channels: Vec<WatchedChannel>,
    /// The channels that measure an excitation.
    excitations: Vec<WatchedChannel>,
    /// Share of the latest frames without a sample, for the channels that miss samples.
    missing: BTreeMap<Name, f64>,
    /// Rate of the estimates, Hz: that of the frames, or of the fusion.
    rate_hz: f64,
    /// Segments of the span, oldest first. The last one is incomplete.
    segments: VecDeque<Segment>,
    last: Option<Last>,
    state: Option<Judged>,
    /// A state found only by the latest judgement.
    candidate: Option<State>,
    /// Whether the estimates contain the innovations of the channels.
    knows_channels: bool,
    /// Nodes whose clock differs from that of most nodes, and the difference, s: positive if ahead.
    wrong_clocks: Vec<(Name, f64)>,
    /// Channels that are probably faulty.
    suspects: BTreeSet<Name>,
}

#[derive(Debug)]
struct WatchedParameter {
    name: Name,
    prior_std: f64,
}

#[derive(Debug)]
struct WatchedChannel {
    name: Name,
    /// Number of samples of the channel per frame, at most 1.
    samples_per_frame: f64,
}

/// Frames of one segment, and how many of them used each channel.
#[derive(Debug, Default)]
struct Segment {
    frames: u64,
    predicted: u64,
    used: Vec<u64>,
}

/// What the last block showed.
#[derive(Debug)]
struct Last {
    measured_ns: i64,
    state: StreamState,
    phase: Phase,
    sustained_information: Vec<f32>,
}

/// The present state of the structure, with its reasons.
#[derive(Debug, Clone)]
struct Judged {
    state: State,
    /// Wall-clock time since which the state has lasted, ns.
    since_ns: i64,
    reasons: Vec<String>,
}

/// A change of the state, with the state before.
#[derive(Debug, PartialEq)]
pub(crate) struct Change {
    pub(crate) before: State,
    pub(crate) display: MonitoringDisplay,
}

impl Monitoring {
    /// Creates the monitoring of a structure without any data.
    ///
    /// # Errors
    /// Returns an error if the name of a parameter or channel cannot be a key.
    pub(crate) fn new(structure: &Structure) -> Result<Self, AlertError> {
        let named = |text: &str| {
            Name::new(text).map_err(|source| AlertError::Name {
                found: text.to_owned(),
                source,
            })
        };
        let parameters = structure.parameters().iter().map(|parameter| {
            Ok(WatchedParameter {
                name: named(parameter.name())?,
                prior_std: parameter.std(),
            })
        });
        let rate_hz = structure.sampling_rate_hz();
        let of_nodes = structure.nodes().iter().flat_map(|node| {
            let node_rate_hz = node.sampling_rate_hz().unwrap_or(rate_hz);
            let samples_per_frame = (node_rate_hz / rate_hz).min(1.0);
            node.channels()
                .iter()
                .map(move |channel| (channel.name(), samples_per_frame))
        });
        let of_nodes: Vec<(&str, f64)> = of_nodes.collect();
        let watched = |index: &usize| {
            let (name, share) = of_nodes.get(*index)?;
            Some(named(name).map(|name| WatchedChannel {
                name,
                samples_per_frame: *share,
            }))
        };
        let observed = structure.observation_channels();
        let mut excitations: Vec<usize> = Vec::new();
        for channel in structure.excitation_channels().iter().flatten() {
            if !excitations.contains(channel) && !observed.contains(channel) {
                excitations.push(*channel);
            }
        }
        let channels = observed.iter().filter_map(watched);
        Ok(Self {
            structure: named(structure.name())?,
            parameters: parameters.collect::<Result<_, AlertError>>()?,
            channels: channels.collect::<Result<_, AlertError>>()?,
            excitations: { excitations.iter().filter_map(watched) }
                .collect::<Result<_, AlertError>>()?,
            missing: BTreeMap::new(),
            rate_hz,
            segments: VecDeque::new(),
            last: None,
            state: None,
            candidate: None,
            knows_channels: false,
            wrong_clocks: Vec::new(),
            suspects: BTreeSet::new(),
        })
    }

    /// Takes the clocks of the nodes and the missing samples from the status of ingest.
    pub(crate) fn take_status(&mut self, of_ingest: &Status) {
        self.missing = of_ingest.missing.clone();
        let clocks = of_ingest.clocks.iter();
        let wrong = clocks.filter_map(|(node, clock)| Some((node.clone(), clock.difference_s?)));
        self.wrong_clocks = wrong.collect();
    }

    /// Takes the comparison of the sensors of one node with the others.
    pub(crate) fn take_health(&mut self, of_node: &SensorHealthDisplay) {
        for channel in &of_node.channels {
            match channel.state {
                Soundness::InDoubt | Soundness::Faulty => {
                    self.suspects.insert(channel.channel.clone());
                }
                Soundness::Sound | Soundness::Unchecked => {
                    self.suspects.remove(&channel.channel);
                }
            }
        }
    }

    /// Returns `true` if nothing is decided because a sensor is in doubt.
    pub(crate) fn has_sensor_in_doubt(&self) -> bool {
        let last = self.last.as_ref();
        last.is_some_and(|last| last.phase == Phase::SensorInDoubt)
    }

    /// Returns `true` if no sensor of the response has delivered a sample for some time.
    fn is_response_silent(&self) -> bool {
        let last = self.last.as_ref();
        last.is_some_and(|last| last.phase == Phase::ResponseSilent)
    }

    /// Clears the list of the sensors in doubt.
    pub(crate) fn clear_suspects(&mut self) {
        self.suspects.clear();
    }

    /// Returns the reason in words. A sensor that is probably faulty is named, if it is known.
    fn words(&self, because: UndecidedBecause) -> String {
        match because {
            UndecidedBecause::SensorInDoubt if self.suspects.is_empty() => {
                SENSORS_DISAGREE.to_owned()
            }
            UndecidedBecause::SensorInDoubt => {
                format!("{}: {}", because.words(), listed(self.suspects.iter()))
            }
            UndecidedBecause::NothingLearnt if self.is_response_silent() => {
                RESPONSE_IS_SILENT.to_owned()
            }
            _ => because.words().to_owned(),
        }
    }

    /// Returns the state and the reason of a parameter with a rule.
    fn of_vigilance(&self, vigilance: Vigilance) -> (State, Option<String>) {
        let (state, why) = match vigilance {
            Vigilance::Undecided(because) => return (State::Blind, Some(self.words(because))),
            Vigilance::Watching => return (State::Watching, None),
            Vigilance::LearnsLittle => {
                (State::Degraded, "damage would be detected later than usual")
            }
            Vigilance::LearnsReference => (State::Blind, REFERENCE_IS_LEARNT),
            Vigilance::LearnsNothing => (
                State::Blind,
                "the present data contain no information; the estimate depends on earlier data",
            ),
        };
        (state, Some(why.to_owned()))
    }

    /// Counts the used samples of a block.
    pub(crate) fn take(&mut self, block: &EstimateBlock) {
        if let (Some(estimate), Some(grid)) = (block.estimates.last(), block.grid()) {
            self.last = Some(Last {
                measured_ns: grid.time_ns(block.end().saturating_sub(1)),
                state: block.state,
                phase: estimate.flags.phase,
                sustained_information: estimate.sustained_information.clone(),
            });
        } else if let Some(last) = &mut self.last {
            last.state = block.state;
        }
        self.rate_hz = block.sampling_rate_hz;
        self.knows_channels = block.channels > 0;
        let segment_frames = ((SPAN_S * self.rate_hz / SEGMENTS as f64) as u64).max(1);
        for estimate in &block.estimates {
            let is_full = |segment: &Segment| segment.frames >= segment_frames;
            if self.segments.back().is_none_or(is_full) {
                if self.segments.len() > SEGMENTS {
                    self.segments.pop_front();
                }
                self.segments.push_back(Segment {
                    used: vec![0; self.channels.len()],
                    ..Segment::default()
                });
            }
            let Some(segment) = self.segments.back_mut() else {
                continue; // one was just added
            };
            segment.frames += 1;
            segment.predicted += u64::from(estimate.flags.prediction_only);
            for (used, innovation) in segment.used.iter_mut().zip(&estimate.innovations) {
                *used += u64::from(!innovation.is_nan());
            }
        }
    }

    /// Judges the state at the wall-clock time `now_ns` (ns since the Unix epoch, UTC). `silence`
    /// is the time since the last block of estimates.
    ///
    /// Returns the display, and a change if the state has changed. A new state counts from its
    /// second judgement, because the first may be an accident.
    pub(crate) fn judge(
        &mut self,
        watch: &Watch,
        silence: Duration,
        now_ns: i64,
    ) -> (MonitoringDisplay, Option<Change>) {
        let parameters = self.parameter_states(watch);
        let mut channels = self.channel_states();
        let has_response = !self.is_without_response(&channels) && !self.is_response_silent();
        if self.knows_channels {
            channels.extend(self.excitation_states());
        }
        let (found, reasons) =
            self.structure_state(watch, &parameters, &channels, has_response, silence);
        let is_repeated = self.candidate.replace(found) == Some(found);
        let before = self.state.take();
        let judged = match &before {
            Some(before) if before.state == found => Judged {
                reasons,
                ..before.clone()
            },
            Some(before) if !is_repeated => before.clone(),
            _ => Judged {
                state: found,
                since_ns: now_ns,
                reasons,
            },
        };
        let display = MonitoringDisplay {
            structure: self.structure.clone(),
            time_ns: now_ns,
            measured_ns: self.last.as_ref().map(|last| last.measured_ns),
            state: judged.state,
            since_ns: judged.since_ns,
            reasons: judged.reasons.clone(),
            parameters,
            channels,
        };
        let changed = before.filter(|before| before.state != judged.state);
        self.state = Some(judged);
        let change = changed.map(|before| Change {
            before: before.state,
            display: display.clone(),
        });
        (display, change)
    }

    fn parameter_states(&self, watch: &Watch) -> Vec<ParameterMonitoring> {
        let states = self
            .parameters
            .iter()
            .enumerate()
            .map(|(index, parameter)| {
                let information = self
                    .last
                    .as_ref()
                    .and_then(|last| last.sustained_information.get(index));
                let sustained_std =
                    information.map(|information| f64::from(*information).sqrt().recip());
                let (state, why) = match watch.vigilance(index) {
                    Some(vigilance) => self.of_vigilance(vigilance),
                    None => without_rule(self.last.is_some(), sustained_std, parameter.prior_std),
                };
                ParameterMonitoring {
                    parameter: parameter.name.clone(),
                    state,
                    why,
                    sustained_std: sustained_std.filter(|std| std.is_finite()),
                }
            });
        states.collect()
    }

    fn channel_states(&self) -> Vec<ChannelMonitoring> {
        if !self.knows_channels {
            return Vec::new();
        }
        let frames: u64 = self.segments.iter().map(|segment| segment.frames).sum();
        let states = self.channels.iter().enumerate().map(|(index, channel)| {
            let of_channel = self
                .segments
                .iter()
                .filter_map(|segment| segment.used.get(index));
            let used: u64 = of_channel.sum();
            let expected = (frames as f64 * channel.samples_per_frame).max(1.0);
            channel.state((used as f64 / expected).min(1.0))
        });
        states.collect()
    }

    /// Returns the states of the channels that measure an excitation. Estimates do not contain
    /// their use, but the filter uses each of their samples.
    fn excitation_states(&self) -> impl Iterator<Item = ChannelMonitoring> {
        self.excitations.iter().map(|channel| {
            let missing = self.missing.get(&channel.name).copied().unwrap_or(0.0);
            let used_share = (1.0 - missing) / channel.samples_per_frame;
            channel.state(used_share.clamp(0.0, 1.0))
        })
    }

    fn structure_state(
        &self,
        watch: &Watch,
        parameters: &[ParameterMonitoring],
        channels: &[ChannelMonitoring],
        has_response: bool,
        silence: Duration,
    ) -> (State, Vec<String>) {
        let Some(last) = &self.last else {
            return (State::Blind, vec!["no estimates have arrived".to_owned()]);
        };
        if last.state == StreamState::Ended {
            return (State::Blind, vec!["the samples have ended".to_owned()]);
        }
        if silence > SILENT_AFTER.max(Duration::from_secs_f64(ESTIMATES_MISSED / self.rate_hz)) {
            let reason = format!("no estimates have arrived for {} s", silence.as_secs());
            return (State::Blind, vec![reason]);
        }
        let mut reasons = Vec::new();
        if last.phase == Phase::ExcitationSilent {
            reasons.push(UndecidedBecause::ExcitationSilent.words().to_owned());
        }
        if self.has_sensor_in_doubt() {
            reasons.push(self.words(UndecidedBecause::SensorInDoubt));
        }
        if !has_response {
            reasons.push(RESPONSE_IS_SILENT.to_owned());
        }
        let is_blind = !reasons.is_empty();
        reasons.extend(clock_reason(&self.wrong_clocks));
        match has_response {
            true => reasons.extend(channel_reasons(channels)),
            false => {
                let excitations = channels.get(self.channels.len()..);
                reasons.extend(channel_reasons(excitations.unwrap_or_default()));
            }
        }
        for reason in parameter_reasons(parameters) {
            // The reason of all parameters can be that of the structure.
            if !reasons.contains(&reason) {
                reasons.push(reason);
            }
        }
        // Damage is found by the rules. Without rules, every parameter counts.
        let has_rule = |(index, _): &(usize, _)| watch.vigilance(*index).is_some();
        let with_rule = parameters.iter().enumerate().filter(has_rule);
        let mut with_rule = with_rule.map(|(_, parameter)| parameter).peekable();
        let is_blind_to = |parameter: &ParameterMonitoring| parameter.state == State::Blind;
        let all_blind = match with_rule.peek() {
            Some(_) => with_rule.all(is_blind_to),
            None => !parameters.is_empty() && parameters.iter().all(is_blind_to),
        };
        let state = match () {
            () if is_blind || all_blind => State::Blind,
            () if reasons.is_empty() => State::Watching,
            () => State::Degraded,
        };
        (state, reasons)
    }

    /// Returns `true` if no response channel is used. In distributed identification, the channels
    /// are unknown, and a fusion without nodes counts instead.
    fn is_without_response(&self, channels: &[ChannelMonitoring]) -> bool {
        if self.knows_channels {
            return channels.iter().all(|channel| channel.state == State::Blind);
        }
        let frames: u64 = self.segments.iter().map(|segment| segment.frames).sum();
        let predicted: u64 = self.segments.iter().map(|segment| segment.predicted).sum();
        predicted as f64 > (1.0 - BLIND_BELOW) * frames as f64
    }
}

impl WatchedChannel {
    /// Returns the state of a channel of which this share of the samples is used.
    fn state(&self, used_share: f64) -> ChannelMonitoring {
        ChannelMonitoring {
            channel: self.name.clone(),
            state: match used_share {
                share if share < BLIND_BELOW => State::Blind,
                share if share < DEGRADED_BELOW => State::Degraded,
                _ => State::Watching,
            },
            used_share,
        }
    }
}

/// Returns the state and the reason of a parameter without a rule.
fn without_rule(
    has_estimates: bool,
    sustained_std: Option<f64>,
    prior_std: f64,
) -> (State, Option<String>) {
    let why = match sustained_std {
        _ if !has_estimates => "no estimates have arrived",
        Some(std) if std >= prior_std => "the present data reveal less than the prior",
        _ => return (State::Watching, None),
    };
    (State::Blind, Some(why.to_owned()))
}

/// Returns a reason that names the nodes whose clock is wrong.
fn clock_reason(wrong: &[(Name, f64)]) -> Option<String> {
    match wrong {
        [] => None,
        [(node, difference_s)] => {
            let side = match *difference_s < 0.0 {
                true => "behind",
                false => "ahead of",
            };
            let seconds = difference_s.abs();
            Some(format!(
                "the clock of {node} is {seconds:.1} s {side} most nodes"
            ))
        }
        _ => {
            let names = listed(wrong.iter().map(|(node, _)| node));
            Some(format!(
                "the clocks of {names} differ from those of most nodes"
            ))
        }
    }
}

/// Returns one reason for the unused channels, and one for each partly used channel.
fn channel_reasons(channels: &[ChannelMonitoring]) -> Vec<String> {
    let names = |state: State| {
        let of_state = channels
            .iter()
            .filter(move |channel| channel.state == state);
        of_state.map(|channel| &channel.channel)
    };
    let mut reasons = Vec::new();
    if names(State::Blind).next().is_some() {
        let names = listed(names(State::Blind));
        reasons.push(format!("no samples of {names} are used"));
    }
    if names(State::Degraded).next().is_some() {
        let of_state = channels
            .iter()
            .filter(|channel| channel.state == State::Degraded);
        let shares = of_state.clone().map(|channel| 100.0 * channel.used_share);
        let (least, most) = (
            shares.clone().fold(100.0, f64::min),
            shares.fold(0.0, f64::max),
        );
        let share = match of_state.count() {
            1 => format!("{least:.0} %"),
            _ => format!("{least:.0} to {most:.0} %"),
        };
        let names = listed(names(State::Degraded));
        reasons.push(format!("only {share} of the samples of {names} are used"));
    }
    reasons
}

/// Returns one reason for all parameters with the same reason.
fn parameter_reasons(parameters: &[ParameterMonitoring]) -> Vec<String> {
    let mut whys: Vec<&str> = Vec::new();
    for why in parameters
        .iter()
        .filter_map(|parameter| parameter.why.as_deref())
    {
        if !whys.contains(&why) {
            whys.push(why);
        }
    }
    let reason = |why: &str| {
        let with = parameters
            .iter()
            .filter(|parameter| parameter.why.as_deref() == Some(why));
        match with.clone().count() == parameters.len() {
            true => why.to_owned(),
            false => format!(
                "{}: {why}",
                listed(with.map(|parameter| &parameter.parameter))
            ),
        }
    };
    whys.into_iter().map(reason).collect()
}

/// Lists names in words, at most [`NAMES_SHOWN`] of them.
fn listed<'n>(names: impl Iterator<Item = &'n Name>) -> String {
    let names: Vec<&str> = names.map(Name::as_str).collect();
    let shown = names.get(..NAMES_SHOWN).unwrap_or(&names);
    match names.len().saturating_sub(shown.len()) {
        0 => shown.join(", "),
        more => format!("{} and {more} more", shown.join(", ")),
    }
}

#[cfg(test)]
mod tests;
