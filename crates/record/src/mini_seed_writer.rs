//! Writes miniSEED 2: records of one channel each, with uncompressed values of 64 bits.
//!
//! Version 2 and not 3, because most seismological programs read only version 2.
//!
//! Source: FDSN, *SEED reference manual* v2.4 (2012), chapter 8 and appendix A (channel names).

use std::io::{self, Write};

use jiff::{Timestamp, tz::TimeZone};

use crate::RecordedChannel;

/// Length of a record as a power of two: 4096 bytes, which every reader accepts.
const LENGTH_EXPONENT: u8 = 12;
const RECORD_BYTES: usize = 1 << LENGTH_EXPONENT;
/// Start of the samples, a multiple of 64 bytes behind the header and all blockettes.
const DATA_START: usize = 128;
/// Maximum number of samples of a record.
const MOST_SAMPLES: usize = (RECORD_BYTES - DATA_START) / 8;
/// Encoding of the samples: 64-bit floating point.
const DOUBLES: u8 = 5;
const BIG_ENDIAN: u8 = 1;
/// Sequence numbers have six digits and start again.
const SEQUENCE_NUMBERS: u32 = 1_000_000;
/// Multipliers of the rate factor: negative ones divide.
const MULTIPLIERS: [i16; 8] = [1, -10, -100, -1000, -10_000, 10, 100, 1000];

/// Codes of a channel: network, station, location and channel, each padded with blanks.
type Codes = [String; 4];

/// A writer of the records of a file.
pub(crate) struct MiniSeedWriter<W: Write> {
    output: W,
    sequence: u32,
}

impl<W: Write> MiniSeedWriter<W> {
    pub(crate) fn new(output: W) -> Self {
        Self {
            output,
            sequence: 0,
        }
    }

    /// Writes all samples of channel `number` (from 1), times `factor`. A missing sample ends a
    /// record. A channel without a rate has no times, so the caller must reject it.
    ///
    /// # Errors
    /// Returns an error if the output cannot be written, or if a time is outside the years 1 to
    /// 9999.
    pub(crate) fn write(
        &mut self,
        number: usize,
        channel: &RecordedChannel,
        factor: f64,
    ) -> io::Result<()> {
        let rate_hz = channel.sampling_rate_hz().unwrap_or(1.0);
        let codes = codes(channel, number, rate_hz);
        let (mut start_ns, mut samples) = (0, Vec::with_capacity(MOST_SAMPLES));
        let mut next_ns = i64::MIN;
        for (time_ns, sample) in channel.timed_samples() {
            let is_apart = (time_ns.saturating_sub(next_ns)) as f64 * rate_hz > 0.5e9;
            if sample.is_nan() || is_apart || samples.len() == MOST_SAMPLES {
                self.record(&codes, rate_hz, start_ns, &samples)?;
                samples.clear();
            }
            if sample.is_nan() {
                continue;
            }
            if samples.is_empty() {
                start_ns = time_ns;
            }
            samples.push(sample * factor);
            next_ns = time_ns.saturating_add((1e9 / rate_hz) as i64);
        }
        self.record(&codes, rate_hz, start_ns, &samples)
    }

