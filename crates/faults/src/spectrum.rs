//! Fourier coefficients of the low band and of the resonances over overlapping windows, one sample at
//! a time.

use nalgebra::Complex;
use serde::{Deserialize, Serialize};

/// Length of a window in periods of the fundamental.
const PERIODS: f64 = 24.0;

/// Windows that run at the same time. Each starts a quarter of a window after the last.
pub(crate) const OVERLAP: usize = 4;

/// First and last bin of the band. The bins have a distance of 1/24 of the fundamental, so that the
/// band extends from 0.125 to 0.33 times the fundamental. A Hann window separates bin 3 from a
/// constant offset.
const LOW_BINS: std::ops::RangeInclusive<usize> = 3..=8;

/// Number of bins of the low band.
const LOW_COUNT: usize = 6;

/// Last bin of the resonances: twice the fundamental. A Hann window covers every second bin.
const LAST_BIN: usize = 48;

/// Largest bin as a share of the samples of a window.
const HIGHEST: f64 = 0.4;

/// Largest share of missing samples in a window. The last value replaces a missing sample.
const MISSING_SHARE: f64 = 0.25;

/// The transform of one group of channels.
#[derive(Debug, Clone)]
pub(crate) struct Spectrum {
    /// Number of samples of a window, a multiple of [`OVERLAP`].
    samples: usize,
    rate_hz: f64,
    /// `exp(−2πi n / samples)` for each `n`.
    turns: Vec<Complex<f64>>,
    /// The low band, and every second bin above it.
    bins: Vec<usize>,
}

/// The windows that are being filled.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Windows {
    /// Number of samples since the start.
    count: u64,
    last: Vec<f64>,
    open: Vec<Window>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Window {
    /// Real and imaginary part per channel and bin, channel by channel.
    sums: Vec<(f64, f64)>,
    /// Missing samples per channel.
    missing: Vec<u32>,
}

/// The Fourier coefficients of one complete window.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Coefficients {
    /// Bins of one channel after the other; `None` for a channel with too many missing samples.
    pub(crate) of_channels: Vec<Option<Vec<Complex<f64>>>>,
}

impl Spectrum {
    /// Plans the transform for a fundamental frequency. `None` if the band has too few samples per
    /// period.
    pub(crate) fn new(fundamental_hz: f64, rate_hz: f64) -> Option<Self> {
        let quarter = (PERIODS * rate_hz / (fundamental_hz * OVERLAP as f64)).round();
        let is_resolved = (16.0..1e6).contains(&quarter);
        let samples = OVERLAP * is_resolved.then_some(quarter as usize)?;
        let turn = |n: usize| {
            let (sin, cos) = libm::sincos(std::f64::consts::TAU * n as f64 / samples as f64);
            Complex::new(cos, -sin)
        };
        let above = (LOW_BINS.end() + 2..=LAST_BIN).step_by(2);
        let is_sampled = |bin: &usize| *bin as f64 <= HIGHEST * samples as f64;
        Some(Self {
            samples,
            rate_hz,
            turns: (0..samples).map(turn).collect(),
            bins: LOW_BINS.chain(above.filter(is_sampled)).collect(),
        })
    }

    /// Creates empty windows for a number of channels.
    pub(crate) fn windows(&self, channels: usize) -> Windows {
        Windows {
            count: 0,
            last: vec![0.0; channels],
            open: vec![Window::new(channels, self.bins.len()); OVERLAP],
        }
    }

    /// Returns `true` if the windows belong to this spectrum and to this many channels.
    pub(crate) fn fits(&self, windows: &Windows, channels: usize) -> bool {
        let is_window = |window: &Window| {
            window.sums.len() == channels * self.bins.len() && window.missing.len() == channels
        };
        windows.last.len() == channels
            && windows.open.len() == OVERLAP
            && windows.open.iter().all(is_window)
    }

