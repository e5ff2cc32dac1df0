//! The segments of a folder and the indices of their frames.

use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::SystemTime;

use super::chunk::Entry;
use super::scan::{Scan, scan};
use super::segment::SegmentName;
use crate::RecordError;

/// Maximum number of indices of older segments in memory, with the least recently used evicted
/// first.
const INDICES_KEPT: usize = 4;

/// State shared by the writer and the readers of a log.
#[derive(Debug)]
pub(super) struct Folder {
    path: PathBuf,
    segments: Mutex<Segments>,
}

/// The sizes of all segments, and the indices of some of them.
#[derive(Debug, Default)]
pub(super) struct Segments {
    sizes: BTreeMap<SegmentName, u64>,
    bytes: u64,
    /// The segment being written, with its index.
    written: Option<(SegmentName, Vec<Entry>)>,
    /// Indices of other segments, with the most recently used one last.
    kept: VecDeque<(SegmentName, Arc<Vec<Entry>>)>,
}

impl Folder {
    /// Finds the segments of a folder by their file names.
    pub(super) fn read(path: &Path) -> Result<Self, RecordError> {
        let failed = |source| RecordError::ReadFile {
            path: path.to_owned(),
            source,
        };
        let mut segments = Segments::default();
        for entry in std::fs::read_dir(path).map_err(failed)? {
            let entry = entry.map_err(failed)?;
            if let Some(name) = entry.file_name().to_str().and_then(SegmentName::parse) {
                segments.set_size(name, entry.metadata().map_err(failed)?.len());
            }
        }
        Ok(Self {
            path: path.to_owned(),
            segments: Mutex::new(segments),
        })
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    pub(super) fn segments(&self) -> MutexGuard<'_, Segments> {
        self.segments.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the first segment that may contain the frame `sequence` or a later one.
    pub(super) fn segment_at(&self, epoch: u64, sequence: u64) -> Option<SegmentName> {
        let sizes = &self.segments().sizes;
        let place = SegmentName { epoch, sequence };
        let before = sizes.range(..=place).next_back();
        before
            .or_else(|| sizes.range(place..).next())
            .map(|(name, _)| *name)
    }

    /// Returns the segment after `name`.
    pub(super) fn segment_after(&self, name: SegmentName) -> Option<SegmentName> {
        use std::ops::Bound::{Excluded, Unbounded};
        self.segments()
            .sizes
            .range((Excluded(name), Unbounded))
            .next()
            .map(|(name, _)| *name)
    }

    pub(super) fn names(&self) -> Vec<SegmentName> {
        self.segments().sizes.keys().copied().collect()
    }

    /// Applies `take` to the index of a segment. Returns `None` if the segment has been deleted.
    pub(super) fn with_index<T>(
        &self,
        name: SegmentName,
        take: impl Fn(&[Entry]) -> T,
    ) -> Result<Option<T>, RecordError> {
        {
            let mut segments = self.segments();
            if let Some((_, entries)) = segments
                .written
                .as_ref()
                .filter(|(written, _)| *written == name)
            {
                return Ok(Some(take(entries)));
            }
            if let Some(entries) = segments.kept_index(name) {
                drop(segments);
                return Ok(Some(take(&entries)));
            }
        }
        // Scanning takes time, so the lock is released for the writer.
        let entries = match scan(&name.path(&self.path)) {
            Ok(Scan { entries, .. }) => Arc::new(entries),
            Err(error) if is_gone(&error) => return Ok(None),
            Err(error) => return Err(error),
        };
        self.segments().keep_index(name, Arc::clone(&entries));
        Ok(Some(take(&entries)))
    }

    /// Returns when a segment was last written, by the clock of this machine at that time.
    pub(super) fn written_at(&self, name: SegmentName) -> Option<SystemTime> {
        let file = std::fs::metadata(name.path(&self.path));
        file.and_then(|file| file.modified()).ok()
    }

    /// Deletes a segment. It is not an error if the file does not exist.
    pub(super) fn delete(&self, name: SegmentName) -> Result<(), RecordError> {
        let path = name.path(&self.path);
        match std::fs::remove_file(&path) {
            Err(source) if source.kind() != std::io::ErrorKind::NotFound => {
                Err(RecordError::WriteLog { path, source })
            }
            _ => {
                self.segments().forget(name);
                Ok(())
            }
        }
    }
}

/// Returns `true` if a file does not exist. Retention may delete a segment just before it is read.
pub(super) fn is_gone(error: &RecordError) -> bool {
    matches!(error, RecordError::Open { source, .. } if source.kind() == std::io::ErrorKind::NotFound)
}

impl Segments {
    pub(super) fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Returns all segments except the one being written, oldest first.
    pub(super) fn oldest(&self) -> impl Iterator<Item = SegmentName> {
        let written = self.written.as_ref().map(|(name, _)| *name);
        self.sizes
            .keys()
            .copied()
            .filter(move |name| Some(*name) != written)
    }

    pub(super) fn newest(&self) -> Option<SegmentName> {
        self.sizes.last_key_value().map(|(name, _)| *name)
    }

    pub(super) fn set_size(&mut self, name: SegmentName, bytes: u64) {
        let before = self.sizes.insert(name, bytes).unwrap_or(0);
        self.bytes = self.bytes - before + bytes;
    }

    pub(super) fn forget(&mut self, name: SegmentName) {
        self.bytes -= self.sizes.remove(&name).unwrap_or(0);
        self.kept.retain(|(kept, _)| *kept != name);
        self.written.take_if(|(written, _)| *written == name);
    }

    /// Returns the index of the segment being written, and starts a new index if the segment has
    /// changed.
    pub(super) fn index_of_written(&mut self, name: SegmentName) -> &mut Vec<Entry> {
        if self
            .written
            .as_ref()
            .is_none_or(|(written, _)| *written != name)
        {
            self.end_written();
        }
        &mut self.written.get_or_insert_with(|| (name, Vec::new())).1
    }

    /// Moves the segment being written to the older segments.
    pub(super) fn end_written(&mut self) {
        if let Some((name, entries)) = self.written.take() {
            self.keep_index(name, Arc::new(entries));
        }
    }

    fn kept_index(&mut self, name: SegmentName) -> Option<Arc<Vec<Entry>>> {
        let place = self.kept.iter().position(|(kept, _)| *kept == name)?;
        let used = self.kept.remove(place)?;
        let entries = Arc::clone(&used.1);
        self.kept.push_back(used);
        Some(entries)
    }

    pub(super) fn keep_index(&mut self, name: SegmentName, entries: Arc<Vec<Entry>>) {
        if !self.sizes.contains_key(&name) {
            // The segment has been deleted in the meantime.
            return;
        }
        self.kept.retain(|(kept, _)| *kept != name);
        self.kept.push_back((name, entries));
        if self.kept.len() > INDICES_KEPT {
            self.kept.pop_front();
        }
    }
}
