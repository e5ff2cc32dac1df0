//! Records of three real structures: the results of Spandrel, and whether they are correct.
//!
//! Every record passes through the cores of the services with the settings of one file per
//! structure. No setting depends on the record. If the records are missing, the rows say so.
//!
//! - `course`: one record through alignment, identification and decision
//! - `batch_fit`: the same model fitted to a whole record without a filter, and records of a
//!   damaged structure
//! - `pairs`: differences of two records relative to their stated uncertainty
//! - `shake_table`, `bridge`, `tower`: the structures
//! - `tower_modes`: the natural frequencies of the tower, which update stiffnesses
//! - `mistakes`: records that are read with a wrong file
//! - `sensor_faults`: records with one faulty sensor

mod batch_fit;
mod bridge;
mod course;
mod error;
mod mistakes;
mod pairs;
mod row;
mod sensor_faults;
mod shake_table;
mod tower;
mod tower_modes;

pub(crate) use bridge::{EVENTS, FILE, FIRST_STRONG};
pub use error::RecordsError;
pub use row::Row;

use std::path::Path;

/// Selection of the runs of the real records.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Extent {
    /// The records as they are, also with a wrong file.
    Records,
    /// The records with one faulty sensor each.
    FaultySensors,
}

/// Identifies the structures from the real records below `data`, and returns one row per case.
///
/// Calls `done` with each row, in the order of the result, once the row is available. Missing
/// records are skipped.
///
/// # Errors
/// Returns an error if an existing record cannot be read or identified.
pub fn real_records(
    data: &Path,
    extent: Extent,
    mut done: impl FnMut(&Row),
) -> Result<Vec<Row>, RecordsError> {
    if extent == Extent::FaultySensors {
        return sensor_faults::rows(data, &mut done);
    }
    let mut all = Vec::new();
    let parts = [
        shake_table::rows,
        mistakes::rows,
        tower::rows,
        tower_modes::rows,
        bridge::rows,
    ];
    for part in parts {
        let rows = part(data)?;
        rows.iter().for_each(&mut done);
        all.extend(rows);
    }
    Ok(all)
}

/// Replaces each text by another. Every text must occur in the file.
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
