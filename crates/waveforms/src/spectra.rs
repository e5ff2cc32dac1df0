//! Power spectral densities of the last minute, for display.
//!
//! Source: P. D. Welch (1967), *IEEE Transactions on Audio and Electroacoustics* 15, 70–73. The
//! Hann windows overlap by half, and the mean of each is removed. The density is one-sided, so that
//! its integral from 0 to half the sampling rate is the variance of the samples.

use std::collections::VecDeque;
use std::ops::Range;

use spandrel_bus::{ChannelSpectrum, FrameBlock, MAX_FREQUENCIES, Name, SpectrumDisplay};
use spandrel_checkpoint::Position;
use spandrel_fourier::HannTransform;

use crate::waveforms::NodeChannels;

/// Length of a window, s. It resolves the natural frequencies of most structures.
const WINDOW_S: f64 = 20.0;
/// Minimum and maximum number of samples in a window. The maximum bounds the memory.
const SHORTEST_WINDOW: usize = 64;
const LONGEST_WINDOW: usize = 4096;
/// Time over which windows are averaged, s.
const AVERAGED_S: f64 = 60.0;
/// Maximum number of windows that are averaged, which bounds the memory.
const MOST_WINDOWS: usize = 16;
/// Interval between two messages, s of measurement time.
const EVERY_S: f64 = 10.0;

/// Derives one spectrum message per node and ten seconds of measurement time from the frames.
///
/// A window with a missing sample is left out.
#[derive(Debug)]
pub(crate) struct Spectra {
    structure: Name,
    nodes: Vec<NodeChannels>,
    sampling_rate_hz: f64,
    transform: HannTransform,
    /// The lines of the transform that are combined into each frequency.
    groups: Vec<Range<usize>>,
    /// Number of frames over which windows are averaged, and between two messages.
    averaged: u64,
    every: u64,
    /// Position of the next frame.
    next: Option<Position>,
    channels: Vec<ChannelWindows>,
}

/// The windows of one channel.
#[derive(Clone, Debug, Default)]
struct ChannelWindows {
    /// Samples of the window that is being filled.
    samples: Vec<f64>,
    /// Number of the last frame, and density, of each complete window.
    complete: VecDeque<(u64, Vec<f32>)>,
}

impl Spectra {
    pub(crate) fn new(structure: Name, nodes: Vec<NodeChannels>, sampling_rate_hz: f64) -> Self {
        let wanted = (WINDOW_S * sampling_rate_hz).ceil() as usize;
        let length = wanted.clamp(SHORTEST_WINDOW, LONGEST_WINDOW);
        let length = length.next_power_of_two();
        let channels = nodes.iter().map(|node| node.channels.len()).sum();
        // The averages contain at least one window.
        let averaged = (AVERAGED_S * sampling_rate_hz).max(2.0 * length as f64);
        Self {
            structure,
            nodes,
            sampling_rate_hz,
            transform: HannTransform::new(length),
            groups: groups(length / 2),
            averaged: averaged as u64,
            every: (EVERY_S * sampling_rate_hz).round().max(1.0) as u64,
            next: None,
            channels: vec![ChannelWindows::default(); channels],
        }
    }

    /// Adds the frames of a block, and returns the messages that become due.
    pub(crate) fn handle(&mut self, block: &FrameBlock, out: &mut Vec<SpectrumDisplay>) {
        let Some(grid) = block.grid() else {
            return; // no block with an invalid rate is published
        };
        let epoch = block.header.epoch;
        let position = |sequence| Position { epoch, sequence };
        for (number, frame) in block.iter() {
            if self.next.is_none_or(|next| next.epoch != epoch) {
                self.channels.fill(ChannelWindows::default());
            } else if self.next != Some(position(number)) {
                let channels = self.channels.iter_mut();
                channels.for_each(|channel| channel.samples.clear());
            }
            self.next = Some(position(number + 1));
            for (place, sample) in frame.iter().enumerate().take(self.channels.len()) {
                self.push(place, number, *sample);
            }
            if (number + 1).is_multiple_of(self.every) {
                self.publish(number, grid.time_ns(number), out);
            }
        }
    }

