//! The MCAP records of a segment: its beginning, its chunks, and its end with an index.
//!
//! The records are those of the crate `mcap`. This module does not use the writer of that crate,
//! because it keeps the index of all chunks in memory, about 300 bytes per chunk. For live samples
//! in blocks of 50 ms, this amounts to a megabyte per structure. This module reads the index from
//! the file when the segment ends.
//!
//! Source: <https://mcap.dev/spec>.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Cursor, Read, Result, Seek, SeekFrom, Write};
use std::path::Path;

use binrw::{BinWrite, BinWriterExt};
use mcap::records::{
    Channel, ChunkHeader, ChunkIndex, DataEnd, Footer, Header, MessageHeader, MessageIndex,
    MessageIndexEntry, SchemaHeader, Statistics, SummaryOffset, op,
};

use super::chunk::{CHUNK_HEAD_BYTES, RECORD_HEAD_BYTES, record_head};
use super::layout::{StatedLayout, TOPIC};
use super::{LoggedFrames, payload};

/// Ids of the only schema and the only channel of a segment.
const SCHEMA: u16 = 1;
const CHANNEL: u16 = 1;
/// Number of bytes read or written at once.
const BUFFER_BYTES: usize = 64 << 10;
/// Size of the head of a message index, and of each entry, in bytes.
const INDEX_HEAD_BYTES: u64 = 6;
const INDEX_ENTRY_BYTES: u64 = 16;

/// Appends a record whose body `body` appends.
fn put(out: &mut Vec<u8>, opcode: u8, body: impl FnOnce(&mut Vec<u8>) -> Result<()>) -> Result<()> {
    out.push(opcode);
    let length_at = out.len();
    out.extend([0; 8]);
    body(out)?;
    let length = (out.len() - length_at - 8) as u64;
    out[length_at..length_at + 8].copy_from_slice(&length.to_le_bytes());
    Ok(())
}

/// Appends the fields of a record.
fn put_fields(out: &mut Vec<u8>, fields: &impl for<'a> BinWrite<Args<'a> = ()>) -> Result<()> {
    let mut end = Cursor::new(out);
    end.seek(SeekFrom::End(0))?;
    end.write_le(fields).map_err(std::io::Error::other)
}

/// Appends the beginning of a file.
pub(super) fn put_begin(out: &mut Vec<u8>) -> Result<()> {
    out.extend(mcap::MAGIC);
    let library = concat!("spandrel ", env!("CARGO_PKG_VERSION")).to_owned();
    put(out, op::HEADER, |out| {
        put_fields(
            out,
            &Header {
                profile: String::new(),
                library,
            },
        )
    })
}

fn put_schema(out: &mut Vec<u8>) -> Result<()> {
    let (name, encoding) = (
        payload::SCHEMA_NAME.to_owned(),
        payload::SCHEMA_ENCODING.to_owned(),
    );
    put(out, op::SCHEMA, |out| {
        put_fields(
            out,
            &SchemaHeader {
                id: SCHEMA,
                name,
                encoding,
            },
        )?;
        out.extend((payload::SCHEMA.len() as u32).to_le_bytes());
        out.extend(payload::SCHEMA.as_bytes());
        Ok(())
    })
}

fn put_channel(out: &mut Vec<u8>, stated: &StatedLayout) -> Result<()> {
    let channel = Channel {
        id: CHANNEL,
        schema_id: SCHEMA,
        topic: TOPIC.to_owned(),
        message_encoding: payload::MESSAGE_ENCODING.to_owned(),
        metadata: stated.metadata(),
    };
    put(out, op::CHANNEL, |out| put_fields(out, &channel))
}

