//! The database file. Only its owner has access. This module detects that the file is missing, and
//! renames a corrupt file.

use crate::error::HistoryError;
use jiff::Timestamp;
use spandrel_bus::check_regular_file;
use spandrel_service::Clock;
use std::fs::{DirBuilder, OpenOptions};
use std::io::ErrorKind;
use std::os::unix::fs::{DirBuilderExt as _, MetadataExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};

/// Permissions of the file and of its folder. Only the owner has access.
const FILE_MODE: u32 = 0o600;
const FOLDER_MODE: u32 = 0o700;
/// Endings of the files that SQLite keeps beside a database.
const BESIDE: [&str; 2] = ["-wal", "-shm"];

/// Identity of a file on a disk, independent of its path.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct FileId {
    device: u64,
    inode: u64,
}

impl FileId {
    /// Returns the identity of the file at a path, or `None` if there is no such file.
    pub(super) fn of(path: &Path) -> Option<Self> {
        let metadata = std::fs::metadata(path).ok()?;
        Some(Self {
            device: metadata.dev(),
            inode: metadata.ino(),
        })
    }
}

/// Whether a missing folder of the file may be created.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Folder {
    /// The first start: a missing folder is created.
    Create,
    /// The folder existed before. Its disk may be unmounted, so a missing folder is not created.
    MustExist,
}

/// Creates the file and its folder if they do not exist. Errors of the operating system are more
/// specific than those of SQLite.
pub(super) fn make_file(path: &Path, folder: Folder) -> Result<(), HistoryError> {
    let parent = path
        .parent()
        .filter(|parent| !parent.as_os_str().is_empty());
    if let Some(parent) = parent.filter(|_| folder == Folder::Create) {
        let made = DirBuilder::new()
            .recursive(true)
            .mode(FOLDER_MODE)
            .create(parent);
        made.map_err(|source| HistoryError::Folder {
            path: parent.to_owned(),
            source,
        })?;
    }
    let open = || {
        OpenOptions::new()
            .append(true)
            .create(true)
            .mode(FILE_MODE)
            .open(path)
    };
    let opened = match check_regular_file(path) {
        // The operating system names a folder.
        Err(error) if error.kind() == ErrorKind::NotFound || path.is_dir() => open(),
        checked => checked.and_then(|()| open()),
    };
    opened.map(drop).map_err(|source| HistoryError::File {
        path: path.to_owned(),
        source,
    })
}

/// Renames a corrupt file and the files that SQLite keeps beside it. Returns the new path, whose
/// ending states the time (UTC).
pub(super) fn set_aside(path: &Path) -> Result<PathBuf, HistoryError> {
    let now_ns = Clock::of_machine().now_ns();
    let time = Timestamp::from_nanosecond(i128::from(now_ns)).unwrap_or_default();
    let time = time.strftime("%Y%m%dT%H%M%SZ");
    let mut aside = with_ending(path, &format!(".corrupt-{time}"));
    let mut again = 1;
    while aside.exists() {
        again += 1;
        aside = with_ending(path, &format!(".corrupt-{time}-{again}"));
    }
    std::fs::rename(path, &aside).map_err(|source| HistoryError::File {
        path: path.to_owned(),
        source,
    })?;
    for ending in BESIDE {
        // Usually, neither exists. If one of them stays, SQLite does not use it for another file.
        let _ = std::fs::rename(with_ending(path, ending), with_ending(&aside, ending));
    }
    Ok(aside)
}

fn with_ending(path: &Path, ending: &str) -> PathBuf {
    let mut text = path.as_os_str().to_owned();
    text.push(ending);
    PathBuf::from(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_and_its_folder_are_for_their_owner_alone() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("new/history.sqlite");
        make_file(&path, Folder::Create).unwrap();
        let mode = |path: &Path| std::fs::metadata(path).unwrap().mode() & 0o777;
        assert_eq!(
            (mode(&path), mode(path.parent().unwrap())),
            (FILE_MODE, FOLDER_MODE)
        );
    }

    #[test]
    fn a_file_is_set_aside_with_all_of_its_parts_and_never_over_another_one() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("history.sqlite");
        let put = |text: &str| {
            std::fs::write(&path, text).unwrap();
            std::fs::write(with_ending(&path, "-wal"), text).unwrap();
            set_aside(&path).unwrap()
        };
        let (first, second) = (put("first"), put("second"));
        for (aside, text) in [(&first, "first"), (&second, "second")] {
            assert_eq!(std::fs::read_to_string(aside).unwrap(), text);
            let wal = with_ending(aside, "-wal");
            assert_eq!(std::fs::read_to_string(wal).unwrap(), text);
            let name = aside.file_name().unwrap().to_str().unwrap();
            assert!(name.starts_with("history.sqlite.corrupt-2"), "{name}");
        }
        assert!(!path.exists());
    }

    #[test]
    fn a_folder_that_is_away_is_not_created() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("away/history.sqlite");
        assert!(make_file(&path, Folder::MustExist).is_err());
        assert!(!path.parent().unwrap().exists());
    }
}
