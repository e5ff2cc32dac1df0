//! A record of miniSEED 2: a header of 48 bytes, a chain of blockettes, and samples.

use super::record::{Record, decode};
use crate::bytes::{ByteOrder, Bytes, text};
use crate::fault::Fault;
use crate::record_time::day_of_year_ns;

const HEADER_BYTES: usize = 48;
/// Position of the offset of the first blockette.
const FIRST_BLOCKETTE: usize = 46;
/// Record lengths that the standard permits, as powers of two.
const LENGTHS: std::ops::RangeInclusive<u8> = 7..=20;
/// Plausible years, which determine the byte order of the header. In the wrong byte order, the year
/// is outside this range.
const YEARS: std::ops::RangeInclusive<u16> = 1900..=2100;
/// Bit of the activity flags: the start time already includes the time correction.
const TIME_IS_CORRECTED: u8 = 2;

/// Returns `true` if bytes begin like a record: a sequence number, a quality code and a blank.
pub(super) fn is_record(bytes: &[u8]) -> bool {
    let Some(head) = bytes.get(..8) else {
        return false;
    };
    head[..6]
        .iter()
        .all(|byte| byte.is_ascii_digit() || *byte == b' ' || *byte == 0)
        && matches!(head[6], b'D' | b'R' | b'Q' | b'M')
        && matches!(head[7], b' ' | 0)
}

/// The content of the blockettes.
#[derive(Debug, Clone, Copy, Default)]
struct Blockettes {
    /// Encoding, byte order and exponent of the record length, from blockette 1000.
    data: Option<(u8, u8, u8)>,
    microseconds: i8,
    /// Quality of the time, per cent.
    clock_quality: Option<u8>,
    rate_hz: Option<f32>,
}

/// The header of fixed length.
struct Header {
    /// Network, station, location and channel, joined by dots.
    name: String,
    year: u16,
    day: u16,
    hour: u8,
    minute: u8,
    second: u8,
    /// Fraction of the second, unit 0.1 ms.
    ticks: u16,
    /// Number of samples.
    count: usize,
    rate_factor: i16,
    rate_multiplier: i16,
    activity: u8,
    /// Time correction, unit 0.1 ms.
    correction_ticks: i32,
    data_start: usize,
    first_blockette: usize,
}

impl Header {
    /// Reads the header, and sets the byte order of `bytes` to its own.
    fn read(bytes: &mut Bytes<'_>) -> Result<Self, Fault> {
        bytes.take(8)?;
        let mut code = |length| bytes.take(length).map(text);
        let (station, location, channel, network) = (code(5)?, code(2)?, code(3)?, code(2)?);
        let order = [ByteOrder::Big, ByteOrder::Little]
            .into_iter()
            .find(|order| {
                let mut year = bytes.clone();
                year.order = *order;
                year.u16().is_ok_and(|year| YEARS.contains(&year))
            });
        bytes.order = order.ok_or_else(|| {
            Fault::at_byte(20, "year", "none in either byte order", "1900 to 2100")
        })?;
        let (year, day) = (bytes.u16()?, bytes.u16()?);
        let (hour, minute, second) = (bytes.u8()?, bytes.u8()?, bytes.u8()?);
        bytes.u8()?; // unused
        let ticks = bytes.u16()?;
        let count = usize::from(bytes.u16()?);
        let (rate_factor, rate_multiplier) = (bytes.i16()?, bytes.i16()?);
        let activity = bytes.u8()?;
        bytes.take(3)?; // clock and quality flags, number of blockettes
        Ok(Self {
            name: [network, station, location, channel].join("."),
            year,
            day,
            hour,
            minute,
            second,
            ticks,
            count,
            rate_factor,
            rate_multiplier,
            activity,
            correction_ticks: bytes.i32()?,
            data_start: usize::from(bytes.u16()?),
            first_blockette: usize::from(bytes.u16()?),
        })
    }

    /// Returns the time of the first sample, without the microseconds (ns since the Unix epoch,
    /// UTC).
    fn start_ns(&self) -> Result<i64, Fault> {
        let second = f64::from(self.second) + f64::from(self.ticks) * 1e-4;
        let (year, day, hour, minute) = (
            i64::from(self.year),
            i64::from(self.day),
            i64::from(self.hour),
            i64::from(self.minute),
        );
        let start_ns = day_of_year_ns(year, day, hour, minute, second).ok_or_else(|| {
            let found = format!("year {year}, day {day}, {hour}:{minute}:{second}");
            Fault::at_byte(20, "start time", found, "a date and time of day")
        })?;
        let correction_ns = if self.activity & TIME_IS_CORRECTED == 0 {
            i64::from(self.correction_ticks) * 100_000
        } else {
            0
        };
        Ok(start_ns + correction_ns)
    }
}

