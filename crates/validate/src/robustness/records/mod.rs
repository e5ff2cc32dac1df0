//! The records of three real structures: what Spandrel says of them, and whether that is right.
//!
//! Every record goes through the cores of the services with the settings of one file per structure. No setting depends on the
//! record. Where the records are missing, the rows say so.
//!
//! - `course`: one record through alignment, identification and decision
//! - `batch_fit`: the same model fitted to a whole record without a filter, and records of a damaged structure
//! - `pairs`: differences of two records in units of what they state
//! - `shake_table`, `bridge`, `tower`: the structures
//! - `mistakes`: records that are read in a wrong way

mod batch_fit;
mod bridge;
mod course;
mod error;
mod mistakes;
mod pairs;
mod row;
mod shake_table;
mod tower;

pub use error::RecordsError;
pub use row::Row;

use std::path::Path;

/// Runs all real records below `data`, and calls `done` with each row as soon as it is known.
///
/// # Errors
/// When a record that is there cannot be read or identified.
pub fn real_records(data: &Path, mut done: impl FnMut(&Row)) -> Result<Vec<Row>, RecordsError> {
    let mut all = Vec::new();
    let parts = [shake_table::rows, mistakes::rows, tower::rows, bridge::rows];
    for part in parts {
        let rows = part(data)?;
        rows.iter().for_each(&mut done);
        all.extend(rows);
    }
    Ok(all)
}

/// Replaces each text by another; all of them must be there.
fn replaced(file: &str, changes: &[(&str, &str)]) -> Result<String, RecordsError> {
    let mut text = file.to_owned();
    for (from, to) in changes {
        if !text.contains(from) {
            return Err(RecordsError::NoSuchText {
                expected: (*from).to_owned(),
            });
        }
        text = text.replace(from, to);
    }
    Ok(text)
}
