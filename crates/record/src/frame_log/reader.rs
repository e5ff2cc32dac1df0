//! Reads frames by sequence number from the segments of a folder.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::sync::Arc;

use super::chunk::{Entry, whole_chunks};
use super::folder::{Folder, is_gone};
use super::segment::SegmentName;
use super::{LogSpan, LoggedFrames};
use crate::RecordError;

/// Maximum number of bytes read at once, unless a single chunk is longer.
const READ_BYTES: u64 = 1 << 20;
/// Minimum number of bytes read at once, because the overhead around the values is not known in
/// advance.
const LEAST_READ_BYTES: u64 = 4096;

/// A reader of a frame log, which may still be written.
#[derive(Debug, Clone)]
pub struct FrameLogReader {
    folder: Arc<Folder>,
}

impl FrameLogReader {
    pub(super) fn new(folder: Arc<Folder>) -> Self {
        Self { folder }
    }

    /// Reads frames of an epoch from number `after` on.
    ///
    /// Joins consecutive blocks, up to `limit` frames and `bytes` bytes of values, but at least one
    /// frame. The result ends at a gap and at the end of the epoch. If frame `after` is missing or
    /// has been deleted, the result starts at the next existing frame. Node positions refer to the
    /// last frame; they are empty if the last block was truncated.
    ///
    /// If the epoch ends at `after`, the result has no frames and `ended` is `true`. A client with
    /// all frames thus detects the end of the epoch. Returns `None` if the log contains nothing at
    /// or after `after`.
    ///
    /// # Errors
    /// Returns an error if a segment cannot be opened or read. A damaged chunk counts as a gap, not
    /// as an error.
    pub fn read(
        &self,
        epoch: u64,
        after: u64,
        limit: u64,
        bytes: usize,
    ) -> Result<Option<LoggedFrames>, RecordError> {
        let mut reading = Reading {
            epoch,
            next: after,
            limit,
            bytes,
            joined: None,
        };
        let mut segment = self.folder.segment_at(epoch, after);
        while let Some(name) = segment.filter(|name| name.epoch <= epoch) {
            while let Some(entries) = self
                .folder
                .with_index(name, |entries| reading.group(entries))?
            {
                let Some(last) = entries.last() else { break };
                let before = reading.next;
                if !self.read_group(name, &entries, &mut reading)? {
                    return Ok(reading.joined);
                }
                // Chunks that could not be read must not be requested again.
                reading.next = reading.next.max(last.end);
                if reading.next == before {
                    break;
                }
            }
            segment = self.folder.segment_after(name);
        }
        Ok(reading.joined)
    }

    /// Reads the chunks of consecutive entries. Returns `true` if more frames are required.
    fn read_group(
        &self,
        name: SegmentName,
        entries: &[Entry],
        reading: &mut Reading,
    ) -> Result<bool, RecordError> {
        let (Some(first), Some(last)) = (entries.first(), entries.last()) else {
            return Ok(true);
        };
        let path = name.path(self.folder.path());
        let read = || -> Result<Vec<u8>, RecordError> {
            let mut file = File::open(&path).map_err(|source| RecordError::Open {
                path: path.clone(),
                source,
            })?;
            let mut bytes = Vec::new();
            let length = last.offset + last.length - first.offset;
            file.seek(SeekFrom::Start(first.offset))
                .and_then(|_| file.take(length).read_to_end(&mut bytes))
                .map_err(|source| RecordError::ReadFile {
                    path: path.clone(),
                    source,
                })?;
            Ok(bytes)
        };
        let bytes = match read() {
            Err(error) if is_gone(&error) => return Ok(true),
            read => read?,
        };
        for (_, _, content) in whole_chunks(&bytes) {
            for block in content.blocks {
                if !reading.take(block) {
                    return Ok(false);
                }
            }
        }
        Ok(true)
    }

