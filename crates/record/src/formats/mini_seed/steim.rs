//! Steim compression, levels 1 and 2: frames of 16 words with differences of 4 to 32 bits.
//!
//! Word 0 of a frame has 16 codes of two bits, one for each word. Words 1 and 2 of the first frame
//! are the first and the last sample. In little-endian data, each number is swapped separately.
//! Thus 8-bit differences keep their order, and so do the 16-bit differences of level 1. Words of
//! other codes are swapped as a whole.
//!
//! Source: SEED manual v2.4, appendix B.

use crate::bytes::Bytes;
use crate::fault::Fault;

const FRAME_BYTES: usize = 64;
const WORDS: usize = 16;

/// The level of the compression.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Level {
    One,
    Two,
}

/// Decodes `count` samples, and compares the last one with the last sample stated in the data.
pub(super) fn decode(mut data: Bytes<'_>, count: usize, level: Level) -> Result<Vec<f64>, Fault> {
    let mut samples = Vec::new();
    if count == 0 {
        return Ok(samples);
    }
    let (mut first, mut last, mut sample) = (0_i32, 0_i32, 0_i32);
    while samples.len() < count {
        let start = data.position();
        let is_first_frame = start == 0;
        let mut frame = Bytes::new(data.take(FRAME_BYTES.min(data.left()))?, data.order);
        let codes = frame
            .u32()
            .map_err(|_| too_few(start, samples.len(), count))?;
        for place in 1..WORDS {
            let code = codes >> (2 * (WORDS - 1 - place)) & 3;
            let Ok(word) = word(&mut frame, code, level) else {
                return Err(too_few(start, samples.len(), count));
            };
            match (is_first_frame, place) {
                (true, 1) => first = word as i32,
                (true, 2) => last = word as i32,
                _ => {
                    let (differences, bits) = packed(code, word, level).ok_or_else(|| {
                        let found = format!("{code} with {}", word >> 30);
                        Fault::at_byte(
                            start + 4 * place,
                            "code of a word",
                            found,
                            "one of Steim level 2",
                        )
                    })?;
                    for index in (0..differences).rev() {
                        if samples.len() == count {
                            break;
                        }
                        let difference = signed(word >> (index * bits), bits);
                        // The first difference refers to the previous record, so the stated first
                        // sample replaces it.
                        sample = if samples.is_empty() {
                            first
                        } else {
                            sample.wrapping_add(difference)
                        };
                        samples.push(f64::from(sample));
                    }
                }
            }
        }
    }
    if sample != last {
        return Err(Fault::at_byte(
            8,
            "last sample as decompressed",
            sample,
            format!("{last} as the record states"),
        ));
    }
    Ok(samples)
}

/// Returns the next word, with its differences from the highest bits down.
fn word(frame: &mut Bytes<'_>, code: u32, level: Level) -> Result<u32, Fault> {
    match (code, level) {
        (1, _) => {
            let bytes = [frame.u8()?, frame.u8()?, frame.u8()?, frame.u8()?];
            Ok(u32::from_be_bytes(bytes))
        }
        (2, Level::One) => Ok(u32::from(frame.u16()?) << 16 | u32::from(frame.u16()?)),
        (_, Level::One | Level::Two) => frame.u32(),
    }
}

fn too_few(position: usize, found: usize, count: usize) -> Fault {
    Fault::at_byte(
        position,
        "number of compressed samples",
        found,
        count.to_string(),
    )
}

/// Returns the number of differences in a word and the bits of each, or `None` if the code does not
/// exist.
fn packed(code: u32, word: u32, level: Level) -> Option<(u32, u32)> {
    match (code, level) {
        (0, _) => Some((0, 0)),
        (1, _) => Some((4, 8)),
        (2, Level::One) => Some((2, 16)),
        (3, Level::One) => Some((1, 32)),
        (2, Level::Two) => match word >> 30 {
            1 => Some((1, 30)),
            2 => Some((2, 15)),
            3 => Some((3, 10)),
            _ => None,
        },
        (_, Level::Two) => match word >> 30 {
            0 => Some((5, 6)),
            1 => Some((6, 5)),
            2 => Some((7, 4)),
            _ => None,
        },
        _ => None,
    }
}

/// Returns the lowest `bits` of a word as a signed number.
fn signed(word: u32, bits: u32) -> i32 {
    ((word << (32 - bits)) as i32) >> (32 - bits)
}
