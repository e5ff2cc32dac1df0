//! What is noted in the file that is locked while a log is open: how far the log can be trusted after a crash.

use std::fs::{File, OpenOptions, TryLockError};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use crate::RecordError;

/// Name of the file.
pub(super) const LOCK: &str = "lock";

/// What stands in it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Noted {
    /// Nothing: an earlier version has written the log, or nobody yet.
    Nothing,
    /// It is written, or was when the power went.
    Written,
    /// It is written, and has all frames that others may know of.
    Complete,
    /// It was closed.
    Closed,
    /// It has not all frames that others may know of. A word cut to its first letter says so: a full disk lets a file be cut.
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
            // between two words: it was being written
            _ => Self::WORDS
                .iter()
                .find(|(_, word)| *word == text)
                .map_or(Self::Written, |(noted, _)| *noted),
        }
    }
}

/// The locked file.
#[derive(Debug)]
pub(super) struct Note {
    file: File,
    path: PathBuf,
    noted: Noted,
}

impl Note {
    /// Locks a folder, and reads what was noted last.
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

    /// Whether all frames that others may know of are in the log; none where that was not noted.
    pub(super) fn is_complete(&self) -> Option<bool> {
        match self.noted {
            Noted::Nothing | Noted::Written => None,
            Noted::Complete | Noted::Closed => Some(true),
            Noted::Incomplete => Some(false),
        }
    }

    /// Whether a log whose segments are in order may have been closed. An earlier version did not note that it was.
    pub(super) fn allows_closed(&self) -> bool {
        matches!(self.noted, Noted::Nothing | Noted::Closed)
    }

    /// The log is going to be written.
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

    /// The log is closed; what it lacks, it lacks.
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
    fn what_is_noted_is_read_back_and_half_a_word_is_none() {
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
