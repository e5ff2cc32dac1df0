//! Determines the content of a segment on disk in one pass.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use mcap::records::{Record, op};

use super::LoggedFrames;
use super::chunk::{
    ChunkContent, Entry, RECORD_HEAD_BYTES, append_entries, chunk_content, record_head,
    whole_chunks,
};
use super::layout::StatedLayout;
use crate::RecordError;
use crate::mcap_record::parse_record;

/// Size of the records after the data, in bytes: opcode, length and body of each.
const DATA_END_BYTES: u64 = RECORD_HEAD_BYTES + 4;
const FOOTER_BYTES: u64 = RECORD_HEAD_BYTES + 20;
const MAGIC_BYTES: u64 = mcap::MAGIC.len() as u64;
/// Number of bytes read at once.
const BUFFER_BYTES: usize = 1 << 20;

/// The end of a segment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum SegmentEnd {
    /// An end with index and footer: the segment was closed.
    InOrder,
    /// An end with a footer but no index: the segment was repaired or cut back.
    Mended,
    /// No end: the writer terminated abnormally.
    Torn,
}

/// The content of a segment.
#[derive(Debug)]
pub(super) struct Scan {
    /// Size of the file, in bytes.
    pub(super) bytes: u64,
    pub(super) stated: Option<StatedLayout>,
    /// The encoding of the messages if it belongs to another version.
    pub(super) foreign_encoding: Option<String>,
    pub(super) entries: Vec<Entry>,
    /// The last intact block.
    pub(super) last: Option<LoggedFrames>,
    /// Offset of the end of the last intact chunk, including its message index.
    pub(super) whole: u64,
    pub(super) end: SegmentEnd,
}

/// Reads a segment from its beginning. Skips damaged chunks and finds the intact ones after them.
pub(super) fn scan(path: &Path) -> Result<Scan, RecordError> {
    let file = File::open(path).map_err(|source| RecordError::Open {
        path: path.to_owned(),
        source,
    })?;
    let read = || -> std::io::Result<Scan> {
        let bytes = file.metadata()?.len();
        let mut pass = Pass {
            reader: BufReader::with_capacity(BUFFER_BYTES, &file),
            bytes,
            body: Vec::new(),
        };
        let end = pass.end()?;
        let found = Scan {
            bytes,
            stated: None,
            foreign_encoding: None,
            entries: Vec::new(),
            last: None,
            whole: 0,
            end,
        };
        pass.chunks(found)
    };
    read().map_err(|source| RecordError::ReadFile {
        path: path.to_owned(),
        source,
    })
}

/// Returns the time of the first frame of a segment, in ns. Returns `None` if its first chunk is
/// damaged.
pub(super) fn start_of(path: &Path) -> std::io::Result<Option<i64>> {
    let file = File::open(path)?;
    let bytes = file.metadata()?.len();
    let mut pass = Pass {
        reader: BufReader::new(&file),
        bytes,
        body: Vec::new(),
    };
    if bytes < MAGIC_BYTES || pass.at(0, MAGIC_BYTES)? != mcap::MAGIC {
        return Ok(None);
    }
    let mut place = MAGIC_BYTES;
    while let Some((opcode, length)) = pass.head(place)? {
        if opcode == op::CHUNK {
            let content = chunk_content(&pass.at(place + RECORD_HEAD_BYTES, length)?);
            return Ok(
                content.and_then(|content| content.blocks.first().map(LoggedFrames::time_ns))
            );
        }
        pass.reader.seek_relative(length as i64)?;
        place += RECORD_HEAD_BYTES + length;
    }
    Ok(None)
}

/// Returns the bytes that end a file without an index: data end, footer and magic.
pub(super) fn mended_end() -> Vec<u8> {
    let mut bytes = Vec::new();
    bytes.push(op::DATA_END);
    bytes.extend(4_u64.to_le_bytes());
    bytes.extend([0; 4]); // no checksum of the data, because each chunk has its own
    bytes.push(op::FOOTER);
    bytes.extend(20_u64.to_le_bytes());
    bytes.extend([0; 20]); // no summary, no offsets, no checksum
    bytes.extend(mcap::MAGIC);
    bytes
}

struct Pass<'a> {
    reader: BufReader<&'a File>,
    bytes: u64,
    body: Vec<u8>,
}

