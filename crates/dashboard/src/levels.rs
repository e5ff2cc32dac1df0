//! The samples of each channel in the last minute: rate, offset, magnitude and last sample.

use serde::Serialize;
use spandrel_bus::{ChannelWaveform, WaveformDisplay};
use std::collections::{BTreeMap, VecDeque};

/// Number of messages over which the figures extend. A message covers about one second.
const MESSAGES: usize = 60;

/// The latest messages of each channel.
#[derive(Debug, Default)]
pub(crate) struct Levels {
    channels: BTreeMap<String, VecDeque<Part>>,
}

/// The samples of a channel in one message.
#[derive(Clone, Copy, Debug)]
struct Part {
    /// Time of the first and after the last frame, ns since the Unix epoch, UTC.
    from_ns: i64,
    to_ns: i64,
    samples: u64,
    /// `None` without samples.
    level: Option<PartLevel>,
}

#[derive(Clone, Copy, Debug)]
struct PartLevel {
    mean: f64,
    rms: f64,
    last: f64,
    least: f64,
    largest: f64,
}

/// The samples of a channel in the last minute. All but the rate and the time are in the unit of
/// the channel.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(crate) struct Level {
    /// Number of samples per second.
    pub(crate) rate_hz: f64,
    /// Mean of the samples.
    pub(crate) mean: f64,
    /// Root mean square of the differences from the mean.
    pub(crate) rms: f64,
    /// Largest difference from the mean.
    pub(crate) peak: f64,
    /// Last sample.
    pub(crate) last: f64,
    /// End of the second of the last sample (s since the Unix epoch, UTC).
    pub(crate) last_s: f64,
}

impl Levels {
    /// Adds a message of one channel.
    pub(crate) fn take(&mut self, display: &WaveformDisplay, waveform: &ChannelWaveform) {
        let length_s = display.bucket_s * waveform.extremes.len() as f64;
        let ends = waveform.extremes.iter().flatten().copied();
        let part = Part {
            from_ns: display.time_ns,
            to_ns: display.time_ns.saturating_add((1e9 * length_s) as i64),
            samples: display.frames.saturating_sub(waveform.missing),
            level: waveform.level.map(|level| PartLevel {
                mean: level.mean,
                rms: level.rms,
                last: level.last,
                least: ends
                    .clone()
                    .map(|ends| f64::from(ends[0]))
                    .fold(f64::NAN, f64::min),
                largest: ends.map(|ends| f64::from(ends[1])).fold(f64::NAN, f64::max),
            }),
        };
        let parts = self
            .channels
            .entry(waveform.channel.to_string())
            .or_default();
        if parts
            .back()
            .is_some_and(|last| part.from_ns <= last.from_ns)
        {
            parts.clear(); // a new run of measurement
        }
        parts.push_back(part);
        // A message before a gap is not of the last minute.
        let since_ns = part
            .to_ns
            .saturating_sub((1e9 * length_s * MESSAGES as f64) as i64);
        parts.retain(|one| one.from_ns >= since_ns);
        parts.truncate(MESSAGES);
    }

