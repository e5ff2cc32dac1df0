//! The length of a recording before it is read, for a progress bar.

use spandrel_record::Format;
use std::io::Read;
use std::path::Path;

/// Bytes at the head of a recording by which its rows are counted.
const COUNTED_BYTES: u64 = 1 << 16;

/// Guesses how many rows a table has, by its size and the length of its first rows: good enough for a progress bar. `None` for
/// other formats.
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
