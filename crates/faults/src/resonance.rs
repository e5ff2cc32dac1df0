//! The frequency scale of a structure, from the frequencies of its resonances.
//!
//! A factor of a sensor multiplies its spectrum by one number at all frequencies. A change of
//! stiffness moves the resonances. The amplitude of each channel relative to the ground therefore
//! shows the frequency scale, whatever the factors, signs and delays of the sensors.

use crate::spectrum::Coefficients;
use nalgebra::Complex;
use serde::{Deserialize, Serialize};
use spandrel_structure::CommonMotion;

/// Distance of the logarithms of the tried frequency scales.
const STEP: f64 = 0.05;

/// First and last tried frequency scale, as multiples of [`STEP`] of the logarithm: 0.74 to 3.2.
const STEPS: std::ops::RangeInclusive<i32> = -6..=23;

/// Damping ratio that a window of 24 periods adds to a resonance, because its bins are wide.
///
/// The half width of a bin of a Hann window is 0.72/24 of the fundamental.
const WINDOW_DAMPING: f64 = 0.03;

/// Standard deviation of the logarithm of the frequency scale of the low band, around the scale of
/// the resonances.
const RESONANCE_STD: f64 = 0.05;

/// Independent values per bin and window, which overlap.
const INDEPENDENT: f64 = 0.2;

/// Largest explained share of a spectrum.
const EXPLAINED: f64 = 0.9999;

/// Powers of all channels in the resonance bins, and their cross-spectra with the ground.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct WideSpectra {
    /// `Σ |xᵢ|²` per channel and bin, channel by channel.
    powers: Vec<f64>,
    /// `Σ x̄₀ xᵢ` per channel and bin, channel by channel. Channel 0 is the ground.
    with_ground: Vec<(f64, f64)>,
}

/// Designed amplitudes of a group, for each tried frequency scale.
#[derive(Debug, Clone)]
pub(crate) struct Resonances {
    /// `|T|` per tried scale, channel and bin.
    amplitudes: Vec<Vec<Vec<f64>>>,
}

/// Logarithms of the likelihoods of the tried frequency scales, for one channel.
pub(crate) type OfScales = Vec<f64>;

impl WideSpectra {
    /// Adds a window, and keeps the share `kept` of the earlier ones.
    pub(crate) fn add(&mut self, window: &Coefficients, kept: f64) {
        let Some(ground) = window.wide(0) else { return };
        let (channels, bins) = (window.of_channels.len(), ground.len());
        self.powers.resize(channels * bins, 0.0);
        self.with_ground.resize(channels * bins, (0.0, 0.0));
        for channel in 0..channels {
            let Some(own) = window.wide(channel) else {
                continue;
            };
            for (bin, (x, y)) in ground.iter().zip(own).enumerate() {
                let index = channel * bins + bin;
                let product = x.conj() * y;
                self.powers[index] = kept * self.powers[index] + y.norm_sqr();
                let sum = &mut self.with_ground[index];
                *sum = (kept * sum.0 + product.re, kept * sum.1 + product.im);
            }
        }
    }

    /// Discards all windows.
    pub(crate) fn clear(&mut self) {
        self.powers.clear();
        self.with_ground.clear();
    }

    /// Returns `true` if the spectra are empty, or belong to this many channels.
    pub(crate) fn fits(&self, channels: usize) -> bool {
        self.powers.len() == self.with_ground.len()
            && self.powers.len().is_multiple_of(channels.max(1))
    }

    fn powers(&self, channel: usize, bins: usize) -> Option<&[f64]> {
        self.powers.get(channel * bins..(channel + 1) * bins)
    }

    fn with_ground(&self, channel: usize, bins: usize) -> Option<&[(f64, f64)]> {
        self.with_ground.get(channel * bins..(channel + 1) * bins)
    }
}

impl Resonances {
    /// Tabulates the responses of some `members` of a common motion. The first one is the ground.
    pub(crate) fn new(motion: &CommonMotion, members: &[usize], frequencies_hz: &[f64]) -> Self {
        let modes: Vec<(f64, f64)> = motion.modes().collect();
        let shapes: Vec<(f64, &[f64])> = motion.shapes().collect();
        let response = |channel: usize, hz: f64| {
            let (rigid, participation) = shapes[members[channel]];
            let of_mode = |((mode_hz, damping), participation): (&(f64, f64), &f64)| {
                let ratio = hz / mode_hz;
                let damping = 2.0 * (damping + WINDOW_DAMPING) * ratio;
                participation * ratio * ratio / Complex::new(1.0 - ratio * ratio, damping)
            };
            modes
                .iter()
                .zip(participation)
                .map(of_mode)
                .sum::<Complex<f64>>()
                + rigid
        };
        Self::tabulated(members.len(), frequencies_hz, response)
    }

