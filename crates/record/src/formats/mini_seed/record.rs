//! A record: the name of its series, its start time and its samples.

use super::{plain_values, steim};
use crate::bytes::Bytes;
use crate::fault::Fault;

/// The samples of one record.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Record {
    /// Network, station, location and channel, separated by dots.
    pub(super) name: String,
    pub(super) rate_hz: f64,
    pub(super) start_ns: i64,
    /// Quality of the time as the recorder states it, per cent.
    pub(super) clock_quality: Option<u8>,
    pub(super) samples: Vec<f64>,
}

/// Description of the supported encodings.
const ENCODINGS: &str = "1, 2, 3 (integers), 4, 5 (floating point), 10 (Steim 1) or 11 (Steim 2)";

/// Decodes `count` samples.
pub(super) fn decode(mut data: Bytes<'_>, encoding: u8, count: usize) -> Result<Vec<f64>, Fault> {
    match encoding {
        1 => plain_values(&mut data, count, |data| data.i16().map(f64::from)),
        2 => plain_values(&mut data, count, |data| {
            // Shift the three bytes up for the sign, and down again.
            let bytes = data.take(3)?;
            let word = match data.order {
                crate::bytes::ByteOrder::Little => {
                    i32::from_le_bytes([0, bytes[0], bytes[1], bytes[2]])
                }
                crate::bytes::ByteOrder::Big => {
                    i32::from_be_bytes([bytes[0], bytes[1], bytes[2], 0])
                }
            };
            Ok(f64::from(word >> 8))
        }),
        3 => plain_values(&mut data, count, |data| data.i32().map(f64::from)),
        4 => plain_values(&mut data, count, |data| data.f32().map(f64::from)),
        5 => plain_values(&mut data, count, Bytes::f64),
        10 => steim::decode(data, count, steim::Level::One),
        11 => steim::decode(data, count, steim::Level::Two),
        other => Err(Fault::at_byte(
            0,
            "encoding of the samples",
            other,
            ENCODINGS,
        )),
    }
}
