//! The frame log: all frames of a structure on disk, in segments that are MCAP files.
//!
//! Blocks of frames are appended, and read by epoch and sequence number. Frames read back are
//! bit-identical.
//!
//! A segment is an MCAP file named after its first frame, with one channel `frames`. Each append
//! writes one chunk with a checksum. After a crash, a segment is therefore intact up to the last
//! complete append.
//!
//! Any MCAP reader can open a segment, and a few lines of code can decode it. The schema of each
//! segment describes the layout of a message. The metadata of its channel contains structure,
//! channels and nodes.
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
//! Frames are in the order of epoch and sequence number. An append skips frames that the log
//! already contains, and frames before the last one. It rejects frames of a lower epoch than the
//! last, and frames of an epoch that has ended.

use std::borrow::Cow;
use std::fs::DirBuilder;
use std::os::unix::fs::DirBuilderExt as _;
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

/// Maximum number of chunks in a segment. Live samples in blocks of 50 ms produce twenty chunks per
/// second, and closing a segment reads all of its chunks.
const MOST_CHUNKS: u32 = 1 << 12;
const NANOSECONDS: u64 = 1_000_000_000;
/// Permissions of a new folder and of its files. Only the owner has access.
const FOLDER_MODE: u32 = 0o700;
const FILE_MODE: u32 = 0o600;

/// Length and retention of segments.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LogSettings {
    /// Size at which a segment is full, in bytes.
    pub segment_bytes: u64,
    /// Time span at which a segment is full, in s, based on the times of its frames.
    pub segment_s: u64,
    /// Maximum total size of all segments, in bytes. The oldest segments beyond it are deleted.
    pub keep_bytes: u64,
    /// Maximum age of frames, in s, relative to the newest frame. Segments are deleted if they
    /// contain only older frames, and if their files have not been written for as long.
    pub keep_s: u64,
}

impl Default for LogSettings {
    /// Returns the default settings. A segment is full after 64 MiB or one hour, or after 4096
    /// appends, which is not configurable. The log keeps up to 10 GiB and 30 days.
    fn default() -> Self {
        Self {
            segment_bytes: 64 << 20,
            segment_s: 3600,
            keep_bytes: 10 << 30,
            keep_s: 30 * 86_400,
        }
    }
}

/// The state of a log when it was opened.
#[derive(Debug, Clone, PartialEq)]
pub struct OpenedLog {
    /// The last intact block.
    pub last: Option<LoggedFrames>,
    /// Whether the newest segment was closed properly; `true` if there is none.
    pub was_closed: bool,
    /// Whether the newest segment was written since the machine booted; `true` if unknown.
    pub same_boot: bool,
    /// The last value passed to [`FrameLog::note_complete`]; `None` if unknown.
    pub is_complete: Option<bool>,
    /// Number of bytes removed after the last complete chunk.
    pub torn_bytes: u64,
    /// New paths of segments from which nothing could be read.
    pub set_aside: Vec<PathBuf>,
}

/// Limits at which a segment is full.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Limits {
    bytes: u64,
    chunks: u64,
    /// Time span of the frames, ns.
    span_ns: u64,
}

impl Limits {
    fn new(settings: &LogSettings) -> Self {
        Self {
            bytes: settings.segment_bytes,
            chunks: MOST_CHUNKS.into(),
            span_ns: settings.segment_s.saturating_mul(NANOSECONDS),
        }
    }

    /// Returns the limits of the first segment after the log is opened: a share that follows from
    /// the name of the structure.
    ///
    /// Structures that start together would otherwise end all their segments at the same moment, on
    /// the one thread that writes the recordings.
    fn first_of(self, structure: &str) -> Self {
        let share = u128::from(crc32fast::hash(structure.as_bytes())) + 1;
        // The product of 64 and 33 bits fits, and the result is at most the limit.
        let of = |limit: u64| u64::try_from((u128::from(limit) * share) >> 32).unwrap_or(limit);
        Self {
            bytes: of(self.bytes),
            chunks: of(self.chunks).max(1),
            span_ns: of(self.span_ns),
        }
    }
}

