//! The core: receives frames of one structure and returns estimates, with one filter step per
//! frame.

mod events;
mod fit;
mod frames;
mod hearing;
mod messages;
mod motion;
mod recent;
mod recovery;
mod reliability;
mod sensors;
mod spikes;
mod state;
mod sudden;

use crate::error::{IdentifyError, key_name};
use crate::estimator::Estimator;
use crate::model_classes::ClassView;
use crate::screening::ScreeningView;
use fit::FitView;
use hearing::Hearing;
use motion::Motion;
use recent::Recent;
use recovery::Recovery;
use reliability::Reliability;
use serde::{Deserialize, Serialize};
use spandrel_bus::{
    Decimation, EstimateBlock, Event, FitDisplay, FitVerdict, FrameBlock, ModelClassDisplay, Name,
    NoiseDisplay, OutlierDisplay, ParameterDisplay, SensorHealthDisplay,
};
use spandrel_faults::SensorCheck;
use spandrel_filter::{BandLimit, FilterError};
use spandrel_structure::{EstimatedResponse, Excitation, Quantity, Structure};
use spikes::Spikes;
use sudden::SuddenFaults;

/// Maximum length of a gap (s) that is bridged by predictions. A longer gap resets the motion, but
/// keeps the parameters.
pub(crate) const BRIDGED_GAP_S: f64 = 10.0;

/// Time (s) for which an excitation must repeat bit-identical samples before its sensor counts as
/// stuck.
///
/// The number of samples must also reach [`STUCK_SAMPLES`]. A coarse converter repeats itself for a
/// shorter time in quiet conditions.
const STUCK_S: f64 = 2.0;
/// Minimum number of repeated samples before a sensor counts as stuck.
const STUCK_SAMPLES: u64 = 50;

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

/// Returns the declared band limit, if any.
pub(crate) fn band_limit_of(structure: &Structure) -> Result<Option<BandLimit>, FilterError> {
    let Some(limit) = structure.band_limit() else {
        return Ok(None);
    };
    let (rate_hz, channels) = (structure.sampling_rate_hz(), structure.channel_count());
    BandLimit::low_pass(limit.order, limit.frequency_hz, rate_hz, channels).map(Some)
}

/// Returns a view of each observed channel. Empty if outliers are not screened.
fn screening_of(
    structure: &Structure,
    estimator: &Estimator,
    channel_names: &[Name],
) -> Vec<ScreeningView> {
    let observed = structure.observation_channels().iter();
    match estimator.outliers() {
        Some(_) => observed
            .map(|channel| ScreeningView::new(channel_names[*channel].clone()))
            .collect(),
        None => Vec::new(),
    }
}

/// Returns the search for sudden faults in its initial state.
fn sudden_faults_of(structure: &Structure) -> SuddenFaults {
    let noise = structure
        .channels()
        .map(|channel| channel.noise_std().powi(2));
    let noise: Vec<f64> = noise.collect();
    let of_rows = structure.observation_channels().iter();
    SuddenFaults::new(
        of_rows.map(|channel| noise[*channel]).collect(),
        structure.fundamental_period_s(),
        structure.sampling_rate_hz(),
    )
}

/// Returns the names of the components of the excitation, with the channels that measure them, if
/// any.
fn excitation_names_of(structure: &Structure) -> Vec<(String, Option<String>)> {
    structure
        .excitations()
        .iter()
        .flat_map(component_names)
        .zip(structure.excitation_channels())
        .map(|(name, channel)| {
            let channel = channel.and_then(|channel| structure.channels().nth(channel));
            (name, channel.map(|channel| channel.name().to_owned()))
        })
        .collect()
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
    /// Returns an error if the filter rejects its settings, or a name cannot be a key.
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
    /// Returns an error if a name cannot be a key, or the band limit is invalid.
    pub fn with_estimator(
        structure: &Structure,
        source: impl Into<String>,
        estimator: Estimator,
    ) -> Result<Self, IdentifyError> {
        let refused = |source| IdentifyError::Filter {
            structure: structure.name().to_owned(),
            source,
        };
        let named = |name: &str| key_name(structure.name(), name);
        let channels = structure.channel_count();
        let fit = FitView::new(structure).map_err(|source| IdentifyError::Name {
            structure: structure.name().to_owned(),
            source,
        })?;
        let band_limit = band_limit_of(structure).map_err(refused)?;
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
        Ok(Self {
            screening: screening_of(structure, &estimator, &channel_names),
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
            sudden: sudden_faults_of(structure),
            recovery: Recovery::default(),
            half_life: structure.half_life_s() * structure.sampling_rate_hz(),
            last_values: vec![f64::NAN; channels],
            excitation_names: excitation_names_of(structure),
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
}

/// Repeats the name of an excitation for each of its components.
fn component_names(excitation: &Excitation) -> impl Iterator<Item = String> {
    std::iter::repeat_n(excitation.name().to_owned(), excitation.component_len())
}

#[cfg(test)]
mod tests;
