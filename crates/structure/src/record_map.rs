//! How the columns of a recording become channels.

/// Maps the columns of a recording to the channels of the structure.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordMap {
    pub(crate) time_column: String,
    pub(crate) time_unit: &'static str,
    pub(crate) resamples: bool,
    pub(crate) remove_offset_s: f64,
    pub(crate) columns: Vec<ColumnMap>,
}

impl RecordMap {
    /// Units that the numbers of the time column may have; the first one is the default.
    pub(crate) const TIME_UNITS: [(&'static str, &'static str); 4] =
        [("s", "s"), ("ms", "ms"), ("us", "us"), ("ns", "ns")];

    /// Default name of the column with the time.
    pub(crate) const TIME_COLUMN: &str = "time";

    /// Returns the name of the column with the time; empty if records have no times, and rows are counted at the structure's rate.
    #[must_use]
    pub fn time_column(&self) -> &str {
        &self.time_column
    }

    /// Returns the unit of times that are numbers: `s`, `ms`, `us` or `ns`.
    #[must_use]
    pub fn time_unit(&self) -> &'static str {
        self.time_unit
    }

    /// Tells whether records of another rate are resampled to that of the structure; if not, they are refused.
    #[must_use]
    pub fn resamples(&self) -> bool {
        self.resamples
    }

    /// Returns the length (s) at the start of a record whose mean is removed from each channel; 0 for none.
    #[must_use]
    pub fn remove_offset_s(&self) -> f64 {
        self.remove_offset_s
    }

    /// Returns the column of each channel, in frame order.
    #[must_use]
    pub fn columns(&self) -> &[ColumnMap] {
        &self.columns
    }
}

/// Says which column holds a channel, and how it becomes SI: `value = factor · column + offset`.
#[derive(Debug, Clone, PartialEq)]
pub struct ColumnMap {
    pub(crate) column: String,
    pub(crate) factor: f64,
    pub(crate) offset: f64,
    pub(crate) states_unit: bool,
}

impl ColumnMap {
    /// Returns the name of the column in the recording.
    #[must_use]
    pub fn column(&self) -> &str {
        &self.column
    }

    /// Returns the size of the column's unit, times the scale of the file (SI unit of the quantity per unit).
    #[must_use]
    pub fn factor(&self) -> f64 {
        self.factor
    }

    /// Tells whether the structure file states the unit of the column; if not, it is the one that the recording states, or SI.
    #[must_use]
    pub fn states_unit(&self) -> bool {
        self.states_unit
    }

    /// Returns what is added afterwards (SI unit of the quantity).
    #[must_use]
    pub fn offset(&self) -> f64 {
        self.offset
    }
}
