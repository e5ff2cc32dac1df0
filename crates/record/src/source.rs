//! The bytes of a file or of a part of an archive: the first bytes, which determine the format, and
//! the rest as a stream.
//!
//! The rest is not read before the first bytes are known to belong to a recording. A huge file of
//! another kind therefore needs neither memory nor time.

use std::fs::File;
use std::io::{self, Cursor, Read};
use std::path::Path;

use crate::RecordError;
use crate::table_layout::HEAD_BYTES;

/// A stream whose first bytes have already been read.
pub(crate) struct Source<'a> {
    head: Vec<u8>,
    rest: Box<dyn Read + Send + 'a>,
}

impl<'a> Source<'a> {
    /// Reads the first bytes of `input`.
    pub(crate) fn new(input: impl Read + Send + 'a) -> io::Result<Self> {
        let mut rest: Box<dyn Read + Send + 'a> = Box::new(input);
        let mut head = Vec::new();
        rest.by_ref().take(HEAD_BYTES).read_to_end(&mut head)?;
        Ok(Self { head, rest })
    }

    /// Opens a file and reads its first bytes.
    ///
    /// # Errors
    /// Returns an error if the file cannot be opened or read, or is a pipe, a device or a socket.
    pub(crate) fn open(path: &Path) -> Result<Self, RecordError> {
        Self::new(open_file(path)?).map_err(|source| RecordError::ReadFile {
            path: path.to_owned(),
            source,
        })
    }

    /// Returns the first bytes.
    pub(crate) fn head(&self) -> &[u8] {
        &self.head
    }

    /// Returns a reader of all bytes.
    pub(crate) fn into_reader(self) -> Box<dyn Read + Send + 'a> {
        Box::new(Cursor::new(self.head).chain(self.rest))
    }

    /// Reads all bytes into memory.
    pub(crate) fn into_bytes(mut self) -> io::Result<Vec<u8>> {
        self.rest.read_to_end(&mut self.head)?;
        Ok(self.head)
    }
}

/// Opens a recording for reading.
///
/// # Errors
/// Returns an error if the file cannot be opened, or is a pipe, a device or a socket. Opening a
/// pipe waits for its writer, and a device such as `/dev/zero` has no end.
pub(crate) fn open_file(path: &Path) -> Result<File, RecordError> {
    let refused = |source| RecordError::Open {
        path: path.to_owned(),
        source,
    };
    let kind = std::fs::metadata(path).map_err(refused)?.file_type();
    if !(kind.is_file() || kind.is_dir()) {
        return Err(RecordError::NotAFile {
            path: path.to_owned(),
        });
    }
    File::open(path).map_err(refused)
}
