//! The frames one after another, the gaps between them, and restarts of the filter.

use super::hearing::Hearing;
use super::recent::Inputs;
use super::{Identification, Output, Stream, fit};
use crate::estimator::Estimator;
use crate::pieces::MOST_ITEMS;
use spandrel_bus::{Block, Estimate, EventKind, FrameBlock, StreamState, TimeGrid};
use spandrel_filter::{FilterError, Frame};

/// Time without samples (s) after which nothing is decided.
///
/// An alert needs evidence that lasts. A prediction repeats the last estimate, also a wrong one.
const SILENT_S: f64 = 1.0;

/// Maximum number of frames of a gap that are bridged in one part.
pub(super) const MOST_BRIDGED: u64 = MOST_ITEMS;

/// Factor by which display values are thinned under high load.
const THINNED: u32 = 10;

impl Identification {
    pub(super) fn take_block(&mut self, block: &FrameBlock, outputs: &mut Vec<Output>) {
        if usize::from(block.channels) != self.frame.len() {
            return; // of another structure; the reader rejects such a block
        }
        if self
            .stream
            .is_none_or(|stream| stream.epoch != block.header.epoch)
        {
            self.enter_epoch(block, outputs);
        }
        let Some(grid) = block.grid() else {
            return; // decoding rejects such a block
        };
        let most = self.most_of_a_block();
        let mut estimates = Vec::with_capacity(most.min(block.count() as usize));
        let mut first = block.header.sequence;
        for (number, values) in block.iter() {
            if estimates.len() == most {
                self.publish(
                    first,
                    std::mem::take(&mut estimates),
                    StreamState::Running,
                    outputs,
                );
                first = number;
            }
            self.take_frame(number, values, grid, &mut estimates, outputs);
        }
        self.publish(first, estimates, block.state, outputs);
    }

    /// Starts a new epoch of the source of frames, with new numbers and times.
    fn enter_epoch(&mut self, block: &FrameBlock, outputs: &mut Vec<Output>) {
        if self.stream.is_some() {
            self.estimator.forget_motion();
            self.forget_sensors();
            self.reset_band_limit();
            if let Some(motion) = &mut self.motion {
                motion.restart();
            }
            outputs.push(self.event(
                block.header.time_ns,
                EventKind::Restart,
                "motion of the structure reset, parameters kept",
                "the source of frames started a new epoch",
            ));
        }
        self.stream = Some(Stream {
            epoch: block.header.epoch,
            next: block.header.sequence,
            t0_ns: block.t0_ns,
            sampling_rate_hz: block.sampling_rate_hz,
        });
    }

    fn take_frame(
        &mut self,
        number: u64,
        values: &[f64],
        grid: TimeGrid,
        estimates: &mut Vec<Estimate>,
        outputs: &mut Vec<Output>,
    ) {
        let time_ns = grid.time_ns(number);
        if let Some(motion) = &mut self.motion {
            motion.take(number, time_ns, values);
        }
        self.frame.copy_from_slice(values);
        if let Some(band_limit) = &mut self.band_limit {
            band_limit.apply(&mut self.frame);
        }
        for (value, channel) in self.observations.iter_mut().zip(&self.observation_channels) {
            *value = self.frame[*channel];
        }
        let known = self.excitation_channels.iter().zip(&self.mean_excitation);
        for (value, (channel, mean)) in self.excitation.iter_mut().zip(known) {
            *value = channel.map_or(*mean, |channel| self.frame[channel]);
        }
        self.hear_excitations(time_ns, values, outputs);
        self.mask_faulty();
        let weighed = self.weigh_excitation();
        self.remember();
        let frame = Frame {
            observations: &self.observations,
            excitation: &self.excitation,
        };
        if self
            .stream
            .is_some_and(|stream| self.unobserved >= stream.bridged_frames())
        {
            self.estimator.forget_motion(); // a prediction over such a time is invalid
        }
        let had_lost_state = self.has_lost_state();
        let result = weighed.and_then(|()| self.estimator.step(frame));
        let observed = result.as_ref().is_ok_and(|step| step.used_channels > 0);
        self.unobserved = if observed { 0 } else { self.unobserved + 1 };
        let beyond_recovery = matches!(&self.estimator, Estimator::Particles(particles) if particles.are_beyond_recovery());
        let restarted = result.is_err() || beyond_recovery;
        if let Err(error) = &result {
            outputs.push(self.restart(time_ns, &error.to_string()));
        } else if beyond_recovery {
            outputs.push(self.restart(
                time_ns,
                "the particles lost the state and did not recover it",
            ));
        } else {
            self.tell_particles(time_ns, had_lost_state, outputs);
        }
        if let Ok(step) = &result {
            self.tell_noise_events(time_ns, step, outputs);
            self.tell_clipping(time_ns, step, outputs);
            self.tell_outliers(time_ns, outputs);
            self.tell_classes(time_ns, outputs);
        }
        let without_faulty = self.check_sensors(time_ns, values, outputs);
        let recovers = self.recover(time_ns, outputs);
        let restarted = restarted || without_faulty || recovers;
        self.find_sudden_faults(time_ns, restarted, outputs);
        let estimate = self.estimate(result.ok(), restarted);
        estimates.push(estimate);
        if let Some(stream) = &mut self.stream {
            stream.next = number + 1;
        }
        if self.decimation.shows(number) {
            match self.is_thinned && !self.decimation.one_in(THINNED).shows(number) {
                false => self.display(time_ns, outputs),
                true => self.shed += self.values_displayed(),
            }
        }
        outputs.extend(
            self.fit
                .take_change(&self.structure, time_ns, &self.estimator)
                .map(Output::Fit),
        );
    }

