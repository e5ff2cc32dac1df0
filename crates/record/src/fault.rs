//! The description of an error inside a file: position, value found and values allowed.

use std::fmt;

/// A violation of a file format.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Fault {
    place: FaultPosition,
    what: String,
    found: String,
    allowed: String,
}

/// A position in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum FaultPosition {
    /// Line, counted from 1.
    Line(u64),
    /// Byte, counted from 0.
    Byte(u64),
    /// The whole file.
    File,
}

impl Fault {
    /// Creates a fault on a line: `what` is `found`, but must be `allowed`.
    pub(crate) fn at_line(
        line: u64,
        what: impl Into<String>,
        found: impl fmt::Display,
        allowed: impl Into<String>,
    ) -> Self {
        Self {
            place: FaultPosition::Line(line),
            what: what.into(),
            found: found.to_string(),
            allowed: allowed.into(),
        }
    }

    /// Creates a fault at a byte: `what` is `found`, but must be `allowed`.
    pub(crate) fn at_byte(
        byte: usize,
        what: impl Into<String>,
        found: impl fmt::Display,
        allowed: impl Into<String>,
    ) -> Self {
        Self {
            place: FaultPosition::Byte(byte as u64),
            what: what.into(),
            found: found.to_string(),
            allowed: allowed.into(),
        }
    }

    /// Creates a fault of the whole file: `what` is `found`, but must be `allowed`.
    pub(crate) fn of_file(
        what: impl Into<String>,
        found: impl fmt::Display,
        allowed: impl Into<String>,
    ) -> Self {
        Self {
            place: FaultPosition::File,
            what: what.into(),
            found: found.to_string(),
            allowed: allowed.into(),
        }
    }

    /// Converts a byte position within a part of a file to a position in the file, where the part
    /// begins at byte `start`.
    pub(crate) fn moved_by(mut self, start: usize) -> Self {
        if let FaultPosition::Byte(byte) = &mut self.place {
            *byte = byte.saturating_add(start as u64);
        }
        self
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.place {
            FaultPosition::Line(line) => write!(formatter, "line {line}: ")?,
            FaultPosition::Byte(byte) => write!(formatter, "byte {byte}: ")?,
            FaultPosition::File => {}
        }
        write!(
            formatter,
            "{} is {}, must be {}",
            self.what, self.found, self.allowed
        )
    }
}
