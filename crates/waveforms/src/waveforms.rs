//! Reduces the samples of each second to the extremes of short buckets, for display.
//!
//! Source of the running variance: B. P. Welford (1962), *Technometrics* 4, 419–420.

use spandrel_bus::{ChannelWaveform, FrameBlock, Name, SampleLevel, TimeGrid, WaveformDisplay};
use spandrel_checkpoint::Position;

/// Number of buckets in one message.
const BUCKETS: u64 = 10;
/// Length of one message at sampling rates that allow it, s.
const MESSAGE_S: f64 = 1.0;

/// The channels of one node, in frame order.
#[derive(Clone, Debug)]
pub struct NodeChannels {
    /// Name of the node.
    pub node: Name,
    /// Names of its channels.
    pub channels: Vec<Name>,
}

/// Derives one waveform message per node and second of measurement time from the frames.
///
/// A message covers frames whose numbers depend on the sampling rate only. Block sizes and speed
/// therefore do not affect it. A message is published only if all its frames have been seen.
#[derive(Debug)]
pub(crate) struct Waveforms {
    structure: Name,
    nodes: Vec<NodeChannels>,
    frames_per_bucket: u64,
    sampling_rate_hz: f64,
    /// Position of the next frame. `None` until a message begins.
    next: Option<Position>,
    channels: Vec<ChannelSamples>,
}

/// The samples of one channel since the message began.
#[derive(Clone, Debug, Default)]
struct ChannelSamples {
    count: u64,
    mean: f64,
    /// Sum of the squared differences from the mean.
    squares: f64,
    last: f64,
    extremes: [Option<[f64; 2]>; BUCKETS as usize],
}

impl Waveforms {
    pub(crate) fn new(structure: Name, nodes: Vec<NodeChannels>, sampling_rate_hz: f64) -> Self {
        let per_bucket = (sampling_rate_hz * MESSAGE_S / BUCKETS as f64).round();
        let channels = nodes.iter().map(|node| node.channels.len()).sum();
        Self {
            structure,
            nodes,
            frames_per_bucket: per_bucket.max(1.0) as u64,
            sampling_rate_hz,
            next: None,
            channels: vec![ChannelSamples::default(); channels],
        }
    }

    /// Adds the frames of a block, and returns the messages that it completes.
    pub(crate) fn handle(&mut self, block: &FrameBlock, out: &mut Vec<WaveformDisplay>) {
        let Some(grid) = block.grid() else {
            return; // no block with an invalid rate is published
        };
        let epoch = block.header.epoch;
        let position = |sequence| Position { epoch, sequence };
        let length = BUCKETS * self.frames_per_bucket;
        for (number, frame) in block.iter() {
            let row = number % length;
            if row == 0 {
                self.channels.fill(ChannelSamples::default());
                self.next = Some(position(number));
            }
            if self.next != Some(position(number)) {
                self.next = None; // frames are missing, or the epoch has changed
                continue;
            }
            self.next = Some(position(number + 1));
            let bucket = (row / self.frames_per_bucket) as usize;
            for (channel, sample) in self.channels.iter_mut().zip(frame) {
                channel.push(bucket, *sample);
            }
            if row + 1 == length {
                self.complete(grid, number - row, length, out);
            }
        }
    }

    fn complete(&self, grid: TimeGrid, first: u64, frames: u64, out: &mut Vec<WaveformDisplay>) {
        let mut samples = self.channels.iter();
        for NodeChannels { node, channels } in &self.nodes {
            let channels = channels.iter().zip(samples.by_ref());
            out.push(WaveformDisplay {
                structure: self.structure.clone(),
                node: node.clone(),
                time_ns: grid.time_ns(first),
                frames,
                bucket_s: self.frames_per_bucket as f64 / self.sampling_rate_hz,
                channels: channels
                    .map(|(channel, samples)| samples.waveform(channel, frames))
                    .collect(),
            });
        }
    }
}

impl ChannelSamples {
    fn push(&mut self, bucket: usize, sample: f64) {
        if sample.is_nan() {
            return;
        }
        self.count += 1;
        let difference = sample - self.mean;
        self.mean += difference / self.count as f64;
        self.squares += difference * (sample - self.mean);
        self.last = sample;
        let [least, largest] = self.extremes[bucket].unwrap_or([sample; 2]);
        self.extremes[bucket] = Some([least.min(sample), largest.max(sample)]);
    }

