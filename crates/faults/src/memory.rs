//! Cross-spectra of a group, with exponential forgetting.

use crate::resonance::WideSpectra;
use crate::spectrum::{Coefficients, OVERLAP};
use nalgebra::Complex;
use serde::{Deserialize, Serialize};

/// Cross-spectra of all pairs of channels.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Memory {
    /// Share that remains of a window when the next one arrives.
    kept: f64,
    /// `Σ x̄ᵢ xⱼ` per bin, row and column.
    cross: Vec<(f64, f64)>,
    /// Spectra around the resonances.
    wide: WideSpectra,
    /// Which channels the sums contain.
    present: Vec<bool>,
    /// Sums of the power of the windows and of its square.
    power: (f64, f64),
    /// Sum of the weights of the windows.
    weight: f64,
    /// Number of windows.
    added: u64,
}

impl Memory {
    /// Creates an empty memory with a half-life in windows.
    pub(crate) fn new(channels: usize, half_life: f64) -> Self {
        Self {
            kept: libm::exp2(-1.0 / (half_life * OVERLAP as f64)),
            cross: Vec::new(),
            wide: WideSpectra::default(),
            present: vec![false; channels],
            power: (0.0, 0.0),
            weight: 0.0,
            added: 0,
        }
    }

    /// Adds a window. A channel that appears or disappears starts the memory again.
    pub(crate) fn add(&mut self, window: &Coefficients) {
        let count = window.of_channels.len();
        let low = (0..count).map(|channel| window.low(channel));
        let low: Vec<Option<&[Complex<f64>]>> = low.collect();
        let bins = low.iter().flatten().next().map_or(0, |row| row.len());
        let present: Vec<bool> = window.of_channels.iter().map(Option::is_some).collect();
        if present != self.present || self.cross.len() != bins * count * count {
            self.cross = vec![(0.0, 0.0); bins * count * count];
            self.wide.clear();
            (self.power, self.weight, self.added) = ((0.0, 0.0), 0.0, 0);
            self.present = present;
        }
        let mut powers = Vec::with_capacity(count);
        for (i, row) in low.iter().enumerate() {
            let Some(row) = row else { continue };
            powers.push(row.iter().map(Complex::norm_sqr).sum::<f64>());
            for (j, column) in low.iter().enumerate() {
                let Some(column) = column else { continue };
                for (bin, (x, y)) in row.iter().zip(*column).enumerate() {
                    let sum = &mut self.cross[(bin * count + i) * count + j];
                    let product = x.conj() * y;
                    *sum = (
                        self.kept * sum.0 + product.re,
                        self.kept * sum.1 + product.im,
                    );
                }
            }
        }
        self.wide.add(window, self.kept);
        powers.sort_by(f64::total_cmp);
        let typical = powers.get(powers.len() / 2).copied().unwrap_or(0.0);
        self.power.0 = self.kept * self.power.0 + typical;
        self.power.1 = self.kept * self.kept * self.power.1 + typical * typical;
        self.weight = self.kept * self.weight + 1.0;
        self.added += 1;
    }

    /// Returns the number of windows since the start.
    pub(crate) fn added(&self) -> u64 {
        self.added
    }

    /// Returns the number of windows with the same information, if each had the same power.
    pub(crate) fn effective_windows(&self) -> f64 {
        match self.power {
            (sum, squares) if squares > 0.0 => sum * sum / squares,
            _ => 0.0,
        }
    }

    /// Returns the mean power of a channel per bin and window.
    pub(crate) fn mean_power(&self, channel: usize) -> f64 {
        let of_bin = |bin| self.cross(bin, channel, channel).re;
        let sum: f64 = (0..self.bins()).map(of_bin).sum();
        sum / (self.bins() as f64 * self.weight).max(f64::MIN_POSITIVE)
    }

    /// Returns the spectra around the resonances.
    pub(crate) fn wide(&self) -> &WideSpectra {
        &self.wide
    }

    /// Returns whether each channel takes part.
    pub(crate) fn present(&self) -> &[bool] {
        &self.present
    }

    /// Returns the number of bins.
    pub(crate) fn bins(&self) -> usize {
        let count = self.present.len();
        self.cross.len() / (count * count).max(1)
    }

    /// Returns `Σ x̄ᵢ xⱼ` in a bin.
    pub(crate) fn cross(&self, bin: usize, i: usize, j: usize) -> Complex<f64> {
        let count = self.present.len();
        let (re, im) = self.cross[(bin * count + i) * count + j];
        Complex::new(re, im)
    }

    /// Returns `true` if the memory belongs to this many channels.
    pub(crate) fn fits(&self, channels: usize) -> bool {
        self.present.len() == channels
            && self.wide.fits(channels)
            && self
                .cross
                .len()
                .is_multiple_of((channels * channels).max(1))
    }
}
