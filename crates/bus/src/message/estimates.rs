//! Estimates of all identified quantities, per frame.

use serde::{Deserialize, Serialize};

use super::block::continues;
use super::{
    Block, FitReasons, FitVerdict, Format, Header, MAX_CHANNELS, MAX_ITEMS, MAX_MESSAGE_BYTES,
    Malformed, Message, StreamState, bounded, check_count, check_finite, check_finite_or_missing,
    check_range,
};
use crate::grid::TimeGrid;

/// Operating phase of the filter.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Phase {
    /// The filter is learning the noise levels, so that the estimate is unreliable.
    Training,
    /// Normal operation.
    Working,
    /// A measured excitation has no usable samples, so that the estimate is unreliable.
    ExcitationSilent,
    /// A sensor in use is probably faulty, so that the estimate is unreliable.
    SensorInDoubt,
    /// No sensor of the response has delivered a usable sample for a second, or in distributed
    /// identification for three fusions. The estimate is a prediction.
    ResponseSilent,
}

/// Special conditions of one frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct EstimateFlags {
    /// Operating phase of the filter.
    pub phase: Phase,
    /// `true` if the filter was restarted from its prior at this frame.
    pub restarted: bool,
    /// `true` if no channel was usable, so that the estimate is the prediction.
    pub prediction_only: bool,
    /// Verdict on the fit. `None` for the station of distributed identification and for particle
    /// filters, which do not assess the fit.
    pub fit: Option<FitVerdict>,
    /// Reasons why the verdict is not supported.
    pub fit_reasons: FitReasons,
    /// `true` while the filter follows a sudden change. The estimates are then still changing.
    pub follows_jump: bool,
    /// Largest acceleration (m/s²) since the present strong motion began. `None` in weak motion,
    /// and if nothing states what strong motion is.
    pub strong_motion: Option<f32>,
}

/// Channels that are excluded because their sensors are faulty.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Excluded {
    /// All channels are used.
    #[default]
    None,
    /// One channel, by its observation row.
    One(u16),
    /// Several channels.
    Several,
}

impl EstimateFlags {
    /// Creates the flags of a frame in normal operation without a verdict on the fit.
    #[must_use]
    pub fn working() -> Self {
        Self {
            phase: Phase::Working,
            restarted: false,
            prediction_only: false,
            fit: None,
            fit_reasons: FitReasons::default(),
            follows_jump: false,
            strong_motion: None,
        }
    }
}

/// Estimate at one frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    /// Means of the parameters, in state order, ratios to nominal.
    pub mean: Vec<f64>,
    /// Covariance of the parameters: upper triangle by columns, p(p+1)/2 values.
    pub covariance: Vec<f64>,
    /// Means of the noise parameters.
    pub noise_mean: Vec<f64>,
    /// Variances of the noise parameters.
    pub noise_covariance: Vec<f64>,
    /// Innovation per observation row, units of the channels. NaN = missing or screened out.
    pub innovations: Vec<f64>,
    /// Normalised innovation squared νᵀS⁻¹ν over the used channels, with the innovation ν and its
    /// covariance S.
    pub normalised_innovation_squared: f64,
    /// Natural logarithm of the evidence of this frame: the density of its measurement given the
    /// earlier data.
    pub log_evidence: f64,
    /// Number of observation rows used in the update.
    pub used_channels: u16,
    /// Special conditions of the frame.
    pub flags: EstimateFlags,
    /// Channels that the check of the sensors excludes.
    pub excluded: Excluded,
    /// Information about each parameter that the filter would keep if it continued to learn at its
    /// present rate: one divided by a variance, ratio to nominal. 0 = nothing is being learnt.
    ///
    /// Empty if the rate is not measured: at the start, by the station of distributed
    /// identification, with several model classes, and by particle filters.
    pub sustained_information: Vec<f32>,
}

impl Estimate {
    /// Returns the variance of parameter `index`, or `None` if the parameter does not exist.
    #[must_use]
    pub fn variance(&self, index: usize) -> Option<f64> {
        self.covariance(index, index)
    }

    /// Returns the covariance of two parameters, or `None` if one of them does not exist.
    #[must_use]
    pub fn covariance(&self, first: usize, second: usize) -> Option<f64> {
        // Column j of the upper triangle starts at j(j+1)/2.
        let (row, column) = (first.min(second), first.max(second));
        self.covariance
            .get(column * (column + 1) / 2 + row)
            .copied()
    }
}

/// Consecutive estimates. Estimate j belongs to frame `header.sequence + j`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EstimateBlock {
    /// Source: id of identify. Sequence and time: number and time of the first frame in this block.
    pub header: Header,
    /// Term of the leading identify. 0 for the station of distributed identification, which has no
    /// standby.
    pub term: u64,
    /// Time of frame 0, ns since the Unix epoch, UTC.
    pub t0_ns: i64,
    /// Sampling rate of the structure, Hz.
    pub sampling_rate_hz: f64,
    /// Number of parameters per estimate.
    pub parameters: u16,
    /// Number of noise parameters per estimate.
    pub noise_parameters: u16,
    /// Number of observation rows per estimate.
    pub channels: u16,
    /// One estimate per frame.
    #[serde(deserialize_with = "bounded::list::<_, _, MAX_ITEMS>")]
    pub estimates: Vec<Estimate>,
    /// Whether more estimates follow this block.
    pub state: StreamState,
}

