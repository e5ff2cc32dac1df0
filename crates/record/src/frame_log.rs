//! The frame log: all frames of a structure on disk, in segments that are MCAP files.
//!
//! Blocks of frames go in; frames come out by epoch and number, the same to the bit. A segment is an MCAP file named after its
//! first frame, with one channel `frames`; each append is one chunk with its checksum, so that what a crash leaves is whole up
//! to the last append. The layout of a message stands in the schema of each segment, and structure, channels and nodes in the
//! metadata of its channel: any reader of MCAP opens it, and a few lines read it.
//!
//! ```
//! use spandrel_record::{FrameLog, LogLayout, LogSettings, LoggedFrames};
//! # let folder = tempfile::tempdir()?;
//! let layout = LogLayout {
//!     structure: "tower".to_owned(),
//!     channels: vec!["roof-x".to_owned(), "roof-y".to_owned()],
//!     nodes: vec!["roof".to_owned()],
//!     sampling_rate_hz: 100.0,
//! };
//! let (mut log, opened) = FrameLog::open(folder.path(), layout, LogSettings::default())?;
//! assert!(opened.last.is_none());
//! let frames = LoggedFrames {
//!     source: "ingest".to_owned(),
//!     epoch: 1,
//!     sequence: 0,
//!     t0_ns: 1_700_000_000_000_000_000,
//!     sampling_rate_hz: 100.0,
//!     channels: 2,
//!     values: vec![0.1, 0.2, f64::NAN, 0.4],
//!     ended: false,
//!     nodes: Vec::new(),
//! };
//! log.append(&[frames])?;
//! let second = log.reader().read(1, 1, 100, 1 << 20)?.unwrap();
//! assert_eq!((second.sequence, second.values[1]), (1, 0.4));
//! log.close()?;
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! Frames are in the order of epoch and number. Frames that are there already, or are before the last one, are passed over by
//! an append; those of an epoch lower than the last are refused, as are those of an epoch that has ended.

use std::borrow::Cow;
use std::path::{Path, PathBuf};
use std::sync::Arc;

mod chunk;
mod folder;
mod frames;
mod layout;
mod note;
mod opening;
mod payload;
mod reader;
mod records;
mod scan;
mod segment;
mod syncer;

use chunk::append_entries;
use folder::Folder;
use note::Note;
use segment::{OpenSegment, SegmentName};
use syncer::sync_folder;

pub(crate) use frames::frame_time_ns;
pub(crate) use layout::StatedLayout;
pub(crate) use payload::{MESSAGE_ENCODING as FRAMES_ENCODING, decode as decode_frames};

pub use frames::{LogLayout, LogSpan, LoggedFrames, NodePosition};
pub use reader::FrameLogReader;
pub use syncer::LogSyncer;

use crate::RecordError;

/// Chunks after which a segment ends: live samples in blocks of 50 ms are twenty chunks a second, and the end of a segment goes over all of
/// its chunks.
const MOST_CHUNKS: u32 = 1 << 12;
const NANOSECONDS: u64 = 1_000_000_000;

/// How long segments are, and how many are kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LogSettings {
    /// A segment of this many bytes is followed by another one.
    pub segment_bytes: u64,
    /// As is one of this many seconds, by the times of its frames.
    pub segment_s: u64,
    /// The oldest segments are deleted while all of them have more bytes than this.
    pub keep_bytes: u64,
    /// The oldest segments are deleted whose frames are all older than this, in s, by the time of the newest frame.
    pub keep_s: u64,
}

impl Default for LogSettings {
    /// Segments of 64 MiB or an hour (or of 4096 appends, whatever the settings say); 10 GiB or 30 days of them.
    fn default() -> Self {
        Self {
            segment_bytes: 64 << 20,
            segment_s: 3600,
            keep_bytes: 10 << 30,
            keep_s: 30 * 86_400,
        }
    }
}

