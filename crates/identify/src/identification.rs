//! The core: receives frames of one structure and returns estimates, with one filter step per
//! frame.

mod events;
mod fit;
mod hearing;
mod motion;
mod recent;
mod recovery;
mod reliability;
mod sensors;
mod spikes;
mod state;
mod sudden;

use crate::display::noise_display;
use crate::error::IdentifyError;
use crate::estimator::Estimator;
use crate::model_classes::ClassView;
use crate::pieces::MOST_ITEMS;
use crate::screening::ScreeningView;
use fit::FitView;
use hearing::Hearing;
use motion::Motion;
use recent::{Inputs, Recent};
use recovery::Recovery;
use reliability::Reliability;
use serde::{Deserialize, Serialize};
use spandrel_bus::{
    Block, ChannelState, Decimation, Estimate, EstimateBlock, EstimateFlags, Event, EventKind,
    FitDisplay, FitVerdict, FrameBlock, Header, ModelClassDisplay, Name, NoiseDisplay,
    OutlierDisplay, ParameterDisplay, Phase, SensorHealthDisplay, StreamState, TimeGrid,
};
use spandrel_faults::SensorCheck;
use spandrel_filter::{BandLimit, FilterError, Frame, NoisePhase, Step};
use spandrel_structure::{EstimatedResponse, Excitation, Quantity, Structure};
use spikes::Spikes;
use sudden::SuddenFaults;

/// Maximum length of a gap (s) that is bridged by predictions. A longer gap resets the motion, but
/// keeps the parameters.
pub(crate) const BRIDGED_GAP_S: f64 = 10.0;

/// Time without samples (s) after which nothing is decided.
///
/// An alert needs evidence that lasts. A prediction repeats the last estimate, also a wrong one.
const SILENT_S: f64 = 1.0;

/// Time (s) for which an excitation must repeat bit-identical samples before its sensor counts as
/// stuck.
///
/// The number of samples must also reach [`STUCK_SAMPLES`]. A coarse converter repeats itself for a
/// shorter time in quiet conditions.
const STUCK_S: f64 = 2.0;
/// Minimum number of repeated samples before a sensor counts as stuck.
const STUCK_SAMPLES: u64 = 50;

/// Maximum number of frames of a gap that are bridged in one part.
const MOST_BRIDGED: u64 = MOST_ITEMS;

/// Maximum size of an estimate block in bytes, unless a single estimate is larger.
///
/// An estimate of forty parameters with its covariance takes 7 kB. A thousand of them would exceed
/// the size limit of a message.
const MOST_BYTES: usize = 1 << 20;

/// Factor by which display values are thinned under high load.
const THINNED: u32 = 10;

/// Name for displaying the effective sample size of the particles, next to the noise levels.
const EFFECTIVE_PARTICLES: &str = "effective-particles";

pub use state::IdentificationState;

/// Inputs of the core.
#[derive(Debug, Clone, PartialEq)]
pub enum IdentificationInput {
    /// Frames that continue the stream or start a new epoch.
    Frames(FrameBlock),
    /// Permanently missing frames of the current epoch, with numbers `from` to before `to`.
    Gap {
        /// Number of the first missing frame.
        since: u64,
        /// Number of the first missing frame that is not processed yet.
        from: u64,
        /// Number of the first frame after the gap.
        to: u64,
    },
}

impl IdentificationInput {
    /// Creates a gap of permanently missing frames, with numbers `from` to before `to`.
    #[must_use]
    pub fn gap(from: u64, to: u64) -> Self {
        Self::Gap {
            since: from,
            from,
            to,
        }
    }
}

