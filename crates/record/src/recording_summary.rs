//! Summarises a recording for users and programs: channels, duration, gaps, statistics and spectral
//! peaks.

use std::fmt;

use serde::Serialize;

use crate::record_time::{iso_text, seconds_text};
use crate::{RecordedChannel, RecordedFile, SpectralPeak, Spectrum, TimeOrigin};

/// Maximum number of gaps listed per channel.
const MOST_GAPS: usize = 5;

/// The summary of a recording.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RecordingSummary {
    /// Path of the file.
    pub path: String,
    /// Name of the format.
    pub format: &'static str,
    /// Remarks for the user.
    pub remarks: Vec<String>,
    /// Channels, in the order of the file.
    pub channels: Vec<ChannelSummary>,
}

/// The summary of a channel. Values are in the unit of the file.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ChannelSummary {
    /// Name of the channel, as used in a mapping.
    pub name: String,
    /// Description of location and direction from the file.
    pub description: Option<String>,
    /// Unit as spelled in the file.
    pub unit: Option<String>,
    /// Quantity of the unit.
    pub quantity: Option<&'static str>,
    /// Factor from the unit to SI.
    pub si_from_unit: Option<f64>,
    /// Sampling rate in Hz, if known.
    pub sampling_rate_hz: Option<f64>,
    /// Whether the times are dates in UTC. Otherwise they are relative to the start of the
    /// recording.
    pub is_dated: bool,
    /// Time of the first sample, in ns: since 1970 if `is_dated`, otherwise since the start of the
    /// recording. `None` without samples.
    pub start_ns: Option<i64>,
    /// Time from the first to the last sample, in s. `None` without samples or without a rate.
    pub span_s: Option<f64>,
    /// Number of samples that are not missing.
    pub samples: u64,
    /// Number of missing samples between the first and the last sample.
    pub missing: u64,
    /// The gaps of the channel.
    pub gaps: Vec<GapSummary>,
    /// Statistics of the existing samples; `None` if there are none.
    pub statistics: Option<Statistics>,
    /// Peaks of the spectrum, in order of frequency.
    pub spectral_peaks: Vec<PeakSummary>,
}

/// A run of missing samples.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct GapSummary {
    /// Time from the start of the channel to the last sample before the gap, in s.
    pub after_s: f64,
    /// Number of missing samples.
    pub samples: u64,
}

/// Statistics of samples.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Statistics {
    /// Mean value, in the unit of the file.
    pub mean: f64,
    /// Standard deviation, with the samples as the whole population.
    pub std: f64,
    /// Lowest value, in the unit of the file.
    pub min: f64,
    /// Highest value, in the unit of the file.
    pub max: f64,
    /// The value with the largest absolute value, with its sign, in the unit of the file.
    pub peak: f64,
    /// Time from the start of the channel to the peak, in s.
    pub peak_after_s: Option<f64>,
}

/// A peak of the spectrum.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PeakSummary {
    /// Frequency, in Hz.
    pub frequency_hz: f64,
    /// Density, in unit²/Hz.
    pub density: f64,
}

impl RecordingSummary {
    /// Summarises a recording.
    pub fn of(file: &RecordedFile) -> Self {
        Self {
            path: file.path().display().to_string(),
            format: file.format().name(),
            remarks: file.remarks().to_vec(),
            channels: file.channels().iter().map(ChannelSummary::of).collect(),
        }
    }

    /// Formats the summary as one JSON object. Non-finite numbers become null.
    pub fn json(&self) -> String {
        format!("{:#}\n", serde_json::json!(self))
    }
}

impl ChannelSummary {
    fn of(channel: &RecordedChannel) -> Self {
        let seconds = |from_ns: i64, to_ns: i64| to_ns.saturating_sub(from_ns) as f64 / 1e9;
        let start_ns = channel.start_ns();
        let after_s = |time_ns: i64| start_ns.map_or(0.0, |start_ns| seconds(start_ns, time_ns));
        let gaps = channel.gaps();
        let peak = |SpectralPeak {
                        frequency_hz,
                        density,
                    }| PeakSummary {
            frequency_hz,
            density,
        };
        let quantity = channel.quantity();
        Self {
            name: channel.name().to_owned(),
            description: channel.description().map(str::to_owned),
            unit: channel.unit().map(str::to_owned),
            quantity: quantity.map(|(quantity, _)| quantity.name()),
            si_from_unit: quantity.map(|(_, factor)| factor),
            sampling_rate_hz: channel.sampling_rate_hz(),
            is_dated: channel.origin() == TimeOrigin::Epoch,
            start_ns,
            span_s: channel.end_ns().map(after_s),
            samples: channel.present(),
            missing: gaps.iter().map(|gap| gap.samples).sum(),
            gaps: gaps
                .iter()
                .map(|gap| GapSummary {
                    after_s: after_s(gap.after_ns),
                    samples: gap.samples,
                })
                .collect(),
            statistics: Statistics::of(channel),
            spectral_peaks: Spectrum::of(channel)
                .map(|spectrum| spectrum.peaks())
                .unwrap_or_default()
                .into_iter()
                .map(peak)
                .collect(),
        }
    }
}

