//! MATLAB level 5 MAT-files (versions 5 to 7.2), compressed or not.
//!
//! Layout: MathWorks, *MAT-File Format* (2019), chapter 1: a header of 128 bytes, then data elements, each with a tag (type and number
//! of bytes) and padded to eight bytes. No crate is used: those that read structures take the sizes in a file at their word, or panic on
//! what they do not know. Version 7.3 is HDF5, another format.

mod array;
mod channels;

use array::Array;

use crate::bytes::{ByteOrder, Bytes};
use crate::fault::Fault;
use crate::recorded::RecordedChannel;
use crate::unpacked::UnpackingBudget;

const HEADER_BYTES: usize = 128;
/// Type of an element that is compressed by zlib.
const COMPRESSED: u32 = 15;
/// Type of an element that is an array.
const MATRIX: u32 = 14;
/// Version that the header of a level 5 file states.
const LEVEL_5: u16 = 0x0100;

/// Whether a file begins as MAT-files of level 5 do, or as HDF5 within the header of one.
pub(crate) fn is_matlab(head: &[u8]) -> bool {
    head.starts_with(b"MATLAB ")
        && head
            .get(126..128)
            .is_some_and(|mark| mark == b"IM" || mark == b"MI")
}

/// Reads all series of all variables.
pub(crate) fn read(bytes: &[u8]) -> Result<Vec<RecordedChannel>, Fault> {
    let mut file = Bytes::new(bytes, ByteOrder::Little);
    file.seek(HEADER_BYTES - 4)?;
    let mark = file.clone().take(4)?;
    file.order = if mark[2..] == *b"IM" {
        ByteOrder::Little
    } else {
        ByteOrder::Big
    };
    let version = file.u16()?;
    if version != LEVEL_5 {
        let allowed = "level 5 (0100): save it with `-v7`; version 7.3 is HDF5 and is not read";
        return Err(Fault::at_byte(
            HEADER_BYTES - 4,
            "version of the MAT-file",
            format!("{version:04x}"),
            allowed,
        ));
    }
    file.take(2)?;
    let mut variables = Vec::new();
    let mut budget = UnpackingBudget::new();
    while !file.is_at_end() {
        let start = file.position();
        let (kind, data) = tagged(&mut file)?;
        match kind {
            COMPRESSED => {
                let decoder = flate2::read::ZlibDecoder::new(data);
                let element = budget.unpack(decoder).map_err(|found| {
                    Fault::at_byte(start, "compressed element", found, "data of zlib")
                })?;
                let mut element = Bytes::new(&element, file.order);
                let (kind, data) = tagged(&mut element).map_err(|_| {
                    Fault::at_byte(
                        start,
                        "compressed element",
                        "shorter than it states",
                        "whole",
                    )
                })?;
                if kind == MATRIX {
                    // places within what was compressed mean nothing to a reader of the file
                    let named = Array::read(Bytes::new(data, file.order), 0).map_err(|fault| {
                        Fault::at_byte(
                            start,
                            "compressed variable",
                            format!("wrong inside ({fault})"),
                            "an array of MATLAB",
                        )
                    })?;
                    variables.extend(named);
                }
            }
            MATRIX => {
                let named = Array::read(Bytes::new(data, file.order), 0)
                    .map_err(|fault| fault.moved_by(start + 8))?;
                variables.extend(named);
            }
            other => {
                return Err(Fault::at_byte(
                    start,
                    "type of an element",
                    other,
                    "14 (array) or 15 (compressed)",
                ));
            }
        }
    }
    channels::of_variables(&variables)
}

/// Reads the tag of an element and its data, and steps over what pads it.
fn tagged<'a>(file: &mut Bytes<'a>) -> Result<(u32, &'a [u8]), Fault> {
    let word = file.u32()?;
    // a small element has its number of bytes in the upper half of the first word, and its data in the second
    if word >> 16 != 0 {
        let (kind, length, start) = (word & 0xffff, (word >> 16) as usize, file.position());
        let data = file.take(4)?;
        let data = data.get(..length).ok_or_else(|| {
            Fault::at_byte(
                start - 4,
                "length of a small element",
                length,
                "at most 4 bytes",
            )
        })?;
        return Ok((kind, data));
    }
    let length = file.u32()? as usize;
    let data = file.take(length)?;
    if word != COMPRESSED {
        let padding = length.next_multiple_of(8) - length;
        file.take(padding.min(file.left()))?;
    }
    Ok((word, data))
}

#[cfg(test)]
mod tests;