/// Outputs of the core.
#[derive(Debug, Clone, PartialEq)]
pub enum Output {
    /// Estimates at the sampling rate.
    Estimates(EstimateBlock),
    /// A parameter at the display rate.
    Parameter(ParameterDisplay),
    /// A noise level at the display rate.
    Noise(NoiseDisplay),
    /// The outlier screening of a channel, at the display rate and after each change.
    Outliers(OutlierDisplay),
    /// The comparison of the sensors of a node, at the display rate.
    SensorHealth(SensorHealthDisplay),
    /// The model classes, at the display rate and after each change.
    Classes(ModelClassDisplay),
    /// The verdict on the fit, at the display rate and after each change.
    Fit(FitDisplay),
    /// Mean and standard deviation of each response in the structure file, per frame.
    ///
    /// They belong to the next estimates. They are for files and are not published on the bus.
    Responses(Vec<Vec<(f64, f64)>>),
    /// An event.
    Event(Event),
}

/// The identification of one structure, without a clock or network: frames in, estimates and events
/// out.
///
/// [`Identification::handle`] filters the frames by the declared band limit, checks the sensors and
/// steps the estimator. A diverged estimator is restarted from its prior and reported as an event.
///
/// [`Identification::new`] uses the estimator of the structure file,
/// [`Identification::with_estimator`] any other one. [`Identification::state`] and
/// [`Identification::restore`] write and read a checkpoint.
#[derive(Debug)]
pub struct Identification {
    structure: Name,
    source: String,
    estimator: Estimator,
    band_limit: Option<BandLimit>,
    observation_channels: Vec<usize>,
    /// Channel that measures each component of the excitation.
    excitation_channels: Vec<Option<usize>>,
    /// Mean of each component of the excitation, used if no channel measures it.
    mean_excitation: Vec<f64>,
    parameter_names: Vec<Name>,
    noise_names: Vec<Name>,
    /// Display name of the effective sample size of the particles. `None` without particles.
    effective_name: Option<Name>,
    responses: Vec<EstimatedResponse>,
    /// Responses of the frames being processed.
    responded: Vec<Vec<(f64, f64)>>,
    /// One entry per observation row. Empty if outliers are not screened.
    screening: Vec<ScreeningView>,
    /// `None` with a single model.
    classes: Option<ClassView>,
    fit: FitView,
    decimation: Decimation,
    is_thinned: bool,
    /// Number of display values omitted since the last report.
    shed: u64,
    stream: Option<Stream>,
    /// Scratch space: the measured values of one frame.
    frame: Vec<f64>,
    /// Scratch space: the values of the frame for the filter.
    observations: Vec<f64>,
    excitation: Vec<f64>,
    restarts: u64,
    /// Number of frames since the last one with a channel.
    unobserved: u64,
    /// Largest number of frames per sample of a node.
    slowest_stride: u64,
    /// State of each component of the excitation.
    hearing: Vec<Hearing>,
    reliability: Reliability,
    recent: Recent,
    sudden: SuddenFaults,
    recovery: Recovery,
    /// Half-life of the filter in frames.
    half_life: f64,
    /// Names of the components, with the channels that measure them, if any.
    excitation_names: Vec<(String, Option<String>)>,
    /// Last measured values. Bit-identical repetitions are not measurements.
    last_values: Vec<f64>,
    /// Number of frames since a parameter was last clipped, if ever.
    since_clipped: Option<u64>,
    check: SensorCheck,
    spikes: Spikes,
    /// Observation rows that are never used.
    left_out: Vec<usize>,
    /// Frames until the parameters are identified again after a restart without a faulty sensor, 0
    /// if they are.
    settling: u64,
    channel_names: Vec<Name>,
    /// Nodes with a channel that is compared with others, and the channels of each in a frame.
    compared: Vec<(Name, std::ops::Range<usize>)>,
    /// `None` if the structure file does not state what strong motion is.
    motion: Option<Motion>,
}

/// Returns the initial state of an excitation component.
///
/// A shaker at rest measures exactly zero force, but the ground at rest is measured with some
/// noise.
fn hearing_of(structure: &Structure, channel: Option<usize>) -> Hearing {
    let measured = channel.and_then(|channel| structure.channels().nth(channel));
    Hearing::new(measured.is_some_and(|channel| channel.quantity() == Quantity::Force))
}

