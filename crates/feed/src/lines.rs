//! Formats of text lines. Each line contains samples of one or more channels.

mod csv;
mod datacast;
mod json;
mod raw;
mod splitter;

use std::fmt;

use spandrel_record::TimeUnit;

use crate::packet::Packet;

pub(crate) use csv::cells;
pub use raw::{RawFormat, RawNumber};
pub(crate) use splitter::{LineSplitter, Split};

/// Maximum length of a text that an error quotes, in bytes.
const QUOTED_BYTES: usize = 60;

/// The format of the lines of a source.
#[derive(Clone, Debug, PartialEq)]
pub enum LineFormat {
    /// Datacast of a Raspberry Shake: `{'EHZ', 1507760140.530, 614, 916}`.
    RaspberryShake,
    /// One JSON object per line.
    Json {
        /// Field of the time. `None` if the objects contain no time.
        time: Option<TimeField>,
        /// Fields of the channels. A field contains a number, or a list of consecutive samples. A
        /// dot separates the names of nested fields.
        fields: Vec<String>,
    },
    /// One row of separated values per line, with one sample of each channel.
    Csv {
        /// Separator of the cells.
        separator: char,
        /// Names of the columns, in the order of the cells.
        columns: Vec<String>,
        /// Column that contains the time. `None` if the rows contain no time.
        time: Option<TimeField>,
        /// Columns of the channels.
        fields: Vec<String>,
    },
}

/// The field or column that contains the time of a sample.
#[derive(Clone, Debug, PartialEq)]
pub struct TimeField {
    /// Name of the field or column.
    pub name: String,
    /// Unit of a time that is a number. A text is a date and time in ISO 8601.
    pub unit: TimeUnit,
}

/// What a field with a time may contain.
const TIME: &str = "must be an ISO 8601 time, or a number that is a time between the years 1678 \
                    and 2262 in the unit `time-unit`";

/// An error in a line.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{what}: is {found}, {allowed}")]
pub struct LineFault {
    what: String,
    found: String,
    allowed: String,
}

impl LineFault {
    pub(crate) fn new(
        what: impl Into<String>,
        found: impl fmt::Display,
        allowed: impl Into<String>,
    ) -> Self {
        Self {
            what: what.into(),
            found: quoted(&found.to_string()),
            allowed: allowed.into(),
        }
    }
}

/// Returns the beginning of a text from outside, without control characters.
pub(crate) fn quoted(text: &str) -> String {
    let shown: String = text
        .chars()
        .map(|c| if c.is_control() { ' ' } else { c })
        .collect();
    match shown.len() > QUOTED_BYTES {
        true => format!("`{}…`", &shown[..shown.floor_char_boundary(QUOTED_BYTES)]),
        false => format!("`{shown}`"),
    }
}

impl LineFormat {
    /// Reads the samples of one line. A blank line, and the header of a CSV table, have none.
    ///
    /// # Errors
    /// Returns an error if the line is malformed.
    pub fn parse(&self, line: &str) -> Result<Vec<Packet>, LineFault> {
        let line = line.trim();
        if line.is_empty() {
            return Ok(Vec::new());
        }
        match self {
            Self::RaspberryShake => datacast::parse(line).map(|packet| vec![packet]),
            Self::Json { time, fields } => json::parse(line, time.as_ref(), fields),
            Self::Csv {
                separator,
                columns,
                time,
                fields,
            } => csv::Row {
                separator: *separator,
                columns,
                time: time.as_ref(),
                fields,
            }
            .parse(line),
        }
    }
}

#[cfg(test)]
mod tests;