    fn push(&mut self, place: usize, number: u64, sample: f64) {
        let length = self.transform.window_len();
        let channel = &mut self.channels[place];
        if sample.is_nan() {
            channel.samples.clear();
            return;
        }
        channel.samples.push(sample);
        if channel.samples.len() < length {
            return;
        }
        let density = self.density(&self.channels[place].samples);
        let channel = &mut self.channels[place];
        channel.samples.drain(..length / 2);
        channel.complete.push_back((number, density));
        if channel.complete.len() > MOST_WINDOWS {
            channel.complete.pop_front();
        }
    }

    /// Returns the density of one window at each frequency, unit²/Hz.
    fn density(&self, samples: &[f64]) -> Vec<f32> {
        let output = self.transform.transform(samples.iter().copied());
        let scale = 2.0 / (self.sampling_rate_hz * self.transform.power());
        // The line at half the sampling rate has no mirror image.
        let halved = |line: usize| if line + 1 == output.len() { 0.5 } else { 1.0 };
        let of_line = |line: usize| scale * halved(line) * output[line].norm_sqr();
        let of_group = |group: &Range<usize>| {
            let sum: f64 = group.clone().map(of_line).sum();
            (sum / group.len() as f64).min(f64::from(f32::MAX)) as f32
        };
        self.groups.iter().map(of_group).collect()
    }

    fn publish(&mut self, number: u64, time_ns: i64, out: &mut Vec<SpectrumDisplay>) {
        let (averaged, count) = (self.averaged, self.groups.len());
        // The clock of a node may have been set back, which repeats numbers.
        let is_recent = |end: u64| end <= number && end + averaged > number;
        let step_hz = self.sampling_rate_hz / self.transform.window_len() as f64;
        let middle = |group: &Range<usize>| 0.5 * (group.start + group.end - 1) as f64 * step_hz;
        let frequencies: Vec<f32> = self.groups.iter().map(|one| middle(one) as f32).collect();
        let mut windows = self.channels.iter_mut();
        for NodeChannels { node, channels } in &self.nodes {
            let channels = channels.iter().zip(windows.by_ref());
            let spectrum = |(channel, windows): (&Name, &mut ChannelWindows)| {
                windows.complete.retain(|(end, _)| is_recent(*end));
                windows.spectrum(channel, count)
            };
            out.push(SpectrumDisplay {
                structure: self.structure.clone(),
                node: node.clone(),
                time_ns,
                window_s: self.transform.window_len() as f64 / self.sampling_rate_hz,
                frequencies_hz: frequencies.clone(),
                channels: channels.map(spectrum).collect(),
            });
        }
    }
}

impl ChannelWindows {
    /// Returns the mean density of the complete windows.
    fn spectrum(&self, channel: &Name, frequencies: usize) -> ChannelSpectrum {
        let windows = self.complete.len();
        let mut sums = vec![0.0; if windows > 0 { frequencies } else { 0 }];
        for (_, density) in &self.complete {
            let both = sums.iter_mut().zip(density);
            both.for_each(|(sum, density)| *sum += f64::from(*density));
        }
        ChannelSpectrum {
            channel: channel.clone(),
            windows: windows as u64,
            density: sums
                .iter()
                .map(|sum| (sum / windows as f64) as f32)
                .collect(),
        }
    }
}

/// Divides the lines 1 to `last` of a transform into at most [`MAX_FREQUENCIES`] groups.
///
/// Low lines stay alone. The groups of high lines grow in proportion to their frequency, as on a
/// logarithmic axis.
fn groups(last: usize) -> Vec<Range<usize>> {
    let ratio = (last as f64).powf(1.0 / MAX_FREQUENCIES as f64);
    let mut groups = Vec::new();
    let mut start = 1;
    for group in 1..=MAX_FREQUENCIES as i32 {
        let end = (ratio.powi(group).round() as usize + 1).clamp(start, last + 1);
        if end > start {
            groups.push(start..end);
            start = end;
        }
    }
    groups
}