impl Pass<'_> {
    fn chunks(&mut self, mut found: Scan) -> std::io::Result<Scan> {
        if self.bytes < MAGIC_BYTES || self.at(0, MAGIC_BYTES)? != mcap::MAGIC {
            return self.behind(0, found);
        }
        let mut place = MAGIC_BYTES;
        while let Some((opcode, length)) = self.head(place)? {
            let after = place + RECORD_HEAD_BYTES + length;
            match opcode {
                op::CHUNK => {
                    // The length is at most the size of the file.
                    self.body.resize(length as usize, 0);
                    self.reader.read_exact(&mut self.body)?;
                    match chunk_content(&self.body) {
                        Some(content) => found.take(content, place, after),
                        None => return self.behind(place + 1, found),
                    }
                    if found.foreign_encoding.is_some() {
                        return Ok(found);
                    }
                }
                op::DATA_END if length == DATA_END_BYTES - RECORD_HEAD_BYTES => return Ok(found),
                op::MESSAGE_INDEX | op::HEADER => {
                    self.body.resize(length as usize, 0);
                    self.reader.read_exact(&mut self.body)?;
                    // These records have no checksum, and a wrong length would skip chunks.
                    if !is_as_long_as_stated(opcode, &self.body) {
                        return self.behind(place + 1, found);
                    }
                    if opcode == op::MESSAGE_INDEX && found.whole == place {
                        found.whole = after;
                    }
                }
                _ => return self.behind(place + 1, found),
            }
            place = after;
        }
        match place < self.bytes {
            true => self.behind(place + 1, found),
            false => Ok(found),
        }
    }

    /// Searches for intact chunks after a damaged position, byte by byte, because a damaged length
    /// must not hide the chunks after it.
    fn behind(&mut self, place: u64, mut found: Scan) -> std::io::Result<Scan> {
        let rest = self.at(place, self.bytes.saturating_sub(place))?;
        for (start, end, content) in whole_chunks(&rest) {
            found.take(content, place + start as u64, place + end as u64);
            if let Some((op::MESSAGE_INDEX, length)) = record_head(&rest[end..])
                && let Some(index) = record_body(&rest[end..], length)
                && is_as_long_as_stated(op::MESSAGE_INDEX, index)
            {
                found.whole = place + end as u64 + RECORD_HEAD_BYTES + length;
            }
        }
        Ok(found)
    }

    /// Determines the end of the file from its last bytes.
    fn end(&mut self) -> std::io::Result<SegmentEnd> {
        let tail_bytes = FOOTER_BYTES + MAGIC_BYTES;
        let Some(footer_at) = self.bytes.checked_sub(tail_bytes) else {
            return Ok(SegmentEnd::Torn);
        };
        let tail = self.at(footer_at, tail_bytes)?;
        let (footer, magic) = tail.split_at(FOOTER_BYTES as usize);
        if magic != mcap::MAGIC
            || record_head(footer) != Some((op::FOOTER, FOOTER_BYTES - RECORD_HEAD_BYTES))
        {
            return Ok(SegmentEnd::Torn);
        }
        let parsed = parse_record(op::FOOTER, &footer[RECORD_HEAD_BYTES as usize..]);
        let Ok(Record::Footer(footer)) = parsed else {
            return Ok(SegmentEnd::Torn);
        };
        let (data_ends, end) = match footer.summary_start {
            0 => (footer_at, SegmentEnd::Mended),
            start => (start.min(footer_at), SegmentEnd::InOrder),
        };
        let Some(data_end_at) = data_ends.checked_sub(DATA_END_BYTES) else {
            return Ok(SegmentEnd::Torn);
        };
        let head = self.at(data_end_at, RECORD_HEAD_BYTES)?;
        let is_there =
            record_head(&head) == Some((op::DATA_END, DATA_END_BYTES - RECORD_HEAD_BYTES));
        Ok(if is_there { end } else { SegmentEnd::Torn })
    }

    /// Returns opcode and length of the record at `place`, or `None` if it is incomplete. The
    /// reader is then at the body of the record.
    fn head(&mut self, place: u64) -> std::io::Result<Option<(u8, u64)>> {
        let Some(most) = self.bytes.checked_sub(place + RECORD_HEAD_BYTES) else {
            return Ok(None);
        };
        let mut head = [0; RECORD_HEAD_BYTES as usize];
        self.reader.read_exact(&mut head)?;
        Ok(record_head(&head).filter(|(_, length)| *length <= most))
    }

    /// Returns the bytes at `place`. The reader is then at the byte after them.
    fn at(&mut self, place: u64, length: u64) -> std::io::Result<Vec<u8>> {
        self.reader.seek(SeekFrom::Start(place))?;
        // The length is at most the size of the file.
        let mut bytes = vec![0; length as usize];
        self.reader.read_exact(&mut bytes)?;
        Ok(bytes)
    }
}

/// Returns `true` if a message index or a header has the length that its own counts imply.
fn is_as_long_as_stated(opcode: u8, body: &[u8]) -> bool {
    let stated = match parse_record(opcode, body) {
        Ok(Record::MessageIndex(index)) => 6 + 16 * index.records.len(),
        Ok(Record::Header(header)) => 8 + header.profile.len() + header.library.len(),
        _ => return false,
    };
    stated == body.len()
}

/// Returns the body of a record with the given length, or `None` if it is incomplete.
fn record_body(record: &[u8], length: u64) -> Option<&[u8]> {
    let length = usize::try_from(length).ok()?;
    record.get(RECORD_HEAD_BYTES as usize..)?.get(..length)
}

impl Scan {
    fn take(&mut self, content: ChunkContent, offset: u64, after: u64) {
        let ChunkContent {
            stated,
            foreign_encoding,
            mut blocks,
        } = content;
        append_entries(&mut self.entries, &blocks, offset, after - offset);
        self.stated = self.stated.take().or(stated);
        self.foreign_encoding = self.foreign_encoding.take().or(foreign_encoding);
        self.last = blocks.pop().or(self.last.take());
        self.whole = after;
    }
}