/// What was found when a log was opened.
#[derive(Debug, Clone, PartialEq)]
pub struct OpenedLog {
    /// The last block that is whole.
    pub last: Option<LoggedFrames>,
    /// Whether the newest segment was closed in order; true where there is none.
    pub was_closed: bool,
    /// Whether the newest segment was written since this machine was started; true where that cannot be told.
    pub same_boot: bool,
    /// What was noted last with [`FrameLog::note_complete`]; none where nothing was.
    pub is_complete: Option<bool>,
    /// Bytes that were cut off behind the last whole chunk.
    pub torn_bytes: u64,
    /// Segments in which nothing could be read: where they are now.
    pub set_aside: Vec<PathBuf>,
}

/// How far the log goes.
#[derive(Debug, Clone, Copy)]
struct LogEnd {
    epoch: u64,
    next: u64,
    ended: bool,
}

/// Writes the frame log of a structure.
///
/// Dropped without [`FrameLog::close`] it loses nothing; the last segment then has no index, and is mended when the log is
/// opened again.
pub struct FrameLog {
    folder: Arc<Folder>,
    stated: StatedLayout,
    settings: LogSettings,
    end: Option<LogEnd>,
    segment: Option<OpenSegment>,
    segment_start_ns: i64,
    syncer: LogSyncer,
    note: Note,
}

impl std::fmt::Debug for FrameLog {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("FrameLog")
            .field("settings", &self.settings)
            .field("end", &self.end)
            .finish_non_exhaustive()
    }
}

impl FrameLog {
    /// Opens the log of a folder, which is created with its parents if it is not there, and locked as long as the log is open.
    ///
    /// The end of the newest segment is mended, and the oldest segments are deleted as the settings say.
    ///
    /// # Errors
    /// Somebody else has the log open, it is of another layout, or the folder cannot be read or written.
    pub fn open(
        folder: &Path,
        layout: LogLayout,
        settings: LogSettings,
    ) -> Result<(Self, OpenedLog), RecordError> {
        let is_new = !folder.exists();
        std::fs::create_dir_all(folder).map_err(|source| RecordError::WriteLog {
            path: folder.to_owned(),
            source,
        })?;
        if let Some(parent) = folder.parent().filter(|_| is_new) {
            // the name of the folder too; a parent that cannot be opened for reading is no reason to log nothing
            let _ = sync_folder(parent);
        }
        let note = Note::lock(folder)?;
        let shared = Arc::new(Folder::read(folder)?);
        let stated = StatedLayout {
            layout,
            boot_id: layout::boot_id(),
        };
        let found = opening::newest(&shared, &stated)?;
        // a segment may be in order because it was full, and the next one lost with the power
        let was_closed = found.was_closed && note.allows_closed();
        let opened = OpenedLog {
            was_closed,
            is_complete: note.is_complete(),
            ..found
        };
        let end = opened.last.as_ref().map(LogEnd::of);
        let newest_ns = opened.last.as_ref().map(LoggedFrames::last_time_ns);
        let log = Self {
            folder: shared,
            stated,
            settings,
            end,
            segment: None,
            segment_start_ns: 0,
            syncer: LogSyncer::new(folder),
            note,
        };
        if let Some(newest_ns) = newest_ns {
            log.delete_older_than(newest_ns)?;
        }
        log.delete_beyond_size()?;
        Ok((log, opened))
    }

