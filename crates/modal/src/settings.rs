//! Settings of the identification, and the lengths that follow from them.

use crate::ModalError;
use crate::prefilter::{decimation_factor, filling_frames};
use serde::{Deserialize, Serialize};

/// Share of the decimated sampling rate below which modes are identified. Above it, the
/// anti-aliasing filter attenuates.
pub(crate) const USABLE_SHARE: f64 = 0.4;
/// Number of half-overlapping segments per epoch for the spectra.
const SEGMENTS: usize = 8;
/// Limits of the length of a spectral segment, in decimated samples.
const SEGMENT_LIMITS: (usize, usize) = (64, 1024);
/// Number of rows of the observability matrix that the block rows must at least provide.
const OBSERVED_ROWS: usize = 240;
/// Limits of the number of block rows that follow from [`OBSERVED_ROWS`].
const ROW_LIMITS: (usize, usize) = (30, 60);
/// Largest number of reference channels that are chosen without a request.
const MOST_REFERENCES: usize = 6;

/// Settings of a [`ModalStream`](crate::ModalStream).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ModalSettings {
    /// Number of channels *l*.
    pub channels: usize,
    /// Positions of the reference channels, *r* in number.
    pub references: Vec<usize>,
    /// Sampling rate of the frames (Hz).
    pub rate_hz: f64,
    /// Lower end of the band (Hz). A high-pass filter removes slower motion. 0 keeps it.
    pub lowest_hz: f64,
    /// Upper end of the band (Hz), at most 0.4 of the sampling rate.
    pub highest_hz: f64,
    /// Frequency below which modes are left to another band (Hz). Unlike [`Self::lowest_hz`], it
    /// filters nothing.
    pub lowest_mode_hz: f64,
    /// Length of an epoch (s).
    pub epoch_s: f64,
    /// Share of an epoch that it has in common with the previous epoch, in whole blocks.
    pub overlap: f64,
    /// Number of blocks per epoch *B*, from which the uncertainty follows.
    pub blocks: usize,
    /// Number of block rows *i* of the block Hankel matrix. Time lags extend to 2*i* − 1 samples.
    pub block_rows: usize,
    /// Highest order of the state-space models.
    pub highest_order: usize,
}

impl ModalSettings {
    /// Default length of an epoch (s).
    pub const EPOCH_S: f64 = 600.0;
    /// Default number of blocks per epoch.
    pub const BLOCKS: usize = 20;
    /// Default highest order.
    pub const HIGHEST_ORDER: usize = 40;

    /// Creates settings with defaults: the whole usable band, epochs of 600 s without overlap, and
    /// all channels as references, or 6 evenly chosen ones of a larger number.
    #[must_use]
    pub fn new(channels: usize, rate_hz: f64) -> Self {
        let references = channels.min(MOST_REFERENCES);
        Self {
            channels,
            references: (0..references)
                .map(|position| position * channels / references)
                .collect(),
            rate_hz,
            lowest_hz: 0.0,
            highest_hz: USABLE_SHARE * rate_hz,
            lowest_mode_hz: 0.0,
            epoch_s: Self::EPOCH_S,
            overlap: 0.0,
            blocks: Self::BLOCKS,
            block_rows: OBSERVED_ROWS
                .div_ceil(channels.max(1))
                .clamp(ROW_LIMITS.0, ROW_LIMITS.1),
            highest_order: Self::HIGHEST_ORDER,
        }
    }

    /// Returns the sampling rate after decimation (Hz).
    #[must_use]
    pub fn decimated_rate_hz(&self) -> f64 {
        self.rate_hz / decimation_factor(self.rate_hz, self.highest_hz) as f64
    }

    /// Returns the length of the shortest epoch that these settings allow (s).
    #[must_use]
    pub fn shortest_epoch_s(&self) -> f64 {
        (self.blocks * 2 * self.block_rows) as f64 / self.decimated_rate_hz()
    }

