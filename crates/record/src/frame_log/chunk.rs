//! Chunks of a segment: decoding, validation and positions of frames.

use std::borrow::Borrow;

use mcap::records::{Record, op};

use super::layout::{StatedLayout, TOPIC};
use super::{LoggedFrames, payload};
use crate::mcap_record::parse_record;

/// Size of opcode and length before the body of a record, in bytes.
pub(super) const RECORD_HEAD_BYTES: u64 = 9;
/// Size of the head of an uncompressed chunk, before its records, in bytes.
pub(super) const CHUNK_HEAD_BYTES: usize = 40;

/// The content of a chunk.
#[derive(Debug, Default)]
pub(super) struct ChunkContent {
    pub(super) stated: Option<StatedLayout>,
    /// The encoding of the messages if it belongs to another version.
    pub(super) foreign_encoding: Option<String>,
    pub(super) blocks: Vec<LoggedFrames>,
}

/// Maximum size of chunks that share an index entry, in bytes. Live chunks have about 500 bytes.
const SHARED_BYTES: u64 = 8 << 10;

/// An index entry: frames of one epoch in one chunk, or in several consecutive chunks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Entry {
    pub(super) epoch: u64,
    /// Sequence number of the first frame.
    pub(super) first: u64,
    /// Sequence number after the last frame.
    pub(super) end: u64,
    /// Number of frames, which is less than `end - first` after a gap.
    pub(super) frames: u64,
    /// Whether the epoch ends here.
    pub(super) ended: bool,
    /// Offset of the record of the first chunk, in bytes.
    pub(super) offset: u64,
    /// Length from there to the end of the record of the last chunk, in bytes.
    pub(super) length: u64,
}

/// Returns opcode and length of the record at the start of `bytes`.
pub(super) fn record_head(bytes: &[u8]) -> Option<(u8, u64)> {
    let (opcode, rest) = bytes.split_first()?;
    let length = rest.first_chunk::<8>()?;
    Some((*opcode, u64::from_le_bytes(*length)))
}

/// Decodes a chunk from the body of its record. Returns `None` if it is damaged.
pub(super) fn chunk_content(body: &[u8]) -> Option<ChunkContent> {
    let Ok(Record::Chunk { header, data }) = parse_record(op::CHUNK, body) else {
        return None;
    };
    let is_whole = header.compression.is_empty()
        && body.len() == CHUNK_HEAD_BYTES + data.len()
        && header.uncompressed_size == data.len() as u64
        && crc32fast::hash(&data) == header.uncompressed_crc;
    if !is_whole {
        return None;
    }
    let mut content = ChunkContent::default();
    let mut rest: &[u8] = &data;
    while !rest.is_empty() {
        let (opcode, length) = record_head(rest)?;
        let (_, after) = rest.split_at_checked(RECORD_HEAD_BYTES as usize)?;
        let (body, after) = after.split_at_checked(usize::try_from(length).ok()?)?;
        rest = after;
        match parse_record(opcode, body).ok()? {
            Record::Channel(channel) if channel.topic == TOPIC => {
                if channel.message_encoding != payload::MESSAGE_ENCODING {
                    return Some(ChunkContent {
                        foreign_encoding: Some(channel.message_encoding),
                        ..ChunkContent::default()
                    });
                }
                content.stated = StatedLayout::from_metadata(&channel.metadata);
            }
            Record::Message { data, .. } => content.blocks.push(payload::decode(&data)?),
            _ => {}
        }
    }
    Some(content)
}

/// Returns the intact chunks in `bytes`: start and end of the record of each, and its content.
///
/// The search proceeds byte by byte, because a damaged length must not hide the chunks after it.
pub(super) fn whole_chunks(bytes: &[u8]) -> impl Iterator<Item = (usize, usize, ChunkContent)> {
    let mut from = 0;
    std::iter::from_fn(move || {
        loop {
            let start = from
                + bytes
                    .get(from..)?
                    .iter()
                    .position(|byte| *byte == op::CHUNK)?;
            from = start + 1;
            let (_, length) = record_head(&bytes[start..])?;
            let body = start + RECORD_HEAD_BYTES as usize;
            let Some(end) = usize::try_from(length)
                .ok()
                .and_then(|length| body.checked_add(length))
            else {
                continue;
            };
            if let Some(content) = bytes.get(body..end).and_then(chunk_content) {
                from = end;
                return Some((start, end, content));
            }
        }
    })
}

/// Appends index entries for the frames of a chunk. Skips frames that earlier entries already
/// contain.
pub(super) fn append_entries<B: Borrow<LoggedFrames>>(
    entries: &mut Vec<Entry>,
    blocks: &[B],
    offset: u64,
    length: u64,
) {
    for block in blocks {
        let block = block.borrow();
        let (epoch, end, ended) = (block.epoch, block.end(), block.ended);
        let mut first = block.sequence;
        if let Some(last) = entries.last_mut() {
            let is_old = epoch < last.epoch
                || (epoch == last.epoch && (end, ended) <= (last.end, last.ended));
            if is_old {
                continue;
            }
            if epoch == last.epoch {
                first = first.max(last.end).min(end);
                let shared = offset + length - last.offset;
                if last.offset == offset || (!last.ended && shared <= SHARED_BYTES) {
                    last.frames += end - first;
                    last.end = end;
                    last.ended = ended;
                    last.length = shared;
                    continue;
                }
            }
        }
        entries.push(Entry {
            epoch,
            first,
            end,
            frames: end - first,
            ended,
            offset,
            length,
        });
    }
}
