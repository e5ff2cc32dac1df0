//! Streams of several bands side by side, so that one setting suits any structure.
//!
//! A subspace method finds a mode only if its time lags cover about a period of the mode, and if
//! the sampling rate is not far above its frequency. The ladder therefore repeats the
//! identification at lower and lower rates, each a fifth of the one above. Each band accounts for
//! the upper four fifths of its frequencies, and the lowest band for all of them.

use crate::identify::{Identified, Mode, identify};
use crate::settings::USABLE_SHARE;
use crate::shape::mac;
use crate::stream::{Epoch, ModalStream};
use crate::{ModalError, ModalSettings};
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;

/// Ratio of the rates of two neighbouring bands.
const STEP: f64 = 5.0;
/// Largest number of bands.
const MOST_BANDS: usize = 5;
/// Share by which a band exceeds its lower limit, so that a mode at the limit is found in one of
/// two bands.
const MARGIN: f64 = 0.1;
/// Relative difference of the frequencies of copies of one mode from two bands.
const SAME_FREQUENCY: f64 = 0.02;
/// Smallest assurance criterion of the shapes of such copies.
const SAME_SHAPE: f64 = 0.9;

/// Collects frames into epochs in one or more frequency bands, from the highest to the lowest.
///
/// [`BandLadder::single`] uses one band. [`BandLadder::new`] adds lower bands, because an
/// identification is poor far below the sampling rate. More bands cost more time per epoch.
///
/// [`BandLadder::push`] returns an epoch once it is complete in all bands. The state can be
/// serialised at any frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BandLadder {
    streams: Vec<ModalStream>,
    /// Epochs of each band that wait for the other bands.
    waiting: Vec<VecDeque<Epoch>>,
}

/// An epoch in all bands, from the highest to the lowest.
#[derive(Debug, Clone, PartialEq)]
pub struct LadderEpoch {
    /// The epoch of each band.
    pub bands: Vec<Epoch>,
}

/// The modes of an epoch in all bands.
#[derive(Debug, Clone, PartialEq)]
pub struct LadderModes {
    /// Modes and machines of all bands, in order of frequency.
    pub modes: Vec<Mode>,
    /// Modes and poles of each band, from the highest to the lowest.
    pub bands: Vec<Identified>,
}

impl BandLadder {
    /// Creates a ladder with a single band, that of the settings.
    ///
    /// # Errors
    /// Returns an error if the settings are not valid.
    pub fn single(settings: &ModalSettings) -> Result<Self, ModalError> {
        Ok(Self::of(vec![ModalStream::new(settings)?]))
    }

    /// Creates a ladder from the band of the settings downwards.
    ///
    /// A lower band is added while its blocks are long enough for its time lags.
    ///
    /// # Errors
    /// Returns an error if the settings are not valid.
    pub fn new(settings: &ModalSettings) -> Result<Self, ModalError> {
        let mut bands = vec![settings.clone()];
        while bands.len() < MOST_BANDS {
            let mut next = settings.clone();
            next.highest_hz = bands[bands.len() - 1].highest_hz / STEP;
            if next.highest_hz <= settings.lowest_hz || next.shortest_epoch_s() > next.epoch_s {
                break;
            }
            bands.push(next);
        }
        // Whole blocks of the lowest band, so that the epochs of all bands are equally long.
        if let Some(lowest) = bands.last() {
            let rate_hz = lowest.decimated_rate_hz();
            let block = (settings.epoch_s * rate_hz / settings.blocks as f64).floor();
            let epoch_s = block.max(1.0) * settings.blocks as f64 / rate_hz;
            bands.iter_mut().for_each(|band| band.epoch_s = epoch_s);
        }
        for position in 1..bands.len() {
            let upper = bands[position].highest_hz;
            bands[position - 1].lowest_mode_hz = upper * (1.0 - MARGIN);
        }
        let streams: Result<Vec<ModalStream>, ModalError> =
            bands.iter().map(ModalStream::new).collect();
        Ok(Self::of(streams?))
    }

    fn of(streams: Vec<ModalStream>) -> Self {
        Self {
            waiting: vec![VecDeque::new(); streams.len()],
            streams,
        }
    }

    /// Returns the settings of each band, from the highest to the lowest.
    pub fn settings(&self) -> impl Iterator<Item = &ModalSettings> {
        self.streams.iter().map(ModalStream::settings)
    }

    /// Adds a frame: one value per channel, `NaN` if missing. Returns an epoch if one is complete
    /// in all bands.
    ///
    /// # Errors
    /// Returns an error if the frame has another number of values than the settings have channels.
    pub fn push(&mut self, frame: &[f64]) -> Result<Option<LadderEpoch>, ModalError> {
        for (stream, waiting) in self.streams.iter_mut().zip(&mut self.waiting) {
            waiting.extend(stream.push(frame)?);
        }
        if self.waiting.iter().any(VecDeque::is_empty) {
            return Ok(None);
        }
        let bands = self.waiting.iter_mut().filter_map(VecDeque::pop_front);
        Ok(Some(LadderEpoch {
            bands: bands.collect(),
        }))
    }

    /// Starts a new epoch after a gap in time. Incomplete epochs are dropped.
    pub fn gap(&mut self) {
        self.streams.iter_mut().for_each(ModalStream::gap);
        self.waiting.iter_mut().for_each(VecDeque::clear);
    }
}

impl LadderEpoch {
    /// Identifies the modes in all bands. Of copies of a mode in two bands, the more precise one
    /// stays.
    ///
    /// # Errors
    /// Returns an error if too few channels are usable, or if a decomposition does not converge.
    pub fn identify(&self) -> Result<LadderModes, ModalError> {
        let bands: Result<Vec<Identified>, ModalError> = self.bands.iter().map(identify).collect();
        let bands = bands?;
        let mut modes: Vec<Mode> = Vec::new();
        for mode in bands.iter().flat_map(|band| &band.modes) {
            let copy = modes.iter_mut().find(|known| is_copy(known, mode));
            match copy {
                Some(known) if known.frequency_std_hz > mode.frequency_std_hz => {
                    known.clone_from(mode);
                }
                Some(_) => {}
                None => modes.push(mode.clone()),
            }
        }
        modes.sort_by(|a, b| a.frequency_hz.total_cmp(&b.frequency_hz));
        Ok(LadderModes { modes, bands })
    }
}

fn is_copy(first: &Mode, second: &Mode) -> bool {
    let difference = (first.frequency_hz - second.frequency_hz).abs();
    first.band_hz != second.band_hz
        && difference < SAME_FREQUENCY * second.frequency_hz
        && first.channels == second.channels
        && mac(&first.shape, &second.shape) > SAME_SHAPE
}

/// Returns the highest upper end of a band at a sampling rate (Hz).
#[must_use]
pub fn highest_band_end_hz(rate_hz: f64) -> f64 {
    USABLE_SHARE * rate_hz
}
