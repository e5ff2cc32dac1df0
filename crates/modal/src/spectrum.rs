//! Spectral densities of a stream by Welch's method, their singular values, and the spectral
//! kurtosis that distinguishes a machine from a mode.
//!
//! Sources: P. D. Welch (1967), IEEE Trans. Audio Electroacoust. 15, 70–73, for the densities.
//! J. Antoni (2006), Mech. Syst. Signal Process. 20, 282–307, for the spectral kurtosis; J.-L.
//! Dion, I. Tawfiq & G. Chevallier (2012), Mech. Syst. Signal Process. 26, 24–33, for its use
//! against harmonics in modal identification.

use nalgebra::{Complex, DMatrix};
use serde::{Deserialize, Serialize};
use spandrel_fourier::HannTransform;

/// A plan of the Fourier transform, which is not part of the state.
#[derive(Clone, Default)]
struct Transform(Option<HannTransform>);

impl std::fmt::Debug for Transform {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str("Transform")
    }
}

impl PartialEq for Transform {
    fn eq(&self, _: &Self) -> bool {
        true
    }
}

/// Accumulates spectral densities of decimated frames.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct SpectrumStream {
    channels: usize,
    length: usize,
    rate_hz: f64,
    /// Frames of the segment that is being filled.
    segment: Vec<f64>,
    segments: usize,
    /// Σ X X*, for each frequency the upper triangle by rows: real and imaginary part.
    products: Vec<[f64; 2]>,
    /// Σ |X|⁴, for each frequency and channel.
    fourth_powers: Vec<f64>,
    #[serde(skip)]
    transform: Transform,
}

impl SpectrumStream {
    /// Creates an empty stream with segments of `length` samples.
    pub(crate) fn new(channels: usize, length: usize, rate_hz: f64) -> Self {
        let frequencies = length / 2 + 1;
        Self {
            channels,
            length,
            rate_hz,
            segment: Vec::new(),
            segments: 0,
            products: vec![[0.0; 2]; frequencies * channels * (channels + 1) / 2],
            fourth_powers: vec![0.0; frequencies * channels],
            transform: Transform::default(),
        }
    }

    /// Forgets everything.
    pub(crate) fn reset(&mut self) {
        self.segment.clear();
        self.clear();
    }

    /// Forgets the sums, but keeps the segment that is being filled.
    pub(crate) fn clear(&mut self) {
        self.segments = 0;
        self.products.fill([0.0; 2]);
        self.fourth_powers.fill(0.0);
    }

    /// Adds a frame.
    pub(crate) fn push(&mut self, frame: &[f64]) {
        self.segment.extend_from_slice(frame);
        if self.segment.len() == self.length * self.channels {
            self.add_segment();
            self.segment.drain(..self.length / 2 * self.channels);
        }
    }

    fn add_segment(&mut self) {
        let (channels, length) = (self.channels, self.length);
        let transform = &mut self.transform.0;
        let transform = transform.get_or_insert_with(|| HannTransform::new(length));
        let outputs: Vec<_> = (0..channels)
            .map(|channel| self.segment.iter().skip(channel).step_by(channels).copied())
            .map(|samples| transform.transform(samples))
            .collect();
        self.segments += 1;
        let pairs = channels * (channels + 1) / 2;
        let frequencies = self
            .products
            .chunks_exact_mut(pairs)
            .zip(self.fourth_powers.chunks_exact_mut(channels));
        for (frequency, (products, fourth_powers)) in frequencies.enumerate() {
            let mut pair = 0;
            for row in 0..channels {
                let x = outputs[row][frequency];
                fourth_powers[row] += x.norm_sqr() * x.norm_sqr();
                for output in &outputs[row..] {
                    let product = x * output[frequency].conj();
                    products[pair][0] += product.re;
                    products[pair][1] += product.im;
                    pair += 1;
                }
            }
        }
    }

    /// Returns the densities of all segments since the last [`Self::clear()`], for the `usable`
    /// channels. Returns `None` without a complete segment.
    pub(crate) fn spectrum(&self, usable: &[bool]) -> Option<EpochSpectrum> {
        if self.segments == 0 {
            return None;
        }
        let outputs: Vec<usize> = (0..self.channels).filter(|c| usable[*c]).collect();
        // The squares of a Hann window sum to 3/8 of its length. A one-sided density doubles.
        let scale = 2.0 / (self.rate_hz * 0.375 * self.length as f64 * self.segments as f64);
        let densities = (0..self.length / 2 + 1)
            .map(|frequency| self.density(frequency, &outputs, scale))
            .collect();
        let kurtosis = (0..self.length / 2 + 1)
            .map(|frequency| self.kurtosis(frequency, &outputs))
            .collect();
        Some(EpochSpectrum {
            step_hz: self.rate_hz / self.length as f64,
            segments: self.segments,
            densities,
            kurtosis,
        })
    }

