//! The segment that is being written, and the names of segments.

use std::borrow::Cow;
use std::fs::{File, OpenOptions};
use std::io::{Seek, SeekFrom, Write};
use std::os::unix::fs::{MetadataExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::chunk::{RECORD_HEAD_BYTES, record_head};
use super::layout::StatedLayout;
use super::records::{put_begin, put_chunk, write_end};
use super::scan::mended_end;
use super::{FILE_MODE, LoggedFrames};
use crate::RecordError;

/// The name of a segment: epoch and sequence number of its first frame. The order of names is the
/// order of segments.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct SegmentName {
    pub(super) epoch: u64,
    pub(super) sequence: u64,
}

const PREFIX: &str = "frames-";
const SUFFIX: &str = ".mcap";
/// Extension appended to the name of an unreadable segment.
const SET_ASIDE: &str = "unreadable";

impl SegmentName {
    pub(super) fn of(frames: &LoggedFrames) -> Self {
        Self {
            epoch: frames.epoch,
            sequence: frames.sequence,
        }
    }

    pub(super) fn parse(file_name: &str) -> Option<Self> {
        let numbers = file_name.strip_prefix(PREFIX)?.strip_suffix(SUFFIX)?;
        let (epoch, sequence) = numbers.split_once('-')?;
        let number = |text: &str| {
            text.bytes()
                .all(|byte| byte.is_ascii_digit())
                .then(|| text.parse().ok())
                .flatten()
        };
        let name = Self {
            epoch: number(epoch)?,
            sequence: number(sequence)?,
        };
        (name.file_name() == file_name).then_some(name)
    }

    pub(super) fn file_name(self) -> String {
        format!("{PREFIX}{:020}-{:020}{SUFFIX}", self.epoch, self.sequence)
    }

    pub(super) fn path(self, folder: &Path) -> PathBuf {
        folder.join(self.file_name())
    }
}

/// Renames an unreadable segment, so that it is neither read again nor lost. Returns its new path.
pub(super) fn set_aside(path: &Path) -> Result<PathBuf, RecordError> {
    let mut aside = PathBuf::from(format!("{}.{SET_ASIDE}", path.display()));
    let mut again = 1;
    while aside.exists() {
        again += 1;
        aside = PathBuf::from(format!("{}.{again}.{SET_ASIDE}", path.display()));
    }
    std::fs::rename(path, &aside).map_err(|source| RecordError::WriteLog {
        path: path.to_owned(),
        source,
    })?;
    Ok(aside)
}

/// Cuts a segment after its last intact chunk, and ends it so that any MCAP reader can open it.
/// Returns the new length.
pub(super) fn mend(path: &Path, whole: u64) -> Result<u64, RecordError> {
    let failed = |source| RecordError::WriteLog {
        path: path.to_owned(),
        source,
    };
    let mut file = OpenOptions::new().write(true).open(path).map_err(failed)?;
    let mended = end_at(&mut file, whole).and_then(|bytes| file.sync_all().map(|()| bytes));
    mended.map_err(failed)
}

/// Cuts the file to `whole` bytes and writes the end. Returns the new length. If the end does not
/// fit on the disk, it is omitted.
fn end_at(file: &mut File, whole: u64) -> std::io::Result<u64> {
    file.set_len(whole)?;
    file.seek(SeekFrom::Start(whole))?;
    let end = mended_end();
    match file.write_all(&end) {
        Ok(()) => Ok(whole + end.len() as u64),
        // The segment is readable without an end, and the next opening of the log repairs it.
        Err(_) => file.set_len(whole).map(|()| whole),
    }
}

/// Returns `true` if a path leads to an open file.
pub(super) fn is_at(file: &File, path: &Path) -> bool {
    let identity = |metadata: std::fs::Metadata| (metadata.dev(), metadata.ino());
    let (open, found) = (file.metadata().map(identity), path.metadata().map(identity));
    matches!((open, found), (Ok(open), Ok(found)) if open == found)
}

/// A segment that is being written.
pub(super) struct OpenSegment {
    name: SegmentName,
    path: PathBuf,
    file: Arc<File>,
    messages: u32,
    chunks: u32,
    /// Length of the file up to the end of its last chunk, in bytes.
    bytes: u64,
}

impl OpenSegment {
    /// Creates an empty file. The first append writes the beginning together with the first chunk.
    ///
    /// An existing file of this name contains nothing readable and is renamed.
    pub(super) fn create(folder: &Path, name: SegmentName) -> Result<Self, RecordError> {
        let path = name.path(folder);
        let create = || {
            let mut options = OpenOptions::new();
            options.write(true).create_new(true).mode(FILE_MODE);
            options.open(&path)
        };
        let created = match create() {
            Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => {
                set_aside(&path)?;
                create()
            }
            created => created,
        };
        let file = created.map_err(|source| RecordError::WriteLog {
            path: path.clone(),
            source,
        })?;
        Ok(Self {
            name,
            path,
            file: Arc::new(file),
            messages: 0,
            chunks: 0,
            bytes: 0,
        })
    }

    pub(super) fn name(&self) -> SegmentName {
        self.name
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    pub(super) fn file(&self) -> &Arc<File> {
        &self.file
    }

    /// Returns `true` if the path still leads to this file.
    pub(super) fn is_in_place(&self) -> bool {
        is_at(&self.file, &self.path)
    }

    pub(super) fn bytes(&self) -> u64 {
        self.bytes
    }

    pub(super) fn chunks(&self) -> u32 {
        self.chunks
    }

    /// Writes a chunk, and returns offset and length of its record. After an error, the caller must
    /// cut the segment back.
    pub(super) fn append(
        &mut self,
        blocks: &[Cow<'_, LoggedFrames>],
        stated: &StatedLayout,
    ) -> Result<(u64, u64), RecordError> {
        let refused = |source| RecordError::WriteLog {
            path: self.path.clone(),
            source,
        };
        let is_first = self.chunks == 0;
        // A single write passes the whole chunk to the file.
        let mut out = Vec::new();
        if is_first {
            put_begin(&mut out).map_err(refused)?;
        }
        let before = out.len();
        put_chunk(&mut out, is_first.then_some(stated), blocks, self.messages).map_err(refused)?;
        (&*self.file).write_all(&out).map_err(refused)?;
        let length =
            record_head(&out[before..]).map_or(0, |(_, length)| RECORD_HEAD_BYTES + length);
        let offset = self.bytes + before as u64;
        self.messages = self.messages.wrapping_add(blocks.len() as u32);
        self.bytes += out.len() as u64;
        self.chunks += 1;
        Ok((offset, length))
    }

    /// Writes index and footer, and returns the length of the file. After an error, the incomplete
    /// end is removed.
    pub(super) fn finish(self, stated: &StatedLayout) -> Result<u64, RecordError> {
        match write_end(&self.path, &self.file, self.bytes, stated) {
            Ok(bytes) => Ok(bytes),
            Err(source) => {
                let path = self.path.clone();
                self.cut_back()?;
                Err(RecordError::WriteLog { path, source })
            }
        }
    }

    /// Cuts the file after its last complete chunk and ends it. Removes a file without chunks.
    /// Returns the new length.
    pub(super) fn cut_back(self) -> Result<u64, RecordError> {
        let Self {
            path,
            file,
            bytes,
            chunks,
            ..
        } = self;
        let done = match chunks {
            0 => std::fs::remove_file(&path).map(|()| 0),
            _ => file
                .try_clone()
                .and_then(|mut file| end_at(&mut file, bytes)),
        };
        done.map_err(|source| RecordError::WriteLog { path, source })
    }
}
