//! Metadata of a segment: properties of its objects, and the layout of their raw data.

use std::collections::BTreeMap;

use super::{Object, Property, SECONDS_1904_TO_1970};
use crate::bytes::{Bytes, text};
use crate::fault::Fault;

/// Codes that replace the length of an index.
const NO_RAW_DATA: u32 = u32::MAX;
const AS_BEFORE: u32 = 0;
const DAQMX_FORMAT_CHANGING: u32 = 0x1269;
const DAQMX_DIGITAL_LINE: u32 = 0x126A;

/// The layout of the raw data of a channel in a segment.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Index {
    /// Values one after the other.
    Values { kind: u32, bytes: u64 },
    /// Values within strides shared by the channels of a device.
    Daqmx {
        count: u64,
        scalers: Vec<Scaler>,
        widths: Vec<u32>,
    },
}

/// The position of the values of a DAQmx channel in a stride.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Scaler {
    pub(super) id: u32,
    pub(super) kind: u32,
    pub(super) buffer: u32,
    pub(super) place: StridePosition,
}

/// A position in a stride: a byte, or the bit of a digital line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum StridePosition {
    Byte(u32),
    Bit(u32),
}

/// The metadata of an object in a segment.
struct Said {
    path: String,
    index: Option<Index>,
    properties: Vec<(String, Property)>,
}

/// The metadata of all objects in a segment.
pub(super) struct Metadata(Vec<Said>);

impl Metadata {
    /// Reads the metadata. `objects` are the objects of earlier segments.
    pub(super) fn read(
        mut data: Bytes<'_>,
        objects: &BTreeMap<String, Object>,
    ) -> Result<Self, Fault> {
        let count = data.u32()?;
        let mut said: Vec<Said> = Vec::new();
        for _ in 0..count {
            let start = data.position();
            let path = string(&mut data)?;
            let before = || objects.get(&path).and_then(|object| object.index.clone());
            let index = match data.u32()? {
                NO_RAW_DATA => None,
                AS_BEFORE => Some(before().ok_or_else(|| {
                    Fault::at_byte(
                        start,
                        format!("index of {path}"),
                        "as before",
                        "stated, because no index precedes it",
                    )
                })?),
                code @ (DAQMX_FORMAT_CHANGING | DAQMX_DIGITAL_LINE) => {
                    Some(daqmx(&mut data, code)?)
                }
                _ => Some(values(&mut data)?),
            };
            let mut properties = Vec::new();
            for _ in 0..data.u32()? {
                let key = string(&mut data)?;
                properties.push((key, property(&mut data)?));
            }
            said.push(Said {
                path,
                index,
                properties,
            });
        }
        Ok(Self(said))
    }

    /// Applies the metadata to the objects and to the order of the raw data.
    pub(super) fn apply(self, objects: &mut BTreeMap<String, Object>, order: &mut Vec<String>) {
        for Said {
            path,
            index,
            properties,
        } in self.0
        {
            let place = objects.len();
            let object = objects.entry(path.clone()).or_insert_with(|| Object {
                place,
                ..Object::default()
            });
            object.properties.extend(properties);
            let in_order = order.contains(&path);
            match index {
                Some(index) => {
                    object.index = Some(index);
                    if !in_order {
                        order.push(path);
                    }
                }
                None => order.retain(|other| *other != path),
            }
        }
    }
}

/// Reads a text preceded by its length.
fn string(data: &mut Bytes<'_>) -> Result<String, Fault> {
    let length = data.u32()? as usize;
    data.take(length).map(text)
}

fn one_dimension(data: &mut Bytes<'_>) -> Result<(), Fault> {
    let start = data.position();
    match data.u32()? {
        1 => Ok(()),
        other => Err(Fault::at_byte(start, "number of dimensions", other, "1")),
    }
}

fn values(data: &mut Bytes<'_>) -> Result<Index, Fault> {
    let start = data.position();
    let kind = data.u32()?;
    one_dimension(data)?;
    let count = data.u64()?;
    let bytes = match (kind, size(kind)) {
        (TEXT, _) => data.u64()?,
        (_, Some(size)) => count.checked_mul(size).ok_or_else(|| {
            Fault::at_byte(
                start,
                "number of values",
                count,
                "small enough that its size in bytes fits 64 bits",
            )
        })?,
        (other, None) => {
            return Err(Fault::at_byte(
                start,
                "type of values",
                format!("{other:#x}"),
                KINDS,
            ));
        }
    };
    Ok(Index::Values { kind, bytes })
}

