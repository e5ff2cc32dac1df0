//! A stream of frames, cut into epochs.

use crate::covariance::{CovarianceStream, EpochCovariances};
use crate::prefilter::Prefilter;
use crate::settings::Layout;
use crate::spectrum::{EpochSpectrum, SpectrumStream};
use crate::{ModalError, ModalSettings};
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;

/// Largest share of missing samples of a channel that takes part in an epoch. Missing samples
/// repeat the last value, which at this share changes a covariance by about 2 %.
pub const MOST_MISSING: f64 = 0.02;

/// What the samples of a channel show in a block, before any filter.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Samples {
    least: f64,
    most: f64,
    present: u64,
    all: u64,
}

impl Samples {
    const NONE: Self = Self {
        least: f64::INFINITY,
        most: f64::NEG_INFINITY,
        present: 0,
        all: 0,
    };

    fn push(&mut self, value: f64) {
        self.all += 1;
        if value.is_finite() {
            self.present += 1;
            self.least = self.least.min(value);
            self.most = self.most.max(value);
        }
    }

    fn and(self, other: Self) -> Self {
        Self {
            least: self.least.min(other.least),
            most: self.most.max(other.most),
            present: self.present + other.present,
            all: self.all + other.all,
        }
    }
}

/// Whether a channel takes part in an epoch.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ChannelUse {
    /// The channel takes part.
    Used,
    /// All samples have the same value.
    Constant,
    /// No sample is present.
    Dead,
    /// More samples are missing than [`MOST_MISSING`] allows.
    Incomplete {
        /// Share of missing samples.
        missing: f64,
    },
}

impl ChannelUse {
    fn of(samples: Samples) -> Self {
        let missing = 1.0 - samples.present as f64 / samples.all.max(1) as f64;
        if samples.present == 0 {
            Self::Dead
        } else if missing > MOST_MISSING {
            Self::Incomplete { missing }
        } else if samples.least == samples.most {
            Self::Constant
        } else {
            Self::Used
        }
    }
}

/// The sums of one epoch, from which [`identify`](crate::identify()) determines modes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Epoch {
    /// Position of the frame after the last frame of the epoch, counted from the first frame of
    /// the stream.
    pub end: u64,
    /// Length of the epoch (s).
    pub length_s: f64,
    /// Whether each channel takes part.
    pub channels: Vec<ChannelUse>,
    /// Output covariances of the channels that take part.
    pub covariances: EpochCovariances,
    /// Spectral densities of the channels that take part, since the end of the previous epoch.
    /// `None` if no segment is complete.
    pub spectrum: Option<EpochSpectrum>,
    /// Sampling rate of the covariances (Hz).
    pub rate_hz: f64,
    /// Band of the modes (Hz).
    pub band_hz: (f64, f64),
    /// Highest order of the state-space models.
    pub highest_order: usize,
}

/// Accumulates frames and returns an [`Epoch`] whenever one is complete.
///
/// The result depends only on the frames, not on how they are grouped into calls. The state can be
/// serialised at any frame and continues bit-identically.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ModalStream {
    settings: ModalSettings,
    layout: Layout,
    prefilter: Prefilter,
    covariances: CovarianceStream,
    spectra: SpectrumStream,
    /// Samples of complete blocks of the present epoch, for each channel.
    samples: VecDeque<Vec<Samples>>,
    current: Vec<Samples>,
    frames: u64,
    blocks_until_epoch: usize,
}

impl ModalStream {
    /// Creates an empty stream.
    ///
    /// # Errors
    /// Returns an error if the settings are not valid.
    pub fn new(settings: &ModalSettings) -> Result<Self, ModalError> {
        let layout = settings.layout()?;
        let channels = settings.channels;
        Ok(Self {
            layout,
            prefilter: Prefilter::new(
                channels,
                settings.rate_hz,
                settings.lowest_hz,
                layout.factor,
            ),
            covariances: CovarianceStream::new(
                channels,
                settings.references.clone(),
                settings.block_rows,
                layout.block,
                settings.blocks,
            ),
            spectra: SpectrumStream::new(channels, layout.segment, layout.rate_hz),
            samples: VecDeque::new(),
            current: vec![Samples::NONE; channels],
            frames: 0,
            blocks_until_epoch: settings.blocks,
            settings: settings.clone(),
        })
    }

    /// Returns the settings.
    #[must_use]
    pub fn settings(&self) -> &ModalSettings {
        &self.settings
    }

    /// Returns the number of frames so far.
    #[must_use]
    pub fn frames(&self) -> u64 {
        self.frames
    }

    /// Adds a frame: one value per channel, `NaN` if missing. Returns an epoch if one is complete.
    ///
    /// # Errors
    /// Returns an error if the frame has another number of values than the stream has channels. The
    /// state does not change.
    pub fn push(&mut self, frame: &[f64]) -> Result<Option<Epoch>, ModalError> {
        if frame.len() != self.settings.channels {
            return Err(ModalError::Frame {
                found: frame.len(),
                channels: self.settings.channels,
            });
        }
        self.frames += 1;
        for (samples, value) in self.current.iter_mut().zip(frame) {
            samples.push(*value);
        }
        let Some(decimated) = self.prefilter.push(frame) else {
            return Ok(None);
        };
        self.spectra.push(decimated);
        if !self.covariances.push(decimated) {
            return Ok(None);
        }
        Ok(self.complete_block())
    }

    /// Starts a new epoch after a gap in time. The incomplete epoch is dropped.
    pub fn gap(&mut self) {
        self.prefilter.reset();
        self.covariances.reset();
        self.spectra.reset();
        self.samples.clear();
        self.current.fill(Samples::NONE);
        self.blocks_until_epoch = self.settings.blocks;
    }

    fn complete_block(&mut self) -> Option<Epoch> {
        if self.samples.len() == self.settings.blocks {
            self.samples.pop_front();
        }
        self.samples.push_back(self.current.clone());
        self.current.fill(Samples::NONE);
        self.blocks_until_epoch -= 1;
        if self.blocks_until_epoch > 0 {
            return None;
        }
        self.blocks_until_epoch = self.layout.hop;
        let epoch = self.epoch();
        self.spectra.clear();
        epoch
    }

    fn epoch(&self) -> Option<Epoch> {
        let channels: Vec<ChannelUse> = (0..self.settings.channels)
            .map(|channel| {
                let blocks = self.samples.iter().map(|block| block[channel]);
                ChannelUse::of(blocks.fold(Samples::NONE, Samples::and))
            })
            .collect();
        let usable: Vec<bool> = channels
            .iter()
            .map(|channel| *channel == ChannelUse::Used)
            .collect();
        let settings = &self.settings;
        Some(Epoch {
            end: self.frames,
            length_s: (self.layout.block * settings.blocks) as f64 / self.layout.rate_hz,
            covariances: self.covariances.epoch(&usable)?,
            spectrum: self.spectra.spectrum(&usable),
            channels,
            rate_hz: self.layout.rate_hz,
            band_hz: (
                settings.lowest_hz.max(settings.lowest_mode_hz),
                settings.highest_hz,
            ),
            highest_order: settings.highest_order,
        })
    }
}