    /// Tabulates `response`, a function of channel and frequency (Hz).
    fn tabulated(
        channels: usize,
        frequencies_hz: &[f64],
        response: impl Fn(usize, f64) -> Complex<f64>,
    ) -> Self {
        let of_channel = |channel: usize, scale: f64| -> Vec<f64> {
            let bins = frequencies_hz.iter();
            bins.map(|hz| response(channel, scale * hz).norm())
                .collect()
        };
        let of_scale = |step: i32| {
            let scale = libm::exp(ln_scale(step));
            (0..channels).map(|one| of_channel(one, scale)).collect()
        };
        Self {
            amplitudes: STEPS.map(of_scale).collect(),
        }
    }

    /// Returns the likelihoods of the tried frequency scales for each channel. The ground has none.
    ///
    /// The likelihood of a channel is `(1 − γ)⁻ⁿ` with `n` independent values. `γ` is the share of
    /// the amplitudes that the ground and the response explain with the best factor.
    pub(crate) fn ln_likelihoods(
        &self,
        spectra: &WideSpectra,
        effective_windows: f64,
    ) -> Vec<Option<OfScales>> {
        let count = self.amplitudes.first().map_or(0, Vec::len);
        (0..count)
            .map(|channel| self.of_channel(spectra, channel, effective_windows))
            .collect()
    }

    fn of_channel(
        &self,
        spectra: &WideSpectra,
        channel: usize,
        effective_windows: f64,
    ) -> Option<OfScales> {
        let bins = self.amplitudes.first()?.first()?.len();
        let ground = spectra.powers(0, bins)?;
        let own = spectra.powers(channel, bins)?;
        let with_ground = spectra.with_ground(channel, bins)?;
        let power: f64 = own.iter().sum();
        if channel == 0 || power <= 0.0 || ground.iter().sum::<f64>() <= 0.0 {
            return None;
        }
        let squares: f64 = own.iter().map(|one| one * one).sum();
        let effective_bins = power * power / squares;
        let count = (INDEPENDENT * effective_windows * effective_bins).max(1.0);
        let ln_likelihood = |scale: &Vec<Vec<f64>>| {
            let amplitudes = &scale[channel];
            let crossed = amplitudes.iter().zip(with_ground);
            let crossed: f64 = crossed.map(|(t, (re, im))| t * re.hypot(*im)).sum();
            let predicted = amplitudes
                .iter()
                .zip(ground)
                .map(|(t, power)| t * t * power);
            let product = predicted.sum::<f64>() * power;
            let explained = crossed * crossed / product.max(f64::MIN_POSITIVE);
            -count * libm::log(1.0 - explained.min(EXPLAINED))
        };
        Some(self.amplitudes.iter().map(ln_likelihood).collect())
    }
}

/// Returns the logarithm of the prior probability of each of the frequency `scales` of the low
/// band, without its constant.
///
/// `of_channels` contains the likelihoods of the channels that are not suspected. Without any, only
/// `usual_std` remains, the standard deviation of the logarithm of the frequency scale.
pub(crate) fn ln_prior<'a>(
    of_channels: impl Iterator<Item = &'a OfScales>,
    scales: &[f64],
    usual_std: f64,
) -> Vec<f64> {
    let usual = STEPS.map(|step| -0.5 * (ln_scale(step) / usual_std).powi(2));
    let mut sum: Vec<f64> = usual.collect();
    for of_channel in of_channels {
        sum.iter_mut()
            .zip(of_channel)
            .for_each(|(sum, one)| *sum += one);
    }
    // Other channels are other data. Only the differences between the scales are comparable.
    let most = sum.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let of_scale = |scale: &f64| {
        let near = sum.iter().zip(STEPS).map(|(one, step)| {
            let distance = (libm::log(*scale) - ln_scale(step)) / RESONANCE_STD;
            one - most - 0.5 * distance * distance
        });
        near.fold(f64::NEG_INFINITY, f64::max)
    };
    scales.iter().map(of_scale).collect()
}