    /// Returns the next epoch in the log after `epoch`, or the lowest one for `None`. Skips
    /// segments that cannot be read. Returns `None` if there is no such epoch.
    pub fn next_epoch(&self, epoch: Option<u64>) -> Option<u64> {
        let lowest = match epoch {
            Some(epoch) => epoch.checked_add(1)?,
            None => 0,
        };
        let mut segment = self.folder.segment_at(lowest, 0);
        while let Some(name) = segment {
            let epoch_of = |entries: &[Entry]| {
                entries
                    .iter()
                    .map(|entry| entry.epoch)
                    .find(|epoch| *epoch >= lowest)
            };
            if let Some(found) = self
                .folder
                .with_index(name, epoch_of)
                .ok()
                .flatten()
                .flatten()
            {
                return Some(found);
            }
            segment = self.folder.segment_after(name);
        }
        None
    }

    /// Returns the frames of each epoch in the log, in order of epochs. Scans all segments without
    /// an index in memory, and skips those that cannot be read.
    pub fn spans(&self) -> Vec<LogSpan> {
        let mut spans: BTreeMap<u64, LogSpan> = BTreeMap::new();
        for name in self.folder.names() {
            let Ok(Some(entries)) = self.folder.with_index(name, <[Entry]>::to_vec) else {
                continue;
            };
            for Entry {
                epoch,
                first,
                end,
                frames,
                ..
            } in entries
            {
                let span = spans.entry(epoch).or_insert(LogSpan {
                    epoch,
                    from: first,
                    to: first,
                    missing: 0,
                });
                // Count the frames missing between the entries and within this entry.
                span.missing += first.saturating_sub(span.to) + (end - first - frames);
                span.to = end;
            }
        }
        spans.into_values().collect()
    }
}

/// The state of a read operation, which joins frames.
struct Reading {
    epoch: u64,
    next: u64,
    limit: u64,
    bytes: usize,
    joined: Option<LoggedFrames>,
}

impl Reading {
    /// Returns the next entries to read together: as many as required, within the maximum number of
    /// bytes read at once.
    fn group(&self, entries: &[Entry]) -> Vec<Entry> {
        let is_before = |entry: &Entry| {
            let has_passed = entry.end < self.next || (entry.end == self.next && !entry.ended);
            entry.epoch < self.epoch || (entry.epoch == self.epoch && has_passed)
        };
        let start = entries.partition_point(is_before);
        let mut group: Vec<Entry> = Vec::new();
        let mut frames = 0;
        for entry in entries[start..]
            .iter()
            .take_while(|entry| entry.epoch == self.epoch)
        {
            let begin = group.first().map_or(entry.offset, |first| first.offset);
            let wanted = (self.bytes as u64)
                .saturating_mul(2)
                .saturating_add(LEAST_READ_BYTES)
                .min(READ_BYTES);
            let is_enough = frames >= self.limit || entry.offset + entry.length - begin > wanted;
            if !group.is_empty() && is_enough {
                break;
            }
            frames += entry.end - entry.first.max(self.next).min(entry.end);
            group.push(*entry);
        }
        group
    }

    /// Appends the matching frames of a block. Returns `true` if more frames are required.
    fn take(&mut self, mut block: LoggedFrames) -> bool {
        let says_nothing = block.end() < self.next || (block.end() == self.next && !block.ended);
        if block.epoch != self.epoch || says_nothing {
            return true;
        }
        block.skip_to(self.next);
        let fitting = (self.bytes / (8 * usize::from(block.channels).max(1))) as u64;
        let room = self.limit.min(fitting).max(1);
        match &mut self.joined {
            None => {
                block.truncate(room);
                self.next = block.end();
                let goes_on = block.count() < room && !block.ended;
                self.joined = Some(block);
                goes_on
            }
            Some(joined) => {
                let room = room.saturating_sub(joined.count());
                block.truncate(room);
                let (end, ended) = (block.end(), block.ended);
                if joined.join(block).is_err() {
                    return false;
                }
                self.next = end;
                joined.count() < self.limit.min(fitting).max(1) && !ended
            }
        }
    }
}
