//! The events of the identification: excitations, noise levels, bounds, outliers, model classes.

use super::hearing::{Heard, Spans};
use super::{Identification, Output, Stream};
use crate::estimator::Estimator;
use spandrel_bus::{Event, EventKind};
use spandrel_filter::{NoiseRule, OutlierChange, Step};

/// Subject of events that concern the whole identification.
const IDENTIFY: &str = "identify";

impl Identification {
    pub(super) fn tell_noise_events(&self, time_ns: i64, step: &Step, outputs: &mut Vec<Output>) {
        if step.training_ended {
            let why = match self.estimator.settings().noise_settings.rule {
                NoiseRule::HalfOrDouble => {
                    "halving or doubling a level has not improved them for ten frames"
                }
                NoiseRule::Fisher | NoiseRule::Published | NoiseRule::Fixed => {
                    "their relative deviations are below 10 % and the innovations agree with them"
                }
            };
            outputs.push(self.event(time_ns, EventKind::Calibration, "noise levels trained", why));
        }
        if step.training_overdue {
            let name = self.most_uncertain_level();
            let why = format!(
                "the sensors provide little information about the level of {name}; see spandrel \
                 check"
            );
            let what = "noise levels still in training: alerts are suspended";
            outputs.push(self.event(time_ns, EventKind::Unidentified, what, &why));
        }
        if step.training_restarted {
            let why = "the innovations kept disagreeing with their covariance";
            outputs.push(self.event(
                time_ns,
                EventKind::Calibration,
                "noise levels back in training",
                why,
            ));
        }
    }

    /// Reports when a measured excitation becomes silent, gets stuck or returns.
    ///
    /// A stuck excitation counts as missing. `values` are the measured values of the frame.
    pub(super) fn hear_excitations(
        &mut self,
        time_ns: i64,
        values: &[f64],
        outputs: &mut Vec<Output>,
    ) {
        let differs = |channel: &usize| {
            let (now, before) = (values[*channel], self.last_values[*channel]);
            !now.is_nan() && now.to_bits() != before.to_bits()
        };
        let moves = self.observation_channels.iter().any(differs);
        for (last, value) in self
            .last_values
            .iter_mut()
            .zip(values)
            .filter(|(_, value)| !value.is_nan())
        {
            *last = *value;
        }
        let Some(stream) = self.stream else { return };
        let spans = Spans {
            long: stream.bridged_frames().max(1),
            short: self.silent_frames(stream),
            stuck: stream.stuck_frames(),
        };
        for input in 0..self.excitation.len() {
            let value = self.excitation_channels[input].map(|channel| values[channel]);
            let change = self.hearing[input].take(value, moves, spans);
            if self.hearing[input].is_stuck(spans) {
                self.excitation[input] = f64::NAN;
            }
            let (name, channel) = &self.excitation_names[input];
            let (kind, what, why) = match change {
                Some(Heard::Silent) => (
                    EventKind::Unidentified,
                    format!("{name} is declared as measured but has no samples"),
                    "stiffness estimates depend on its unknown level: alerts are suspended",
                ),
                Some(Heard::Stuck) => (
                    EventKind::ChannelExcluded,
                    format!(
                        "the sensor of {name} is stuck at one value while the structure moves: \
                         its samples are not used"
                    ),
                    "the excitation of the structure is not known: alerts are suspended",
                ),
                Some(Heard::Again) => (
                    EventKind::ChannelBack,
                    format!("{name} is measured again"),
                    "the estimates have had time to settle: alerts are active again",
                ),
                None => continue,
            };
            let subject = match kind {
                EventKind::ChannelExcluded | EventKind::ChannelBack => {
                    channel.as_deref().unwrap_or(name)
                }
                _ => IDENTIFY,
            };
            outputs.push(self.event_of(subject, time_ns, kind, &what, why));
        }
    }

    /// Reports parameters that reach their bounds.
    ///
    /// It reports again only after the parameters have stayed off their bounds for longer than the
    /// longest bridged gap.
    pub(super) fn tell_clipping(&mut self, time_ns: i64, step: &Step, outputs: &mut Vec<Output>) {
        let Some(bridged) = self.stream.map(Stream::bridged_frames) else {
            return;
        };
        let clips = step.limited_states > 0;
        if clips && self.since_clipped.is_none_or(|frames| frames > bridged) {
            let at_bound = self
                .parameter_names
                .iter()
                .enumerate()
                .filter(|(index, _)| self.estimator.is_at_bound(*index));
            let names: Vec<&str> = at_bound.map(|(_, name)| name.as_str()).collect();
            outputs.push(self.event(
                time_ns,
                EventKind::Unidentified,
                "parameters kept at their bounds",
                &format!("the estimate left its bounds: {}", names.join(", ")),
            ));
        }
        self.since_clipped = if clips {
            Some(0)
        } else {
            self.since_clipped.map(|frames| frames + 1)
        };
    }