fn ln_scale(step: i32) -> f64 {
    STEP * f64::from(step)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::memory::Memory;
    use crate::spectrum::Spectrum;

    /// Designed frequency (Hz) and damping ratio of an oscillator.
    const DESIGNED: (f64, f64) = (1.0, 0.05);

    /// Absolute acceleration of the oscillator for a ground acceleration of 1.
    fn response(channel: usize, hz: f64) -> Complex<f64> {
        if channel == 0 {
            return Complex::from(1.0);
        }
        let ratio = hz / DESIGNED.0;
        let damping = 2.0 * (DESIGNED.1 + WINDOW_DAMPING) * ratio;
        Complex::new(1.0, damping) / Complex::new(1.0 - ratio * ratio, damping)
    }

    /// Returns the likelihoods that 200 s of an oscillator of another frequency give. The motions
    /// of the ground and of the oscillator are multiplied by `factors`.
    fn likelihoods(frequency_hz: f64, factors: [f64; 2]) -> Vec<Option<OfScales>> {
        const RATE_HZ: f64 = 20.0;
        const SUBSTEPS: usize = 50;
        let spectrum = Spectrum::new(DESIGNED.0, RATE_HZ).unwrap();
        let resonances = Resonances::tabulated(2, &spectrum.wide_hz(), response);
        let (mut windows, mut memory) = (spectrum.windows(2), Memory::new(2, 6.0));
        let mut random = 1_u64;
        let (omega, dt) = (
            std::f64::consts::TAU * frequency_hz,
            1.0 / (RATE_HZ * SUBSTEPS as f64),
        );
        let (mut place, mut velocity) = (0.0, 0.0);
        for _ in 0..4000 {
            random = random
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1);
            let ground = (random >> 33) as f64 / f64::from(1_u32 << 31) - 0.5;
            let mut absolute = 0.0;
            for _ in 0..SUBSTEPS {
                absolute = -omega * omega * place - 0.1 * omega * velocity;
                velocity += dt * (absolute - ground);
                place += dt * velocity;
            }
            let values = [factors[0] * ground, factors[1] * absolute];
            if let Some(window) = spectrum.take(&mut windows, values.into_iter()) {
                memory.add(&window);
            }
        }
        resonances.ln_likelihoods(memory.wide(), memory.effective_windows())
    }

    #[test]
    fn oscillator_shows_its_frequency_whatever_the_factors() {
        for frequency_hz in [1.1, 1.0, 0.7, 0.5] {
            let right = likelihoods(frequency_hz, [1.0, 1.0]);
            assert_eq!(right[0], None, "the ground has no resonance");
            let of_scales = right[1].as_ref().unwrap();
            let best = (0..of_scales.len())
                .max_by(|a, b| of_scales[*a].total_cmp(&of_scales[*b]))
                .unwrap();
            let found = DESIGNED.0 / libm::exp(ln_scale(STEPS.start() + best as i32));
            assert!(
                (found / frequency_hz - 1.0).abs() < 0.05,
                "{found} Hz, expected {frequency_hz} Hz"
            );
            // The factors cancel, except for rounding.
            let wrong = likelihoods(frequency_hz, [0.5, -4.0]);
            let differences = of_scales.iter().zip(wrong[1].as_ref().unwrap());
            for (right, wrong) in differences {
                assert!((right - wrong).abs() < 1e-9, "{right} {wrong}");
            }
        }
    }

    #[test]
    fn ground_without_samples_or_motion_shows_no_frequency() {
        for factors in [[0.0, 1.0], [f64::NAN, 1.0], [1.0, 0.0]] {
            assert_eq!(likelihoods(1.0, factors), [None, None], "{factors:?}");
        }
    }

    #[test]
    fn prior_of_the_scale_follows_the_resonances_and_is_comparable_without_them() {
        let scales = [1.0, 2.0];
        let usual = ln_prior(std::iter::empty(), &scales, 0.3);
        // The normal density of ln 2 with a standard deviation of 0.3. The tried scales are steps.
        assert!(usual[0].abs() < 1e-9, "{usual:?}");
        assert!((usual[1] + 2.6).abs() < 0.3, "{usual:?}");
        let sharp: OfScales = STEPS
            .map(|step| -50.0 * (ln_scale(step) - 0.7).powi(2) / 0.01 + 1000.0)
            .collect();
        let resonance = ln_prior(std::iter::once(&sharp), &scales, 0.3);
        assert!(resonance[1].abs() < 1.0, "{resonance:?}");
        assert!(resonance[0] < -20.0, "{resonance:?}");
    }
}