impl Statistics {
    /// Computes the statistics of the existing samples. Returns `None` if there are none.
    pub fn of(channel: &RecordedChannel) -> Option<Self> {
        let present = || channel.samples().filter(|sample| !sample.is_nan());
        let count = present().count() as f64;
        let first = present().next()?;
        // Sums are relative to the first value, so that a large offset does not reduce the
        // precision.
        let mean = first + present().map(|sample| sample - first).sum::<f64>() / count;
        let variance = present()
            .map(|sample| (sample - mean) * (sample - mean))
            .sum::<f64>()
            / count;
        let farther = |peak: f64, sample: f64| {
            if sample.abs() > peak.abs() {
                sample
            } else {
                peak
            }
        };
        let peak = present().fold(first, farther);
        let peak_ns = channel
            .timed_samples()
            .find(|(_, sample)| *sample == peak)
            .map(|(time_ns, _)| time_ns);
        let after_s = |time_ns: i64| {
            time_ns.saturating_sub(channel.start_ns().unwrap_or(time_ns)) as f64 / 1e9
        };
        Some(Self {
            mean,
            std: variance.sqrt(),
            min: present().fold(first, f64::min),
            max: present().fold(first, f64::max),
            peak,
            peak_after_s: peak_ns.map(after_s),
        })
    }
}

impl fmt::Display for RecordingSummary {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            formatter,
            "{}: {}, {}",
            self.path,
            self.format,
            counted(self.channels.len() as u64, "channel")
        )?;
        self.remarks
            .iter()
            .try_for_each(|remark| writeln!(formatter, "  {remark}"))?;
        self.channels
            .iter()
            .try_for_each(|channel| write!(formatter, "{channel}"))
    }
}

impl fmt::Display for ChannelSummary {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let unit = self.unit.as_deref().unwrap_or("unit not stated");
        let quantity = self
            .quantity
            .map(|quantity| format!("{quantity} in "))
            .unwrap_or_default();
        write!(formatter, "\n{}: {quantity}{unit}", self.name)?;
        match &self.description {
            Some(description) => writeln!(formatter, " ({description})")?,
            None => writeln!(formatter)?,
        }
        let samples = || counted(self.samples, "sample");
        let digits = digits_of_times(self.sampling_rate_hz);
        match (self.sampling_rate_hz, self.span_s) {
            (Some(rate_hz), Some(span_s)) => write!(
                formatter,
                "  {} at {} Hz, {span_s:.digits$} s",
                samples(),
                rounded(rate_hz)
            )?,
            (_, _) => write!(formatter, "  {}, sampling rate not stated", samples())?,
        }
        match (self.start_ns, self.is_dated) {
            (Some(start_ns), true) => writeln!(formatter, " from {}", iso_text(start_ns))?,
            (Some(start_ns), false) if start_ns != 0 => {
                writeln!(formatter, " from {} s", seconds_text(start_ns))?
            }
            (Some(_) | None, _) => writeln!(formatter)?,
        }
        if !self.gaps.is_empty() {
            let told = self
                .gaps
                .iter()
                .take(MOST_GAPS)
                .map(|gap| format!("{} after {:.digits$} s", gap.samples, gap.after_s));
            let more = if self.gaps.len() > MOST_GAPS {
                ", …"
            } else {
                ""
            };
            let told = told.collect::<Vec<_>>().join(", ");
            let (missing, gaps) = (
                counted(self.missing, "sample"),
                counted(self.gaps.len() as u64, "gap"),
            );
            writeln!(formatter, "  {missing} missing in {gaps}: {told}{more}")?;
        }
        if let Some(Statistics {
            mean,
            std,
            min,
            max,
            peak,
            peak_after_s,
        }) = self.statistics
        {
            let [mean, std, min, max, peak] = [mean, std, min, max, peak].map(rounded);
            write!(
                formatter,
                "  mean {mean}, std {std}, min {min}, max {max}, peak {peak}"
            )?;
            match peak_after_s {
                Some(after_s) => writeln!(formatter, " after {after_s:.digits$} s")?,
                None => writeln!(formatter)?,
            }
        }
        if !self.spectral_peaks.is_empty() {
            let told = self
                .spectral_peaks
                .iter()
                .map(|peak| format!("{:.3}", peak.frequency_hz))
                .collect::<Vec<_>>();
            writeln!(formatter, "  spectral peaks at {} Hz", told.join(", "))?;
        }
        Ok(())
    }
}

