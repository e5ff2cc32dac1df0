//! Exchanged channels: the amplitude of each channel in bands around the first natural frequency.
//!
//! Far below the first natural frequency, all channels measure the same motion. Around it and
//! above, each place has its own amplitude. Records of sound sensors show this profile. Two
//! exchanged channels have the profile of each other.
//!
//! A loss of stiffness changes the profile as well, but not to that of an exchange in all bands at
//! once. An exchange is therefore only stated if the exchanged channels, and all others, agree with
//! the records. A factor moves all bands of one channel by the same amount. An exchange must
//! therefore also be more probable than a factor.

use crate::hypothesis::PRIOR_ODDS;
use serde::{Deserialize, Serialize};

/// Centres of the bands, in multiples of the fundamental.
const CENTRES: [f64; BANDS] = [0.45, 0.75, 1.1, 1.6, 2.5];

/// Number of bands.
pub(crate) const BANDS: usize = 5;

/// Centre of a band divided by its width.
const QUALITY: f64 = 2.5;

/// Highest centre as a share of the sampling rate.
const HIGHEST: f64 = 0.4;

/// Root mean square deviation from the records, in standard deviations, up to which a channel
/// agrees with them.
const AGREES: f64 = 1.5;

/// Largest squared deviation of a channel that agrees with the records.
const LIMIT: f64 = AGREES * AGREES * BANDS as f64;

/// Logarithms of the amplitudes squared in the bands, relative to the median of the channels.
pub(crate) type Profile = [f64; BANDS];

/// Mean and standard deviation of the profile of a sound channel.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ProfileReference {
    /// Mean of the natural logarithms of the relative power in each band.
    pub mean: [f64; BANDS],
    /// Standard deviation of the natural logarithms in each band, from record to record.
    pub std: [f64; BANDS],
}

/// The band filters of a group: two poles each, with gain 1 at the centre.
#[derive(Debug, Clone)]
pub(crate) struct BandFilters {
    /// `b₀`, `a₁` and `a₂` of each band. `None` above the range of the sampling rate.
    bands: [Option<[f64; 3]>; BANDS],
}

/// Band powers of all channels of a group.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct BandPowers {
    of_channels: Vec<[Band; BANDS]>,
    last: Vec<f64>,
    /// Windows in the memory.
    windows: u32,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
struct Band {
    /// State of the filter, transposed direct form II.
    state: (f64, f64),
    /// Power since the last window, in the memory, and in total.
    present: f64,
    memory: f64,
    total: f64,
}

/// Two channels of a group, and the probability that they are exchanged.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Exchange {
    pub(crate) channels: (usize, usize),
    pub(crate) probability: f64,
}

impl ProfileReference {
    /// Returns the squared deviation of a profile, in variances, summed over the bands.
    fn deviation(&self, profile: &Profile) -> f64 {
        let bands = profile.iter().zip(&self.mean).zip(&self.std);
        bands
            .map(|((found, mean), std)| ((found - mean) / std).powi(2))
            .sum()
    }

    /// Like [`ProfileReference::deviation`], if the channel has the most probable factor.
    fn deviation_with_factor(&self, profile: &Profile) -> f64 {
        let bands = profile.iter().zip(&self.mean).zip(&self.std);
        let (mut weights, mut sum) = (0.0, 0.0);
        for ((found, mean), std) in bands {
            let weight = 1.0 / (std * std);
            weights += weight;
            sum += weight * (found - mean);
        }
        let moved = sum / weights;
        self.deviation(&profile.map(|found| found - moved))
    }

    /// Returns `true` if a profile agrees with the records.
    pub(crate) fn agrees(&self, profile: &Profile) -> bool {
        self.deviation(profile) <= LIMIT
    }
}

impl BandFilters {
    /// Plans the filters. Source: R. Bristow-Johnson, Cookbook formulae for audio equalizer biquad
    /// filter coefficients, band-pass with constant peak gain.
    pub(crate) fn new(fundamental_hz: f64, rate_hz: f64) -> Self {
        Self {
            bands: CENTRES.map(|centre| {
                let share = centre * fundamental_hz / rate_hz;
                let (sin, cos) = libm::sincos(std::f64::consts::TAU * share);
                let alpha = sin / (2.0 * QUALITY);
                let scale = 1.0 + alpha;
                (share <= HIGHEST)
                    .then(|| [alpha / scale, -2.0 * cos / scale, (1.0 - alpha) / scale])
            }),
        }
    }
}

impl BandPowers {
    pub(crate) fn new(channels: usize) -> Self {
        Self {
            of_channels: vec![Default::default(); channels],
            last: vec![0.0; channels],
            windows: 0,
        }
    }

    /// Takes the values of one frame. The last value replaces a missing one.
    pub(crate) fn take(&mut self, filters: &BandFilters, values: impl Iterator<Item = f64>) {
        let channels = self.of_channels.iter_mut().zip(&mut self.last);
        for ((bands, last), value) in channels.zip(values) {
            if value.is_finite() {
                *last = value;
            }
            for (band, filter) in bands.iter_mut().zip(&filters.bands) {
                let Some([b, a1, a2]) = filter else { continue };
                let out = b * *last + band.state.0; // b₁ = 0, b₂ = −b₀
                band.state = (band.state.1 - a1 * out, -b * *last - a2 * out);
                band.present += out * out;
            }
        }
    }

