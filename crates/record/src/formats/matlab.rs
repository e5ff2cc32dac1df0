//! MATLAB level 5 MAT-files (versions 5 to 7.2), compressed or not.
//!
//! A file has a header of 128 bytes, and then data elements. Each element has a tag (type and
//! number of bytes) and is padded to eight bytes. Version 7.3 is HDF5, which is another format.
//!
//! No crate is used. The crates that read structures trust the sizes in a file, or panic on unknown
//! content.
//!
//! Source: MathWorks, *MAT-File Format* (2019), chapter 1.

mod array;
mod channels;

use array::Array;

use crate::bytes::{ByteOrder, Bytes};
use crate::fault::Fault;
use crate::recorded::RecordedChannel;
use crate::unpacked::{Refusal, UnpackingBudget};

const HEADER_BYTES: usize = 128;
/// Type of an element compressed by zlib.
const COMPRESSED: u32 = 15;
/// Type of an array element.
const MATRIX: u32 = 14;
/// Version in the header of a level 5 file.
const LEVEL_5: u16 = 0x0100;

/// Returns `true` if a file begins like a level 5 MAT-file, or like HDF5 with such a header.
pub(crate) fn is_matlab(head: &[u8]) -> bool {
    head.starts_with(b"MATLAB ")
        && head
            .get(126..128)
            .is_some_and(|mark| mark == b"IM" || mark == b"MI")
}

/// Reads all series of all variables. Compressed variables count towards the `budget`.
pub(crate) fn read(bytes: &[u8], budget: &UnpackingBudget) -> Result<Vec<RecordedChannel>, Fault> {
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
        let allowed = "level 5 (0100): save it with `-v7`; version 7.3 is HDF5 and is not \
            supported";
        return Err(Fault::at_byte(
            HEADER_BYTES - 4,
            "version of the MAT-file",
            format!("{version:04x}"),
            allowed,
        ));
    }
    file.take(2)?;
    let mut variables = Vec::new();
    while !file.is_at_end() {
        let start = file.position();
        let (kind, data) = tagged(&mut file)?;
        match kind {
            COMPRESSED => {
                let decoder = flate2::read::ZlibDecoder::new(data);
                let element = budget
                    .unpack(decoder)
                    .map_err(|error| Refusal::of(&error, "zlib data").at_byte(start))?;
                let mut element = Bytes::new(&element, file.order);
                let (kind, data) = tagged(&mut element).map_err(|_| {
                    Fault::at_byte(start, "compressed element", "shorter than stated", "whole")
                })?;
                if kind == MATRIX {
                    // Positions in decompressed data are meaningless to the user.
                    let named = Array::read(Bytes::new(data, file.order), 0).map_err(|fault| {
                        Fault::at_byte(
                            start,
                            "compressed variable",
                            format!("invalid ({fault})"),
                            "a MATLAB array",
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

/// Reads the tag and the data of an element, and skips the padding.
fn tagged<'a>(file: &mut Bytes<'a>) -> Result<(u32, &'a [u8]), Fault> {
    let word = file.u32()?;
    // In a small element, the upper half of the first word is the number of bytes, and the second
    // word contains the data.
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
