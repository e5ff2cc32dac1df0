//! Estimates of the two routes: the file of `spandrel estimate`, and the stream on the bus.

use super::within;
use spandrel_bus::{
    Block, Bus, Delivery, EstimateBlock, Keys, Start, Stream, StreamSettings, StreamState,
};
use std::path::Path;

/// Mean and standard deviation of each parameter, then of each identified noise level, at one
/// frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Identified {
    pub time_ns: i64,
    pub mean_and_std: Vec<(f64, f64)>,
}

impl Identified {
    /// Formats all values bit for bit as a line of text, for another process.
    pub fn to_line(&self) -> String {
        let bits = self
            .mean_and_std
            .iter()
            .map(|(mean, std)| format!(" {:x} {:x}", mean.to_bits(), std.to_bits()));
        format!("{}{}\n", self.time_ns, bits.collect::<String>())
    }

    /// Parses the output of [`Identified::to_line`].
    pub fn from_line(line: &str) -> Self {
        let (time_ns, bits) = line.split_once(' ').unwrap();
        let values: Vec<f64> = bits
            .split(' ')
            .map(|hex| f64::from_bits(u64::from_str_radix(hex, 16).unwrap()))
            .collect();
        let pairs = values.chunks_exact(2).map(|pair| (pair[0], pair[1]));
        Self {
            time_ns: time_ns.parse().unwrap(),
            mean_and_std: pairs.collect(),
        }
    }
}

/// Output of `spandrel estimate --output --json` for a record.
pub struct Estimated {
    pub parameters: Vec<String>,
    pub frames: Vec<Identified>,
    pub summary: serde_json::Value,
}

impl Estimated {
    /// Reads the file without its `responses`, which are not on the bus.
    pub fn read(path: &Path, responses: &[&str], summary: serde_json::Value) -> Self {
        let table = super::Record::read(path);
        let named = |column: &String| {
            column
                .strip_suffix(".mean")
                .filter(|name| !responses.contains(name))
                .map(str::to_owned)
        };
        let parameters: Vec<String> = table.channels().iter().filter_map(named).collect();
        let of_parameter = |row: usize, name: &String| {
            (
                table.value(row, &format!("{name}.mean")),
                table.value(row, &format!("{name}.std")),
            )
        };
        let frame = |row: usize| Identified {
            time_ns: table.time_ns(row),
            mean_and_std: parameters
                .iter()
                .map(|name| of_parameter(row, name))
                .collect(),
        };
        Self {
            frames: (0..table.len()).map(frame).collect(),
            parameters,
            summary,
        }
    }
}

/// Reader of a structure's estimates on the bus. A gap fails the test.
pub struct EstimateReader {
    stream: Stream<EstimateBlock>,
    frames: Vec<Identified>,
    ends: usize,
    read_by: String,
}

impl EstimateReader {
    pub async fn join(bus: &Bus, keys: &Keys) -> Self {
        Self::with_settings(bus, keys, StreamSettings::new(Start::Beginning)).await
    }

    /// Joins a source that stores its estimates. On a busy machine, this reader waits for the
    /// source as long as it takes, and does not give up its estimates.
    pub async fn join_patiently(bus: &Bus, keys: &Keys) -> Self {
        Self::with_settings(bus, keys, StreamSettings::new(Start::Beginning).patient()).await
    }

    pub async fn with_settings(bus: &Bus, keys: &Keys, settings: StreamSettings) -> Self {
        let stream = bus
            .follow(keys.estimates(), keys.estimates_buffer(), settings)
            .await
            .unwrap();
        Self {
            stream,
            frames: Vec::new(),
            ends: 0,
            read_by: keys.estimates(),
        }
    }

    /// Reads until `count` frames have arrived since the start.
    pub async fn read_frames(&mut self, count: usize) -> &[Identified] {
        while self.frames.len() < count {
            self.read_block(&format!("{count} frames")).await;
        }
        &self.frames
    }

    /// Reads until the stream has ended. A gap that starts a new run of frames ends the preceding
    /// run.
    pub async fn read_to_end(&mut self, runs: usize) -> &[Identified] {
        while self.ends < runs {
            self.read_block("the end").await;
        }
        &self.frames
    }