/// Position in the current epoch of frames.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Stream {
    epoch: u64,
    next: u64,
    t0_ns: i64,
    sampling_rate_hz: f64,
}

impl Stream {
    /// Returns the maximum number of frames that predictions may bridge.
    fn bridged_frames(self) -> u64 {
        (BRIDGED_GAP_S * self.sampling_rate_hz) as u64
    }

    /// Returns the number of repetitions after which a sensor counts as stuck.
    fn stuck_frames(self) -> u64 {
        ((STUCK_S * self.sampling_rate_hz) as u64).max(STUCK_SAMPLES)
    }
}

impl Identification {
    /// Creates the identification of a structure at its prior. Estimates are published under the ID
    /// `source`.
    ///
    /// # Errors
    /// Fails if the filter rejects its settings, or a name cannot be a key.
    pub fn new(structure: &Structure, source: impl Into<String>) -> Result<Self, IdentifyError> {
        let refused = |source| IdentifyError::Filter {
            structure: structure.name().to_owned(),
            source,
        };
        let estimator = Estimator::new(structure).map_err(refused)?;
        Self::with_estimator(structure, source, estimator)
    }

    /// Creates an identification like [`Identification::new`], but with the given estimator of the
    /// same structure.
    ///
    /// # Errors
    /// Fails if a name cannot be a key, or the band limit is invalid.
    pub fn with_estimator(
        structure: &Structure,
        source: impl Into<String>,
        estimator: Estimator,
    ) -> Result<Self, IdentifyError> {
        let refused = |source| IdentifyError::Filter {
            structure: structure.name().to_owned(),
            source,
        };
        let named = |name: &str| {
            Name::new(name).map_err(|source| IdentifyError::Name {
                structure: structure.name().to_owned(),
                source,
            })
        };
        let channels = structure.channel_count();
        let fit = FitView::new(structure).map_err(|source| IdentifyError::Name {
            structure: structure.name().to_owned(),
            source,
        })?;
        let band_limit = structure
            .band_limit()
            .map(|limit| {
                BandLimit::low_pass(
                    limit.order,
                    limit.frequency_hz,
                    structure.sampling_rate_hz(),
                    channels,
                )
            })
            .transpose()
            .map_err(refused)?;
        let parameter_names = structure
            .parameters()
            .iter()
            .map(|parameter| named(parameter.name()))
            .collect::<Result<_, IdentifyError>>()?;
        let noise_names = estimator
            .settings()
            .noise
            .parameters
            .iter()
            .map(|parameter| named(&parameter.name))
            .collect::<Result<_, _>>()?;
        let check = SensorCheck::new(structure);
        let compared = sensors::compared_nodes(structure, &check)?;
        let motion = Motion::new(structure).map_err(|source| IdentifyError::Earthquakes {
            structure: structure.name().to_owned(),
            source,
        })?;
        let channel_names = structure
            .channels()
            .map(|channel| named(channel.name()))
            .collect::<Result<Vec<Name>, IdentifyError>>()?;
        let recent = Recent::new(
            structure.observation_channels().len(),
            structure.excitation_channels().len(),
            check.window_s() * structure.sampling_rate_hz(),
        );
        let noise = structure
            .channels()
            .map(|channel| channel.noise_std().powi(2));
        let noise: Vec<f64> = noise.collect();
        let of_rows = structure.observation_channels().iter();
        let sudden = SuddenFaults::new(
            of_rows.map(|channel| noise[*channel]).collect(),
            structure.fundamental_period_s(),
            structure.sampling_rate_hz(),
        );
        let screening = match estimator.outliers() {
            Some(_) => {
                let channels = structure.observation_channels().iter();
                let views =
                    channels.map(|channel| ScreeningView::new(channel_names[*channel].clone()));
                views.collect()
            }
            None => Vec::new(),
        };
        Ok(Self {
            screening,
            classes: estimator
                .classes()
                .map(|bank| ClassView::new(structure, bank)),
            fit,
            structure: named(structure.name())?,
            source: source.into(),
            observation_channels: structure.observation_channels().to_vec(),
            excitation_channels: structure.excitation_channels().to_vec(),
            mean_excitation: structure.mean_excitation().as_slice().to_vec(),
            observations: vec![f64::NAN; structure.observation_channels().len()],
            excitation: vec![0.0; structure.excitation_channels().len()],
            frame: vec![f64::NAN; channels],
            decimation: Decimation::new(structure.sampling_rate_hz(), structure.display_rate_hz()),
            is_thinned: false,
            shed: 0,
            parameter_names,
            noise_names,
            effective_name: matches!(estimator, Estimator::Particles(_))
                .then(|| named(EFFECTIVE_PARTICLES))
                .transpose()?,
            responses: structure.estimated_responses().to_vec(),
            responded: Vec::new(),
            estimator,
            band_limit,
            stream: None,
            restarts: 0,
            unobserved: 0,
            slowest_stride: structure.frames_per_sample().into_iter().max().unwrap_or(1),
            hearing: structure
                .excitation_channels()
                .iter()
                .map(|channel| hearing_of(structure, *channel))
                .collect(),
            reliability: Reliability::new(structure),
            recent,
            sudden,
            recovery: Recovery::default(),
            half_life: structure.half_life_s() * structure.sampling_rate_hz(),
            last_values: vec![f64::NAN; channels],
            excitation_names: structure
                .excitations()
                .iter()
                .flat_map(component_names)
                .zip(structure.excitation_channels())
                .map(|(name, channel)| {
                    let channel = channel.and_then(|channel| structure.channels().nth(channel));
                    (name, channel.map(|channel| channel.name().to_owned()))
                })
                .collect(),
            since_clipped: None,
            check,
            spikes: Spikes::default(),
            left_out: Vec::new(),
            settling: 0,
            compared,
            channel_names,
            motion,
        })
    }

