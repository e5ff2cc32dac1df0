//! Parses MCAP records with the crate `mcap`, but checks the lengths of strings first, because a
//! damaged file may state any length.

use mcap::records::{Record, op};
use mcap::{McapError, McapResult};

/// Parses a record after checking that its strings lie within it.
///
/// The crate `mcap` allocates up to 4 GiB for a string, based on its stated length alone.
///
/// # Errors
/// Returns an error if the record is not valid.
pub(crate) fn parse_record(opcode: u8, body: &[u8]) -> McapResult<Record<'_>> {
    match texts_fit(opcode, body) {
        Some(()) => mcap::parse_record(opcode, body),
        None => Err(McapError::UnexpectedEof),
    }
}

/// Checks the strings of a record, and returns `None` if one of them exceeds the record.
///
/// Source: <https://mcap.dev/spec>, section "Records".
fn texts_fit(opcode: u8, body: &[u8]) -> Option<()> {
    let two = |before: usize| after_text(after_text(body.get(before..)?)?);
    match opcode {
        op::HEADER => two(0).map(drop),
        op::SCHEMA => two(2).map(drop),
        op::CHANNEL => map_fits(two(4)?),
        op::CHUNK => after_text(body.get(28..)?).map(drop),
        // The first list of a chunk index starts with its length in bytes, too.
        op::CHUNK_INDEX => after_text(after_text(body.get(32..)?)?.get(8..)?).map(drop),
        op::ATTACHMENT => two(16).map(drop),
        op::ATTACHMENT_INDEX => two(40).map(drop),
        op::METADATA => map_fits(after_text(body)?),
        op::METADATA_INDEX => after_text(body.get(16..)?).map(drop),
        _ => Some(()),
    }
}

/// Returns the bytes after a string or list, which starts with its length in bytes.
fn after_text(bytes: &[u8]) -> Option<&[u8]> {
    let (length, rest) = bytes.split_first_chunk::<4>()?;
    rest.get(usize::try_from(u32::from_le_bytes(*length)).ok()?..)
}

/// Checks the strings of a list of pairs.
fn map_fits(bytes: &[u8]) -> Option<()> {
    let behind = after_text(bytes)?;
    let mut pairs = bytes.get(4..bytes.len() - behind.len())?;
    while !pairs.is_empty() {
        pairs = after_text(after_text(pairs)?)?;
    }
    Some(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(text: &str) -> Vec<u8> {
        [&(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat()
    }

    /// Returns records with strings in the encoding of MCAP writers.
    fn records() -> Vec<(u8, Vec<u8>)> {
        let pairs = [text("unit"), text("m/s2")].concat();
        let map = [&(pairs.len() as u32).to_le_bytes()[..], &pairs].concat();
        let index = [&10_u32.to_le_bytes()[..], &[1; 10]].concat();
        vec![
            (op::HEADER, [text("spandrel"), text("0.1.0")].concat()),
            (
                op::SCHEMA,
                [vec![1, 0], text("frames"), text(""), text("data")].concat(),
            ),
            (
                op::CHANNEL,
                [vec![1, 0, 1, 0], text("frames"), text("json"), map.clone()].concat(),
            ),
            (op::CHUNK, [vec![0; 28], text(""), vec![0; 8]].concat()),
            (
                op::CHUNK_INDEX,
                [vec![0; 32], index, vec![0; 8], text("zstd"), vec![0; 16]].concat(),
            ),
            (op::METADATA, [text("name"), map].concat()),
            (op::METADATA_INDEX, [vec![0; 16], text("name")].concat()),
            (
                op::ATTACHMENT_INDEX,
                [vec![0; 40], text("name"), text("text/plain")].concat(),
            ),
        ]
    }

    // A changed bit in the length of a string must not cause an allocation of a gigabyte.
    #[test]
    fn changed_bits_of_a_record_do_not_increase_its_allocation() {
        for (opcode, body) in records() {
            assert!(parse_record(opcode, &body).is_ok(), "record {opcode}");
            for bit in 0..8 * body.len() {
                let mut changed = body.clone();
                changed[bit / 8] ^= 1 << (bit % 8);
                let taken = allocation_counter::measure(|| drop(parse_record(opcode, &changed)));
                assert!(
                    taken.bytes_max < 4096,
                    "record {opcode}, bit {bit}: {} bytes",
                    taken.bytes_max
                );
            }
        }
    }
}
