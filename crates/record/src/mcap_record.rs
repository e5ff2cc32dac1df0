//! Parses the records of MCAP files, through the crate `mcap`, without believing what a damaged one says of its texts.

use mcap::records::{Record, op};
use mcap::{McapError, McapResult};

/// Parses a record, whose texts have to lie within it: `mcap` reserves up to 4 GiB for a text on the word of its length alone.
///
/// # Errors
/// It is none.
pub(crate) fn parse_record(opcode: u8, body: &[u8]) -> McapResult<Record<'_>> {
    match texts_fit(opcode, body) {
        Some(()) => mcap::parse_record(opcode, body),
        None => Err(McapError::UnexpectedEof),
    }
}

/// Goes over the texts of a record; `None` if one of them is longer than what is left. Layouts: <https://mcap.dev/spec>, records.
fn texts_fit(opcode: u8, body: &[u8]) -> Option<()> {
    let two = |before: usize| after_text(after_text(body.get(before..)?)?);
    match opcode {
        op::HEADER => two(0).map(drop),
        op::SCHEMA => two(2).map(drop),
        op::CHANNEL => map_fits(two(4)?),
        op::CHUNK => after_text(body.get(28..)?).map(drop),
        op::CHUNK_INDEX => after_text(after_text(body.get(32..)?)?.get(8..)?).map(drop), // its first list is as long as it says, too
        op::ATTACHMENT => two(16).map(drop),
        op::ATTACHMENT_INDEX => two(40).map(drop),
        op::METADATA => map_fits(after_text(body)?),
        op::METADATA_INDEX => after_text(body.get(16..)?).map(drop),
        _ => Some(()),
    }
}

/// What follows a text, or a list, that begins with its length in bytes.
fn after_text(bytes: &[u8]) -> Option<&[u8]> {
    let (length, rest) = bytes.split_first_chunk::<4>()?;
    rest.get(usize::try_from(u32::from_le_bytes(*length)).ok()?..)
}

/// Goes over a list of pairs of texts.
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

    /// Records with texts, as their writers make them.
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

    // Broke: one changed bit in the length of a text had a gigabyte reserved.
    #[test]
    fn a_record_is_read_and_no_changed_bit_has_more_reserved_than_it_has() {
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