    /// Writes one record, or nothing without samples.
    fn record(
        &mut self,
        [network, station, location, channel]: &Codes,
        rate_hz: f64,
        start_ns: i64,
        samples: &[f64],
    ) -> io::Result<()> {
        if samples.is_empty() {
            return Ok(());
        }
        self.sequence = self.sequence % (SEQUENCE_NUMBERS - 1) + 1;
        let (factor, multiplier, is_exact) = rate_factors(rate_hz);
        let (start, microseconds) = start_time(start_ns)?;
        let mut record = Vec::with_capacity(RECORD_BYTES);
        record.extend(format!("{:06}D ", self.sequence).as_bytes());
        record.extend(format!("{station}{location}{channel}{network}").as_bytes());
        record.extend(start);
        record.extend((samples.len() as u16).to_be_bytes());
        record.extend(factor.to_be_bytes());
        record.extend(multiplier.to_be_bytes());
        record.extend([0, 0, 0, if is_exact { 2 } else { 3 }]); // flags, number of blockettes
        record.extend(0_i32.to_be_bytes()); // time correction
        record.extend((DATA_START as u16).to_be_bytes());
        record.extend(48_u16.to_be_bytes()); // first blockette
        record.extend([1000_u16.to_be_bytes(), 56_u16.to_be_bytes()].concat());
        record.extend([DOUBLES, BIG_ENDIAN, LENGTH_EXPONENT, 0]);
        let next = if is_exact { 0_u16 } else { 64 };
        record.extend([1001_u16.to_be_bytes(), next.to_be_bytes()].concat());
        record.extend([0, microseconds, 0, 0]);
        if !is_exact {
            record.extend([100_u16.to_be_bytes(), 0_u16.to_be_bytes()].concat());
            record.extend((rate_hz as f32).to_be_bytes());
        }
        record.resize(DATA_START, 0);
        samples
            .iter()
            .for_each(|sample| record.extend(sample.to_be_bytes()));
        record.resize(RECORD_BYTES, 0);
        self.output.write_all(&record)
    }

    /// Flushes the output.
    pub(crate) fn finish(mut self) -> io::Result<()> {
        self.output.flush()
    }
}

/// Returns the codes of a channel. A name like those of miniSEED keeps its codes. Any other channel
/// has network `XX`, its number as the station, and a channel code for its rate and quantity.
fn codes(channel: &RecordedChannel, number: usize, rate_hz: f64) -> Codes {
    let stated: Vec<&str> = channel.name().split('.').collect();
    if let [network, station, location, code] = stated[..] {
        let fits = |text: &str, longest: usize| {
            text.len() <= longest && text.bytes().all(|byte| byte.is_ascii_alphanumeric())
        };
        if fits(network, 2) && fits(station, 5) && fits(location, 2) && fits(code, 3) {
            return [
                format!("{network:2}"),
                format!("{station:5}"),
                format!("{location:2}"),
                format!("{code:3}"),
            ];
        }
    }
    let band = match rate_hz {
        1000.0.. => 'F',
        250.0.. => 'C',
        80.0.. => 'H',
        10.0.. => 'B',
        1.5.. => 'M',
        0.5.. => 'L',
        _ => 'V',
    };
    let is_acceleration = channel
        .quantity()
        .is_some_and(|(quantity, _)| quantity == crate::Quantity::Acceleration);
    let instrument = if is_acceleration { 'N' } else { 'Y' };
    [
        "XX".to_owned(),
        format!("{number:05}"),
        "  ".to_owned(),
        format!("{band}{instrument}1"),
    ]
}

/// Returns factor and multiplier of a rate, and whether they give exactly this rate.
fn rate_factors(rate_hz: f64) -> (i16, i16, bool) {
    let scaled = |multiplier: i16| match multiplier {
        1.. => rate_hz / f64::from(multiplier),
        _ => rate_hz * f64::from(-multiplier),
    };
    let fits = |factor: f64| (1.0..=f64::from(i16::MAX)).contains(&factor);
    let exact = MULTIPLIERS.into_iter().find(|multiplier| {
        let factor = scaled(*multiplier);
        fits(factor) && (factor - factor.round()).abs() < 1e-9 * factor
    });
    let multiplier = exact
        .or_else(|| MULTIPLIERS.into_iter().find(|one| fits(scaled(*one))))
        .unwrap_or(1);
    let factor = scaled(multiplier).round().clamp(1.0, f64::from(i16::MAX));
    (factor as i16, multiplier, exact.is_some())
}