    /// Processes one input and appends the outputs.
    pub fn handle(&mut self, input: IdentificationInput, outputs: &mut Vec<Output>) {
        let mut next = Some(input);
        while let Some(input) = next {
            next = self.handle_part(input, outputs);
        }
    }

    /// Processes one input like [`Identification::handle`], but only part of a long gap.
    ///
    /// Returns the rest of the gap, if any. The caller therefore need not hold all estimates at
    /// once. 4096 frames with 160 parameters would take about 400 MB.
    #[must_use]
    pub fn handle_part(
        &mut self,
        input: IdentificationInput,
        outputs: &mut Vec<Output>,
    ) -> Option<IdentificationInput> {
        match input {
            IdentificationInput::Frames(block) => {
                self.take_block(&block, outputs);
                None
            }
            IdentificationInput::Gap { since, from, to } => {
                let done = self.bridge(since, from, to, outputs);
                (done < to).then_some(IdentificationInput::Gap {
                    since,
                    from: done,
                    to,
                })
            }
        }
    }

    /// Returns how often the filter was restarted from its prior.
    #[must_use]
    pub fn restarts(&self) -> u64 {
        self.restarts
    }

    /// Sets whether display values are thinned to a tenth of their rate. The setting does not
    /// affect estimates.
    pub fn thin_display(&mut self, is_thinned: bool) {
        self.is_thinned = is_thinned;
    }

    /// Returns the number of display values omitted since the last call.
    pub fn take_omitted(&mut self) -> u64 {
        std::mem::take(&mut self.shed)
    }

    /// Returns the number of the first frame that is not processed, 0 before the first.
    #[must_use]
    pub fn done(&self) -> u64 {
        self.stream.map_or(0, |stream| stream.next)
    }

    /// Returns the estimator.
    #[must_use]
    pub fn estimator(&self) -> &Estimator {
        &self.estimator
    }