#[cfg(test)]
mod tests {
    use super::*;
    use spandrel_bus::{Header, Message, StreamState};
    use std::f64::consts::PI;

    const RATE_HZ: f64 = 100.0;
    /// Number of samples of a window at this rate: the first power of two from 20 s on.
    const LENGTH: usize = 2048;

    fn name(text: &str) -> Name {
        Name::new(text).unwrap()
    }

    fn block(sequence: u64, values: &[f64]) -> FrameBlock {
        FrameBlock {
            header: Header {
                source: "ingest".into(),
                epoch: 1,
                sequence,
                time_ns: 0,
            },
            t0_ns: 0,
            sampling_rate_hz: RATE_HZ,
            channels: 1,
            values: values.to_vec(),
            state: StreamState::Running,
        }
    }

    /// Returns the messages for samples of a single channel, in blocks of `size`.
    fn messages(samples: &[f64], size: usize) -> Vec<SpectrumDisplay> {
        let nodes = vec![NodeChannels {
            node: name("roof"),
            channels: vec![name("roof-x")],
        }];
        let mut spectra = Spectra::new(name("tower"), nodes, RATE_HZ);
        let mut out = Vec::new();
        for (k, values) in samples.chunks(size).enumerate() {
            spectra.handle(&block((k * size) as u64, values), &mut out);
        }
        out.iter().for_each(|message| message.check().unwrap());
        out
    }

    /// Returns the integral of the density of the last message, over the width of each group.
    fn power(message: &SpectrumDisplay) -> f64 {
        let step = RATE_HZ / LENGTH as f64;
        let widths = groups(LENGTH / 2);
        let widths = widths.iter().map(|group| group.len() as f64 * step);
        let density = message.channels[0].density.iter();
        density
            .zip(widths)
            .map(|(density, width)| f64::from(*density) * width)
            .sum()
    }

    /// Reproducible samples, uniform between -1 and 1: variance 1/3, no correlation.
    fn noise(count: usize) -> Vec<f64> {
        let mut state = 20_061_u64;
        let next = |_| {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1);
            (state >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
        };
        (0..count).map(next).collect()
    }

    #[test]
    fn a_sine_has_the_power_and_frequency_of_its_amplitude() {
        let sine = |k: usize| 9.81 + 0.3 * (2.0 * PI * 4.0 * k as f64 / RATE_HZ).sin();
        let samples: Vec<f64> = (0..6000).map(sine).collect();
        let found = messages(&samples, 64).pop().unwrap();
        // Half the squared amplitude. The sine falls between two lines, and a Hann window then
        // changes the power by less than 1e-3.
        assert!(
            (power(&found) / 0.045 - 1.0).abs() < 1e-3,
            "{}",
            power(&found)
        );
        let density = found.channels[0].density.iter().enumerate();
        let peak = density.max_by(|a, b| a.1.total_cmp(b.1)).unwrap().0;
        let width = f64::from(found.frequencies_hz[peak] - found.frequencies_hz[peak - 1]);
        assert!((f64::from(found.frequencies_hz[peak]) - 4.0).abs() <= width);
        // The offset of 9.81 does not leak. With it, the first line would exceed the peak.
        assert!(found.channels[0].density[0] < 1e-6 * found.channels[0].density[peak]);
    }

