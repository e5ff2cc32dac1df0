//! Rows of separated values with declared columns.

use spandrel_record::record_time::parse_time_ns;

use super::{LineFault, TIME, TimeField};
use crate::packet::Packet;

/// What a row needs to be read.
pub(super) struct Row<'a> {
    pub(super) separator: char,
    pub(super) columns: &'a [String],
    pub(super) time: Option<&'a TimeField>,
    pub(super) fields: &'a [String],
}

impl Row<'_> {
    pub(super) fn parse(&self, line: &str) -> Result<Vec<Packet>, LineFault> {
        if has_header(line, self.separator, self.columns) {
            return Ok(Vec::new());
        }
        let cells: Vec<&str> = cells(line, self.separator).collect();
        if cells.len() != self.columns.len() {
            return Err(LineFault::new(
                "row",
                line,
                format!(
                    "must have {} cells ({}) but has {}",
                    self.columns.len(),
                    self.columns.join(", "),
                    cells.len()
                ),
            ));
        }
        let cell = |name: &str| {
            let place = self.columns.iter().position(|column| column == name)?;
            cells.get(place).copied()
        };
        let start_ns = match self.time {
            None => None,
            Some(time) => {
                let text = cell(&time.name).unwrap_or_default();
                let time_ns = parse_time_ns(text, time.unit)
                    .ok_or_else(|| LineFault::new(&*time.name, text, TIME))?;
                Some(time_ns)
            }
        };
        self.fields
            .iter()
            .map(|field| {
                let text = cell(field).unwrap_or_default();
                Ok(Packet {
                    label: field.clone(),
                    start_ns,
                    rate_hz: None,
                    values: vec![number(field, text)?],
                    clock_quality: None,
                })
            })
            .collect()
    }
}

/// Returns the cells of a row without blanks and quotes around them.
pub(crate) fn cells(line: &str, separator: char) -> impl Iterator<Item = &str> {
    line.split(separator)
        .map(|cell| cell.trim().trim_matches('"'))
}

/// Returns `true` if a line is the header of these columns.
fn has_header(line: &str, separator: char, columns: &[String]) -> bool {
    cells(line, separator).eq(columns.iter().map(String::as_str))
}

/// Reads a number. An empty cell and `nan` are missing samples.
fn number(field: &str, text: &str) -> Result<f64, LineFault> {
    if text.is_empty() {
        return Ok(f64::NAN);
    }
    text.parse()
        .map_err(|_| LineFault::new(field, text, "must be a number"))
}