    /// Returns the message with the present plausibilities of the model classes, or `None` with a
    /// single model.
    ///
    /// `time_ns` is the measurement time that the message states (ns since the Unix epoch, UTC).
    #[must_use]
    pub fn class_display(&self, time_ns: i64) -> Option<ModelClassDisplay> {
        let (bank, view) = (self.estimator.classes()?, self.classes.as_ref()?);
        Some(view.display(&self.structure, time_ns, bank))
    }

    /// Returns the verdict on the fit after the last frame. `None` if the fit is not assessed.
    #[must_use]
    pub fn fit_verdict(&self) -> Option<FitVerdict> {
        fit::judged(&self.estimator).map(|judged| judged.verdict)
    }

    /// Returns `true` if several model classes are compared.
    #[must_use]
    pub fn compares_classes(&self) -> bool {
        self.classes.is_some()
    }

    /// Returns the names of the parameters, in the order of the estimates.
    pub fn parameter_names(&self) -> impl Iterator<Item = &Name> {
        self.parameter_names.iter()
    }

    /// Returns the names of the channels screened for outliers, if any.
    pub fn screened_channels(&self) -> impl Iterator<Item = &Name> {
        self.screening.iter().map(ScreeningView::channel)
    }

    /// Returns the display names of the noise levels and of the effective sample size of the
    /// particles.
    pub fn displayed_noise_names(&self) -> impl Iterator<Item = &Name> {
        self.noise_names.iter().chain(&self.effective_name)
    }

    /// Returns `true` while the particle filter has diverged. Its estimates then support no alerts.
    ///
    /// Returns `false` for all other filters.
    #[must_use]
    pub fn has_lost_state(&self) -> bool {
        match &self.estimator {
            Estimator::Particles(particles) => {
                particles.health().is_some_and(|health| health.is_lost())
            }
            Estimator::Filter(_) | Estimator::Classes(_) => false,
        }
    }

    /// Returns the names of the identified noise levels, in the order of the estimates.
    #[must_use]
    pub fn noise_names(&self) -> &[Name] {
        &self.noise_names
    }

    fn take_block(&mut self, block: &FrameBlock, outputs: &mut Vec<Output>) {
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
    fn bridge(&mut self, since: u64, from: u64, to: u64, outputs: &mut Vec<Output>) -> u64 {
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

    fn restart(&mut self, time_ns: i64, why: &str) -> Output {
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

    fn told_restart(
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
    fn forget_sensors(&mut self) {
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

    fn estimate(&mut self, step: Option<Step>, restarted: bool) -> Estimate {
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

    /// Returns the number of frames without a sample after which channels count as silent.
    fn silent_frames(&self, stream: Stream) -> u64 {
        let of_time = (SILENT_S * stream.sampling_rate_hz) as u64;
        of_time.max(2 * self.slowest_stride).max(1)
    }

    /// Returns `true` if no sensor of the response has delivered a usable sample for some time.
    fn has_silent_response(&self) -> bool {
        self.stream
            .is_some_and(|stream| self.unobserved >= self.silent_frames(stream))
    }

    fn publish(
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
    fn most_of_a_block(&self) -> usize {
        self.stream.map_or(1, |stream| {
            (MOST_BYTES / self.empty_block(stream).item_bytes()).max(1)
        })
    }

    /// Returns the number of messages from [`Self::display`].
    fn values_displayed(&self) -> u64 {
        let single =
            usize::from(self.classes.is_some()) + usize::from(self.effective_name.is_some());
        let fit = usize::from(fit::judged(&self.estimator).is_some());
        (self.parameter_names.len() + self.noise_names.len() + single + fit + self.screening.len())
            as u64
    }

    fn display(&mut self, time_ns: i64, outputs: &mut Vec<Output>) {
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

/// Repeats the name of an excitation for each of its components.
fn component_names(excitation: &Excitation) -> impl Iterator<Item = String> {
    std::iter::repeat_n(excitation.name().to_owned(), excitation.component_len())
}

#[cfg(test)]
mod tests;