/// Reads one record, and returns it with its length. Returns `None` as the record if it contains
/// text or no samples.
pub(super) fn read(bytes: &[u8]) -> Result<(Option<Record>, usize), Fault> {
    if !is_record(bytes) {
        let found = format!("`{}`", text(&bytes[..bytes.len().min(8)]).escape_default());
        return Err(Fault::at_byte(
            0,
            "start of a record",
            found,
            "a sequence number and D, R, Q or M, or MS and 3",
        ));
    }
    let mut unread = Bytes::new(bytes, ByteOrder::Big);
    let header = Header::read(&mut unread)?;
    let blockettes = Blockettes::read(&unread, header.first_blockette)?;
    let Some((encoding, data_order, length)) = blockettes.data else {
        return Err(Fault::at_byte(
            header.first_blockette,
            "blockette 1000",
            "absent",
            "present: it specifies encoding and length",
        ));
    };
    let length = record_length(length, header.first_blockette, bytes.len())?;
    let rate_hz = blockettes.rate_hz.map_or_else(
        || nominal_rate(header.rate_factor, header.rate_multiplier),
        |rate_hz| Some(f64::from(rate_hz)),
    );
    if header.count == 0 || encoding == 0 || rate_hz.is_none() {
        // The record contains only a header, or the text of a log.
        return Ok((None, length));
    }
    let rate_hz = rate_hz
        .filter(|rate_hz| rate_hz.is_finite() && *rate_hz > 0.0)
        .unwrap_or(0.0);
    if rate_hz == 0.0 {
        return Err(Fault::at_byte(
            32,
            "sampling rate",
            format!("{} and {}", header.rate_factor, header.rate_multiplier),
            "a positive number of Hz",
        ));
    }
    let data_start = header.data_start;
    if !(HEADER_BYTES..length).contains(&data_start) {
        let allowed = format!("{HEADER_BYTES} to {}", length - 1);
        return Err(Fault::at_byte(
            44,
            "start of the samples",
            format!("byte {data_start}"),
            allowed,
        ));
    }

    let start_ns = header.start_ns()? + i64::from(blockettes.microseconds) * 1000;
    let data_order = if data_order == 0 {
        ByteOrder::Little
    } else {
        ByteOrder::Big
    };
    let data = Bytes::new(&bytes[data_start..length], data_order);
    let samples =
        decode(data, encoding, header.count).map_err(|fault| fault.moved_by(data_start))?;
    Ok((
        Some(Record {
            name: header.name,
            rate_hz,
            start_ns,
            clock_quality: blockettes.clock_quality,
            samples,
        }),
        length,
    ))
}

/// Returns the length of a record of which `available` bytes follow. `exponent` is its logarithm to
/// base 2.
fn record_length(exponent: u8, first_blockette: usize, available: usize) -> Result<usize, Fault> {
    if !LENGTHS.contains(&exponent) {
        return Err(Fault::at_byte(
            first_blockette,
            "length of the record",
            format!("2^{exponent}"),
            "2^7 to 2^20 bytes",
        ));
    }
    let length = 1_usize << exponent;
    if length > available {
        return Err(Fault::at_byte(
            0,
            "record",
            format!("{available} bytes to the end of the file"),
            length.to_string(),
        ));
    }
    Ok(length)
}

impl Blockettes {
    /// Follows the chain of blockettes. Every link must point forward, so the chain ends.
    fn read(header: &Bytes<'_>, first: usize) -> Result<Self, Fault> {
        let mut found = Self::default();
        let (mut link, mut least, mut next) = (FIRST_BLOCKETTE, HEADER_BYTES, first);
        while next != 0 {
            if next < least {
                let place = format!("byte {next} of the record");
                return Err(Fault::at_byte(
                    link,
                    "next blockette",
                    place,
                    format!("from byte {least} on"),
                ));
            }
            let position = next;
            (link, least) = (position + 2, position + 4);
            let mut blockette = header.clone();
            blockette.seek(position)?;
            let kind = blockette.u16()?;
            next = usize::from(blockette.u16()?);
            match kind {
                1000 => found.data = Some((blockette.u8()?, blockette.u8()?, blockette.u8()?)),
                1001 => {
                    // The manual allows 0 to 100.
                    found.clock_quality = Some(blockette.u8()?).filter(|quality| *quality <= 100);
                    found.microseconds = blockette.u8()? as i8;
                }
                100 => found.rate_hz = Some(blockette.f32()?),
                _ => {}
            }
        }
        Ok(found)
    }
}

/// Returns the sampling rate in Hz from a factor and a multiplier. Negative values are periods and
/// divisors. Returns `None` if the factor is zero.
fn nominal_rate(factor: i16, multiplier: i16) -> Option<f64> {
    let (factor, multiplier) = (f64::from(factor), f64::from(multiplier));
    if factor == 0.0 {
        return None;
    }
    let rate_hz = if factor > 0.0 { factor } else { -1.0 / factor };
    Some(match multiplier {
        0.0 => rate_hz,
        multiplier if multiplier > 0.0 => rate_hz * multiplier,
        multiplier => rate_hz / -multiplier,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn factor_and_multiplier_give_the_rates_in_the_manual() {
        // SEED manual v2.4, page 110: 330 Hz, 330.6 Hz, one sample per minute, 0.1 Hz.
        for (factor, multiplier, expected) in [
            (33, 10, 330.0),
            (3306, -10, 330.6),
            (-60, 1, 1.0 / 60.0),
            (1, -10, 0.1),
        ] {
            let rate_hz = nominal_rate(factor, multiplier).unwrap();
            assert!(
                (rate_hz - expected).abs() < 1e-12,
                "{factor}, {multiplier}: {rate_hz}"
            );
        }
        assert_eq!(nominal_rate(0, 0), None);
    }
}