/// Appends a chunk of blocks and the message index. `sequence` is the number of the first message.
///
/// The chunk is not compressed, because noise in the last bits of samples does not compress, and
/// small chunks compress even less. The first chunk of a segment contains schema and channel, so it
/// requires `stated`.
pub(super) fn put_chunk(
    out: &mut Vec<u8>,
    stated: Option<&StatedLayout>,
    blocks: &[Cow<'_, LoggedFrames>],
    sequence: u32,
) -> Result<()> {
    let (mut records, mut message, mut entries) =
        (Vec::new(), Vec::new(), Vec::with_capacity(blocks.len()));
    if let Some(stated) = stated {
        put_schema(&mut records)?;
        put_channel(&mut records, stated)?;
    }
    let mut number = sequence;
    for block in blocks {
        payload::encode_to(block, &mut message);
        let log_time = u64::try_from(block.time_ns()).unwrap_or(0);
        entries.push(MessageIndexEntry {
            log_time,
            offset: records.len() as u64,
        });
        put(&mut records, op::MESSAGE, |out| {
            put_fields(
                out,
                &MessageHeader {
                    channel_id: CHANNEL,
                    sequence: number,
                    log_time,
                    publish_time: log_time,
                },
            )?;
            out.extend_from_slice(&message);
            Ok(())
        })?;
        number = number.wrapping_add(1);
    }
    let times = || entries.iter().map(|entry| entry.log_time);
    let header = ChunkHeader {
        message_start_time: times().min().unwrap_or(0),
        message_end_time: times().max().unwrap_or(0),
        uncompressed_size: records.len() as u64,
        uncompressed_crc: crc32fast::hash(&records),
        compression: String::new(),
        compressed_size: records.len() as u64,
    };
    put(out, op::CHUNK, |out| {
        put_fields(out, &header)?;
        out.extend_from_slice(&records);
        Ok(())
    })?;
    put(out, op::MESSAGE_INDEX, |out| {
        put_fields(
            out,
            &MessageIndex {
                channel_id: CHANNEL,
                records: entries,
            },
        )
    })
}

/// Writes the end of a segment after its `bytes` bytes: the index of the chunks, which it reads
/// from the file, and the footer.
///
/// Returns the length of the file.
pub(super) fn write_end(
    path: &Path,
    file: &File,
    bytes: u64,
    stated: &StatedLayout,
) -> Result<u64> {
    let mut out = Vec::with_capacity(2 * BUFFER_BYTES);
    // The data needs no checksum, because each chunk has its own.
    put(&mut out, op::DATA_END, |out| {
        put_fields(
            out,
            &DataEnd {
                data_section_crc: 0,
            },
        )
    })?;
    let mut end = End {
        file,
        crc: crc32fast::Hasher::new(),
        place: bytes,
        out,
        offsets: Vec::new(),
    };
    end.write(false)?;
    let summary_start = end.place;
    end.group(op::SCHEMA, |end| put_schema(&mut end.out))?;
    end.group(op::CHANNEL, |end| put_channel(&mut end.out, stated))?;
    let mut statistics = Statistics {
        message_count: 0,
        schema_count: 1,
        channel_count: 1,
        attachment_count: 0,
        metadata_count: 0,
        chunk_count: 0,
        message_start_time: u64::MAX,
        message_end_time: 0,
        channel_message_counts: BTreeMap::new(),
    };
    end.group(op::CHUNK_INDEX, |end| {
        each_chunk(path, bytes, |index, messages| {
            statistics.message_count += messages;
            statistics.chunk_count += 1;
            statistics.message_start_time =
                statistics.message_start_time.min(index.message_start_time);
            statistics.message_end_time = statistics.message_end_time.max(index.message_end_time);
            put(&mut end.out, op::CHUNK_INDEX, |out| put_fields(out, &index))?;
            if end.out.len() < BUFFER_BYTES {
                Ok(())
            } else {
                end.write(true)
            }
        })
    })?;
    statistics
        .channel_message_counts
        .insert(CHANNEL, statistics.message_count);
    end.group(op::STATISTICS, |end| {
        put(&mut end.out, op::STATISTICS, |out| {
            put_fields(out, &statistics)
        })
    })?;
    end.finish(summary_start)?;
    Ok(end.place)
}

/// The state of writing the end of a segment.
struct End<'a> {
    file: &'a File,
    /// Checksum of the summary so far.
    crc: crc32fast::Hasher,
    /// Length of the file so far, in bytes.
    place: u64,
    out: Vec<u8>,
    offsets: Vec<SummaryOffset>,
}

