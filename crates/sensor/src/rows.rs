//! Sources of samples, row by row: a simulation or a record.

use spandrel_bus::TimeGrid;
use spandrel_record::{RecordError, RecordReader};
use spandrel_structure::Structure;

/// The values of all channels of a structure at one time.
#[derive(Clone, Debug, PartialEq)]
pub struct Row {
    /// Time of measurement, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// One value per channel in frame order, SI units; NaN if missing.
    pub values: Vec<f64>,
}

/// Simulates a structure from `start_ns` (ns since the Unix epoch).
///
/// Returns `frames` rows, or an endless iterator if `frames` is `None`. The iterator is empty if
/// the sampling rate of the structure is invalid for frames.
pub fn simulated_rows(
    structure: &Structure,
    seed: u64,
    start_ns: i64,
    frames: Option<u64>,
) -> impl Iterator<Item = Row> + Send + use<> {
    let grid = TimeGrid::new(start_ns, structure.sampling_rate_hz());
    let simulator = structure.simulator(seed);
    let frames = frames.unwrap_or(u64::MAX);
    grid.into_iter().flat_map(move |grid| {
        let numbered = (0..frames).zip(simulator.clone());
        numbered.map(move |(number, frame)| Row {
            time_ns: grid.time_ns(number),
            values: frame.values,
        })
    })
}

/// Reads the rows of a record and adds `shift_ns` (ns) to their times.
pub fn recorded_rows(
    mut reader: impl RecordReader + 'static,
    shift_ns: i64,
) -> impl Iterator<Item = Result<Row, RecordError>> + Send {
    let mut failed = false;
    std::iter::from_fn(move || {
        if failed {
            // Reading cannot continue after an error.
            return None;
        }
        let row = reader.next_row().transpose()?;
        failed = row.is_err();
        Some(row.map(|row| Row {
            time_ns: row.time_ns.saturating_add(shift_ns),
            values: row.values.to_vec(),
        }))
    })
}
