//! Estimate of a recording's length before it is read, for a progress bar.

use spandrel_record::Format;
use std::io::Read;
use std::path::Path;

/// Number of bytes at the start of a recording in which rows are counted.
const COUNTED_BYTES: u64 = 1 << 16;

/// Estimates the number of rows of a table from its size and the length of its first rows.
///
/// The result suffices for a progress bar. Returns `None` for other formats.
pub fn expected_rows(path: &Path) -> Option<u64> {
    let file = std::fs::File::open(path).ok()?;
    let size = file.metadata().ok()?.len();
    let mut head = Vec::new();
    file.take(COUNTED_BYTES).read_to_end(&mut head).ok()?;
    if Format::of(&head, path) != Some(Format::Table) {
        return None;
    }
    let rows = head.iter().filter(|byte| **byte == b'\n').count() as u64;
    (rows > 0).then(|| (rows as f64 * (size as f64 / head.len() as f64)) as u64)
}
