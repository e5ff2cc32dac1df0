//! The check of the sensors against each other, and its consequences.

use super::hearing::Hearing;
use super::spikes::Sample;
use super::{Identification, Output};
use crate::error::{IdentifyError, key_name};
use spandrel_bus::{
    ChannelHealthDisplay, EventKind, Excluded, FaultKind, Name, SensorHealthDisplay,
};
use spandrel_faults::{Change, ChannelHealth, Fault, SensorCheck, SensorReference, Soundness};
use spandrel_filter::{FilterError, Frame, Verdict};
use spandrel_structure::Structure;
use std::ops::Range;

/// Standard deviation of the parameters, as a share of the prior, while the motion settles after a
/// restart.
///
/// The motion is unknown at first. Without this, its error would move the parameters far from
/// their prior, and a filter with fewer sensors does not always return.
const HELD: f64 = 0.01;

/// Maximum share of spikes among the recent samples of a channel.
const MOST_SPIKES: f64 = 0.5;

impl Identification {
    /// Checks the sensors with the measured values of a frame. Returns `true` if the filter was
    /// restarted without a faulty sensor.
    pub(super) fn check_sensors(
        &mut self,
        time_ns: i64,
        values: &[f64],
        outputs: &mut Vec<Output>,
    ) -> bool {
        let changes = self.compare_sensors(values);
        let excluded = |change: &Change| {
            change.now == Soundness::Faulty && self.observation_channels.contains(&change.channel)
        };
        // Samples that the screening has rejected are not part of the estimates.
        let restarts = { changes.iter() }.any(|one| excluded(one) && self.uses(one.channel));
        for change in changes {
            let is_told = self.has_sudden_fault(change.channel);
            if change.now == Soundness::Faulty {
                self.leave_to_check(change.channel);
            }
            if !is_told {
                outputs.extend(self.tell_sensor(time_ns, change));
            }
        }
        if restarts {
            let restarted = self.restart_without_faulty();
            outputs.push(self.told_restart(
                time_ns,
                restarted,
                "the estimates so far contain the samples of a faulty sensor",
            ));
            return true;
        }
        self.settle().unwrap_or(false)
    }

    /// Restarts the filter, and repeats the recent frames without the samples of faulty sensors.
    pub(super) fn restart_without_faulty(&mut self) -> Result<(), FilterError> {
        self.restart_held()?;
        let recent = self.recent.clone();
        let repeated = recent.repeat(usize::MAX, |inputs| {
            self.observations.copy_from_slice(inputs.observations);
            self.mask_faulty();
            self.estimator.set_teaching(inputs.teaches);
            self.estimator.set_reliability(inputs.shares)?;
            self.estimator.step(Frame {
                observations: &self.observations,
                excitation: inputs.excitation,
            })?;
            self.settle().map(drop)
        });
        repeated.or_else(|_| self.restart_held())
    }

    /// Restarts the filter from its prior, and holds the parameters until the motion has settled.
    fn restart_held(&mut self) -> Result<(), FilterError> {
        self.settling = (self.check.window_s() * self.rate_hz()) as u64;
        self.estimator.restart()?;
        self.estimator.set_parameter_std(HELD)
    }

    /// Counts a frame after a restart without a faulty sensor. Returns `true` if the parameters are
    /// identified again from now on.
    fn settle(&mut self) -> Result<bool, FilterError> {
        let ends = self.settling == 1;
        self.settling = self.settling.saturating_sub(1);
        if ends {
            self.estimator.set_parameter_std(1.0)?;
        }
        Ok(ends)
    }

    /// Returns `false` if the samples of the channel are already left out because of a sudden
    /// fault, or if the screening rejects all of them.
    fn uses(&self, channel: usize) -> bool {
        let screened = self.estimator.outliers().zip(self.row_of(channel));
        let is_rejected = screened.is_some_and(|(outliers, row)| outliers.channels()[row].faulty());
        !is_rejected && !self.has_sudden_fault(channel)
    }