    /// Reports when particles lose the state, and when they follow the data again.
    pub(super) fn tell_particles(&self, time_ns: i64, had_lost: bool, outputs: &mut Vec<Output>) {
        let Estimator::Particles(particles) = &self.estimator else {
            return;
        };
        let Some(health) = particles
            .health()
            .filter(|health| health.is_lost() != had_lost)
        else {
            return;
        };
        let why = format!(
            "effective particles: {:.0} of {}; squared innovations: {:.1} times their prediction",
            health.effective_share() * particles.count() as f64,
            particles.count(),
            health.misfit(),
        );
        let (kind, what) = match health.is_lost() {
            true => (
                EventKind::Unidentified,
                "the particles lost the state: alerts are suspended",
            ),
            false => (
                EventKind::Calibration,
                "the particles follow the data again",
            ),
        };
        outputs.push(self.event(time_ns, kind, what, &why));
    }

    /// Reports a changed screening of a channel, as an event and on its topic.
    pub(super) fn tell_outliers(&mut self, time_ns: i64, outputs: &mut Vec<Output>) {
        let Some(outliers) = self.estimator.outliers() else {
            return;
        };
        if outliers.change_began() {
            outputs.push(self.event(
                time_ns,
                EventKind::Calibration,
                "outlier screening paused: the structure or its motion has changed",
                "samples of several sensors disagree with the predicted response at the same time",
            ));
        }
        for (view, screen) in self.screening.iter_mut().zip(outliers.channels()) {
            let Some((change, why)) = view.take(time_ns, screen) else {
                continue;
            };
            let (kind, what) = match change {
                OutlierChange::FaultBegan => (
                    EventKind::ChannelExcluded,
                    "the sensor or the model is wrong: its samples are not used",
                ),
                OutlierChange::FaultEnded => (EventKind::ChannelBack, "the sensor is used again"),
                OutlierChange::Rescaled | OutlierChange::Trained => (
                    EventKind::Calibration,
                    "the scale of its residuals was re-estimated",
                ),
            };
            outputs.push(Output::Event(Event {
                structure: self.structure.clone(),
                time_ns,
                kind,
                subject: view.channel().to_string(),
                what: what.to_owned(),
                why,
            }));
            outputs.push(Output::Outliers(view.display(
                &self.structure,
                time_ns,
                screen,
            )));
        }
    }

    /// Reports changes of the model classes, as events and on their topic.
    pub(super) fn tell_classes(&mut self, time_ns: i64, outputs: &mut Vec<Output>) {
        let (Some(bank), Some(view)) = (self.estimator.classes(), &mut self.classes) else {
            return;
        };
        let told = view.take(time_ns, bank);
        if !told.is_empty() {
            outputs.push(Output::Classes(view.display(
                &self.structure,
                time_ns,
                bank,
            )));
        }
        outputs.extend(
            told.into_iter()
                .map(|told| self.event(time_ns, told.kind, &told.what, &told.why)),
        );
    }

    fn most_uncertain_level(&self) -> &str {
        let noise = self.estimator.noise();
        let relative = |l: usize| noise.covariance[(l, l)] / (noise.mean[l] * noise.mean[l]);
        let most = (0..self.noise_names.len()).max_by(|a, b| relative(*a).total_cmp(&relative(*b)));
        most.map_or("a sensor", |l| self.noise_names[l].as_str())
    }

    pub(super) fn event(&self, time_ns: i64, kind: EventKind, what: &str, why: &str) -> Output {
        self.event_of(IDENTIFY, time_ns, kind, what, why)
    }

    pub(super) fn event_of(
        &self,
        subject: &str,
        time_ns: i64,
        kind: EventKind,
        what: &str,
        why: &str,
    ) -> Output {
        Output::Event(Event {
            structure: self.structure.clone(),
            time_ns,
            kind,
            subject: subject.to_owned(),
            what: what.to_owned(),
            why: why.to_owned(),
        })
    }
}