fn daqmx(data: &mut Bytes<'_>, code: u32) -> Result<Index, Fault> {
    // The type of values is redundant, because the scalers state their own.
    data.u32()?;
    one_dimension(data)?;
    let count = data.u64()?;
    let mut scalers = Vec::new();
    for _ in 0..data.u32()? {
        let start = data.position();
        let (kind, buffer, place) = (data.u32()?, data.u32()?, data.u32()?);
        let place = match code {
            DAQMX_DIGITAL_LINE => {
                data.u8()?; // format of samples
                StridePosition::Bit(place)
            }
            _ => {
                data.u32()?; // format of samples
                StridePosition::Byte(place)
            }
        };
        if daqmx_size(kind).is_none() {
            return Err(Fault::at_byte(
                start,
                "type of a DAQmx scaler",
                kind,
                "0 to 5 (integers of 8, 16 or 32 bits)",
            ));
        }
        scalers.push(Scaler {
            id: data.u32()?,
            kind,
            buffer,
            place,
        });
    }
    let mut widths = Vec::new();
    for _ in 0..data.u32()? {
        widths.push(data.u32()?);
    }
    Ok(Index::Daqmx {
        count,
        scalers,
        widths,
    })
}

/// Returns the number of bytes per value of a DAQmx scaler. Types alternate between unsigned and
/// signed, with 8, 16 and 32 bits.
pub(super) fn daqmx_size(kind: u32) -> Option<usize> {
    (kind <= 5).then(|| 1 << (kind / 2))
}

const BOOLEAN: u32 = 0x21;
/// Type of text.
pub(super) const TEXT: u32 = 0x20;
const TIME: u32 = 0x44;
const KINDS: &str = "1 to 8 (integers), 9, 10, 19, 1a (floating point), 20 (text), 21 (boolean), \
                     44 (time) or 8000c, 10000d (complex)";

/// Returns the number of bytes per value of a type, or `None` if it is variable or unknown.
pub(super) fn size(kind: u32) -> Option<u64> {
    match kind {
        0 | 1 | 5 | BOOLEAN => Some(1),
        2 | 6 => Some(2),
        3 | 7 | 9 | 0x19 => Some(4),
        4 | 8 | 10 | 0x1A | 0x0008_000C => Some(8),
        TIME | 0x0010_000D => Some(16),
        _ => None,
    }
}

/// Reads a number of a type. Returns `None` if the type is not numeric.
pub(super) fn number(data: &mut Bytes<'_>, kind: u32) -> Result<Option<f64>, Fault> {
    Ok(Some(match kind {
        1 => f64::from(data.u8()? as i8),
        2 => f64::from(data.i16()?),
        3 => f64::from(data.i32()?),
        4 => data.i64()? as f64,
        5 | BOOLEAN => f64::from(data.u8()?),
        6 => f64::from(data.u16()?),
        7 => f64::from(data.u32()?),
        8 => data.u64()? as f64,
        9 | 0x19 => f64::from(data.f32()?),
        10 | 0x1A => data.f64()?,
        _ => return Ok(None),
    }))
}

fn property(data: &mut Bytes<'_>) -> Result<Property, Fault> {
    let start = data.position();
    match data.u32()? {
        TEXT => string(data).map(Property::Text),
        TIME => {
            // Fractions of 2⁻⁶⁴ s and whole seconds. In little-endian files, the lower half comes
            // first.
            let (fraction, seconds) = match data.order {
                crate::bytes::ByteOrder::Little => (data.u64()?, data.i64()?),
                crate::bytes::ByteOrder::Big => {
                    let seconds = data.i64()?;
                    (data.u64()?, seconds)
                }
            };
            let fraction_ns = ((u128::from(fraction) * 1_000_000_000) >> 64) as i64;
            let since_1970 = seconds.saturating_sub(SECONDS_1904_TO_1970);
            Ok(Property::Time(
                since_1970
                    .saturating_mul(1_000_000_000)
                    .saturating_add(fraction_ns),
            ))
        }
        kind => match (number(data, kind)?, size(kind)) {
            (Some(number), _) => Ok(Property::Number(number)),
            (None, Some(size)) => data.take(size as usize).map(|_| Property::Other),
            (None, None) => Err(Fault::at_byte(
                start,
                "type of a property",
                format!("{kind:#x}"),
                KINDS,
            )),
        },
    }
}
