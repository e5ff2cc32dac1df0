//! Resampling to another rate, with an anti-aliasing filter.
//!
//! The filter is a sinc with a Kaiser window. It is symmetric about each output sample, so it has
//! zero phase. Relative to the lower of the two rates, the pass band ends at 0.40. The stop band
//! begins at 0.50, which is half the lower rate, with an attenuation of 80 dB. Ripple and aliases
//! are 1e-4 of the amplitude.
//!
//! Source: A. V. Oppenheim and R. W. Schafer, *Discrete-Time Signal Processing*, 3rd edition,
//! section 7.5.3.

use std::f64::consts::PI;

use crate::{RecordedChannel, Segment};

/// Centre of the transition band, as a fraction of the lower rate.
const CUTOFF: f64 = 0.45;
/// Width of the transition band, as a fraction of the lower rate.
const TRANSITION: f64 = 0.10;
/// Attenuation in the stop band, in dB.
const ATTENUATION_DB: f64 = 80.0;
/// Number of positions between two input samples at which the filter is tabulated. Linear
/// interpolation between them causes an error of (π/512)²/8 of the amplitude, which is -106 dB.
const POSITIONS: usize = 512;
/// Relative tolerance within which two rates count as equal and the channel remains unchanged.
/// Clocks differ by less.
const SAME_RATE: f64 = 1e-3;

/// Resamples a channel to `to_hz` (Hz). `grid_ns` (ns) is the time of any output sample and defines
/// the time grid.
///
/// Each gap-free run of samples is filtered separately, so a gap remains a gap. The first and last
/// values of a run extend beyond its ends. Values within 26 steps of the lower rate from an end are
/// therefore less accurate. A channel that already has the rate, or has no rate, remains unchanged.
pub(crate) fn resampled(channel: &RecordedChannel, to_hz: f64, grid_ns: i64) -> RecordedChannel {
    let from_hz = match channel.sampling_rate_hz() {
        Some(from_hz) if (from_hz - to_hz).abs() > SAME_RATE * to_hz => from_hz,
        Some(_) | None => return channel.clone(),
    };
    let filter = Filter::new(from_hz, to_hz);
    let mut segments = Vec::new();
    for segment in channel.segments() {
        for (first, run) in runs(segment.samples()) {
            let start_ns = segment
                .start_ns()
                .saturating_add((first as f64 * 1e9 / from_hz).round() as i64);
            segments.extend(filter.apply(start_ns, run, grid_ns));
        }
    }
    channel.with_samples(to_hz, segments)
}

/// Returns the runs of existing samples, each with the index of its first sample.
pub(crate) fn runs(samples: &[f64]) -> impl Iterator<Item = (usize, &[f64])> {
    let mut start = 0;
    samples
        .split(|sample| sample.is_nan())
        .filter_map(move |run| {
            let first = start;
            start += run.len() + 1;
            (!run.is_empty()).then_some((first, run))
        })
}

/// The filter from one sampling rate to another.
struct Filter {
    from_hz: f64,
    to_hz: f64,
    /// Number of input samples on either side of an output sample.
    reach: usize,
    positions: usize,
    /// Filter weights by position between two input samples, then by input sample, earliest first.
    table: Vec<f64>,
}

impl Filter {
    fn new(from_hz: f64, to_hz: f64) -> Self {
        // Kaiser's formulas for the filter length (from attenuation and transition width) and the
        // window shape.
        let lower = (to_hz / from_hz).min(1.0); // lower rate as a fraction of the input rate
        let length = (ATTENUATION_DB - 7.95) / (2.285 * 2.0 * PI * TRANSITION * lower);
        let beta = 0.1102 * (ATTENUATION_DB - 8.7);
        let half = length / 2.0;
        let reach = half.ceil() as usize;
        // A longer filter is smoother and needs fewer positions for the same error.
        let positions = ((POSITIONS as f64 * lower).ceil() as usize).max(2);
        let cutoff = CUTOFF * lower;
        let mut table = Vec::with_capacity((positions + 1) * 2 * reach);
        for position in 0..=positions {
            let fraction = position as f64 / positions as f64;
            for tap in 0..2 * reach {
                let distance = tap as f64 - (reach as f64 - 1.0) - fraction;
                let share = distance / half;
                let window = if share.abs() < 1.0 {
                    bessel_i0(beta * (1.0 - share * share).sqrt()) / bessel_i0(beta)
                } else {
                    0.0
                };
                table.push(2.0 * cutoff * sinc(2.0 * cutoff * distance) * window);
            }
        }
        Self {
            from_hz,
            to_hz,
            reach,
            positions,
            table,
        }
    }

    /// Filters a run of samples. The output is on the grid and within the run. Returns `None` if
    /// the run contains no grid time.
    fn apply(&self, start_ns: i64, run: &[f64], grid_ns: i64) -> Option<Segment> {
        let grid_step = start_ns.saturating_sub(grid_ns) as f64 * self.to_hz / 1e9;
        let first = (grid_step - GRID_TOLERANCE).ceil();
        let first_ns = grid_ns.saturating_add((first * 1e9 / self.to_hz).round() as i64);
        let offset = (first - grid_step) * self.from_hz / self.to_hz; // in input samples
        let ratio = self.from_hz / self.to_hz;
        let last = (run.len() - 1) as f64 + GRID_TOLERANCE * ratio;
        let count = if offset <= last {
            ((last - offset) / ratio).floor() as usize + 1
        } else {
            0
        };
        let samples: Vec<f64> = (0..count)
            .map(|step| self.value(run, offset + step as f64 * ratio))
            .collect();
        (!samples.is_empty()).then(|| Segment::new(first_ns, samples))
    }

