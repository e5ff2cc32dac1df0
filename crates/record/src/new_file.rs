//! Writes a file that replaces an existing one only when it is complete.

use crate::RecordError;
use std::ffi::OsString;
use std::fs::File;
use std::io::{self, BufWriter, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// Ending of the name of an incomplete file.
const ENDING: &str = ".new";

/// A file that receives its name when it is complete.
///
/// Until [`NewFile::finish`], the data are in a file beside it, whose name has the ending `.new`.
/// An existing file therefore keeps its content if something fails. A file that is dropped before
/// is removed.
///
/// A pipe, a device or a symbolic link is written directly.
#[derive(Debug)]
#[must_use = "the file is removed if it is not finished"]
pub struct NewFile {
    path: PathBuf,
    /// Name of the incomplete file. `None` if `path` is written directly.
    beside: Option<PathBuf>,
    file: File,
}

impl NewFile {
    /// Creates the file beside `path`, with the permissions of an existing file.
    ///
    /// # Errors
    /// Returns an error if the file cannot be created.
    pub fn create(path: &Path) -> io::Result<Self> {
        let existing = path.symlink_metadata().ok();
        let is_replaced = existing.as_ref().is_none_or(|found| found.is_file());
        let beside = path.file_name().filter(|_| is_replaced).map(|name| {
            let mut name = OsString::from(name);
            name.push(ENDING);
            path.with_file_name(name)
        });
        let file = File::create(beside.as_deref().unwrap_or(path))?;
        let new = Self {
            path: path.to_owned(),
            beside,
            file,
        };
        if let (Some(found), Some(_)) = (existing, &new.beside) {
            new.file.set_permissions(found.permissions())?;
        }
        Ok(new)
    }

    /// Syncs the file to disk and gives it its name.
    ///
    /// # Errors
    /// Returns an error if the file cannot be synced or renamed. An existing file is then
    /// unchanged.
    pub fn finish(mut self) -> io::Result<()> {
        let Some(beside) = &self.beside else {
            return self.file.flush();
        };
        self.file.sync_all()?;
        std::fs::rename(beside, &self.path)?;
        self.beside = None;
        // After a power failure, a folder without sync can lead to the old file, but not to a part
        // of the new one.
        let folder = self.path.parent().filter(|path| path != &Path::new(""));
        let _ = File::open(folder.unwrap_or(Path::new("."))).and_then(|folder| folder.sync_all());
        Ok(())
    }
}

/// As [`NewFile::create`], with the error of the crate.
pub(crate) fn create(path: &Path) -> Result<NewFile, RecordError> {
    NewFile::create(path).map_err(|source| RecordError::Open {
        path: path.to_owned(),
        source,
    })
}

/// As [`NewFile::finish`], with the error of the crate.
pub(crate) fn finish(file: NewFile) -> Result<(), RecordError> {
    let path = file.path.clone();
    let finished = file.finish();
    finished.map_err(|source| RecordError::WriteLog { path, source })
}

/// Flushes the buffer before [`finish`].
pub(crate) fn finish_buffered(output: BufWriter<NewFile>) -> Result<(), RecordError> {
    let path = output.get_ref().path.clone();
    let file = output.into_inner();
    finish(file.map_err(|error| RecordError::WriteLog {
        path,
        source: error.into_error(),
    })?)
}

/// Writes a file that is either complete or unchanged.
///
/// # Errors
/// Returns an error if the file cannot be written. An existing file is then unchanged.
pub fn write_whole(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut file = NewFile::create(path)?;
    file.write_all(bytes)?;
    file.finish()
}

impl Write for NewFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.file.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

impl Seek for NewFile {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.file.seek(to)
    }
}

impl Drop for NewFile {
    fn drop(&mut self) {
        if let Some(beside) = &self.beside {
            let _ = std::fs::remove_file(beside);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Read as _;
    use std::os::unix::fs::PermissionsExt as _;

    fn names(folder: &Path) -> Vec<OsString> {
        let entries = std::fs::read_dir(folder).unwrap();
        entries.map(|entry| entry.unwrap().file_name()).collect()
    }

    #[test]
    fn existing_file_keeps_its_content_until_the_new_one_is_complete() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out.csv");
        std::fs::write(&path, "before").unwrap();
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o640)).unwrap();
        let mut file = NewFile::create(&path).unwrap();
        file.write_all(b"half").unwrap();
        drop(file);
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "before");
        assert_eq!(names(folder.path()), ["out.csv"]);
        write_whole(&path, b"after").unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "after");
        assert_eq!(names(folder.path()), ["out.csv"]);
        let mode = path.metadata().unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o640);
    }

    #[test]
    fn pipe_and_link_are_written_directly() {
        let folder = tempfile::tempdir().unwrap();
        let pipe = folder.path().join("pipe");
        let made = std::process::Command::new("mkfifo").arg(&pipe).status();
        assert!(made.unwrap().success());
        let reader = std::thread::spawn({
            let pipe = pipe.clone();
            move || {
                let mut text = String::new();
                File::open(pipe).unwrap().read_to_string(&mut text).unwrap();
                text
            }
        });
        write_whole(&pipe, b"through the pipe").unwrap();
        assert_eq!(reader.join().unwrap(), "through the pipe");
        let (link, target) = (folder.path().join("link"), folder.path().join("target"));
        std::fs::write(&target, "before").unwrap();
        std::os::unix::fs::symlink(&target, &link).unwrap();
        write_whole(&link, b"after").unwrap();
        assert_eq!(std::fs::read_to_string(&target).unwrap(), "after");
        assert!(link.is_symlink());
    }
}
