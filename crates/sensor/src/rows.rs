//! Where samples come from: a simulation or a record, instant by instant.

use spandrel_bus::TimeGrid;
use spandrel_record::{RecordError, RecordReader};
use spandrel_structure::Structure;

/// All channels of a structure at one instant.
#[derive(Clone, Debug, PartialEq)]
pub struct Row {
    /// Time of measurement, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// A value per channel in frame order, SI units, NaN = missing.
    pub values: Vec<f64>,
}

/// Simulates a structure from `start_ns` (ns since the Unix epoch), for a number of frames or without end.
///
/// Empty if the rate of the structure is none that frames can have.
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

/// Reads a record; its times are moved by `shift_ns`.
pub fn recorded_rows(
    mut reader: impl RecordReader + 'static,
    shift_ns: i64,
) -> impl Iterator<Item = Result<Row, RecordError>> + Send {
    let mut failed = false;
    std::iter::from_fn(move || {
        if failed {
            return None; // reading cannot go on after an error
        }
        let row = reader.next_row().transpose()?;
        failed = row.is_err();
        Some(row.map(|row| Row {
            time_ns: row.time_ns.saturating_add(shift_ns),
            values: row.values.to_vec(),
        }))
    })
}