    /// Compares the sensors by a frame, or by the one before it if spikes are removed. Returns the
    /// changes that it causes.
    fn compare_sensors(&mut self, values: &[f64]) -> Vec<Change> {
        let Some(outliers) = self.estimator.outliers() else {
            return self.check.take(values);
        };
        // A spike is no fault of the whole channel.
        let unpredicted = values.iter().map(|value| Sample::unpredicted(*value));
        let mut samples: Vec<Sample> = unpredicted.collect();
        for (screen, channel) in outliers.channels().iter().zip(&self.observation_channels) {
            if screen.scale() == 0.0 {
                // The screening recognises no spikes before its first training.
                samples[*channel] = Sample::unpredicted(f64::NAN);
                continue;
            }
            if screen.faulty() {
                continue; // it cannot show whether the other channels deviate
            }
            samples[*channel].residual = screen.residual();
            // Spikes are rare. A channel with more rejected samples has another cause.
            samples[*channel].is_rejected =
                screen.verdict() == Verdict::Outlier && screen.rejected_share() < MOST_SPIKES;
        }
        if !self.spikes.take(&mut samples) {
            return Vec::new();
        }
        let measured: Vec<f64> = samples.iter().map(|sample| sample.value).collect();
        let without_spikes: Vec<f64> = samples.iter().map(|sample| sample.without_spike).collect();
        self.check.take_screened(&measured, &without_spikes)
    }

    fn rate_hz(&self) -> f64 {
        self.stream.map_or(0.0, |stream| stream.sampling_rate_hz)
    }

    fn tell_sensor(&self, time_ns: i64, change: Change) -> Option<Output> {
        let is_response = self.observation_channels.contains(&change.channel);
        // A stuck or silent excitation has been reported.
        let inputs = self.excitation_channels.iter().zip(&self.hearing);
        let is_told = |(channel, hearing): (&Option<usize>, &Hearing)| {
            *channel == Some(change.channel) && hearing.is_silent()
        };
        if { inputs }.any(is_told) {
            return None;
        }
        let words = || change.fault.map(|fault| fault.words()).unwrap_or_default();
        let (kind, what, why) = match (change.before, change.now) {
            (_, Soundness::Faulty) if is_response => (
                EventKind::ChannelExcluded,
                format!("the sensor {}: its samples are not used", words()),
                reason(change.fault),
            ),
            (_, Soundness::Faulty) => (
                EventKind::ChannelExcluded,
                format!("the sensor {}: alerts are suspended", words()),
                "the excitation of the structure is not known",
            ),
            (_, Soundness::InDoubt) => (
                EventKind::ChannelInDoubt,
                format!(
                    "the sensor may be faulty ({}): alerts are suspended",
                    words()
                ),
                "its motion differs from that of the other sensors at frequencies at which the \
                 stiffness has no effect",
            ),
            (Soundness::Faulty, Soundness::Sound | Soundness::Unchecked) => (
                EventKind::ChannelBack,
                "the sensor is used again".to_owned(),
                "it agrees with the other sensors again",
            ),
            (Soundness::InDoubt, Soundness::Unchecked) => (
                EventKind::ChannelBack,
                "the sensor is no longer in doubt".to_owned(),
                "it sends no samples that could be compared",
            ),
            (Soundness::InDoubt, Soundness::Sound) => (
                EventKind::ChannelBack,
                "the sensor is no longer in doubt".to_owned(),
                "it agrees with the other sensors",
            ),
            (Soundness::Sound | Soundness::Unchecked, Soundness::Sound | Soundness::Unchecked) => {
                return None;
            }
        };
        let name = &self.channel_names[change.channel];
        Some(self.event_of(name.as_str(), time_ns, kind, &what, why))
    }

    /// Removes the samples of faulty sensors from the values of the filter.
    pub(super) fn mask_faulty(&mut self) {
        for row in 0..self.observations.len() {
            if self.left_out.contains(&row) || self.is_excluded(row) {
                self.observations[row] = f64::NAN;
            }
        }
    }

    /// Returns `true` if a sensor in use is probably faulty.
    pub(super) fn has_sensor_in_doubt(&self) -> bool {
        let faulty_ground = || {
            let mut measured = self.excitation_channels.iter().flatten();
            measured.any(|channel| self.is_faulty(*channel))
        };
        self.check.is_in_doubt(|channel| self.uses(channel))
            || self.sudden.is_in_doubt()
            || self.settling > 0
            || faulty_ground()
    }

    /// Returns the channels that the check excludes.
    pub(super) fn excluded(&self) -> Excluded {
        let mut rows = (0..self.observation_channels.len()).filter(|row| self.is_excluded(*row));
        match (rows.next(), rows.next()) {
            (None, _) => Excluded::None,
            (Some(row), None) => Excluded::One(row as u16),
            (Some(_), Some(_)) => Excluded::Several,
        }
    }