    /// Returns the figures of a channel. `None` without samples.
    pub(crate) fn of(&self, channel: &str) -> Option<Level> {
        let parts = self.channels.get(channel)?;
        let levels = || parts.iter().filter_map(|part| Some((part, part.level?)));
        let samples: u64 = levels().map(|(part, _)| part.samples).sum();
        let (last, newest) = levels().next_back()?;
        let share = |part: &Part| part.samples as f64 / samples as f64;
        let mean: f64 = levels().map(|(part, level)| share(part) * level.mean).sum();
        // The mean square about the common mean: within the messages, and between their means.
        let square = |level: &PartLevel| level.rms.powi(2) + (level.mean - mean).powi(2);
        let variance: f64 = levels()
            .map(|(part, level)| share(part) * square(&level))
            .sum();
        let peak = |level: &PartLevel| (level.largest - mean).max(mean - level.least);
        let (first, end) = (parts.front()?, parts.back()?);
        Some(Level {
            rate_hz: samples as f64 / ((end.to_ns - first.from_ns).max(1) as f64 / 1e9),
            mean,
            rms: variance.sqrt(),
            peak: levels().map(|(_, level)| peak(&level)).fold(0.0, f64::max),
            last: newest.last,
            last_s: last.to_ns as f64 / 1e9,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use spandrel_bus::{Name, SampleLevel};

    fn name(text: &str) -> Name {
        Name::new(text).unwrap()
    }

    /// A message of one second with these samples, in one bucket each. NaN is missing.
    fn message(second: i64, samples: [f64; 4]) -> WaveformDisplay {
        let present: Vec<f64> = samples.into_iter().filter(|one| !one.is_nan()).collect();
        let mean = present.iter().sum::<f64>() / present.len() as f64;
        let square = present.iter().map(|one| (one - mean).powi(2)).sum::<f64>();
        let bucket = |one: f64| (!one.is_nan()).then_some([one as f32; 2]);
        WaveformDisplay {
            structure: name("tower"),
            node: name("roof"),
            time_ns: second * 1_000_000_000,
            frames: 4,
            bucket_s: 0.25,
            channels: vec![ChannelWaveform {
                channel: name("roof-x"),
                missing: (4 - present.len()) as u64,
                level: present.last().map(|last| SampleLevel {
                    mean,
                    rms: (square / present.len() as f64).sqrt(),
                    last: *last,
                }),
                extremes: samples.map(bucket).to_vec(),
            }],
        }
    }

    fn levels(messages: &[WaveformDisplay]) -> Levels {
        let mut levels = Levels::default();
        messages
            .iter()
            .for_each(|one| levels.take(one, &one.channels[0]));
        levels
    }

    #[test]
    fn figures_of_several_seconds_are_those_of_all_samples() {
        let missing = f64::NAN;
        let seconds = [[1.0, 2.0, 3.0, 6.0], [missing, 8.0, missing, 4.0]];
        let found = levels(&[message(0, seconds[0]), message(1, seconds[1])]);
        let found = found.of("roof-x").unwrap();
        // Six samples: 1, 2, 3, 6, 8, 4. Mean 4, squares 9 + 4 + 1 + 4 + 16 + 0 = 34.
        assert!((found.mean - 4.0).abs() < 1e-12, "{found:?}");
        assert!(
            (found.rms - (34.0_f64 / 6.0).sqrt()).abs() < 1e-12,
            "{found:?}"
        );
        assert!((found.rate_hz - 3.0).abs() < 1e-12, "{found:?}");
        assert!((found.peak - 4.0).abs() < 1e-12, "{found:?}");
        assert_eq!((found.last, found.last_s), (4.0, 2.0));
    }

    #[test]
    fn only_the_last_minute_counts() {
        let quiet = (60..120).map(|second| message(second, [1.0; 4]));
        let all: Vec<_> = std::iter::once(message(59, [100.0; 4]))
            .chain(quiet)
            .collect();
        let has_peak = |messages: &[WaveformDisplay], expected: f64| {
            let found = levels(messages).of("roof-x").unwrap().peak;
            // Rounding of the common mean.
            assert!((found - expected).abs() < 1e-12, "{found} {expected}");
        };
        has_peak(&all[..2], 49.5);
        has_peak(&all, 0.0);
        // After a gap, and after a new run of measurement that starts earlier.
        let loud = message(59, [100.0; 4]);
        has_peak(&[loud.clone(), message(300, [1.0; 4])], 0.0);
        has_peak(&[loud, message(10, [1.0; 4])], 0.0);
    }

    #[test]
    fn a_silent_channel_keeps_its_last_sample_for_a_minute() {
        let silent = (1..60).map(|second| message(second, [f64::NAN; 4]));
        let all: Vec<_> = std::iter::once(message(0, [2.0; 4]))
            .chain(silent)
            .collect();
        let found = levels(&all).of("roof-x").unwrap();
        assert_eq!((found.last, found.last_s), (2.0, 1.0));
        assert!((found.rate_hz - 4.0 / 60.0).abs() < 1e-9);
        let mut longer = levels(&all);
        let last = message(60, [f64::NAN; 4]);
        longer.take(&last, &last.channels[0]);
        assert_eq!(longer.of("roof-x"), None);
        assert_eq!(longer.of("roof-y"), None);
    }
}
