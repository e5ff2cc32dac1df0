//! The shape of the latest samples of one node, at display rate.

use serde::{Deserialize, Serialize};

use super::{Format, MAX_CHANNELS, Malformed, Message, check_count, check_finite, check_range};
use crate::name::Name;

/// Maximum number of buckets in one message.
pub const MAX_BUCKETS: usize = 100;

/// Mean and magnitude of the samples of one channel in one message.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SampleLevel {
    /// Mean of the samples, in the unit of the channel.
    pub mean: f64,
    /// Root mean square of the differences between the samples and `mean`, in the unit of the
    /// channel.
    pub rms: f64,
    /// Last sample, in the unit of the channel.
    pub last: f64,
}

/// The samples of one channel, reduced to their extremes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ChannelWaveform {
    /// Name of the channel.
    pub channel: Name,
    /// Number of frames without a sample of the channel.
    pub missing: u64,
    /// Mean and magnitude. `None` if all samples are missing.
    pub level: Option<SampleLevel>,
    /// Minimum and maximum of each bucket, in the unit of the channel. `None` if all samples of
    /// the bucket are missing.
    pub extremes: Vec<Option<[f32; 2]>>,
}

/// The samples of one node in about one second, reduced to the extremes of short buckets.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct WaveformDisplay {
    /// Name of the structure.
    pub structure: Name,
    /// Name of the node.
    pub node: Name,
    /// Time of the first frame, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// Number of frames.
    pub frames: u64,
    /// Length of a bucket, s. The first bucket starts at `time_ns`.
    pub bucket_s: f64,
    /// The channels of the node.
    pub channels: Vec<ChannelWaveform>,
}

impl Message for WaveformDisplay {
    const TYPE: &'static str = "waveform";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        check_range("bucket_s", self.bucket_s, f64::MIN_POSITIVE, 1e6)?;
        check_count("channels", self.channels.len(), 1, MAX_CHANNELS)?;
        let frames = usize::try_from(self.frames).unwrap_or(usize::MAX);
        for channel in &self.channels {
            let missing = usize::try_from(channel.missing).unwrap_or(usize::MAX);
            check_count("missing", missing, 0, frames)?;
            check_count("extremes", channel.extremes.len(), 1, MAX_BUCKETS)?;
            if let Some(level) = channel.level {
                check_finite("mean", level.mean)?;
                check_range("rms", level.rms, 0.0, f64::MAX)?;
                check_finite("last", level.last)?;
            }
            for [least, largest] in channel.extremes.iter().flatten().copied() {
                check_finite("minimum", f64::from(least))?;
                check_range("maximum", f64::from(largest), f64::from(least), f64::MAX)?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn display() -> WaveformDisplay {
        WaveformDisplay {
            structure: Name::new("tower").unwrap(),
            node: Name::new("roof").unwrap(),
            time_ns: 5,
            frames: 100,
            bucket_s: 0.5,
            channels: vec![ChannelWaveform {
                channel: Name::new("roof-x").unwrap(),
                missing: 50,
                level: Some(SampleLevel {
                    mean: 0.25,
                    rms: 0.5,
                    last: -0.125,
                }),
                extremes: vec![Some([-1.5, 0.75]), None],
            }],
        }
    }

    #[test]
    fn an_empty_bucket_is_null() {
        let text = String::from_utf8(display().encode().unwrap()).unwrap();
        assert!(text.contains(r#""extremes":[[-1.5,0.75],null]"#), "{text}");
        let decoded = WaveformDisplay::decode("application/json", text.as_bytes()).unwrap();
        assert_eq!(decoded, display());
    }

    #[test]
    fn impossible_values_are_refused() {
        type Change = fn(&mut WaveformDisplay);
        let changes: [Change; 10] = [
            |display| display.bucket_s = 0.0,
            |display| display.channels.clear(),
            |display| display.channels[0].missing = 101,
            |display| display.channels[0].extremes.clear(),
            |display| display.channels[0].extremes = vec![None; MAX_BUCKETS + 1],
            |display| display.channels[0].extremes[0] = Some([1.0, 0.5]),
            |display| display.channels[0].extremes[0] = Some([f32::NEG_INFINITY, 0.5]),
            |display| display.channels[0].level.as_mut().unwrap().rms = -1.0,
            |display| display.channels[0].level.as_mut().unwrap().mean = f64::NAN,
            |display| display.channels[0].level.as_mut().unwrap().last = f64::INFINITY,
        ];
        for change in changes {
            let mut wrong = display();
            change(&mut wrong);
            assert!(wrong.check().is_err(), "{wrong:?}");
        }
        assert_eq!(display().check(), Ok(()));
    }
}