    /// Returns the time before the first epoch, in which the filter and the time lags are filled
    /// (s).
    #[must_use]
    pub fn start_up_s(&self) -> f64 {
        let factor = decimation_factor(self.rate_hz, self.highest_hz);
        (filling_frames(factor) + 2 * self.block_rows * factor) as f64 / self.rate_hz
    }

    /// Checks the settings.
    ///
    /// # Errors
    /// Returns an error that names the first wrong value and the allowed ones.
    pub fn validate(&self) -> Result<(), ModalError> {
        self.layout().map(|_| ())
    }

    /// Checks the settings and returns the lengths that follow from them.
    ///
    /// # Errors
    /// Returns the same errors as [`Self::validate()`].
    pub(crate) fn layout(&self) -> Result<Layout, ModalError> {
        self.check()?;
        let rate_hz = self.decimated_rate_hz();
        let block = (self.epoch_s * rate_hz / self.blocks as f64 * (1.0 + 1e-9)).floor() as usize;
        if block < 2 * self.block_rows {
            return Err(ModalError::Epoch {
                found_s: self.epoch_s,
                at_least_s: self.shortest_epoch_s(),
            });
        }
        let longest = (block * self.blocks / SEGMENTS).clamp(SEGMENT_LIMITS.0, SEGMENT_LIMITS.1);
        let hop = ((1.0 - self.overlap) * self.blocks as f64).round() as usize;
        Ok(Layout {
            factor: decimation_factor(self.rate_hz, self.highest_hz),
            rate_hz,
            block,
            hop: hop.clamp(1, self.blocks),
            segment: 1 << longest.ilog2(),
        })
    }

    fn check(&self) -> Result<(), ModalError> {
        if self.channels < 2 {
            return Err(ModalError::Channels {
                found: self.channels,
                at_least: 2,
            });
        }
        let mut seen = vec![false; self.channels];
        for &found in &self.references {
            match seen.get_mut(found) {
                Some(seen) if !*seen => *seen = true,
                Some(_) | None => {
                    return Err(ModalError::Reference {
                        found,
                        last: self.channels - 1,
                    });
                }
            }
        }
        if !(self.rate_hz.is_finite() && self.rate_hz > 0.0) {
            return Err(ModalError::Rate {
                found_hz: self.rate_hz,
            });
        }
        let limit_hz = USABLE_SHARE * self.rate_hz;
        let (lowest_hz, highest_hz) = (self.lowest_hz, self.highest_hz);
        if !(lowest_hz >= 0.0
            && lowest_hz < highest_hz
            && highest_hz <= limit_hz * (1.0 + f64::EPSILON))
        {
            return Err(ModalError::Band {
                lowest_hz,
                highest_hz,
                limit_hz,
            });
        }
        if !(self.overlap >= 0.0 && self.overlap < 1.0) {
            return Err(ModalError::Overlap {
                found: self.overlap,
            });
        }
        let rank = self.block_rows.saturating_mul(self.references.len());
        let counts = [
            (
                "number of reference channels",
                self.references.len(),
                1,
                self.channels,
            ),
            ("number of blocks", self.blocks, 4, 1000),
            ("number of block rows", self.block_rows, 4, 1000),
            ("highest order", self.highest_order, 2, rank.min(200)),
        ];
        for (what, found, least, most) in counts {
            if !(least..=most).contains(&found) {
                return Err(ModalError::Count {
                    what,
                    found,
                    least,
                    most,
                });
            }
        }
        if !(self.epoch_s.is_finite() && self.epoch_s > 0.0) {
            return Err(ModalError::Epoch {
                found_s: self.epoch_s,
                at_least_s: self.shortest_epoch_s(),
            });
        }
        Ok(())
    }
}

/// Lengths that follow from the settings.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct Layout {
    /// Ratio of the sampling rates before and after decimation.
    pub(crate) factor: usize,
    /// Sampling rate after decimation (Hz).
    pub(crate) rate_hz: f64,
    /// Length of a block, in decimated samples.
    pub(crate) block: usize,
    /// Number of blocks from the end of an epoch to the end of the next one.
    pub(crate) hop: usize,
    /// Length of a spectral segment, in decimated samples; a power of two.
    pub(crate) segment: usize,
}
