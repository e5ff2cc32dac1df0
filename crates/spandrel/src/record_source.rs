//! Opens a recording as the structure file says: columns, units, offsets.

use crate::error::AppError;
use spandrel_record::{ChannelColumn, ColumnMapping, OffsetRemoval, Recording};
use spandrel_structure::Structure;
use std::io::Read;
use std::path::Path;

/// Bytes at the head of a recording by which its rows are counted.
const COUNTED_BYTES: u64 = 1 << 16;

/// Guesses how many rows a recording has, by its size and the length of its first rows: good enough for a progress bar.
pub fn expected_rows(path: &Path) -> Option<u64> {
    let file = std::fs::File::open(path).ok()?;
    let size = file.metadata().ok()?.len();
    let mut head = Vec::new();
    file.take(COUNTED_BYTES).read_to_end(&mut head).ok()?;
    let rows = head.iter().filter(|byte| **byte == b'\n').count() as u64;
    (rows > 0).then(|| (rows as f64 * (size as f64 / head.len() as f64)) as u64)
}

/// Returns where each channel of a structure stands in its recordings, and in which unit.
///
/// # Errors
/// When a calibration is no number that can be undone.
pub fn mapping(structure: &Structure) -> Result<ColumnMapping, AppError> {
    let map = structure.record();
    let columns = structure
        .channels()
        .zip(map.columns())
        .map(|(channel, column)| {
            // the structure file has already turned its unit into the factor
            ChannelColumn::new(channel.name())
                .with_column(column.column())
                .with_calibration(column.factor(), column.offset())
        })
        .collect::<Result<Vec<_>, _>>()?;
    Ok(ColumnMapping::new(columns).with_time_column(map.time_column()))
}

/// Opens `path` for `structure` and checks that it is sampled at the structure's rate.
///
/// # Errors
/// When the file cannot be read, lacks columns or has another rate; it names what it has.
pub fn open(structure: &Structure, path: &Path) -> Result<Recording, AppError> {
    let offset = match structure.record().remove_offset_s() {
        seconds if seconds > 0.0 => OffsetRemoval::MeanOfFirst { seconds },
        _ => OffsetRemoval::Keep,
    };
    let recording = Recording::open(path, &mapping(structure)?, offset)?;
    recording.check_sampling_rate(structure.sampling_rate_hz())?;
    Ok(recording)
}
