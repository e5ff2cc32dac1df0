//! Selects the arrays of a MAT-file that are series of samples, and names them.
//!
//! MATLAB has no convention for this. With times beside a matrix (`t`, `time`), the columns are
//! series if the matrix has as many rows as times. Likewise, its rows are series if it has as many
//! columns as times. Without times, the series run along the longer side of any matrix.
//!
//! The sampling rate results from the times, or from a number such as `fs`, `samplerate`,
//! `sampling_rate` or `dt` beside the matrix. Names come from a text `…name` and a cell array
//! `…names` beside it, and units from `…unit` and `…units`. Otherwise, the variable and the column
//! determine the name.

use super::array::{Array, Named};
use crate::fault::Fault;
use crate::rate::rate_from_step;
use crate::recorded::{RecordedChannel, Segment};

const TIMES: [&str; 3] = ["t", "time", "times"];
const RATES: [&str; 7] = [
    "fs",
    "samplerate",
    "sampling_rate",
    "samplingrate",
    "sample_rate",
    "samplingfrequency",
    "rate",
];
const STEPS: [&str; 2] = ["dt", "timestep"];
/// Minimum number of samples in a series. Shorter arrays are settings.
const LEAST_SAMPLES: usize = 3;

/// Information from the structures around an array.
#[derive(Debug, Clone, Default)]
struct Around {
    path: String,
    times_s: Option<Vec<f64>>,
    rate_hz: Option<f64>,
}

impl Around {
    /// Returns the information for these fields, which have their own times or rate or those of the
    /// outer level.
    fn with(&self, fields: &[Named]) -> Self {
        let mut around = self.clone();
        for (name, array) in fields {
            match array {
                Array::Numbers { values, .. } if is_one_of(name, &TIMES) && increases(values) => {
                    around.times_s = Some(values.clone());
                }
                _ => {}
            }
            if let Some(number) = array
                .number()
                .filter(|number| number.is_finite() && *number > 0.0)
            {
                if is_one_of(name, &RATES) {
                    around.rate_hz = Some(number);
                } else if is_one_of(name, &STEPS) {
                    around.rate_hz = Some(rate_from_step(number));
                }
            }
        }
        around
    }
}

fn is_one_of(name: &str, known: &[&str]) -> bool {
    known.contains(&name.to_ascii_lowercase().as_str())
}

/// Returns the series of all variables.
pub(super) fn of_variables(variables: &[Named]) -> Result<Vec<RecordedChannel>, Fault> {
    let mut channels = Vec::new();
    collect(variables, &Around::default(), &mut channels);
    match channels.is_empty() {
        true => {
            let names = variables
                .iter()
                .map(|(name, _)| name.as_str())
                .collect::<Vec<_>>()
                .join(", ");
            Err(Fault::of_file(
                "content",
                format!("the variables {names}"),
                "a numeric matrix with samples",
            ))
        }
        false => Ok(channels),
    }
}

/// Collects the series of arrays on the same level.
fn collect(fields: &[Named], outer: &Around, channels: &mut Vec<RecordedChannel>) {
    let around = outer.with(fields);
    for (name, array) in fields {
        let path = if around.path.is_empty() {
            name.clone()
        } else {
            format!("{}.{name}", around.path)
        };
        match array {
            Array::Numbers {
                rows,
                columns,
                values,
            } if !is_one_of(name, &TIMES) => {
                let matrix = Matrix {
                    rows: *rows,
                    columns: *columns,
                    values,
                };
                series(&path, &matrix, fields, &around, channels);
            }
            Array::Structures(elements) => {
                for (index, element) in elements.iter().enumerate() {
                    let own_name = element
                        .iter()
                        .find(|(name, _)| name.to_ascii_lowercase().ends_with("name"));
                    let own_name = own_name
                        .and_then(|(_, array)| array.text())
                        .filter(|name| !name.is_empty());
                    let path = match (own_name, elements.len()) {
                        (Some(own_name), 2..) => own_name.to_owned(),
                        (None, 2..) => format!("{path}({})", index + 1),
                        (_, _) => path.clone(),
                    };
                    collect(
                        element,
                        &Around {
                            path,
                            ..around.clone()
                        },
                        channels,
                    );
                }
            }
            Array::Cells(cells) => {
                let numbered = |(index, cell): (usize, &Array)| {
                    (format!("{path}({})", index + 1), cell.clone())
                };
                let cells: Vec<Named> = cells.iter().enumerate().map(numbered).collect();
                collect(
                    &cells,
                    &Around {
                        path: String::new(),
                        ..around.clone()
                    },
                    channels,
                );
            }
            Array::Numbers { .. } | Array::Text(_) | Array::Other => {}
        }
    }
}

