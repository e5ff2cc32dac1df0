//! Syncs the frame log to disk, on a thread that may block.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::RecordError;

/// A handle that syncs appended data of a frame log to disk.
#[derive(Debug, Clone)]
pub struct LogSyncer {
    shared: Arc<Shared>,
}

#[derive(Debug)]
struct Shared {
    folder: PathBuf,
    unsynced: Mutex<Unsynced>,
    /// Lock held during a sync. A second call must not return before the first one has finished.
    turn: Mutex<()>,
}

#[derive(Debug, Default)]
struct Unsynced {
    files: Vec<(PathBuf, Arc<File>)>,
    has_new_file: bool,
}

impl LogSyncer {
    pub(super) fn new(folder: &Path) -> Self {
        let shared = Shared {
            folder: folder.to_owned(),
            unsynced: Mutex::default(),
            turn: Mutex::default(),
        };
        Self {
            shared: Arc::new(shared),
        }
    }

    /// Waits until all data appended before this call is synced to disk. Returns immediately if it
    /// already is.
    ///
    /// # Errors
    /// Returns an error if syncing failed. The next call retries the files. The data may still be
    /// lost, because some operating systems report such an error only once.
    pub fn sync(&self) -> Result<(), RecordError> {
        let _turn = self
            .shared
            .turn
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        let unsynced = std::mem::take(&mut *self.unsynced());
        let synced = self.sync_all(&unsynced);
        if synced.is_err() {
            let mut again = self.unsynced();
            for (path, file) in unsynced.files {
                again.add(&path, &file);
            }
            again.has_new_file |= unsynced.has_new_file;
        }
        synced
    }

    fn sync_all(&self, unsynced: &Unsynced) -> Result<(), RecordError> {
        for (path, file) in &unsynced.files {
            file.sync_data().map_err(|source| RecordError::WriteLog {
                path: path.clone(),
                source,
            })?;
        }
        match unsynced.has_new_file {
            true => sync_folder(&self.shared.folder),
            false => Ok(()),
        }
    }

    fn unsynced(&self) -> MutexGuard<'_, Unsynced> {
        self.shared
            .unsynced
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    /// Records that a file has unsynced data.
    pub(super) fn written(&self, path: &Path, file: &Arc<File>) {
        self.unsynced().add(path, file);
    }

    /// Records that the folder has a new file.
    pub(super) fn created(&self) {
        self.unsynced().has_new_file = true;
    }
}

impl Unsynced {
    fn add(&mut self, path: &Path, file: &Arc<File>) {
        if !self.files.iter().any(|(_, known)| Arc::ptr_eq(known, file)) {
            self.files.push((path.to_owned(), Arc::clone(file)));
        }
    }
}

/// Syncs the entries of a folder to disk, so that new file names persist.
pub(super) fn sync_folder(folder: &Path) -> Result<(), RecordError> {
    let synced = File::open(folder).and_then(|folder| folder.sync_all());
    synced.map_err(|source| RecordError::WriteLog {
        path: folder.to_owned(),
        source,
    })
}
