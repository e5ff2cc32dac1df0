//! Reads a file of any format, determines its sampling rate and removes its offsets.

use std::{collections::VecDeque, path::Path};

use flate2::read::MultiGzDecoder;

use crate::{
    ColumnMapping, CsvReader, Format, ReadOptions, RecordError, RecordReader, RecordedFile,
    RecordedRows, Row, TimeSource, rate::rate_from_times, source::Source,
    unpacked::UnpackingBudget,
};

/// Policy for the constant part of each channel, such as the tilt of an accelerometer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum OffsetRemoval {
    /// Values remain as in the file.
    Keep,
    /// The mean of each channel over the first seconds is subtracted from the whole channel.
    MeanOfFirst {
        /// Length of the span in s, from the time of the first row.
        seconds: f64,
    },
}

/// A reader that buffers the first rows of a recording to determine the sampling rate and the
/// offsets.
///
/// The buffer contains 1001 rows, or more if the span of the offset requires it. All later rows are
/// streamed.
pub struct Recording {
    reader: Box<dyn RecordReader>,
    head: VecDeque<(i64, Vec<f64>)>,
    sampling_rate_hz: Option<f64>,
    rows_in_head: usize,
    offsets: Vec<Option<f64>>,
    values: Vec<f64>,
    doubts: Vec<String>,
}

/// Policy for the conversion of a recording to another sampling rate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Resampling {
    /// Samples remain as in the file.
    None,
    /// All channels are converted to one rate, with an anti-aliasing filter. The whole file is in
    /// memory.
    To {
        /// The target rate, in Hz.
        rate_hz: f64,
    },
}

/// Number of rows that determine the sampling rate. With this number, the error of times rounded to
/// milliseconds averages to less than [`RATE_TOLERANCE`] up to 1000 Hz.
const RATE_ROWS: usize = 1001;
/// Relative tolerance between the measured and the declared rate. It is well above the drift of
/// quartz clocks (1e-4) and the averaged error of rounded times. At this difference, a sample moves
/// by half a step in 500 samples.
const RATE_TOLERANCE: f64 = 1e-3;

impl Recording {
    /// Opens a file of any known format, detected by its content and then by its name.
    ///
    /// Tables are streamed. Files of other formats are read into memory.
    ///
    /// # Errors
    /// Returns an error if the format is unknown, the file does not match the mapping, or one of
    /// its first rows is invalid.
    pub fn open(
        path: &Path,
        mapping: &ColumnMapping,
        offset: OffsetRemoval,
    ) -> Result<Self, RecordError> {
        Self::open_resampled(path, mapping, offset, Resampling::None)
    }

    /// Opens a file like [`Recording::open`], and resamples it as `resampling` specifies. Offsets
    /// are removed after resampling.
    ///
    /// # Errors
    /// Returns the same errors as [`Recording::open`]. Also returns an error if the target rate is
    /// not valid, or if the file does not state its own rate.
    pub fn open_resampled(
        path: &Path,
        mapping: &ColumnMapping,
        offset: OffsetRemoval,
        resampling: Resampling,
    ) -> Result<Self, RecordError> {
        let read = || RecordedFile::read(path, &options_of(mapping));
        let file = match resampling {
            Resampling::None => match table_reader(path, mapping)? {
                Some(reader) => return Self::new(Box::new(reader), offset),
                None => read()?,
            },
            // Channels that are not required need not be filtered.
            Resampling::To { rate_hz } => read()?.only(mapping).resampled(rate_hz)?,
        };
        let rows = RecordedRows::new(&file, mapping)?;
        Ok(Self {
            doubts: file.doubts().to_vec(),
            ..Self::new(Box::new(rows), offset)?
        })
    }

    /// Buffers the first rows of a reader.
    ///
    /// # Errors
    /// Returns an error if the span of the offset is not a positive time, or if one of the first
    /// rows is invalid.
    pub fn new(
        mut reader: Box<dyn RecordReader>,
        offset: OffsetRemoval,
    ) -> Result<Self, RecordError> {
        let span_ns = match offset {
            OffsetRemoval::Keep => 0,
            OffsetRemoval::MeanOfFirst { seconds } if seconds.is_finite() && seconds > 0.0 => {
                // The conversion saturates far beyond the length of any record.
                (seconds * 1e9).round() as i64
            }
            OffsetRemoval::MeanOfFirst { seconds } => {
                return Err(RecordError::OffsetSpan { found_s: seconds });
            }
        };
        let channel_count = reader.channels().len();
        let mut head = VecDeque::new();
        let mut means = vec![RunningMean::default(); channel_count];
        while let Some(row) = reader.next_row()? {
            head.push_back((row.time_ns, row.values.to_vec()));
            let start_ns = head.front().map_or(row.time_ns, |(time_ns, _)| *time_ns);
            let is_in_span = row.time_ns.saturating_sub(start_ns) < span_ns;
            if is_in_span {
                means
                    .iter_mut()
                    .zip(row.values)
                    .for_each(|(mean, value)| mean.add(*value));
            } else if head.len() >= RATE_ROWS {
                break;
            }
        }
        let times_ns: Vec<i64> = head
            .iter()
            .take(RATE_ROWS)
            .map(|(time_ns, _)| *time_ns)
            .collect();
        Ok(Self {
            reader,
            sampling_rate_hz: rate_from_times(&times_ns),
            rows_in_head: head.len(),
            head,
            offsets: means.iter().map(RunningMean::mean).collect(),
            values: vec![f64::NAN; channel_count],
            doubts: Vec::new(),
        })
    }