    /// Returns the value at `place`, in input samples from the start of the run.
    fn value(&self, run: &[f64], place: f64) -> f64 {
        let whole = place.floor();
        let position = (place - whole) * self.positions as f64;
        let (row, between) = (
            (position as usize).min(self.positions - 1),
            position.fract(),
        );
        let width = 2 * self.reach;
        let weights = self.table[row * width..(row + 2) * width].split_at(width);
        let earliest = whole as i64 - (self.reach as i64 - 1);
        let (mut sum, mut total) = (0.0, 0.0);
        for (tap, (here, there)) in weights.0.iter().zip(weights.1).enumerate() {
            let weight = here + between * (there - here);
            // Values at the ends extend beyond the run.
            let index = (earliest + tap as i64).clamp(0, run.len() as i64 - 1) as usize;
            sum += weight * run[index];
            total += weight;
        }
        // The normalisation preserves a constant.
        sum / total
    }
}

/// Tolerance for a grid time outside the ends of a run, as a fraction of a step. It covers rounding
/// to 1 ns.
const GRID_TOLERANCE: f64 = 1e-4;

fn sinc(argument: f64) -> f64 {
    let angle = PI * argument;
    if angle.abs() < 1e-9 {
        1.0
    } else {
        angle.sin() / angle
    }
}

/// Returns the modified Bessel function of the first kind and order 0. Its power series converges
/// for any argument.
fn bessel_i0(argument: f64) -> f64 {
    let quarter_square = argument * argument / 4.0;
    let (mut term, mut sum, mut order) = (1.0, 1.0, 1.0);
    while term > sum * f64::EPSILON {
        term *= quarter_square / (order * order);
        sum += term;
        order += 1.0;
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sine(rate_hz: f64, frequency_hz: f64, seconds: f64) -> RecordedChannel {
        let count = (rate_hz * seconds) as usize;
        let samples = (0..count)
            .map(|index| (2.0 * PI * frequency_hz * index as f64 / rate_hz).sin())
            .collect();
        RecordedChannel::new("a", Some(rate_hz), vec![Segment::new(0, samples)])
    }

    /// Returns the largest deviation from the exact sine, away from the ends.
    fn worst(channel: &RecordedChannel, frequency_hz: f64, amplitude: f64) -> f64 {
        let (start_ns, end_ns) = (
            channel.start_ns().unwrap() + 1_000_000_000,
            channel.end_ns().unwrap() - 1_000_000_000,
        );
        let inner = channel
            .timed_samples()
            .filter(|(time_ns, _)| (start_ns..end_ns).contains(time_ns));
        inner.fold(0.0, |worst: f64, (time_ns, value)| {
            let expected = amplitude * (2.0 * PI * frequency_hz * time_ns as f64 / 1e9).sin();
            worst.max((value - expected).abs())
        })
    }

    #[test]
    fn sine_in_the_pass_band_keeps_amplitude_and_phase() {
        // Integer ratios and an irregular one, up and down. The pass band ends at 0.40 of the lower
        // rate.
        for (from_hz, to_hz) in [
            (200.0, 100.0),
            (120.0, 100.0),
            (100.0, 120.0),
            (128.0, 99.7),
        ] {
            let frequency_hz = 0.39 * f64::min(from_hz, to_hz);
            let out = resampled(&sine(from_hz, frequency_hz, 10.0), to_hz, 0);
            assert_eq!(out.sampling_rate_hz(), Some(to_hz));
            let worst = worst(&out, frequency_hz, 1.0);
            assert!(worst < 2e-4, "{from_hz} to {to_hz} Hz: {worst}");
        }
    }

    #[test]
    fn aliases_are_attenuated_to_less_than_1_5e_4() {
        for (from_hz, to_hz, frequency_hz) in [
            (200.0, 100.0, 51.0),
            (200.0, 100.0, 90.0),
            (1000.0, 120.0, 61.0),
        ] {
            let out = resampled(&sine(from_hz, frequency_hz, 10.0), to_hz, 0);
            let worst = worst(&out, frequency_hz, 0.0);
            assert!(
                worst < 1.5e-4,
                "{frequency_hz} Hz from {from_hz} to {to_hz} Hz: {worst}"
            );
        }
    }

    #[test]
    fn constant_is_unchanged_up_to_its_ends() {
        let channel = RecordedChannel::new("a", Some(200.0), vec![Segment::new(0, vec![3.5; 400])]);
        let out = resampled(&channel, 90.0, 0);
        assert!(out.samples().all(|sample| (sample - 3.5).abs() < 1e-12));
        assert_eq!(out.present(), 180); // 0 to 1.995 s
    }

    #[test]
    fn gap_remains_a_gap() {
        let mut samples = vec![1.0; 400];
        samples[200..240].fill(f64::NAN);
        let channel = RecordedChannel::new("a", Some(200.0), vec![Segment::new(0, samples)]);
        let out = resampled(&channel, 100.0, 0);
        let gaps = out.gaps();
        assert_eq!(gaps.len(), 1);
        // The last sample before the gap is at 0.995 s and the first one after it at 1.2 s: 0.99 s
        // and 1.20 s on the grid.
        assert_eq!((gaps[0].after_ns, gaps[0].samples), (990_000_000, 20));
    }

    #[test]
    fn output_is_on_the_requested_grid() {
        let channel = RecordedChannel::new(
            "a",
            Some(200.0),
            vec![Segment::new(3_000_000, vec![1.0; 400])],
        );
        assert_eq!(resampled(&channel, 100.0, 0).start_ns(), Some(10_000_000));
    }

    #[test]
    fn channel_of_the_same_rate_is_unchanged() {
        let channel = sine(100.0, 45.0, 2.0);
        assert_eq!(resampled(&channel, 100.05, 0), channel);
    }
}