    /// Bridges permanently missing frames, or part of them. Returns the number of the first
    /// remaining frame.
    pub(super) fn bridge(
        &mut self,
        since: u64,
        from: u64,
        to: u64,
        outputs: &mut Vec<Output>,
    ) -> u64 {
        let Some(stream) = self.stream else {
            return to; // there was no state before the gap
        };
        let Some(grid) = TimeGrid::new(stream.t0_ns, stream.sampling_rate_hz) else {
            return to;
        };
        let bridged = stream.bridged_frames();
        let lost = to.saturating_sub(since);
        let forgets = lost > bridged;
        if from == since {
            outputs.push(self.event(
                grid.time_ns(from),
                EventKind::Gap,
                &format!("{lost} frames are permanently lost"),
                if forgets {
                    "gap too long to bridge: parameters kept, motion reset"
                } else {
                    "bridged by predictions"
                },
            ));
        }
        let missing = vec![f64::NAN; self.frame.len()];
        let done = to.min(from + MOST_BRIDGED.min(self.most_of_a_block() as u64));
        if from < done {
            let mut estimates = Vec::with_capacity((done - from) as usize);
            for number in from..done {
                if number - since < bridged {
                    self.take_frame(number, &missing, grid, &mut estimates, outputs);
                } else {
                    let estimate = self.estimate(None, false);
                    estimates.push(estimate);
                }
            }
            self.publish(from, estimates, StreamState::Running, outputs);
        }
        if done == to && forgets {
            self.estimator.forget_motion();
            self.forget_sensors();
            self.reset_band_limit();
        }
        if let Some(stream) = &mut self.stream {
            stream.next = done;
        }
        done
    }

    pub(super) fn restart(&mut self, time_ns: i64, why: &str) -> Output {
        self.reset_band_limit();
        self.settling = 0;
        let restarted = self.estimator.restart();
        self.told_restart(time_ns, restarted, why)
    }

    /// Restarts a filter that has lost the structure. Returns `true` in this case.
    ///
    /// A frame without samples counts neither for nor against it.
    fn recover(&mut self, time_ns: i64, outputs: &mut Vec<Output>) -> bool {
        if self.unobserved > 0 {
            return false;
        }
        let motion = self.motion.as_ref();
        let is_strong = motion.is_some_and(|motion| motion.strong().is_some());
        let judged = fit::judged(&self.estimator);
        let must_restart = self.recovery.take(judged, is_strong, self.half_life);
        if must_restart {
            outputs.push(self.restart(
                time_ns,
                "the data have contradicted the model for long, and a parameter is at its bound \
                 or far outside its prior",
            ));
        }
        must_restart
    }

    pub(super) fn told_restart(
        &mut self,
        time_ns: i64,
        restarted: Result<(), FilterError>,
        why: &str,
    ) -> Output {
        self.restarts += 1;
        let what = match restarted {
            Ok(()) => "filter restarted from its prior".to_owned(),
            Err(refusal) => format!("filter could not be restarted: {refusal}"),
        };
        self.event(time_ns, EventKind::Restart, &what, why)
    }

    /// Discards the samples by which the sensors are compared, because the next ones do not follow
    /// them.
    pub(super) fn forget_sensors(&mut self) {
        self.check.forget_motion();
        self.spikes.forget();
        self.recent.forget();
        self.sudden.forget();
    }

    /// Keeps the inputs of the filter. They are of no use if the excitation is unknown.
    fn remember(&mut self) {
        if self.hearing.iter().any(Hearing::is_silent) {
            self.recent.forget();
            return;
        }
        self.recent.add(Inputs {
            observations: &self.observations,
            excitation: &self.excitation,
            shares: self.reliability.shares(),
            teaches: self.reliability.teaches(),
        });
    }

    fn reset_band_limit(&mut self) {
        if let Some(band_limit) = &mut self.band_limit {
            band_limit.reset();
        }
    }

    /// Returns the number of frames without a sample after which channels count as silent.
    pub(super) fn silent_frames(&self, stream: Stream) -> u64 {
        let of_time = (SILENT_S * stream.sampling_rate_hz) as u64;
        of_time.max(2 * self.slowest_stride).max(1)
    }

    /// Returns `true` if no sensor of the response has delivered a usable sample for some time.
    pub(super) fn has_silent_response(&self) -> bool {
        self.stream
            .is_some_and(|stream| self.unobserved >= self.silent_frames(stream))
    }
}