/// The end of the log.
#[derive(Debug, Clone, Copy)]
struct LogEnd {
    epoch: u64,
    next: u64,
    ended: bool,
}

/// A writer of the frame log of a structure.
///
/// Dropping the log without [`FrameLog::close`] loses no frames. The last segment then has no
/// index, and the next [`FrameLog::open`] repairs it.
pub struct FrameLog {
    folder: Arc<Folder>,
    stated: StatedLayout,
    settings: LogSettings,
    end: Option<LogEnd>,
    segment: Option<OpenSegment>,
    segment_start_ns: i64,
    /// Limits of the current segment.
    limits: Limits,
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
    /// Opens the log in a folder, and locks the folder while the log is open.
    ///
    /// Creates the folder and its parents if they do not exist. Repairs the end of the newest
    /// segment, and deletes old segments according to the settings.
    ///
    /// # Errors
    /// Returns an error if the log is already open, the folder contains another layout, or the
    /// folder cannot be read or written.
    pub fn open(
        folder: &Path,
        layout: LogLayout,
        settings: LogSettings,
    ) -> Result<(Self, OpenedLog), RecordError> {
        let created = DirBuilder::new()
            .recursive(true)
            .mode(FOLDER_MODE)
            .create(folder);
        created.map_err(|source| RecordError::WriteLog {
            path: folder.to_owned(),
            source,
        })?;
        let note = Note::lock(folder)?;
        let shared = Arc::new(Folder::read(folder)?);
        if shared.names().is_empty() {
            // The names of the folder and of those above it need a sync, too. An unreadable one
            // must not prevent logging.
            for above in folder.ancestors().skip(1) {
                let _ = sync_folder(above);
            }
        }
        let stated = StatedLayout {
            layout,
            boot_id: layout::boot_id(),
        };
        let found = opening::newest(&shared, &stated)?;
        // A segment may have ended properly because it was full, while a power failure lost the
        // next one.
        let was_closed = found.was_closed && note.allows_closed();
        let opened = OpenedLog {
            was_closed,
            is_complete: note.is_complete(),
            ..found
        };
        let limits = Limits::new(&settings).first_of(&stated.layout.structure);
        let end = opened.last.as_ref().map(LogEnd::of);
        let newest_ns = opened.last.as_ref().map(LoggedFrames::last_time_ns);
        let log = Self {
            folder: shared,
            stated,
            settings,
            end,
            segment: None,
            segment_start_ns: 0,
            limits,
            syncer: LogSyncer::new(folder),
            note,
        };
        if let Some(newest_ns) = newest_ns {
            log.delete_older_than(newest_ns)?;
        }
        log.delete_beyond_size()?;
        Ok((log, opened))
    }