/// Returns the start time of a record in units of 0.1 ms, and the remaining microseconds.
fn start_time(start_ns: i64) -> io::Result<([u8; 10], u8)> {
    let micros = (i128::from(start_ns) + 500).div_euclid(1000);
    let time = Timestamp::from_nanosecond(micros * 1000)
        .map_err(io::Error::other)?
        .to_zoned(TimeZone::UTC);
    let in_second = time.subsec_nanosecond().unsigned_abs() / 1000;
    let year = u16::try_from(time.year()).map_err(io::Error::other)?;
    let mut start = [0; 10];
    start[..2].copy_from_slice(&year.to_be_bytes());
    start[2..4].copy_from_slice(&(time.day_of_year() as u16).to_be_bytes());
    start[4] = time.hour() as u8;
    start[5] = time.minute() as u8;
    start[6] = time.second() as u8;
    let ticks = (in_second / 100) as u16; // at most 9999
    start[8..].copy_from_slice(&ticks.to_be_bytes());
    Ok((start, (in_second % 100) as u8))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Segment, TimeOrigin, read_mini_seed};

    const START_NS: i64 = 1_709_208_000_123_457_000;

    fn channel(name: &str, rate_hz: f64, segments: Vec<Segment>) -> RecordedChannel {
        RecordedChannel::new(name, Some(rate_hz), segments)
            .with_unit("m/s2")
            .with_origin(TimeOrigin::Epoch)
    }

    fn written(channels: &[RecordedChannel]) -> Vec<u8> {
        let mut bytes = Vec::new();
        let mut writer = MiniSeedWriter::new(&mut bytes);
        for (index, channel) in channels.iter().enumerate() {
            writer.write(index + 1, channel, 1.0).unwrap();
        }
        writer.finish().unwrap();
        bytes
    }

    #[test]
    fn samples_of_many_records_and_their_gaps_read_back_bit_for_bit() {
        let samples: Vec<f64> = (0..1500)
            .map(|step| (f64::from(step) * 0.1).sin())
            .collect();
        let mut with_missing = samples.clone();
        with_missing[700] = f64::NAN;
        let later = Segment::new(START_NS + 20_000_000_000, vec![1e-17, -3.5]);
        let roof = channel("roof", 200.0, vec![Segment::new(START_NS, samples), later]);
        let base = channel("base", 200.0, vec![Segment::new(START_NS, with_missing)]);
        let read = read_mini_seed(&written(&[roof.clone(), base.clone()])).unwrap();
        let present = |channel: &RecordedChannel| -> Vec<(i64, u64)> {
            let timed = channel.timed_samples().filter(|(_, value)| !value.is_nan());
            timed.map(|(time, value)| (time, value.to_bits())).collect()
        };
        assert_eq!(read.len(), 2);
        for (read, written) in read.iter().zip([&roof, &base]) {
            assert_eq!(read.sampling_rate_hz(), Some(200.0));
            assert_eq!(present(read), present(written));
            assert_eq!(read.gaps(), written.gaps());
        }
    }

    #[test]
    fn names_are_numbers_of_channels_unless_they_are_codes_already() {
        let names = ["acceleration-1", "IU.COLA.00.LHZ", "acceleration-3"];
        let channels = names.map(|name| channel(name, 100.0, vec![Segment::new(0, vec![1.0])]));
        let read = read_mini_seed(&written(&channels)).unwrap();
        let read: Vec<&str> = read.iter().map(RecordedChannel::name).collect();
        assert_eq!(read, ["XX.00001..HN1", "IU.COLA.00.LHZ", "XX.00003..HN1"]);
    }

    #[test]
    fn rates_are_exact_where_the_header_can_state_them() {
        for rate_hz in [200.0, 119.88, 0.02, 40_000.0, 1000.0 / 7.0] {
            let one = channel("a", rate_hz, vec![Segment::new(START_NS, vec![1.0, 2.0])]);
            let read = read_mini_seed(&written(&[one])).unwrap();
            let found = read[0].sampling_rate_hz().unwrap();
            // The blockette of other rates is a number of 32 bits.
            assert!((found / rate_hz - 1.0).abs() < 6e-8, "{rate_hz}: {found}");
        }
    }
}