impl EstimateBlock {
    /// Returns the times of the frames, from frame 0 of the epoch. `None` if the sampling rate is
    /// invalid, which [`Message::check`] excludes.
    #[must_use]
    pub fn grid(&self) -> Option<TimeGrid> {
        TimeGrid::new(self.t0_ns, self.sampling_rate_hz)
    }

    /// Iterates over the estimates in order, with their frame numbers.
    pub fn iter(&self) -> impl Iterator<Item = (u64, &Estimate)> {
        (self.header.sequence..).zip(&self.estimates)
    }

    fn check_estimate(&self, estimate: &Estimate) -> Result<(), Malformed> {
        let parameters = usize::from(self.parameters);
        let noise = usize::from(self.noise_parameters);
        let lists = [
            ("mean", &estimate.mean, parameters),
            (
                "covariance",
                &estimate.covariance,
                parameters * (parameters + 1) / 2,
            ),
            ("noise mean", &estimate.noise_mean, noise),
            ("noise covariance", &estimate.noise_covariance, noise),
        ];
        for (what, list, expected) in lists {
            check_length(what, list.len(), expected)?;
            for &value in list {
                check_finite(what, value)?;
            }
        }
        check_length(
            "innovations",
            estimate.innovations.len(),
            usize::from(self.channels),
        )?;
        check_finite_or_missing("innovations", &estimate.innovations)?;
        check_finite(
            "normalised innovation squared",
            estimate.normalised_innovation_squared,
        )?;
        check_finite("log evidence", estimate.log_evidence)?;
        if !estimate.sustained_information.is_empty() {
            check_length(
                "sustained information",
                estimate.sustained_information.len(),
                parameters,
            )?;
        }
        if let Some(peak) = estimate.flags.strong_motion {
            check_range("strong motion", peak.into(), 0.0, f64::MAX)?;
        }
        for &information in &estimate.sustained_information {
            check_range("sustained information", information.into(), 0.0, f64::MAX)?;
        }
        check_count(
            "used channels",
            usize::from(estimate.used_channels),
            0,
            usize::from(self.channels),
        )
    }
}

fn check_length(what: &'static str, found: usize, expected: usize) -> Result<(), Malformed> {
    if found == expected {
        return Ok(());
    }
    Err(Malformed::Length {
        what,
        found,
        expected,
    })
}

impl Message for EstimateBlock {
    const TYPE: &'static str = "estimates";
    const VERSION: u16 = 5;
    const FORMAT: Format = Format::Postcard;

    fn check(&self) -> Result<(), Malformed> {
        check_count("parameters", usize::from(self.parameters), 0, MAX_CHANNELS)?;
        check_count(
            "noise parameters",
            usize::from(self.noise_parameters),
            0,
            MAX_CHANNELS,
        )?;
        check_count("channels", usize::from(self.channels), 0, MAX_CHANNELS)?;
        check_count("estimates", self.estimates.len(), 0, MAX_ITEMS)?;
        if self.grid().is_none() {
            return Err(Malformed::Rate {
                found: self.sampling_rate_hz,
            });
        }
        for estimate in &self.estimates {
            self.check_estimate(estimate)?;
        }
        self.header.check(self.count())
    }
}

impl Block for EstimateBlock {
    fn header(&self) -> &Header {
        &self.header
    }

    fn count(&self) -> u64 {
        self.estimates.len() as u64
    }

    fn state(&self) -> StreamState {
        self.state
    }

    fn term(&self) -> u64 {
        self.term
    }

    fn set_term(&mut self, term: u64) {
        self.term = term;
    }

    fn item_bytes(&self) -> usize {
        const LENGTHS_AND_FLAGS: usize = 64;
        let parameters = usize::from(self.parameters);
        let values = parameters * (parameters + 3) / 2
            + 2 * usize::from(self.noise_parameters)
            + usize::from(self.channels);
        (8 * values + 4 * parameters + LENGTHS_AND_FLAGS).min(MAX_MESSAGE_BYTES)
    }

    fn skip(&mut self, items: u64) {
        let items = items.min(self.count());
        self.header.sequence += items;
        if let Some(grid) = self.grid() {
            self.header.time_ns = grid.time_ns(self.header.sequence);
        }
        self.estimates.drain(..items as usize);
    }

    fn truncate(&mut self, items: u64) {
        if items < self.count() {
            self.estimates.truncate(items as usize);
            self.state = StreamState::Running;
        }
    }

    fn append(&mut self, next: &Self) -> bool {
        let follows = continues(&self.header, self.end(), self.state, &next.header)
            && self.term == next.term
            && self.t0_ns == next.t0_ns
            && self.sampling_rate_hz == next.sampling_rate_hz
            && (self.parameters, self.noise_parameters, self.channels)
                == (next.parameters, next.noise_parameters, next.channels)
            && self.count() + next.count() <= MAX_ITEMS as u64;
        if follows {
            self.estimates.extend_from_slice(&next.estimates);
            self.state = next.state;
        }
        follows
    }
}
