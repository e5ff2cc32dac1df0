//! A record of miniSEED 3: a header of 40 bytes, source identifier, extra headers and samples. It
//! is little endian and has a checksum.

use super::record::{Record, decode};
use crate::bytes::{ByteOrder, Bytes, text};
use crate::fault::Fault;
use crate::record_time::day_of_year_ns;

const CHECKSUM: std::ops::Range<usize> = 28..32;

/// Returns `true` if bytes begin like a record.
pub(super) fn is_record(bytes: &[u8]) -> bool {
    bytes.starts_with(b"MS\x03")
}

/// Reads one record, and returns it with its length. Returns `None` as the record if it contains
/// text or no samples.
pub(super) fn read(bytes: &[u8]) -> Result<(Option<Record>, usize), Fault> {
    let mut header = Bytes::new(bytes, ByteOrder::Little);
    header.take(4)?; // MS, version, flags
    let nanoseconds = header.u32()?;
    let (year, day) = (header.u16()?, header.u16()?);
    let (hour, minute, second, encoding) = (header.u8()?, header.u8()?, header.u8()?, header.u8()?);
    let rate = header.f64()?;
    let count = header.u32()? as usize;
    let stated = header.u32()?;
    header.u8()?; // publication version
    let identifier_length = usize::from(header.u8()?);
    let extra_length = usize::from(header.u16()?);
    let data_length = header.u32()? as usize;
    let identifier = text(header.take(identifier_length)?);
    let clock_quality = clock_quality(header.take(extra_length)?);
    let data_start = header.position();
    let data = header.take(data_length)?;
    let length = header.position();

    let found = checksum(&bytes[..length]);
    if found != stated {
        return Err(Fault::at_byte(
            CHECKSUM.start,
            "checksum",
            format!("{stated:08x}"),
            format!("{found:08x} for these bytes"),
        ));
    }
    if count == 0 || encoding == 0 || rate == 0.0 {
        return Ok((None, length));
    }
    // A negative number is a period in seconds.
    let rate_hz = if rate < 0.0 { -1.0 / rate } else { rate };
    if !(rate_hz.is_finite() && rate_hz > 0.0) {
        return Err(Fault::at_byte(
            16,
            "sampling rate",
            rate,
            "a number of Hz, or minus a number of seconds",
        ));
    }
    let (year, day, hour, minute) = (
        i64::from(year),
        i64::from(day),
        i64::from(hour),
        i64::from(minute),
    );
    let start_ns = day_of_year_ns(year, day, hour, minute, f64::from(second))
        .filter(|_| nanoseconds < 1_000_000_000);
    let start_ns = start_ns.ok_or_else(|| {
        let found =
            format!("year {year}, day {day}, {hour}:{minute}:{second} and {nanoseconds} ns");
        Fault::at_byte(4, "start time", found, "a date and time of day")
    })?;
    // Steim frames are big endian in both versions.
    let order = if matches!(encoding, 10 | 11) {
        ByteOrder::Big
    } else {
        ByteOrder::Little
    };
    let samples = decode(Bytes::new(data, order), encoding, count)
        .map_err(|fault| fault.moved_by(data_start))?;
    let start_ns = start_ns + i64::from(nanoseconds);
    Ok((
        Some(Record {
            name: name_of(&identifier),
            rate_hz,
            start_ns,
            clock_quality,
            samples,
        }),
        length,
    ))
}

/// Returns the quality of the time in the extra headers, per cent. `None` if they do not state it.
fn clock_quality(extra_headers: &[u8]) -> Option<u8> {
    let headers: serde_json::Value = serde_json::from_slice(extra_headers).ok()?;
    let quality = headers["FDSN"]["Time"]["Quality"].as_f64()?;
    (0.0..=100.0)
        .contains(&quality)
        .then(|| quality.round() as u8)
}

/// Converts `FDSN:IU_COLA_00_L_H_Z` to `IU.COLA.00.LHZ`, the form of version 2. Other identifiers
/// remain unchanged.
fn name_of(identifier: &str) -> String {
    let Some(codes) = identifier.strip_prefix("FDSN:") else {
        return identifier.to_owned();
    };
    let codes: Vec<&str> = codes.split('_').collect();
    match codes[..] {
        [network, station, location, band, source, position] => {
            format!("{network}.{station}.{location}.{band}{source}{position}")
        }
        _ => identifier.to_owned(),
    }
}

/// Returns the CRC-32C (Castagnoli) of a record, with the four bytes of the checksum itself as
/// zero.
pub(super) fn checksum(record: &[u8]) -> u32 {
    let mut remainder = !0_u32;
    for (place, byte) in record.iter().enumerate() {
        let byte = if CHECKSUM.contains(&place) { 0 } else { *byte };
        remainder = REMAINDERS[usize::from(remainder as u8 ^ byte)] ^ (remainder >> 8);
    }
    !remainder
}

/// Remainders of all bytes for the polynomial 0x1EDC6F41, with reflected bits.
const REMAINDERS: [u32; 256] = {
    let mut remainders = [0; 256];
    let mut byte = 0;
    while byte < 256 {
        let mut remainder = byte as u32;
        let mut bit = 0;
        while bit < 8 {
            remainder = if remainder & 1 == 1 {
                (remainder >> 1) ^ 0x82F6_3B78
            } else {
                remainder >> 1
            };
            bit += 1;
        }
        remainders[byte] = remainder;
        byte += 1;
    }
    remainders
};

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn checksum_equals_the_example_of_the_standard() {
        // RFC 3720, section B.4: 32 bytes of zeros. The other examples do not apply, because the
        // checksum bytes count as zero here.
        assert_eq!(checksum(&[0; 32]), 0x8A91_36AA);
    }

    #[test]
    fn source_identifiers_become_the_codes_of_version_2() {
        assert_eq!(name_of("FDSN:IU_COLA_00_L_H_Z"), "IU.COLA.00.LHZ");
        assert_eq!(name_of("XFDSN:x"), "XFDSN:x");
    }
}