    /// Returns the frequencies of the low band (Hz).
    pub(crate) fn low_hz(&self) -> Vec<f64> {
        self.frequencies_hz()[..LOW_COUNT].to_vec()
    }

    /// Returns the frequencies of the resonance bins (Hz).
    pub(crate) fn wide_hz(&self) -> Vec<f64> {
        self.frequencies_hz()[LOW_COUNT - 1..].to_vec()
    }

    fn frequencies_hz(&self) -> Vec<f64> {
        let bins = self.bins.iter();
        bins.map(|bin| *bin as f64 * self.rate_hz / self.samples as f64)
            .collect()
    }

    /// Returns the length of a window (s).
    pub(crate) fn window_s(&self) -> f64 {
        self.samples as f64 / self.rate_hz
    }

    /// Returns the squared sum of the window, the factor from the variance of white noise to the
    /// power of a bin.
    pub(crate) fn noise_power(&self) -> f64 {
        0.375 * self.samples as f64
    }

    /// Returns the weight of the next frame in the mean of its quarter of a window.
    pub(crate) fn weight_in_quarter(&self, windows: &Windows) -> f64 {
        let place = (windows.count % (self.samples / OVERLAP) as u64) as usize;
        0.5 - 0.5 * self.turns[place * OVERLAP].re
    }

    /// Takes the values of one frame. Returns the coefficients of a window that is now complete.
    pub(crate) fn take(
        &self,
        windows: &mut Windows,
        values: impl Iterator<Item = f64>,
    ) -> Option<Coefficients> {
        let quarter = self.samples / OVERLAP;
        let bins = self.bins.len();
        let place = |phase: usize, count: u64| {
            let since = count.checked_sub((phase * quarter) as u64)?;
            Some((since % self.samples as u64) as usize)
        };
        for (channel, value) in values.enumerate() {
            let is_missing = !value.is_finite();
            if !is_missing {
                windows.last[channel] = value;
            }
            let value = windows.last[channel];
            for (phase, window) in windows.open.iter_mut().enumerate() {
                let Some(place) = place(phase, windows.count) else {
                    continue;
                };
                window.missing[channel] += u32::from(is_missing);
                let weighted = value * (0.5 - 0.5 * self.turns[place].re);
                let sums = &mut window.sums[channel * bins..(channel + 1) * bins];
                for (sum, bin) in sums.iter_mut().zip(&self.bins) {
                    let turn = self.turns[bin * place % self.samples];
                    sum.0 += weighted * turn.re;
                    sum.1 += weighted * turn.im;
                }
            }
        }
        let mut complete = None;
        for (phase, window) in windows.open.iter_mut().enumerate() {
            if place(phase, windows.count) == Some(self.samples - 1) {
                complete = Some(self.coefficients(window));
                *window = Window::new(window.missing.len(), bins);
            }
        }
        windows.count += 1;
        complete
    }

    fn coefficients(&self, window: &Window) -> Coefficients {
        let most = (MISSING_SHARE * self.samples as f64) as u32;
        let of_channel = |(sums, missing): (&[(f64, f64)], &u32)| {
            let values = sums.iter().map(|(re, im)| Complex::new(*re, *im));
            (*missing <= most).then(|| values.collect())
        };
        let channels = window.sums.chunks(self.bins.len()).zip(&window.missing);
        Coefficients {
            of_channels: channels.map(of_channel).collect(),
        }
    }
}

impl Coefficients {
    /// Returns the coefficients of a channel in the low band.
    pub(crate) fn low(&self, channel: usize) -> Option<&[Complex<f64>]> {
        Some(low(self.of_channels[channel].as_ref()?))
    }

    /// Returns the coefficients of a channel in the resonance bins.
    pub(crate) fn wide(&self, channel: usize) -> Option<&[Complex<f64>]> {
        self.of_channels[channel].as_ref()?.get(LOW_COUNT - 1..)
    }