    /// Appends blocks as one chunk, all or nothing; they are with the operating system when it returns.
    ///
    /// Frames up to the last one of the log are passed over, and so are blocks without frames unless they end the epoch.
    ///
    /// # Errors
    /// Nothing of the blocks is in the log then. A block is not as the layout says, is of an epoch before the last one or of one
    /// that has ended; or the file cannot be written, and the next append begins another.
    pub fn append(&mut self, blocks: &[LoggedFrames]) -> Result<(), RecordError> {
        let (blocks, end) = self.new_of(blocks)?;
        let Some(first) = blocks.first() else {
            return Ok(());
        };
        let (name, start_ns) = (SegmentName::of(first), first.time_ns());
        let newest_ns = blocks
            .iter()
            .map(|block| block.last_time_ns())
            .max()
            .unwrap_or(start_ns);
        if self.is_full(start_ns) {
            // what does not fit on the disk is cut off again: frames are not in danger
            let _ = self.end_segment();
        }
        self.note.written()?;
        let begins = self.segment.is_none();
        let mut segment = match self.segment.take() {
            Some(segment) => segment,
            None => OpenSegment::create(self.folder.path(), name)?,
        };
        let (offset, length) = match segment.append(&blocks, &self.stated) {
            Ok(place) => place,
            Err(error) => {
                self.cut_back(segment);
                return Err(error);
            }
        };
        if begins {
            self.segment_start_ns = start_ns;
            self.syncer.created();
        }
        self.syncer.written(segment.path(), segment.file());
        {
            let mut segments = self.folder.segments();
            segments.set_size(segment.name(), segment.bytes());
            append_entries(
                segments.index_of_written(segment.name()),
                &blocks,
                offset,
                length,
            );
        }
        self.segment = Some(segment);
        self.end = end;
        // a segment that cannot be deleted is no reason to lose frames; it is tried again
        if begins {
            let _ = self.delete_older_than(newest_ns);
        }
        let _ = self.delete_beyond_size();
        Ok(())
    }

    /// Notes on the disk whether the log has all frames that others may know of, for whoever opens it after a crash. That it has
    /// not can be noted on a full disk as well.
    ///
    /// # Errors
    /// The disk refuses.
    pub fn note_complete(&mut self, is_complete: bool) -> Result<(), RecordError> {
        self.note.complete(is_complete)
    }

    /// What brings the log to the disk itself, on any thread.
    pub fn syncer(&self) -> LogSyncer {
        self.syncer.clone()
    }

    /// What reads the log, on any thread.
    pub fn reader(&self) -> FrameLogReader {
        FrameLogReader::new(Arc::clone(&self.folder))
    }

    /// Ends the last segment with index and footer, and waits until everything is on the disk.
    ///
    /// # Errors
    /// The end does not fit on the disk, or the disk refuses; the frames themselves are in the log.
    pub fn close(mut self) -> Result<(), RecordError> {
        self.end_segment()?;
        self.syncer.sync()?;
        self.note.closed()
    }