    /// Multiplies the memory by `kept`, and adds the powers since the last window.
    ///
    /// A window without all channels empties the memory.
    pub(crate) fn close(&mut self, kept: f64, is_complete: bool) {
        for band in self.of_channels.iter_mut().flatten() {
            let present = std::mem::take(&mut band.present);
            if is_complete {
                band.memory = kept * band.memory + present;
                band.total += present;
            } else {
                band.memory = 0.0;
            }
        }
        self.windows = if is_complete {
            self.windows.saturating_add(1)
        } else {
            0
        };
    }

    /// Discards the motion so far, except for its total.
    pub(crate) fn forget(&mut self) {
        for band in self.of_channels.iter_mut().flatten() {
            *band = Band {
                total: band.total,
                ..Band::default()
            };
        }
        self.last.fill(0.0);
        self.windows = 0;
    }

    /// Returns the number of windows in the memory.
    pub(crate) fn windows(&self) -> u32 {
        self.windows
    }

    /// Returns the profile of each channel in the memory.
    pub(crate) fn profiles(&self) -> Vec<Profile> {
        self.relative(|band| band.memory)
    }

    /// Returns the profile of each channel over all windows. `None` without motion.
    pub(crate) fn mean_profiles(&self) -> Option<Vec<Profile>> {
        let moves = self.of_channels.iter().all(|bands| bands[0].total > 0.0);
        moves.then(|| self.relative(|band| band.total))
    }

    fn relative(&self, power: impl Fn(&Band) -> f64) -> Vec<Profile> {
        let logarithm = |band: &Band| libm::log(power(band).max(f64::MIN_POSITIVE));
        let mut profiles: Vec<Profile> = self
            .of_channels
            .iter()
            .map(|bands| std::array::from_fn(|band| logarithm(&bands[band])))
            .collect();
        for band in 0..BANDS {
            let mut sorted: Vec<f64> = profiles.iter().map(|profile| profile[band]).collect();
            sorted.sort_by(f64::total_cmp);
            let count = sorted.len();
            let median = 0.5 * (sorted[(count - 1) / 2] + sorted[count / 2]);
            profiles
                .iter_mut()
                .for_each(|profile| profile[band] -= median);
        }
        profiles
    }

    pub(crate) fn fits(&self, channels: usize) -> bool {
        self.of_channels.len() == channels && self.last.len() == channels
    }
}

/// Returns the most probable exchange of two channels, with its probability.
///
/// `references` contains one entry per channel. The probability is 0 if the exchanged channels or
/// the other ones differ from the references. The alternatives are no fault, and a factor of one of
/// the two channels.
pub(crate) fn most_probable_exchange(
    profiles: &[Profile],
    references: &[ProfileReference],
) -> Option<Exchange> {
    let count = profiles.len();
    let deviation = |i: usize, j: usize| references[j].deviation(&profiles[i]);
    let own: Vec<f64> = (0..count)
        .map(|channel| deviation(channel, channel))
        .collect();
    let all: f64 = own.iter().sum();
    let with_factor =
        |channel: usize| references[channel].deviation_with_factor(&profiles[channel]);
    let pairs = (count * (count - 1) / 2) as f64;
    let pair = |(i, j): (usize, usize)| {
        let (exchanged, as_learnt) = (deviation(i, j) + deviation(j, i), own[i] + own[j]);
        let others = all - as_learnt;
        let agree = exchanged <= 2.0 * LIMIT && others <= (count - 2) as f64 * LIMIT;
        let with_factor = (with_factor(i) + own[j]).min(own[i] + with_factor(j));
        let otherwise = as_learnt.min(with_factor);
        let odds = libm::exp(0.5 * (otherwise - exchanged).min(600.0)) / (PRIOR_ODDS * pairs);
        Exchange {
            channels: (i, j),
            probability: if agree { odds / (1.0 + odds) } else { 0.0 },
        }
    };
    let all_pairs = (0..count).flat_map(|i| (i + 1..count).map(move |j| (i, j)));
    all_pairs
        .map(pair)
        .max_by(|a, b| a.probability.total_cmp(&b.probability))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn reference(mean: Profile) -> ProfileReference {
        let std = [0.4; BANDS];
        ProfileReference { mean, std }
    }

    #[test]
    fn factor_that_makes_a_channel_look_like_another_is_no_exchange() {
        let references = [reference([1.0; BANDS]), reference([0.3; BANDS])];
        // A factor of 0.7 moves the logarithm of the power by −0.71.
        let profiles = [[0.29; BANDS], [0.65; BANDS]];
        let found = most_probable_exchange(&profiles, &references).unwrap();
        assert!(found.probability < 0.05, "{found:?}");
    }

    #[test]
    fn exchange_that_no_factor_explains_is_found() {
        let (first, second) = ([1.0, 2.0, 1.0, 2.0, 1.0], [2.0, 1.0, 2.0, 1.0, 2.0]);
        let references = [reference(first), reference(second)];
        let found = most_probable_exchange(&[second, first], &references).unwrap();
        assert!(found.probability > 0.99, "{found:?}");
        let found = most_probable_exchange(&[first, second], &references).unwrap();
        assert!(found.probability < 0.01, "{found:?}");
    }
}
