//! Estimates and display values, as messages.

use super::hearing::Hearing;
use super::motion::Motion;
use super::{Identification, Output, Stream, fit};
use crate::display::noise_display;
use crate::estimator::Estimator;
use spandrel_bus::{
    Block, ChannelState, Estimate, EstimateBlock, EstimateFlags, Header, ParameterDisplay, Phase,
    StreamState, TimeGrid,
};
use spandrel_filter::{NoisePhase, Step};
use spandrel_structure::EstimatedResponse;

/// Maximum size of an estimate block in bytes, unless a single estimate is larger.
///
/// An estimate of forty parameters with its covariance takes 7 kB. A thousand of them would exceed
/// the size limit of a message.
pub(super) const MOST_BYTES: usize = 1 << 20;

impl Identification {
    pub(super) fn estimate(&mut self, step: Option<Step>, restarted: bool) -> Estimate {
        if !self.responses.is_empty() {
            let response = |response: &EstimatedResponse| self.estimator.response(response.terms());
            self.responded
                .push(self.responses.iter().map(response).collect());
        }
        let parameters = self.parameter_names.len();
        let noise = self.estimator.noise();
        let innovations = match step {
            Some(_) => self.estimator.innovation().to_vec(),
            None => vec![f64::NAN; self.observations.len()],
        };
        let used = step.map_or(0, |step| step.used_channels);
        Estimate {
            mean: self.estimator.parameter_mean().to_vec(),
            covariance: (0..parameters)
                .flat_map(|j| (0..=j).map(move |i| (i, j)))
                .map(|(i, j)| self.estimator.parameter_covariance(i, j))
                .collect(),
            noise_mean: noise.mean.as_slice().to_vec(),
            noise_covariance: noise.covariance.diagonal().as_slice().to_vec(),
            innovations,
            normalised_innovation_squared: step
                .map_or(0.0, |step| step.normalised_innovation_squared),
            log_evidence: step.map_or(0.0, |step| step.log_evidence),
            used_channels: used as u16,
            flags: self.flags(restarted, used),
            excluded: self.excluded(),
            sustained_information: self.sustained_information(),
        }
    }

    /// Returns the information about each parameter that the present learning rate sustains. Empty
    /// if the estimator does not measure it.
    fn sustained_information(&self) -> Vec<f32> {
        let information = |variance: f64| variance.recip().clamp(0.0, f32::MAX.into()) as f32;
        let of_each = 0..self.parameter_names.len();
        of_each
            .map(|j| self.estimator.sustained_variance(j).map(information))
            .collect::<Option<_>>()
            .unwrap_or_default()
    }

    fn flags(&self, restarted: bool, used: usize) -> EstimateFlags {
        let judged = fit::judged(&self.estimator);
        EstimateFlags {
            phase: match self.estimator.noise().phase {
                NoisePhase::Training => Phase::Training,
                NoisePhase::Working if self.has_lost_state() => Phase::Training,
                NoisePhase::Working if self.hearing.iter().any(Hearing::is_silent) => {
                    Phase::ExcitationSilent
                }
                NoisePhase::Working if self.has_silent_response() => Phase::ResponseSilent,
                NoisePhase::Working if self.has_sensor_in_doubt() => Phase::SensorInDoubt,
                NoisePhase::Working => Phase::Working,
            },
            restarted,
            prediction_only: used == 0,
            fit: judged.map(|judged| judged.verdict),
            fit_reasons: judged.map(|judged| judged.reasons).unwrap_or_default(),
            follows_jump: self.estimator.fit().follows_jump(),
            strong_motion: self.motion.as_ref().and_then(Motion::strong),
        }
    }

    pub(super) fn publish(
        &mut self,
        first: u64,
        estimates: Vec<Estimate>,
        state: StreamState,
        outputs: &mut Vec<Output>,
    ) {
        let Some(stream) = self.stream else {
            return;
        };
        let time_ns = TimeGrid::new(stream.t0_ns, stream.sampling_rate_hz)
            .map_or(stream.t0_ns, |g| g.time_ns(first));
        if !self.responded.is_empty() {
            outputs.push(Output::Responses(std::mem::take(&mut self.responded)));
        }
        let header = Header {
            source: self.source.clone(),
            epoch: stream.epoch,
            sequence: first,
            time_ns,
        };
        outputs.push(Output::Estimates(EstimateBlock {
            header,
            estimates,
            state,
            ..self.empty_block(stream)
        }));
    }

    fn empty_block(&self, stream: Stream) -> EstimateBlock {
        EstimateBlock {
            header: Header {
                source: String::new(),
                epoch: stream.epoch,
                sequence: 0,
                time_ns: 0,
            },
            term: 0,
            t0_ns: stream.t0_ns,
            sampling_rate_hz: stream.sampling_rate_hz,
            parameters: self.parameter_names.len() as u16,
            noise_parameters: self.noise_names.len() as u16,
            channels: self.observations.len() as u16,
            estimates: Vec::new(),
            state: StreamState::Running,
        }
    }

    /// Returns the number of estimates that fit into [`MOST_BYTES`], at least one.
    pub(super) fn most_of_a_block(&self) -> usize {
        self.stream.map_or(1, |stream| {
            (MOST_BYTES / self.empty_block(stream).item_bytes()).max(1)
        })
    }

    /// Returns the number of messages from [`Self::display`].
    pub(super) fn values_displayed(&self) -> u64 {
        let single =
            usize::from(self.classes.is_some()) + usize::from(self.effective_name.is_some());
        let fit = usize::from(fit::judged(&self.estimator).is_some());
        (self.parameter_names.len() + self.noise_names.len() + single + fit + self.screening.len())
            as u64
    }

    pub(super) fn display(&mut self, time_ns: i64, outputs: &mut Vec<Output>) {
        for (index, name) in self.parameter_names.iter().enumerate() {
            let mean = self.estimator.parameter_mean()[index];
            let variance = self.estimator.parameter_covariance(index, index);
            let display =
                ParameterDisplay::of_normal(&self.structure, name, time_ns, mean, variance);
            outputs.push(Output::Parameter(display));
        }
        let noise = self.estimator.noise();
        for (l, name) in self.noise_names.iter().enumerate() {
            let (mean, variance) = (noise.mean[l], noise.covariance[(l, l)]);
            outputs.push(Output::Noise(noise_display(
                &self.structure,
                name,
                time_ns,
                mean,
                variance,
            )));
        }
        if let (Estimator::Particles(particles), Some(name)) =
            (&self.estimator, &self.effective_name)
            && let Some(health) = particles.health()
        {
            let effective = health.effective_share() * particles.count() as f64;
            outputs.push(Output::Noise(noise_display(
                &self.structure,
                name,
                time_ns,
                effective,
                0.0,
            )));
        }
        outputs.extend(self.class_display(time_ns).map(Output::Classes));
        outputs.extend(
            self.fit
                .display(&self.structure, time_ns, &self.estimator)
                .map(Output::Fit),
        );
        outputs.extend(self.sensor_displays(time_ns).map(Output::SensorHealth));
        let excluded = self.excluded_rows();
        if let Some(outliers) = self.estimator.outliers() {
            let views = self.screening.iter_mut().zip(&excluded);
            for ((view, excluded), screen) in views.zip(outliers.channels()) {
                let mut display = view.display(&self.structure, time_ns, screen);
                if *excluded {
                    display.state = ChannelState::Faulty;
                }
                outputs.push(Output::Outliers(display));
            }
        }
    }
}
