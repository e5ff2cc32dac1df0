//! The mark in the lock file, which shows after a crash whether the log can be trusted.

use std::fs::{File, OpenOptions, TryLockError};
use std::os::unix::fs::{FileExt, OpenOptionsExt as _};
use std::path::{Path, PathBuf};

use super::FILE_MODE;
use super::segment::is_at;
use crate::RecordError;

/// Name of the lock file.
pub(super) const LOCK: &str = "lock";

/// The content of the lock file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Noted {
    /// No mark: the log is new, or an earlier version wrote it.
    Nothing,
    /// The log is being written, or was when it was interrupted.
    Written,
    /// The log is being written, and contains all published frames.
    Complete,
    /// The log was closed.
    Closed,
    /// The log lacks published frames. A word truncated to its first letter represents this state,
    /// because a file can be truncated even on a full disk.
    Incomplete,
}

impl Noted {
    const WORDS: [(Self, &'static [u8]); 3] = [
        (Self::Written, b"written"),
        (Self::Complete, b"complete"),
        (Self::Closed, b"closed"),
    ];

    fn of(text: &[u8]) -> Self {
        match text {
            [] => Self::Nothing,
            [_] => Self::Incomplete,
            // A mixture of two words results from an interrupted write.
            _ => Self::WORDS
                .iter()
                .find(|(_, word)| *word == text)
                .map_or(Self::Written, |(noted, _)| *noted),
        }
    }
}

/// The lock file and its current mark.
#[derive(Debug)]
pub(super) struct Note {
    file: File,
    path: PathBuf,
    noted: Noted,
}

impl Note {
    /// Locks a folder, and reads the last mark.
    pub(super) fn lock(folder: &Path) -> Result<Self, RecordError> {
        let path = folder.join(LOCK);
        let failed = |source| RecordError::WriteLog {
            path: path.clone(),
            source,
        };
        let opened = OpenOptions::new()
            .create(true)
            .read(true)
            .write(true)
            .truncate(false)
            .mode(FILE_MODE)
            .open(&path);
        let file = opened.map_err(failed)?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                return Err(RecordError::LogInUse {
                    folder: folder.to_owned(),
                });
            }
            Err(TryLockError::Error(source)) => return Err(failed(source)),
        }
        let mut text = [0; 16];
        let length = file.read_at(&mut text, 0).map_err(failed)?;
        Ok(Self {
            file,
            noted: Noted::of(&text[..length]),
            path,
        })
    }

    /// Returns `true` if the path still leads to this file.
    pub(super) fn is_in_place(&self) -> bool {
        is_at(&self.file, &self.path)
    }

    /// Returns whether the log contains all published frames, or `None` if that is unknown.
    pub(super) fn is_complete(&self) -> Option<bool> {
        match self.noted {
            Noted::Nothing | Noted::Written => None,
            Noted::Complete | Noted::Closed => Some(true),
            Noted::Incomplete => Some(false),
        }
    }

    /// Returns `true` if the log may have been closed, provided that its segments are in order. An
    /// earlier version left no mark.
    pub(super) fn allows_closed(&self) -> bool {
        matches!(self.noted, Noted::Nothing | Noted::Closed)
    }

    /// Marks the log as being written, if it is marked as closed or has no mark.
    pub(super) fn written(&mut self) -> Result<(), RecordError> {
        match self.allows_closed() {
            true => self.note(Noted::Written),
            false => Ok(()),
        }
    }

    pub(super) fn complete(&mut self, is_complete: bool) -> Result<(), RecordError> {
        self.note(if is_complete {
            Noted::Complete
        } else {
            Noted::Incomplete
        })
    }

    /// Marks the log as closed, unless it is incomplete.
    pub(super) fn closed(&mut self) -> Result<(), RecordError> {
        match self.noted {
            Noted::Incomplete => Ok(()),
            _ => self.note(Noted::Closed),
        }
    }

    fn note(&mut self, noted: Noted) -> Result<(), RecordError> {
        let word = Noted::WORDS
            .iter()
            .find(|(known, _)| *known == noted)
            .map(|(_, word)| *word);
        let written = match word {
            Some(word) => self
                .file
                .write_all_at(word, 0)
                .and_then(|()| self.file.set_len(word.len() as u64)),
            None => self.file.set_len(1),
        };
        let forced = written.and_then(|()| self.file.sync_data());
        forced.map_err(|source| RecordError::WriteLog {
            path: self.path.clone(),
            source,
        })?;
        self.noted = noted;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn written_note_is_read_back_and_an_incomplete_word_is_ignored() {
        let folder = tempfile::tempdir().unwrap();
        let note = || Note::lock(folder.path()).unwrap();
        let found = |note: &Note| (note.is_complete(), note.allows_closed());
        assert_eq!(
            found(&note()),
            (None, true),
            "as an earlier version left it"
        );
        note().written().unwrap();
        assert_eq!(found(&note()), (None, false));
        note().closed().unwrap();
        assert_eq!(found(&note()), (Some(true), true));
        note().complete(true).unwrap();
        note().written().unwrap();
        assert_eq!(
            found(&note()),
            (Some(true), false),
            "complete, and not closed"
        );
        note().complete(false).unwrap();
        note().closed().unwrap();
        note().written().unwrap();
        assert_eq!(
            found(&note()),
            (Some(false), false),
            "it lacks what it lacks"
        );
        std::fs::write(folder.path().join(LOCK), "writlete").unwrap();
        assert_eq!(found(&note()), (None, false));
    }
}
