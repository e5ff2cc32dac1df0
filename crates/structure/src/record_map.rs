//! Conversion of the columns of a recording to channels.

/// Mapping from the columns of a recording to the channels of the structure.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordMap {
    pub(crate) time_column: String,
    pub(crate) time_unit: &'static str,
    pub(crate) resamples: bool,
    pub(crate) remove_offset_s: f64,
    pub(crate) columns: Vec<ColumnMap>,
}

impl RecordMap {
    /// Units of a numeric time column; the first is the default.
    pub(crate) const TIME_UNITS: [(&'static str, &'static str); 4] =
        [("s", "s"), ("ms", "ms"), ("us", "us"), ("ns", "ns")];

    /// Default name of the time column.
    pub(crate) const TIME_COLUMN: &str = "time";

    /// Returns the name of the time column.
    ///
    /// It is empty if records have no times. Rows are then counted at the sampling rate of the
    /// structure.
    #[must_use]
    pub fn time_column(&self) -> &str {
        &self.time_column
    }

    /// Returns the unit of numeric times: `s`, `ms`, `us` or `ns`.
    #[must_use]
    pub fn time_unit(&self) -> &'static str {
        self.time_unit
    }

    /// Returns `true` if records at another rate are resampled to the rate of the structure.
    ///
    /// Otherwise they are rejected.
    #[must_use]
    pub fn resamples(&self) -> bool {
        self.resamples
    }

    /// Returns the initial length (s) of a record whose mean is removed from each channel.
    ///
    /// A length of 0 removes no mean.
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

/// Column of a channel and its conversion to SI: `value = factor · column + offset`.
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

    /// Returns the size of the column's unit times the scale of the file (SI unit of the quantity
    /// per unit).
    #[must_use]
    pub fn factor(&self) -> f64 {
        self.factor
    }

    /// Returns `true` if the structure file states the unit of the column.
    ///
    /// Otherwise the recording may state it; the default is SI.
    #[must_use]
    pub fn states_unit(&self) -> bool {
        self.states_unit
    }

    /// Returns the offset added after the multiplication (SI unit of the quantity).
    #[must_use]
    pub fn offset(&self) -> f64 {
        self.offset
    }
}