    fn density(&self, frequency: usize, outputs: &[usize], scale: f64) -> DMatrix<Complex<f64>> {
        DMatrix::from_fn(outputs.len(), outputs.len(), |row, column| {
            let (first, second) = (
                outputs[row].min(outputs[column]),
                outputs[row].max(outputs[column]),
            );
            let [re, im] = self.product(frequency, first, second);
            let im = if row <= column { im } else { -im };
            Complex::new(re * scale, im * scale)
        })
    }

    /// Returns Σ X_first X_second* for `first` ≤ `second`.
    fn product(&self, frequency: usize, first: usize, second: usize) -> [f64; 2] {
        let pairs = self.channels * (self.channels + 1) / 2;
        let before = first * self.channels - first * first.saturating_sub(1) / 2;
        self.products[frequency * pairs + before + second - first]
    }

    /// Returns the spectral kurtosis of the channels, weighted by their power at this frequency.
    ///
    /// SK = K/(K−1) ((K+1) Σ|X|⁴/(Σ|X|²)² − 2) over *K* segments: 0 for stationary Gaussian
    /// motion, −1 for a sine of constant amplitude (Antoni 2006).
    fn kurtosis(&self, frequency: usize, outputs: &[usize]) -> f64 {
        if self.segments < 2 {
            return 0.0;
        }
        let k = self.segments as f64;
        let mut sum = 0.0;
        let mut weights = 0.0;
        for &channel in outputs {
            let power = self.product(frequency, channel, channel)[0];
            if power > 0.0 {
                let fourth = self.fourth_powers[frequency * self.channels + channel];
                sum += power * (k / (k - 1.0) * ((k + 1.0) * fourth / (power * power) - 2.0));
                weights += power;
            }
        }
        if weights > 0.0 { sum / weights } else { 0.0 }
    }
}

/// Spectral densities of an epoch.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EpochSpectrum {
    step_hz: f64,
    segments: usize,
    densities: Vec<DMatrix<Complex<f64>>>,
    kurtosis: Vec<f64>,
}

impl EpochSpectrum {
    /// Returns the distance between two frequencies (Hz). The first is 0 Hz.
    #[must_use]
    pub fn step_hz(&self) -> f64 {
        self.step_hz
    }

    /// Returns the number of segments that were averaged.
    #[must_use]
    pub fn segments(&self) -> usize {
        self.segments
    }

    /// Returns the singular values of the density matrix at each frequency, in descending order.
    ///
    /// Each channel is first divided by its standard deviation, so that channels of different units
    /// are comparable. The unit is 1/Hz.
    #[must_use]
    pub fn singular_values(&self) -> Vec<Vec<f64>> {
        let channels = self.densities.first().map_or(0, DMatrix::nrows);
        let std: Vec<f64> = (0..channels)
            .map(|c| {
                let variance: f64 = self.densities.iter().map(|d| d[(c, c)].re).sum();
                (variance * self.step_hz).sqrt()
            })
            .collect();
        self.densities
            .iter()
            .map(|density| {
                let scaled = DMatrix::from_fn(channels, channels, |row, column| {
                    density[(row, column)] / (std[row] * std[column])
                });
                let mut values: Vec<f64> = scaled.symmetric_eigenvalues().iter().copied().collect();
                values.sort_by(|a, b| b.total_cmp(a));
                values
            })
            .collect()
    }

    /// Returns the density of one usable channel at each frequency, in its unit squared per Hz.
    #[must_use]
    pub fn density(&self, channel: usize) -> Vec<f64> {
        self.densities
            .iter()
            .map(|density| density[(channel, channel)].re)
            .collect()
    }

    /// Returns the spectral kurtosis at a frequency (Hz), or `None` outside of the spectrum.
    ///
    /// It is 0 for stationary Gaussian motion and −1 for a sine.
    #[must_use]
    pub fn kurtosis(&self, frequency_hz: f64) -> Option<f64> {
        let position = (frequency_hz / self.step_hz).round();
        (position >= 0.0)
            .then(|| self.kurtosis.get(position as usize).copied())
            .flatten()
    }
}