    /// Returns the sampling rate in Hz, from the mean of the first 1000 time steps without gaps.
    ///
    /// # Errors
    /// Returns [`RecordError::TooShort`] if there are fewer than two rows.
    pub fn sampling_rate_hz(&self) -> Result<f64, RecordError> {
        let too_short = || RecordError::TooShort {
            path: self.reader.path().to_owned(),
            rows: self.rows_in_head,
        };
        self.sampling_rate_hz.ok_or_else(too_short)
    }

    /// Checks that the sampling rate is within 0.1 % of the declared rate (Hz), and returns the
    /// declared rate.
    ///
    /// # Errors
    /// Returns [`RecordError::SamplingRate`] if the rates differ, and [`RecordError::TooShort`] if
    /// there are fewer than two rows.
    pub fn check_sampling_rate(&self, declared_hz: f64) -> Result<f64, RecordError> {
        let found_hz = self.sampling_rate_hz()?;
        let is_declared = (found_hz - declared_hz).abs() <= RATE_TOLERANCE * declared_hz;
        if is_declared {
            return Ok(declared_hz);
        }
        Err(RecordError::SamplingRate {
            path: self.reader.path().to_owned(),
            found_hz,
            declared_hz,
        })
    }

    /// Returns remarks on the times of the channels, as [`RecordedFile::doubts`] does. Empty for a
    /// table that is streamed.
    pub fn doubts(&self) -> &[String] {
        &self.doubts
    }

    /// Returns the offset that is subtracted from each channel, in SI units. An entry is `None` if
    /// offsets are kept or if the channel has no sample in the span.
    pub fn offsets(&self) -> &[Option<f64>] {
        &self.offsets
    }
}

/// Opens a table for streaming, compressed by gzip or not. Returns `None` if the file has another
/// format.
fn table_reader(
    path: &Path,
    mapping: &ColumnMapping,
) -> Result<Option<CsvReader<'static>>, RecordError> {
    if path.is_dir() {
        return Ok(None);
    }
    let file = Source::open(path)?;
    let reader =
        |source: Source<'static>| CsvReader::new(source.into_reader(), path, mapping).map(Some);
    match Format::of(file.head(), path) {
        Some(Format::Table) => reader(file),
        Some(Format::Gzip) => {
            let budget = UnpackingBudget::streamed();
            let decoder = MultiGzDecoder::new(budget.packed(file.into_reader()));
            let unpacked = Source::new(budget.unpacked(decoder));
            let unpacked = unpacked.map_err(|source| RecordError::ReadFile {
                path: path.to_owned(),
                source,
            })?;
            match Format::of(unpacked.head(), &path.with_extension("")) {
                Some(Format::Table) => reader(unpacked),
                Some(_) | None => Ok(None),
            }
        }
        Some(_) | None => Ok(None),
    }
}

/// Returns the properties that a mapping declares for files that do not state them.
fn options_of(mapping: &ColumnMapping) -> ReadOptions {
    let options = ReadOptions::default();
    match mapping.time() {
        TimeSource::Column { name, unit } => ReadOptions {
            time_column: Some(name.clone()),
            time_unit: Some(*unit),
            ..options
        },
        TimeSource::Counted { rate_hz } => ReadOptions {
            sampling_rate_hz: Some(*rate_hz),
            ..options
        },
    }
}

impl RecordReader for Recording {
    fn path(&self) -> &Path {
        self.reader.path()
    }

    fn channels(&self) -> &[String] {
        self.reader.channels()
    }

    fn next_row(&mut self) -> Result<Option<Row<'_>>, RecordError> {
        let time_ns = match self.head.pop_front() {
            Some((time_ns, values)) => {
                self.values.copy_from_slice(&values);
                time_ns
            }
            None => match self.reader.next_row()? {
                Some(row) => {
                    self.values.copy_from_slice(row.values);
                    row.time_ns
                }
                None => return Ok(None),
            },
        };
        for (value, offset) in self.values.iter_mut().zip(&self.offsets) {
            if let Some(offset) = offset {
                *value -= offset;
            }
        }
        Ok(Some(Row {
            time_ns,
            values: &self.values,
        }))
    }
}

/// The running mean of the samples of one channel, without missing samples.
#[derive(Debug, Clone, Default)]
struct RunningMean {
    sum: f64,
    count: u32,
}

impl RunningMean {
    fn add(&mut self, value: f64) {
        if !value.is_nan() {
            self.sum += value;
            self.count += 1;
        }
    }

    fn mean(&self) -> Option<f64> {
        (self.count > 0).then(|| self.sum / f64::from(self.count))
    }
}

#[cfg(test)]
mod tests;