    #[test]
    fn white_noise_has_its_level_at_all_frequencies() {
        let found = messages(&noise(6000), 64).pop().unwrap();
        assert_eq!(found.channels[0].windows, 4);
        // Variance 1/3 over 50 Hz. The density of one line of one window has a relative standard
        // deviation of 1. Four windows that overlap by half count as at least three, and Hann's
        // lines as at least half their number (Welch 1967, equation 17 and table).
        let level = 1.0 / 3.0 / (RATE_HZ / 2.0);
        for range in [60..110, 110..160] {
            let of = groups(LENGTH / 2);
            let lines: f64 = of[range.clone()]
                .iter()
                .map(|group| group.len() as f64)
                .sum();
            let weighted =
                range.map(|k| f64::from(found.channels[0].density[k]) * of[k].len() as f64);
            let mean = weighted.sum::<f64>() / lines;
            let deviation = 1.0 / (3.0_f64 * lines / 2.0).sqrt();
            assert!(
                (mean / level - 1.0).abs() < 4.0 * deviation,
                "{mean} against {level}"
            );
        }
    }

    /// Parseval's theorem, in the time domain: Σ w²x² is proportional to the sum over all lines.
    #[test]
    fn one_window_has_the_power_of_its_weighted_samples() {
        let samples = noise(LENGTH);
        let mean = samples.iter().sum::<f64>() / LENGTH as f64;
        let weight = |n: usize| (PI * n as f64 / LENGTH as f64).sin().powi(2);
        let squares = |n: usize| (weight(n) * (samples[n] - mean)).powi(2);
        let weights: f64 = (0..LENGTH).map(|n| weight(n).powi(2)).sum();
        let all = (0..LENGTH).map(squares).sum::<f64>() / weights;
        // The frequencies leave out 0 Hz, where only the weighting of the mean remains.
        let at_zero: f64 = (0..LENGTH).map(|n| weight(n) * (samples[n] - mean)).sum();
        let expected = all - at_zero.powi(2) / (weights * LENGTH as f64);
        let mut padded = samples.clone();
        padded.resize(3000, f64::NAN);
        let found = messages(&padded, 3000).pop().unwrap();
        assert_eq!(found.channels[0].windows, 1);
        assert!(
            (power(&found) / expected - 1.0).abs() < 1e-5,
            "{} {expected}",
            power(&found)
        );
    }

    #[test]
    fn a_missing_sample_leaves_out_its_windows() {
        let mut samples = noise(6000);
        samples[5000] = f64::NAN;
        let found = messages(&samples, 64);
        let windows: Vec<u64> = found.iter().map(|one| one.channels[0].windows).collect();
        // Windows end after 2048, 3072, 4096, but not 5120. The next would end at 7049.
        assert_eq!(windows, [0, 0, 1, 2, 3, 3]);
        let silent = [samples, vec![f64::NAN; 9000]].concat();
        let last = messages(&silent, 64).pop().unwrap();
        assert_eq!(
            (last.channels[0].windows, last.channels[0].density.len()),
            (0, 0)
        );
    }

    #[test]
    fn windows_from_before_a_clock_was_set_back_are_left_out() {
        let nodes = vec![NodeChannels {
            node: name("roof"),
            channels: vec![name("roof-x")],
        }];
        let mut spectra = Spectra::new(name("tower"), nodes, RATE_HZ);
        let mut windows = Vec::new();
        for (sequence, count) in [(100_000, 6000), (50_000, 3000)] {
            let mut out = Vec::new();
            spectra.handle(&block(sequence, &noise(count)), &mut out);
            windows.push(out.last().unwrap().channels[0].windows);
        }
        assert_eq!(windows, [4, 1]);
    }

    #[test]
    fn block_sizes_do_not_affect_the_spectrum() {
        let samples = noise(6000);
        assert_eq!(messages(&samples, 6000), messages(&samples, 7));
    }

    #[test]
    fn the_groups_cover_each_line_once() {
        for last in [32, 256, 1024, 2048] {
            let groups = groups(last);
            assert!(groups.len() <= MAX_FREQUENCIES, "{last}: {}", groups.len());
            let lines: Vec<usize> = groups.into_iter().flatten().collect();
            assert_eq!(lines, (1..=last).collect::<Vec<_>>());
        }
    }
}