    fn waveform(&self, channel: &Name, frames: u64) -> ChannelWaveform {
        let level = SampleLevel {
            mean: self.mean,
            rms: (self.squares / self.count as f64).sqrt(),
            last: self.last,
        };
        // The mean of samples near the limits of a double overflows.
        let is_level = self.count > 0 && level.mean.is_finite() && level.rms.is_finite();
        let narrow = |value: f64| value.clamp(f64::from(f32::MIN), f64::from(f32::MAX)) as f32;
        let extremes = self.extremes.iter();
        ChannelWaveform {
            channel: channel.clone(),
            missing: frames - self.count,
            level: is_level.then_some(level),
            extremes: extremes
                .map(|both| both.map(|ends| ends.map(narrow)))
                .collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use spandrel_bus::{Header, Message, StreamState};
    use std::f64::consts::{PI, SQRT_2};

    const RATE_HZ: f64 = 100.0;

    fn name(text: &str) -> Name {
        Name::new(text).unwrap()
    }

    fn waveforms(rate_hz: f64) -> Waveforms {
        let node = |node: &str, channels: &[&str]| NodeChannels {
            node: name(node),
            channels: channels.iter().map(|channel| name(channel)).collect(),
        };
        let nodes = vec![
            node("base", &["base-x"]),
            node("roof", &["roof-x", "roof-y"]),
        ];
        Waveforms::new(name("tower"), nodes, rate_hz)
    }

    /// A block from frame `first`. All channels have the same samples.
    fn block(epoch: u64, first: u64, samples: &[f64], rate_hz: f64) -> FrameBlock {
        FrameBlock {
            header: Header {
                source: "ingest".into(),
                epoch,
                sequence: first,
                time_ns: 0,
            },
            t0_ns: 7,
            sampling_rate_hz: rate_hz,
            channels: 3,
            values: samples.iter().flat_map(|sample| [*sample; 3]).collect(),
            state: StreamState::Running,
        }
    }

    fn messages(blocks: &[FrameBlock]) -> Vec<WaveformDisplay> {
        let mut waveforms = waveforms(RATE_HZ);
        let mut out = Vec::new();
        blocks
            .iter()
            .for_each(|block| waveforms.handle(block, &mut out));
        out.iter().for_each(|message| message.check().unwrap());
        out
    }

    /// A sine of 5 Hz and amplitude 2 around 9.81, for three and a half seconds.
    fn sine() -> Vec<f64> {
        let sample = |k: u32| 9.81 + 2.0 * (2.0 * PI * 5.0 * f64::from(k) / RATE_HZ).sin();
        (0..350).map(sample).collect()
    }

    #[test]
    fn a_sine_has_the_level_and_extremes_of_its_amplitude() {
        let found = messages(&[block(1, 0, &sine(), RATE_HZ)]);
        let nodes: Vec<&str> = found.iter().map(|message| message.node.as_str()).collect();
        assert_eq!(nodes, ["base", "roof", "base", "roof", "base", "roof"]);
        assert_eq!(found[2].time_ns, 1_000_000_007);
        assert_eq!((found[2].frames, found[2].bucket_s), (100, 0.1));
        let channel = &found[3].channels[1];
        let level = channel.level.unwrap();
        // Five whole periods: the mean is the offset, and the rms is the amplitude over √2.
        assert!((level.mean - 9.81).abs() < 1e-12, "{level:?}");
        assert!((level.rms - 2.0 / SQRT_2).abs() < 1e-12, "{level:?}");
        assert_eq!(level.last, sine()[199]);
        // A bucket is half a period. At 20 samples per period, a sample falls on each crest.
        let [least, largest] = channel.extremes[0].unwrap();
        assert!((f64::from(largest) - 11.81).abs() < 1e-6, "{largest}");
        assert!((f64::from(least) - 9.81).abs() < 1e-6, "{least}");
        let [least, _] = channel.extremes[1].unwrap();
        assert!((f64::from(least) - 7.81).abs() < 1e-6, "{least}");
    }

    #[test]
    fn a_bucket_without_samples_is_a_gap() {
        let mut samples = sine();
        samples[120..145].fill(f64::NAN);
        let channel = &messages(&[block(1, 0, &samples, RATE_HZ)])[2].channels[0];
        assert_eq!(channel.missing, 25);
        let gaps: Vec<bool> = channel.extremes.iter().map(Option::is_none).collect();
        let expected = [2, 3].map(|gap| (0..10).map(|k| k == gap).collect::<Vec<_>>());
        let both: Vec<bool> = (0..10).map(|k| expected[0][k] || expected[1][k]).collect();
        assert_eq!(gaps, both);
        samples[100..200].fill(f64::NAN);
        let silent = &messages(&[block(1, 0, &samples, RATE_HZ)])[2].channels[0];
        assert_eq!((silent.missing, silent.level), (100, None));
    }

    #[test]
    fn block_sizes_do_not_affect_the_messages() {
        let whole = messages(&[block(1, 0, &sine(), RATE_HZ)]);
        for size in [1, 7, 64] {
            let pieces = sine();
            let pieces = pieces.chunks(size).enumerate();
            let blocks: Vec<FrameBlock> = pieces
                .map(|(k, samples)| block(1, (k * size) as u64, samples, RATE_HZ))
                .collect();
            assert_eq!(messages(&blocks), whole, "blocks of {size}");
        }
    }

    #[test]
    fn a_message_is_published_only_with_all_its_frames() {
        // The first message begins before frame 50. Frames 220 to 229 are missing.
        let blocks = [
            block(1, 50, &[1.0; 170], RATE_HZ),
            block(1, 230, &[1.0; 270], RATE_HZ),
        ];
        let times: Vec<i64> = messages(&blocks).iter().map(|one| one.time_ns).collect();
        assert_eq!(times[..2], [1_000_000_007; 2]);
        assert_eq!(
            times[2..],
            [3_000_000_007, 3_000_000_007, 4_000_000_007, 4_000_000_007]
        );
        // A new epoch does not complete a message of the previous one.
        let restarted = [
            block(1, 0, &[1.0; 50], RATE_HZ),
            block(2, 50, &[1.0; 50], RATE_HZ),
        ];
        assert_eq!(messages(&restarted), []);
    }

    #[test]
    fn a_bucket_has_at_least_one_frame() {
        let mut waveforms = waveforms(2.0);
        let mut out = Vec::new();
        waveforms.handle(&block(1, 0, &[1.0; 10], 2.0), &mut out);
        assert_eq!((out[0].frames, out[0].bucket_s), (10, 0.5));
        assert!(out[0].channels[0].extremes.iter().all(Option::is_some));
    }

    #[test]
    fn samples_near_the_limits_of_a_double_give_a_valid_message() {
        let samples = [f64::MAX, -f64::MAX].repeat(50);
        let found = messages(&[block(1, 0, &samples, RATE_HZ)]);
        assert_eq!(found[0].channels[0].level, None);
        assert_eq!(found[0].channels[0].extremes[0], Some([f32::MIN, f32::MAX]));
    }
}