/// A matrix in column-major order.
struct Matrix<'a> {
    rows: usize,
    columns: usize,
    values: &'a [f64],
}

/// Converts the columns or rows of a matrix to series.
fn series(
    path: &str,
    matrix: &Matrix<'_>,
    beside: &[Named],
    around: &Around,
    channels: &mut Vec<RecordedChannel>,
) {
    let Matrix {
        rows,
        columns,
        values,
    } = *matrix;
    let is_by_column = match &around.times_s {
        Some(times_s) if rows == times_s.len() => true,
        Some(times_s) if columns == times_s.len() => false,
        // If there are times, only arrays of the same length are series.
        Some(_) => return,
        None => rows >= columns,
    };
    let (length, count) = if is_by_column {
        (rows, columns)
    } else {
        (columns, rows)
    };
    if length < LEAST_SAMPLES {
        return;
    }
    let names = listed(beside, "names", count);
    let units = listed(beside, "units", count);
    let one_unit = beside
        .iter()
        .find(|(name, _)| name.to_ascii_lowercase().ends_with("unit"));
    let one_unit = one_unit.and_then(|(_, array)| array.text());
    // If there are names, the name of the matrix, such as `data`, is redundant.
    let parent = path.rsplit_once('.').map(|(parent, _)| parent);
    for index in 0..count {
        let name = match (&names, parent) {
            (Some(names), Some(parent)) => format!("{parent}.{}", names[index]),
            (Some(names), None) => format!("{path}.{}", names[index]),
            (None, _) if count == 1 => path.to_owned(),
            (None, _) => format!("{path}.{}", index + 1),
        };
        let samples: Vec<f64> = match is_by_column {
            true => values[index * rows..(index + 1) * rows].to_vec(),
            false => values.iter().skip(index).step_by(rows).copied().collect(),
        };
        let samples: Vec<f64> = samples
            .into_iter()
            .map(|sample| if sample.is_finite() { sample } else { f64::NAN })
            .collect();
        let channel = match &around.times_s {
            Some(times_s) => {
                let times_ns: Vec<i64> = times_s
                    .iter()
                    .map(|time_s| (time_s * 1e9).round() as i64)
                    .collect();
                RecordedChannel::from_times(name, None, &times_ns, &samples)
            }
            None => RecordedChannel::new(name, around.rate_hz, vec![Segment::new(0, samples)]),
        };
        let unit = units
            .as_ref()
            .map(|units| units[index])
            .or(one_unit)
            .unwrap_or_default();
        channels.push(channel.with_unit(unit));
    }
}

/// Returns a cell array of `count` texts beside a matrix, whose name ends in `ending`.
fn listed<'a>(beside: &'a [Named], ending: &str, count: usize) -> Option<Vec<&'a str>> {
    let named = beside
        .iter()
        .filter(|(name, _)| name.to_ascii_lowercase().ends_with(ending));
    named
        .filter_map(|(_, array)| array.texts())
        .find(|texts| texts.len() == count)
}

/// Returns `true` if numbers can be times.
fn increases(values: &[f64]) -> bool {
    values.len() >= LEAST_SAMPLES
        && values.windows(2).all(|pair| pair[1] > pair[0])
        && values.iter().all(|value| value.is_finite())
}