    /// Returns one series per channel, of a window that contains two. These are the channels of the
    /// first half and their alternatives in the second half. The one that follows the other channels
    /// better is taken.
    pub(crate) fn most_coherent(mut self) -> Self {
        let alternatives = self.of_channels.split_off(self.of_channels.len() / 2);
        let with_others = |channel: usize, bins: &[Complex<f64>]| -> f64 {
            let pairs = self.of_channels.iter().zip(&alternatives).enumerate();
            let others = pairs.filter(|(other, _)| *other != channel);
            let both = others.flat_map(|(_, (own, other))| [own, other]);
            both.flatten()
                .map(|other| coherence(low(bins), low(other)))
                .sum()
        };
        let is_better: Vec<bool> = self
            .of_channels
            .iter()
            .zip(&alternatives)
            .enumerate()
            .map(|(channel, series)| match series {
                (Some(own), Some(other)) => with_others(channel, other) > with_others(channel, own),
                _ => false,
            })
            .collect();
        let channels = self.of_channels.iter_mut().zip(alternatives);
        for ((own, other), is_better) in channels.zip(is_better) {
            if is_better {
                *own = other;
            }
        }
        self
    }
}

/// Returns the coefficients of the low band.
fn low(bins: &[Complex<f64>]) -> &[Complex<f64>] {
    &bins[..LOW_COUNT.min(bins.len())]
}

/// Returns the coherence of two channels in the band of one window, 0 to 1.
fn coherence(one: &[Complex<f64>], other: &[Complex<f64>]) -> f64 {
    let power = |bins: &[Complex<f64>]| bins.iter().map(Complex::norm_sqr).sum::<f64>();
    let products = one.iter().zip(other).map(|(x, y)| x.conj() * y);
    let both = power(one) * power(other);
    products.sum::<Complex<f64>>().norm_sqr() / both.max(f64::MIN_POSITIVE)
}

impl Window {
    fn new(channels: usize, bins: usize) -> Self {
        Self {
            sums: vec![(0.0, 0.0); channels * bins],
            missing: vec![0; channels],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Fundamental of 1 Hz at 20 Hz: windows of 24 s and 480 samples, bins of 1/24 Hz.
    fn complete(value: impl Fn(f64) -> f64, frames: usize) -> Vec<Coefficients> {
        let spectrum = Spectrum::new(1.0, 20.0).unwrap();
        assert_eq!(spectrum.window_s(), 24.0);
        let mut windows = spectrum.windows(1);
        let frames = 0..frames;
        let taken = frames.filter_map(|frame| {
            spectrum.take(&mut windows, std::iter::once(value(frame as f64 / 20.0)))
        });
        taken.collect()
    }

    #[test]
    fn sine_of_a_bin_has_half_its_amplitude_times_the_sum_of_the_window() {
        let hz = 5.0 / 24.0;
        let all = complete(
            |t| 3.0 * (std::f64::consts::TAU * hz * t).cos() + 100.0,
            960,
        );
        // Windows end after 480 samples and after each further 120.
        assert_eq!(all.len(), 5);
        let first = all[0].of_channels[0].as_ref().unwrap();
        // The sum of a Hann window of 480 samples is 240. Its neighbours have half of the peak.
        assert!((first[2].norm() - 1.5 * 240.0).abs() < 1e-6, "{first:?}");
        assert!((first[1].norm() - 0.75 * 240.0).abs() < 1e-6, "{first:?}");
        assert!(
            first[5].norm() < 1e-6 && first[0].norm() < 1e-6,
            "an offset must not leak"
        );
    }

    #[test]
    fn window_with_many_missing_samples_has_no_coefficients() {
        let lost = |from: f64, to: f64| {
            move |t: f64| {
                if (from..to).contains(&t) {
                    f64::NAN
                } else {
                    t.sin()
                }
            }
        };
        assert!(complete(lost(3.0, 3.6), 480)[0].of_channels[0].is_some());
        assert!(complete(lost(3.0, 9.5), 480)[0].of_channels[0].is_none());
    }
}
