//! Limits the length of a row of a table, because a file without line breaks is one row.

use std::io::{self, Read};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

/// Maximum length of a row, in bytes: a hundred bytes for each of [`MOST_COLUMNS`].
pub(crate) const MOST_ROW_BYTES: usize = 1 << 20;

/// Maximum number of columns of a table. Recorders with thousands of channels, such as optical
/// fibres, stay below it.
pub(crate) const MOST_COLUMNS: usize = 10_000;

/// Number of bytes that the readers of a table read ahead of the current row.
const READ_AHEAD_BYTES: usize = 2 * 64 * 1024;

/// The number of bytes read since the last complete row.
///
/// Clones share the number.
#[derive(Debug, Clone, Default)]
pub(crate) struct RowLimit {
    since_row: Arc<AtomicUsize>,
}

/// A reader that fails as soon as a row exceeds the limit.
pub(crate) struct LimitedRows<R> {
    input: R,
    limit: RowLimit,
}

impl RowLimit {
    /// Returns a reader of `input` with this limit.
    pub(crate) fn of<R>(&self, input: R) -> LimitedRows<R> {
        LimitedRows {
            input,
            limit: self.clone(),
        }
    }

    /// Begins a new row.
    pub(crate) fn complete_row(&self) {
        self.since_row.store(0, Relaxed);
    }

    /// Returns `true` if the current row exceeds the limit.
    pub(crate) fn is_exceeded(&self) -> bool {
        self.since_row.load(Relaxed) > MOST_ROW_BYTES + READ_AHEAD_BYTES
    }
}

impl<R: Read> Read for LimitedRows<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if self.limit.is_exceeded() {
            return Err(io::Error::other("a row is too long"));
        }
        let count = self.input.read(buffer)?;
        self.limit.since_row.fetch_add(count, Relaxed);
        Ok(count)
    }
}