    /// Returns the number of frames that were not received when published and were fetched by
    /// query.
    pub fn fetched(&self) -> u64 {
        self.stream.counts().follow.fetched_items
    }

    async fn read_block(&mut self, until: &str) {
        let what = format!(
            "{} of {until}, {} frames so far",
            self.read_by,
            self.frames.len()
        );
        match within(&what, self.stream.deliveries().recv_async())
            .await
            .unwrap()
        {
            Delivery::Gap(gap) => panic!("{}: frames lost: {gap:?}", self.read_by),
            Delivery::Block(block) => {
                self.ends += usize::from(block.state() == StreamState::Ended);
                self.frames.extend(identified(&block));
            }
        }
    }
}

/// Returns the estimates of a block, with the standard deviations that `spandrel estimate` writes.
pub fn identified(block: &EstimateBlock) -> Vec<Identified> {
    let grid = block.grid().unwrap();
    let frames = block.iter().map(|(number, estimate)| {
        let std = |index| estimate.variance(index).unwrap().max(0.0).sqrt();
        let parameters = estimate
            .mean
            .iter()
            .enumerate()
            .map(|(index, mean)| (*mean, std(index)));
        let noise = estimate.noise_mean.iter().zip(&estimate.noise_covariance);
        let pairs =
            parameters.chain(noise.map(|(mean, variance)| (*mean, variance.max(0.0).sqrt())));
        Identified {
            time_ns: grid.time_ns(number),
            mean_and_std: pairs.collect(),
        }
    });
    frames.collect()
}

/// Compares time, mean and standard deviation of each frame bit for bit.
#[track_caller]
pub fn assert_same_bits(
    route: &str,
    parameters: &[String],
    expected: &[Identified],
    found: &[Identified],
) {
    let count = (expected.len(), found.len());
    let back = || {
        let not_later = |pair: &[Identified]| pair[1].time_ns <= pair[0].time_ns;
        match found.windows(2).position(not_later) {
            Some(number) => format!(
                "frame {number} at {} ns, and the next at {} ns",
                found[number].time_ns,
                found[number + 1].time_ns
            ),
            None => {
                let is_missing = |number: usize| match found.get(number) {
                    Some(frame) => frame.time_ns != expected[number].time_ns,
                    None => true,
                };
                let first = (0..expected.len()).find(|number| is_missing(*number));
                format!("their times increase; the first missing frame is {first:?}")
            }
        }
    };
    assert!(
        count.0 == count.1,
        "{route}\n  expected {} frames (spandrel estimate)\n  found    {}; {}",
        count.0,
        count.1,
        back()
    );
    let bits = |frame: &Identified| -> Vec<(u64, u64)> {
        frame
            .mean_and_std
            .iter()
            .map(|(mean, std)| (mean.to_bits(), std.to_bits()))
            .collect()
    };
    let differs =
        |(a, b): &(&Identified, &Identified)| a.time_ns != b.time_ns || bits(a) != bits(b);
    let different = expected.iter().zip(found).filter(differs).count();
    let Some((number, (a, b))) = expected
        .iter()
        .zip(found)
        .enumerate()
        .find(|(_, pair)| differs(pair))
    else {
        return;
    };
    let pairs = a.mean_and_std.iter().zip(&b.mean_and_std);
    let index = pairs
        .into_iter()
        .position(|(a, b)| (a.0.to_bits(), a.1.to_bits()) != (b.0.to_bits(), b.1.to_bits()));
    let of = |frame: &Identified| {
        let time_s = frame.time_ns as f64 * 1e-9;
        match index {
            Some(index) => {
                let (mean, std) = frame.mean_and_std[index];
                format!("{mean:?} ± {std:?} at t = {time_s:.3} s")
            }
            None => format!("frame at t = {time_s:.9} s"),
        }
    };
    let parameter = index.map_or("time", |index| {
        parameters
            .get(index)
            .map_or("a noise level", String::as_str)
    });
    panic!(
        "{route}: first difference in frame {number}, {parameter}\n  expected {} (spandrel \
         estimate)\n  found    {}\n  {different} of {} frames differ",
        of(a),
        of(b),
        expected.len()
    );
}