    /// Returns whether the check excludes each observation row.
    pub(super) fn excluded_rows(&self) -> Vec<bool> {
        (0..self.observation_channels.len())
            .map(|row| self.is_excluded(row))
            .collect()
    }

    fn is_excluded(&self, row: usize) -> bool {
        self.leaves_out(row) || self.is_faulty(self.observation_channels[row])
    }

    fn is_faulty(&self, channel: usize) -> bool {
        let health = self.check.health()[channel];
        health.is_some_and(|health| health.soundness == Soundness::Faulty)
    }

    /// Returns the nodes with a channel that is compared with others.
    pub(crate) fn compared_nodes(&self) -> impl Iterator<Item = &Name> {
        self.compared.iter().map(|(node, _)| node)
    }

    /// Returns the messages about the comparison, one per compared node.
    pub(super) fn sensor_displays(
        &self,
        time_ns: i64,
    ) -> impl Iterator<Item = SensorHealthDisplay> {
        let display = move |(node, channels): &(Name, Range<usize>)| SensorHealthDisplay {
            structure: self.structure.clone(),
            node: node.clone(),
            time_ns,
            channels: channels
                .clone()
                .map(|channel| {
                    let health = self.health(channel).unwrap_or_default();
                    channel_display(&self.channel_names[channel], &health)
                })
                .collect(),
        };
        self.compared.iter().map(display)
    }

    /// Returns the check of the sensors.
    #[must_use]
    pub fn sensor_check(&self) -> &SensorCheck {
        &self.check
    }

    /// Sets the relations that the sensors showed in earlier recordings.
    pub fn expect_sensors(&mut self, references: &[SensorReference]) {
        let names: Vec<&str> = self.channel_names.iter().map(Name::as_str).collect();
        self.check.expect(&names, references);
    }

    /// Never uses the channel with this name. Returns `false` if no response is measured by it.
    pub fn leave_out(&mut self, channel: &str) -> bool {
        let names = &self.channel_names;
        let mut rows = self.observation_channels.iter();
        let row = rows.position(|index| names[*index].as_str() == channel);
        self.left_out.extend(row);
        row.is_some()
    }
}

/// Returns the nodes with a channel that is compared with others, and their channels in a frame.
pub(super) fn compared_nodes(
    structure: &Structure,
    check: &SensorCheck,
) -> Result<Vec<(Name, Range<usize>)>, IdentifyError> {
    let mut compared = Vec::new();
    let mut first = 0;
    for node in structure.nodes() {
        let channels = first..first + node.channels().len();
        first = channels.end;
        if check.health()[channels.clone()].iter().any(Option::is_some) {
            let name = key_name(structure.name(), node.name())?;
            compared.push((name, channels));
        }
    }
    Ok(compared)
}

/// Returns why a fault is no damage.
fn reason(fault: Option<Fault>) -> &'static str {
    match fault {
        Some(Fault::Drift(_)) => "damage does not move the mean of an acceleration",
        Some(Fault::Clipped(_)) => "the peaks of a motion differ in height",
        Some(Fault::Exchanged) => {
            "around the first natural frequency, it moves as another sensor did in the baseline"
        }
        _ => {
            "below the first natural frequency, all sensors along a direction measure the same \
             motion"
        }
    }
}

fn channel_display(channel: &Name, health: &ChannelHealth) -> ChannelHealthDisplay {
    use spandrel_bus::Soundness as State;
    let kind = |fault: Fault| match fault {
        Fault::Gain(_) => FaultKind::Gain,
        Fault::Sign(_) => FaultKind::Sign,
        Fault::Delay(_) => FaultKind::Delay,
        Fault::Dead => FaultKind::Dead,
        Fault::Disturbed => FaultKind::Disturbed,
        Fault::Drift(_) => FaultKind::Drift,
        Fault::Clipped(_) => FaultKind::Clipped,
        Fault::Exchanged => FaultKind::Exchanged,
    };
    ChannelHealthDisplay {
        channel: channel.clone(),
        state: match health.soundness {
            Soundness::Unchecked => State::Unchecked,
            Soundness::Sound => State::Sound,
            Soundness::InDoubt => State::InDoubt,
            Soundness::Faulty => State::Faulty,
        },
        probability: health.probability,
        fault: health.fault.map(kind),
        gain: health.gain,
        delay_s: health.delay_s,
        coherence: health.coherence,
    }
}