/// Returns the number of decimals, at least three, that distinguish the times of two samples.
fn digits_of_times(rate_hz: Option<f64>) -> usize {
    /// Maximum number of decimals, because times have a resolution of 1 ns.
    const MOST: f64 = 9.0;
    rate_hz
        .filter(|rate_hz| *rate_hz > 0.0)
        .map_or(3.0, |rate_hz| rate_hz.log10().ceil().clamp(3.0, MOST)) as usize
}

/// Formats a count with its noun, in the singular if the count is 1.
fn counted(count: u64, what: &str) -> String {
    format!("{count} {what}{}", if count == 1 { "" } else { "s" })
}

/// Formats a number with six significant digits, without trailing zeros.
fn rounded(number: f64) -> String {
    let magnitude = number.abs();
    if number == 0.0 || !(1e-4..1e7).contains(&magnitude) {
        return if number == 0.0 {
            "0".to_owned()
        } else {
            format!("{number:.5e}")
        };
    }
    let decimals = (5 - magnitude.log10().floor() as i32).max(0) as usize;
    let text = format!("{number:.decimals$}");
    match text.contains('.') {
        true => text.trim_end_matches('0').trim_end_matches('.').to_owned(),
        false => text,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Format, Segment};
    use std::path::Path;

    #[test]
    fn summary_of_a_channel_has_unit_span_gap_and_peak() {
        let samples = vec![1.0, -4.0, f64::NAN, 2.0, 1.0];
        let channel = RecordedChannel::new(
            "roof",
            Some(100.0),
            vec![Segment::new(1_709_208_000_000_000_000, samples)],
        )
        .with_unit("cm/sec2")
        .with_description("Tran")
        .with_origin(TimeOrigin::Epoch);
        let file = RecordedFile::from_channels(Path::new("hall.v2"), Format::Csmip, vec![channel]);
        assert_eq!(
            RecordingSummary::of(&file).to_string(),
            "hall.v2: CSMIP volume 2, 1 channel\n\nroof: acceleration in cm/sec2 (Tran)\n  \
             4 samples at 100 Hz, 0.040 s from 2024-02-29T12:00:00Z\n  1 sample missing in 1 gap: \
             1 after 0.010 s\n  mean 0, std 2.34521, min -4, max 2, peak -4 after 0.010 s\n"
        );
        let json = RecordingSummary::of(&file).json();
        let value: serde_json::Value = serde_json::from_str(&json).unwrap();
        assert_eq!(value["channels"][0]["statistics"]["peak"], -4.0);
        assert_eq!(value["channels"][0]["si_from_unit"], 0.01);
    }

    /// At 20 kHz, three decimals would show "after 0.001 s" for some twenty samples around the
    /// peak.
    #[test]
    fn times_have_enough_digits_for_the_sampling_rate() {
        let mut samples = vec![0.0; 100];
        samples[27] = 5.0;
        let channel = |rate_hz| {
            RecordedChannel::new("a", Some(rate_hz), vec![Segment::new(0, samples.clone())])
        };
        for (rate_hz, told) in [
            (100.0, "0.270 s"),
            (1000.0, "0.027 s"),
            (20_000.0, "0.00135 s"),
            (65_536.0, "0.00041 s"),
        ] {
            let file = RecordedFile::from_channels(
                Path::new("hall.uff"),
                Format::Uff58,
                vec![channel(rate_hz)],
            );
            let text = RecordingSummary::of(&file).to_string();
            assert!(
                text.contains(&format!("peak 5 after {told}\n")),
                "{rate_hz} Hz: {text}"
            );
        }
    }

    #[test]
    fn numbers_have_six_digits() {
        for (number, text) in [
            (200.0, "200"),
            (119.99983, "120"),
            (0.312883, "0.312883"),
            (-54.284843, "-54.2848"),
            (1e-7, "1.00000e-7"),
            (1_017_300.0, "1017300"),
        ] {
            assert_eq!(rounded(number), text);
        }
    }
}
