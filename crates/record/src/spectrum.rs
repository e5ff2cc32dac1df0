//! Power spectral density by Welch's method, and its peaks.
//!
//! Source: P. D. Welch (1967), *IEEE Transactions on Audio and Electroacoustics* 15, 70–73. The
//! Hann windows overlap by half, and the mean of each is removed. The density is one-sided.

use spandrel_fourier::HannTransform;

use crate::RecordedChannel;
use crate::resample::runs;

/// Maximum and minimum number of samples per window. The maximum gives a spectrum of readable size,
/// and the minimum is required for a useful spectrum.
const LONGEST_WINDOW: usize = 8192;
const SHORTEST_WINDOW: usize = 64;
/// Number of half-overlapping windows to average if the record is long enough.
const AVERAGES: usize = 8;
/// Minimum ratio of a peak to the higher of its two adjacent valleys.
const PROMINENCE: f64 = 4.0;
/// Maximum number of peaks returned.
const MOST_PEAKS: usize = 6;

/// A one-sided power spectral density.
#[derive(Debug, Clone, PartialEq)]
pub struct Spectrum {
    step_hz: f64,
    density: Vec<f64>,
}

/// A peak of a spectrum.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpectralPeak {
    /// Frequency in Hz, from a parabola through the logarithms of the three highest values.
    pub frequency_hz: f64,
    /// Density at the highest value, in unit²/Hz.
    pub density: f64,
}

impl Spectrum {
    /// Computes the spectrum of a channel, without its gaps. Returns `None` if the channel has no
    /// sampling rate or no gap-free run of 64 samples.
    pub fn of(channel: &RecordedChannel) -> Option<Self> {
        let rate_hz = channel.sampling_rate_hz()?;
        let runs: Vec<&[f64]> = channel
            .segments()
            .iter()
            .flat_map(|segment| runs(segment.samples()).map(|(_, run)| run))
            .collect();
        let longest = runs.iter().map(|run| run.len()).max()?;
        let wanted = (2 * longest / (AVERAGES + 1))
            .clamp(SHORTEST_WINDOW, LONGEST_WINDOW)
            .min(longest);
        let length = 1 << wanted.checked_ilog2()?;
        if length < SHORTEST_WINDOW {
            return None;
        }
        let transform = HannTransform::new(length);
        let mut density = vec![0.0; length / 2 + 1];
        let mut windows = 0_u32;
        for run in runs {
            for piece in run.windows(length).step_by(length / 2) {
                let lines = transform.transform(piece.iter().copied());
                density
                    .iter_mut()
                    .zip(&lines)
                    .for_each(|(density, value)| *density += value.norm_sqr());
                windows += 1;
            }
        }
        let scale = 2.0 / (rate_hz * transform.power() * f64::from(windows));
        density.iter_mut().for_each(|density| *density *= scale);
        // The values at 0 Hz and at half the sampling rate have no mirror image.
        for end in [0, density.len() - 1] {
            density[end] /= 2.0;
        }
        Some(Self {
            step_hz: rate_hz / length as f64,
            density,
        })
    }

    /// Returns the distance between two values, in Hz. The first value is at 0 Hz.
    pub fn step_hz(&self) -> f64 {
        self.step_hz
    }

    /// Returns the density in unit²/Hz, from 0 Hz to half the sampling rate.
    pub fn density(&self) -> &[f64] {
        &self.density
    }

    /// Returns the highest peaks, at most six, in order of frequency.
    pub fn peaks(&self) -> Vec<SpectralPeak> {
        let density = &self.density;
        let mut peaks: Vec<SpectralPeak> = Vec::new();
        // The values next to 0 Hz contain drift and the rest of the mean.
        for index in 2..density.len().saturating_sub(1) {
            let height = density[index];
            let is_highest = height > density[index - 1] && height >= density[index + 1];
            if is_highest && height >= PROMINENCE * valley_beside(density, index) {
                peaks.push(self.peak(index));
            }
        }
        peaks.sort_by(|one, other| other.density.total_cmp(&one.density));
        peaks.truncate(MOST_PEAKS);
        peaks.sort_by(|one, other| one.frequency_hz.total_cmp(&other.frequency_hz));
        peaks
    }

    fn peak(&self, index: usize) -> SpectralPeak {
        let [before, here, after] = [index - 1, index, index + 1]
            .map(|index| self.density[index].max(f64::MIN_POSITIVE).ln());
        let curvature = before - 2.0 * here + after;
        let shift = if curvature < 0.0 {
            0.5 * (before - after) / curvature
        } else {
            0.0
        };
        SpectralPeak {
            frequency_hz: (index as f64 + shift) * self.step_hz,
            density: self.density[index],
        }
    }
}

/// Returns the higher of the minima on both sides of a peak. On each side, the search ends at the
/// first value above the peak.
fn valley_beside(density: &[f64], index: usize) -> f64 {
    let height = density[index];
    let lowest = |values: &mut dyn Iterator<Item = &f64>| {
        values
            .take_while(|value| **value <= height)
            .fold(height, |lowest, value| lowest.min(*value))
    };
    let left = lowest(&mut density[..index].iter().rev());
    let right = lowest(&mut density[index + 1..].iter());
    left.max(right).max(f64::MIN_POSITIVE)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Segment;
    use std::f64::consts::PI;

    fn channel(samples: Vec<f64>) -> RecordedChannel {
        RecordedChannel::new("a", Some(200.0), vec![Segment::new(0, samples)])
    }

    fn two_sines() -> Vec<f64> {
        let sine = |time_s: f64, frequency_hz: f64| (2.0 * PI * frequency_hz * time_s).sin();
        (0..20_000)
            .map(|n| n as f64 / 200.0)
            .map(|t| 5.0 + 3.0 * sine(t, 1.27) + 0.5 * sine(t, 14.2))
            .collect()
    }

    #[test]
    fn peaks_are_at_the_frequencies_of_the_sines() {
        let peaks = Spectrum::of(&channel(two_sines())).unwrap().peaks();
        let frequencies: Vec<f64> = peaks.iter().map(|peak| peak.frequency_hz).collect();
        assert_eq!(frequencies.len(), 2, "{frequencies:?}");
        assert!(
            (frequencies[0] - 1.27).abs() < 0.01 && (frequencies[1] - 14.2).abs() < 0.01,
            "{frequencies:?}"
        );
    }

    #[test]
    fn density_sums_to_the_variance() {
        // Parseval's theorem: 3²/2 + 0.5²/2.
        let spectrum = Spectrum::of(&channel(two_sines())).unwrap();
        let variance = spectrum.density().iter().sum::<f64>() * spectrum.step_hz();
        assert!((variance - 4.625).abs() < 0.01, "{variance}");
    }

    #[test]
    fn gap_adds_no_peaks() {
        let mut samples = two_sines();
        samples[10_000..10_300].fill(f64::NAN);
        let peaks = Spectrum::of(&channel(samples)).unwrap().peaks();
        assert_eq!(peaks.len(), 2);
    }

    #[test]
    fn short_record_has_no_spectrum() {
        assert_eq!(Spectrum::of(&channel(vec![1.0; 63])), None);
        assert!(
            Spectrum::of(&channel(vec![1.0; 64]))
                .unwrap()
                .peaks()
                .is_empty()
        );
    }
}