    /// Appends blocks as one chunk, either completely or not at all. On return, the operating
    /// system has accepted the data.
    ///
    /// Skips frames that the log already contains. Skips blocks without frames unless they end the
    /// epoch.
    ///
    /// # Errors
    /// After an error, the log contains none of the blocks. A block does not match the layout, or
    /// belongs to a lower epoch than the last or to an epoch that has ended. Or the file cannot be
    /// written; the next append then begins a new file.
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
            // An incomplete end is cut off again if the disk is full. No frames are lost.
            let _ = self.end_segment();
            self.limits = Limits::new(&self.settings);
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
        // A failed deletion must not prevent logging. It is retried later.
        if begins {
            let _ = self.delete_older_than(newest_ns);
        }
        let _ = self.delete_beyond_size();
        Ok(())
    }

    /// Returns `true` if the open files are no longer at their paths. They were moved or deleted,
    /// or their disk is not mounted. Frames appended then are missing from the folder.
    #[must_use]
    pub fn is_lost(&self) -> bool {
        let is_there =
            self.note.is_in_place() && self.segment.as_ref().is_none_or(OpenSegment::is_in_place);
        !is_there
    }

    /// Saves a mark on disk that shows after a crash whether the log contains all published frames.
    /// An incomplete log can be marked even on a full disk.
    ///
    /// # Errors
    /// Returns an error if the mark cannot be written.
    pub fn note_complete(&mut self, is_complete: bool) -> Result<(), RecordError> {
        self.note.complete(is_complete)
    }

    /// Returns a handle that syncs the log to disk from any thread.
    pub fn syncer(&self) -> LogSyncer {
        self.syncer.clone()
    }

    /// Returns a reader of the log for any thread.
    pub fn reader(&self) -> FrameLogReader {
        FrameLogReader::new(Arc::clone(&self.folder))
    }

    /// Closes the last segment with index and footer, and waits until all data is synced to disk.
    ///
    /// # Errors
    /// Returns an error if the disk is full or reports another error. The log still contains all
    /// frames.
    pub fn close(mut self) -> Result<(), RecordError> {
        self.end_segment()?;
        self.syncer.sync()?;
        self.note.closed()
    }

    /// Returns the blocks, or parts of blocks, that the log does not contain yet, and the end of
    /// the log after them.
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
                    let allowed = format!("at least {}, the epoch of the last frames", end.epoch);
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
                            format!("below {}, where epoch {} ended", end.next, end.epoch);
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

    /// Returns `true` if a frame at `time_ns` (ns) must begin a new segment.
    fn is_full(&self, time_ns: i64) -> bool {
        let Some(segment) = &self.segment else {
            return false;
        };
        let lasts_ns = u64::try_from(time_ns.saturating_sub(self.segment_start_ns)).unwrap_or(0);
        segment.bytes() >= self.limits.bytes
            || u64::from(segment.chunks()) >= self.limits.chunks
            || lasts_ns >= self.limits.span_ns
    }

    /// Closes the current segment, if there is one.
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

    /// Removes an incomplete chunk from the end of a segment.
    fn cut_back(&self, segment: OpenSegment) {
        let (name, bytes) = (segment.name(), segment.bytes());
        // If this fails, an incomplete chunk remains after the last complete one. Readers ignore
        // it.
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

    /// Deletes the oldest segments while the total size exceeds the limit, but never the newest
    /// one.
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

    /// Deletes the oldest segments that are too old.
    ///
    /// A segment is too old by its modification time, and the times of its frames must not
    /// contradict that. A jump of either clock therefore deletes nothing. The start of the
    /// next segment marks the end of a segment. Frames later than `newest_ns` have a wrong time.
    fn delete_older_than(&self, newest_ns: i64) -> Result<(), RecordError> {
        let keep_ns =
            i64::try_from(self.settings.keep_s.saturating_mul(NANOSECONDS)).unwrap_or(i64::MAX);
        let first_kept_ns = newest_ns.saturating_sub(keep_ns);
        let names = self.folder.names();
        let Some(latest) = names.last().and_then(|name| self.folder.written_at(*name)) else {
            return Ok(());
        };
        let is_written_long_ago = |name: SegmentName| {
            let age = self
                .folder
                .written_at(name)
                .and_then(|at| latest.duration_since(at).ok());
            age.is_some_and(|age| age.as_secs() >= self.settings.keep_s)
        };
        let is_recent = |start_ns: i64| (first_kept_ns..=newest_ns).contains(&start_ns);
        let is_too_old = |pair: &&[SegmentName]| match pair {
            [name, next] => {
                is_written_long_ago(*name)
                    && !opening::start_ns(&self.folder, *next).is_some_and(is_recent)
            }
            _ => false,
        };
        let over = names.windows(2).take_while(is_too_old).count();
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

/// Returns `true` if a file name is that of a segment.
pub(crate) fn is_segment(file_name: &str) -> bool {
    SegmentName::parse(file_name).is_some()
}

/// Checks that no process has the log of a folder open. The folder may be missing.
///
/// # Errors
/// Returns an error if another process has the log open, or if the lock file cannot be opened.
pub fn check_unused(folder: &Path) -> Result<(), RecordError> {
    match folder.is_dir() {
        true => Note::lock(folder).map(drop),
        false => Ok(()),
    }
}

/// Returns `true` if a file name is that of the lock file, which is not part of the recording.
pub(crate) fn is_lock(file_name: &str) -> bool {
    file_name == note::LOCK
}

#[cfg(test)]
mod tests;