    /// The blocks, or parts of them, that are not in the log yet, and how far it goes with them.
    fn new_of<'a>(
        &self,
        blocks: &'a [LoggedFrames],
    ) -> Result<(Vec<Cow<'a, LoggedFrames>>, Option<LogEnd>), RecordError> {
        let mut end = self.end;
        let mut new = Vec::with_capacity(blocks.len());
        for block in blocks {
            block.check(&self.stated.layout)?;
            if block.count() == 0 && !block.ended {
                continue;
            }
            let mut block = Cow::Borrowed(block);
            if let Some(end) = end {
                let refused = |what: &'static str, found: String, allowed: String| {
                    let structure = self.stated.layout.structure.clone();
                    Err(RecordError::NotLoggable {
                        structure,
                        what,
                        found,
                        allowed,
                    })
                };
                if block.epoch < end.epoch {
                    let allowed = format!("{} as that of the last frames, or higher", end.epoch);
                    return refused("epoch", block.epoch.to_string(), allowed);
                }
                if block.epoch == end.epoch {
                    let is_known = block.end() < end.next
                        || (block.end(), block.ended) <= (end.next, end.ended);
                    if is_known {
                        continue;
                    }
                    if end.ended {
                        let allowed =
                            format!("below {} where epoch {} has ended", end.next, end.epoch);
                        return refused(
                            "number of the last frame",
                            (block.end() - 1).to_string(),
                            allowed,
                        );
                    }
                    if block.sequence < end.next {
                        block.to_mut().skip_to(end.next);
                    }
                }
            }
            end = Some(LogEnd::of(&block));
            new.push(block);
        }
        Ok((new, end))
    }

    /// Whether frames of this time begin another segment.
    fn is_full(&self, time_ns: i64) -> bool {
        let Some(segment) = &self.segment else {
            return false;
        };
        let span_ns = self.settings.segment_s.saturating_mul(NANOSECONDS);
        let lasts_ns = u64::try_from(time_ns.saturating_sub(self.segment_start_ns)).unwrap_or(0);
        segment.bytes() >= self.settings.segment_bytes
            || segment.chunks() >= MOST_CHUNKS
            || lasts_ns >= span_ns
    }

    /// Ends the segment that is being written, if there is one.
    fn end_segment(&mut self) -> Result<(), RecordError> {
        let Some(segment) = self.segment.take() else {
            return Ok(());
        };
        let (name, bytes) = (segment.name(), segment.bytes());
        self.syncer.written(segment.path(), segment.file());
        let finished = segment.finish(&self.stated);
        let mut segments = self.folder.segments();
        segments.set_size(name, *finished.as_ref().unwrap_or(&bytes));
        segments.end_written();
        finished.map(|_| ())
    }

    /// Cuts off what did not become a whole chunk.
    fn cut_back(&self, segment: OpenSegment) {
        let (name, bytes) = (segment.name(), segment.bytes());
        // where even that fails, the rest of a chunk stays behind the last whole one, and is never read
        let length = segment.cut_back().unwrap_or(bytes);
        let mut segments = self.folder.segments();
        match length {
            0 => segments.forget(name),
            _ => {
                segments.set_size(name, length);
                segments.end_written();
            }
        }
    }

    /// Deletes the oldest segments while there are too many bytes; never the one that is being written.
    fn delete_beyond_size(&self) -> Result<(), RecordError> {
        loop {
            let oldest = {
                let segments = self.folder.segments();
                let is_newest =
                    |name: &SegmentName| self.segment.is_none() && segments.newest() == Some(*name);
                let oldest = segments.oldest().next().filter(|name| !is_newest(name));
                oldest.filter(|_| segments.bytes() > self.settings.keep_bytes)
            };
            match oldest {
                Some(name) => self.folder.delete(name)?,
                None => return Ok(()),
            }
        }
    }

    /// Deletes the oldest segments that were over, by the beginning of the next one, before the time that is kept.
    fn delete_older_than(&self, newest_ns: i64) -> Result<(), RecordError> {
        let keep_ns =
            i64::try_from(self.settings.keep_s.saturating_mul(NANOSECONDS)).unwrap_or(i64::MAX);
        let first_kept_ns = newest_ns.saturating_sub(keep_ns);
        let names = self.folder.names();
        let mut over = 0;
        for (place, name) in names.iter().enumerate().skip(1) {
            match opening::start_ns(&self.folder, *name) {
                Some(start_ns) if start_ns < first_kept_ns => over = place,
                Some(_) => break,
                None => {} // it cannot be read: the next one tells
            }
        }
        names
            .into_iter()
            .take(over)
            .try_for_each(|name| self.folder.delete(name))
    }
}

impl LogEnd {
    fn of(frames: &LoggedFrames) -> Self {
        Self {
            epoch: frames.epoch,
            next: frames.end(),
            ended: frames.ended,
        }
    }
}

/// Whether a file of this name is a segment of a frame log.
pub(crate) fn is_segment(file_name: &str) -> bool {
    SegmentName::parse(file_name).is_some()
}

/// Whether a file of this name is in the folder of a frame log without being part of the recording.
pub(crate) fn is_lock(file_name: &str) -> bool {
    file_name == note::LOCK
}

#[cfg(test)]
mod tests;