impl End<'_> {
    fn write(&mut self, is_summary: bool) -> Result<()> {
        self.file.write_all(&self.out)?;
        if is_summary {
            self.crc.update(&self.out);
        }
        self.place += self.out.len() as u64;
        self.out.clear();
        Ok(())
    }

    /// Writes a group of records of one kind.
    fn group(
        &mut self,
        group_opcode: u8,
        records: impl FnOnce(&mut Self) -> Result<()>,
    ) -> Result<()> {
        let group_start = self.place;
        records(self)?;
        self.write(true)?;
        self.offsets.push(SummaryOffset {
            group_opcode,
            group_start,
            group_length: self.place - group_start,
        });
        Ok(())
    }

    /// Writes the places of the groups and the footer.
    fn finish(&mut self, summary_start: u64) -> Result<()> {
        let summary_offset_start = self.place;
        for offset in std::mem::take(&mut self.offsets) {
            put(&mut self.out, op::SUMMARY_OFFSET, |out| {
                put_fields(out, &offset)
            })?;
        }
        // The checksum of the summary includes the part of the footer before the checksum itself.
        put(&mut self.out, op::FOOTER, |out| {
            put_fields(
                out,
                &Footer {
                    summary_start,
                    summary_offset_start,
                    summary_crc: 0,
                },
            )
        })?;
        self.out.truncate(self.out.len() - 4);
        self.write(true)?;
        let summary_crc = self.crc.clone().finalize();
        self.out.extend(summary_crc.to_le_bytes());
        self.out.extend(mcap::MAGIC);
        self.write(false)
    }
}

/// Calls `take` for each chunk of a file of `bytes` bytes that this module wrote, with its index
/// entry and number of messages.
fn each_chunk(
    path: &Path,
    bytes: u64,
    mut take: impl FnMut(ChunkIndex, u64) -> Result<()>,
) -> Result<()> {
    let mut reader = BufReader::with_capacity(BUFFER_BYTES, File::open(path)?);
    let mut place = mcap::MAGIC.len() as u64;
    reader.seek_relative(place as i64)?;
    let mut chunk: Option<ChunkIndex> = None;
    while place < bytes {
        let mut head = [0; RECORD_HEAD_BYTES as usize];
        reader.read_exact(&mut head)?;
        let (opcode, length) = record_head(&head).unwrap_or_default();
        let after = place + RECORD_HEAD_BYTES + length;
        let mut passed = 0;
        match opcode {
            op::CHUNK => {
                let mut head = [0; CHUNK_HEAD_BYTES];
                reader.read_exact(&mut head)?;
                passed = head.len() as u64;
                let number = |at: usize| {
                    head[at..]
                        .first_chunk()
                        .map_or(0, |bytes| u64::from_le_bytes(*bytes))
                };
                chunk = Some(ChunkIndex {
                    message_start_time: number(0),
                    message_end_time: number(8),
                    chunk_start_offset: place,
                    chunk_length: after - place,
                    message_index_offsets: BTreeMap::from([(CHANNEL, after)]),
                    message_index_length: 0,
                    compression: String::new(),
                    compressed_size: number(16),
                    uncompressed_size: number(16),
                });
            }
            op::MESSAGE_INDEX => {
                if let Some(index) = chunk.take() {
                    let messages = length.saturating_sub(INDEX_HEAD_BYTES) / INDEX_ENTRY_BYTES;
                    take(
                        ChunkIndex {
                            message_index_length: after - place,
                            ..index
                        },
                        messages,
                    )?;
                }
            }
            _ => {}
        }
        reader.seek_relative((length.saturating_sub(passed)) as i64)?;
        place = after;
    }
    Ok(())
}
