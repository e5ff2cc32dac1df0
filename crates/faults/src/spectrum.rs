//! Fourier coefficients of the low band and of the resonances over overlapping windows, one sample
//! at a time.

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

/// Largest share of missing samples in a window.
const MISSING_SHARE: f64 = 0.25;

/// Longest gap that is interpolated, in periods of the fundamental.
///
/// A longer one distorts the resonance so much that it reaches the low band, where the channels
/// then seem to disagree.
const LONGEST_GAP: f64 = 0.125;

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
    /// Last sample per channel.
    last: Vec<f64>,
    /// Missing samples per channel since the last one. The maximum before the first.
    gaps: Vec<u32>,
    open: Vec<Window>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Window {
    /// Real and imaginary part per bin and channel, bin by bin.
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
            gaps: vec![u32::MAX; channels],
            open: vec![Window::new(channels, self.bins.len()); OVERLAP],
        }
    }

    /// Returns `true` if the windows belong to this spectrum and to this many channels.
    pub(crate) fn fits(&self, windows: &Windows, channels: usize) -> bool {
        let is_window = |window: &Window| {
            window.sums.len() == channels * self.bins.len() && window.missing.len() == channels
        };
        windows.last.len() == channels
            && windows.gaps.len() == channels
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

    /// Returns the sum of the squared window weights. It is the ratio of the power of a bin to the
    /// variance of white noise.
    pub(crate) fn noise_power(&self) -> f64 {
        0.375 * self.samples as f64
    }

    /// Returns the weight of the next frame in the mean of its quarter of a window.
    pub(crate) fn weight_in_quarter(&self, windows: &Windows) -> f64 {
        let place = (windows.count % (self.samples / OVERLAP) as u64) as usize;
        0.5 - 0.5 * self.turns[place * OVERLAP].re
    }

    /// Takes the values of one frame. Returns the coefficients of a window that is now complete.
    ///
    /// Missing samples are interpolated once the next sample has arrived. A channel with a long gap
    /// has no coefficients in the windows that contain it.
    pub(crate) fn take(
        &self,
        windows: &mut Windows,
        values: impl Iterator<Item = f64>,
    ) -> Option<Coefficients> {
        let longest = (LONGEST_GAP * self.samples as f64 / PERIODS) as u32;
        let now = windows.count;
        // What the windows receive of this frame: nothing of a missing sample, for now.
        let mut taken = vec![0.0; windows.last.len()];
        for (channel, value) in values.enumerate() {
            let gap = windows.gaps[channel];
            if !value.is_finite() {
                windows.gaps[channel] = gap.saturating_add(1);
                continue;
            }
            taken[channel] = value;
            if (1..=longest).contains(&gap) {
                let last = windows.last[channel];
                let step = (value - last) / f64::from(gap + 1);
                for age in 1..=gap {
                    let missing = value - f64::from(age) * step;
                    self.fill(windows, age as usize, channel, missing);
                }
            }
            windows.last[channel] = value;
            windows.gaps[channel] = 0;
        }
        for (phase, window) in windows.open.iter_mut().enumerate() {
            let Some(place) = self.place(phase, now) else {
                continue;
            };
            for (missing, gap) in window.missing.iter_mut().zip(&windows.gaps) {
                *missing = match *gap {
                    0 => *missing,
                    gap if gap > longest => u32::MAX,
                    _ => missing.saturating_add(1),
                };
            }
            let hann = self.hann(place);
            for (sums, bin) in window.sums.chunks_mut(taken.len()).zip(&self.bins) {
                let turn = hann * self.turns[bin * place % self.samples];
                for (sum, value) in sums.iter_mut().zip(&taken) {
                    sum.0 += value * turn.re;
                    sum.1 += value * turn.im;
                }
            }
        }
        let mut complete = None;
        for (phase, window) in windows.open.iter_mut().enumerate() {
            if self.place(phase, now) == Some(self.samples - 1) {
                // Samples that are still missing cannot be interpolated in time.
                for (missing, gap) in window.missing.iter_mut().zip(&windows.gaps) {
                    if *gap > 0 {
                        *missing = u32::MAX;
                    }
                }
                complete = Some(self.coefficients(window));
                *window = Window::new(taken.len(), self.bins.len());
            }
        }
        windows.count += 1;
        complete
    }

    /// Adds the value of a frame before the present one to the windows that contain it.
    fn fill(&self, windows: &mut Windows, age: usize, channel: usize, value: f64) {
        for (phase, window) in windows.open.iter_mut().enumerate() {
            let channels = window.missing.len();
            let now = self.place(phase, windows.count);
            let Some(place) = now.and_then(|now| now.checked_sub(age)) else {
                continue; // the window started later
            };
            let hann = self.hann(place);
            let sums = window.sums.iter_mut().skip(channel).step_by(channels);
            for (sum, bin) in sums.zip(&self.bins) {
                let turn = hann * self.turns[bin * place % self.samples];
                sum.0 += value * turn.re;
                sum.1 += value * turn.im;
            }
        }
    }

    /// Returns the place of a frame in the window of a phase. `None` before the first window.
    fn place(&self, phase: usize, count: u64) -> Option<usize> {
        let quarter = self.samples / OVERLAP;
        let since = count.checked_sub((phase * quarter) as u64)?;
        Some((since % self.samples as u64) as usize)
    }

    /// Returns the weight of a place in a window.
    fn hann(&self, place: usize) -> f64 {
        0.5 - 0.5 * self.turns[place].re
    }

    fn coefficients(&self, window: &Window) -> Coefficients {
        let most = (MISSING_SHARE * self.samples as f64) as u32;
        let channels = window.missing.len();
        let of_channel = |(channel, missing): (usize, &u32)| {
            let sums = window.sums.iter().skip(channel).step_by(channels);
            let values = sums.map(|(re, im)| Complex::new(*re, *im));
            (*missing <= most).then(|| values.collect())
        };
        Coefficients {
            of_channels: window.missing.iter().enumerate().map(of_channel).collect(),
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
    /// first half and their alternatives in the second half. The one that follows the other
    /// channels better is taken.
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
    fn short_gaps_are_interpolated_and_long_ones_leave_no_coefficients() {
        let motion = |t: f64| (std::f64::consts::TAU * 0.2 * t).sin();
        let first = |lost: &dyn Fn(f64) -> bool| {
            let value = |t: f64| if lost(t) { f64::NAN } else { motion(t) };
            complete(value, 480).remove(0).of_channels.remove(0)
        };
        let whole = first(&|_| false).unwrap();
        // Gaps of two samples, one of them across the start of the second window at 6 s.
        let short = |t: f64| {
            [3.02, 5.92, 11.02]
                .iter()
                .any(|from| (0.0..0.1).contains(&(t - from)))
        };
        let interpolated = first(&short).unwrap();
        let largest = whole.iter().map(|one| one.norm()).fold(0.0, f64::max);
        for (one, other) in whole.iter().zip(&interpolated) {
            assert!((one - other).norm() < 2e-4 * largest, "{one} {other}");
        }
        assert_eq!(first(&|t| (3.02..3.18).contains(&t)), None, "three samples");
        assert_eq!(first(&|t| t > 23.92), None, "a gap at the end");
        let every_third = |t: f64| ((20.0 * t).round() as u64).is_multiple_of(3);
        assert_eq!(first(&every_third), None, "a third of the samples");
    }
}
