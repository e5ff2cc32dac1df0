//! Unpacks compressed data with an upper bound: a small file may claim to be a large one.

use std::io::Read;

/// Bytes that compressed data may have when unpacked: more than a day of 20 channels at 200 Hz as text.
const MOST_BYTES: u64 = 4 << 30;

/// Reads all that a decoder gives; the memory grows with it, not with what a header states. The error is what was found.
pub(crate) fn unpacked(decoder: impl Read) -> Result<Vec<u8>, String> {
    let mut bytes = Vec::new();
    decoder.take(MOST_BYTES + 1).read_to_end(&mut bytes).map_err(|error| format!("damaged ({error})"))?;
    match bytes.len() as u64 > MOST_BYTES {
        true => Err(format!("more than {} GiB", MOST_BYTES >> 30)),
        false => Ok(bytes),
    }
}
