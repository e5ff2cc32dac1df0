//! What a segment on disk holds, by one pass over it.

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

/// Bytes of the records after the data: opcode, length and body of each.
const DATA_END_BYTES: u64 = RECORD_HEAD_BYTES + 4;
const FOOTER_BYTES: u64 = RECORD_HEAD_BYTES + 20;
const MAGIC_BYTES: u64 = mcap::MAGIC.len() as u64;
/// Read at once.
const BUFFER_BYTES: usize = 1 << 20;

/// How a segment ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum SegmentEnd {
    /// With index and footer: it was closed.
    InOrder,
    /// With a footer alone: it was mended, or cut back.
    Mended,
    /// Without: its writer died.
    Torn,
}

/// What a segment holds.
#[derive(Debug)]
pub(super) struct Scan {
    /// Bytes of the file.
    pub(super) bytes: u64,
    pub(super) stated: Option<StatedLayout>,
    /// Encoding of its messages where that is of another version.
    pub(super) foreign_encoding: Option<String>,
    pub(super) entries: Vec<Entry>,
    /// The last block that is whole.
    pub(super) last: Option<LoggedFrames>,
    /// Where the last whole chunk ends, its message index included.
    pub(super) whole: u64,
    pub(super) end: SegmentEnd,
}

/// Reads a segment from its beginning. Chunks that are not whole are passed over, those behind them are found again.
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

/// Time of the first frame of a segment, in ns; `None` if its first chunk is not whole.
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

/// The bytes that end a file without an index: end of data, footer, magic.
pub(super) fn mended_end() -> Vec<u8> {
    let mut bytes = Vec::new();
    bytes.push(op::DATA_END);
    bytes.extend(4_u64.to_le_bytes());
    bytes.extend([0; 4]); // no checksum of the data: each chunk has its own
    bytes.push(op::FOOTER);
    bytes.extend(20_u64.to_le_bytes());
    bytes.extend([0; 20]); // no summary, no offsets, no checksum of it
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
                    self.body.resize(length as usize, 0); // no more than the file has
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
                    // without a checksum: a length that is wrong would lead past chunks
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

    /// Looks for whole chunks behind a damaged place, byte by byte: a length that is wrong must not hide what follows.
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

    /// How the file ends, told by its last bytes.
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

    /// Opcode and length of the record at this byte, if it is whole; the reader is left at its body.
    fn head(&mut self, place: u64) -> std::io::Result<Option<(u8, u64)>> {
        let Some(most) = self.bytes.checked_sub(place + RECORD_HEAD_BYTES) else {
            return Ok(None);
        };
        let mut head = [0; RECORD_HEAD_BYTES as usize];
        self.reader.read_exact(&mut head)?;
        Ok(record_head(&head).filter(|(_, length)| *length <= most))
    }

    /// Bytes from this place on; the reader is left behind them.
    fn at(&mut self, place: u64, length: u64) -> std::io::Result<Vec<u8>> {
        self.reader.seek(SeekFrom::Start(place))?;
        let mut bytes = vec![0; length as usize]; // no more than the file has
        self.reader.read_exact(&mut bytes)?;
        Ok(bytes)
    }
}

/// Whether a message index or a header has the length that its own counts say.
fn is_as_long_as_stated(opcode: u8, body: &[u8]) -> bool {
    let stated = match parse_record(opcode, body) {
        Ok(Record::MessageIndex(index)) => 6 + 16 * index.records.len(),
        Ok(Record::Header(header)) => 8 + header.profile.len() + header.library.len(),
        _ => return false,
    };
    stated == body.len()
}

/// The body of a record of this length, if it is there whole.
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
