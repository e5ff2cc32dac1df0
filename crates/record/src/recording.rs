//! A file of any format with its sampling rate, and its offsets removed.

use std::{collections::VecDeque, path::Path};

use crate::{ColumnMapping, CsvReader, RecordError, RecordReader, Row};

/// Whether the constant part of each channel is taken away, such as the tilt of an accelerometer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum OffsetRemoval {
    /// Values stay as they are in the file.
    Keep,
    /// The mean of each channel over the first seconds is subtracted from the whole channel.
    MeanOfFirst {
        /// Length of the span in s, from the time of the first row.
        seconds: f64,
    },
}

/// Reads a recording with its first rows looked at ahead: they give the sampling rate and the offsets.
///
/// Holds at most 1000 rows, or those of the span of the offset; after them the rows stream.
pub struct Recording {
    reader: Box<dyn RecordReader>,
    head: VecDeque<(i64, Vec<f64>)>,
    sampling_rate_hz: Option<f64>,
    rows_in_head: usize,
    offsets: Vec<Option<f64>>,
    values: Vec<f64>,
}

/// Ends of file names that [`Recording::open`] knows.
const FORMATS: &[&str] = &[".csv"];
/// Rows that the sampling rate is found from: enough that times rounded to milliseconds average out below
/// [`RATE_TOLERANCE`] up to 1000 Hz.
const RATE_ROWS: usize = 1001;
/// Relative difference up to which a rate found is the declared one: well above the drift of quartz clocks (1e-4) and
/// what rounded times leave after averaging. At this difference a sample still moves by half a step in 500 only.
const RATE_TOLERANCE: f64 = 1e-3;

impl Recording {
    /// Opens a file of a known format, told by the end of its name.
    ///
    /// # Errors
    /// The format is unknown, the file does not fit the mapping, or one of its first rows is wrong.
    pub fn open(path: &Path, mapping: &ColumnMapping, offset: OffsetRemoval) -> Result<Self, RecordError> {
        Self::check_format(path)?;
        Self::new(Box::new(CsvReader::open(path, mapping)?), offset)
    }

    /// Checks that the end of a file name tells a known format.
    ///
    /// # Errors
    /// It does not.
    pub fn check_format(path: &Path) -> Result<(), RecordError> {
        match path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("csv")) {
            true => Ok(()),
            false => Err(RecordError::UnknownFormat { path: path.to_owned(), allowed: FORMATS }),
        }
    }

    /// Looks ahead into any reader.
    ///
    /// # Errors
    /// The span of the offset is no positive time, or one of the first rows is wrong.
    pub fn new(mut reader: Box<dyn RecordReader>, offset: OffsetRemoval) -> Result<Self, RecordError> {
        let span_ns = match offset {
            OffsetRemoval::Keep => 0,
            OffsetRemoval::MeanOfFirst { seconds } if seconds.is_finite() && seconds > 0.0 => {
                (seconds * 1e9).round() as i64 // saturates far beyond any record
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
                means.iter_mut().zip(row.values).for_each(|(mean, value)| mean.add(*value));
            } else if head.len() >= RATE_ROWS {
                break;
            }
        }
        let times_ns: Vec<i64> = head.iter().take(RATE_ROWS).map(|(time_ns, _)| *time_ns).collect();
        Ok(Self {
            reader,
            sampling_rate_hz: rate_from_times(&times_ns),
            rows_in_head: head.len(),
            head,
            offsets: means.iter().map(RunningMean::mean).collect(),
            values: vec![f64::NAN; channel_count],
        })
    }

    /// The sampling rate in Hz: from the mean of the steps in time of the first 1000, without those that are gaps.
    ///
    /// # Errors
    /// [`RecordError::TooShort`] if there are fewer than two rows.
    pub fn sampling_rate_hz(&self) -> Result<f64, RecordError> {
        let too_short = || RecordError::TooShort { path: self.reader.path().to_owned(), rows: self.rows_in_head };
        self.sampling_rate_hz.ok_or_else(too_short)
    }

    /// Checks that the file is sampled at the declared rate in Hz within 0.1 %, and gives back the declared rate.
    ///
    /// # Errors
    /// [`RecordError::SamplingRate`] if it is not, [`RecordError::TooShort`] if there are fewer than two rows.
    pub fn check_sampling_rate(&self, declared_hz: f64) -> Result<f64, RecordError> {
        let found_hz = self.sampling_rate_hz()?;
        let is_declared = (found_hz - declared_hz).abs() <= RATE_TOLERANCE * declared_hz;
        if is_declared {
            return Ok(declared_hz);
        }
        Err(RecordError::SamplingRate { path: self.reader.path().to_owned(), found_hz, declared_hz })
    }

    /// What is subtracted from each channel, in SI units; `None` if offsets are kept, or if the channel has no sample in
    /// the span.
    pub fn offsets(&self) -> &[Option<f64>] {
        &self.offsets
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
        Ok(Some(Row { time_ns, values: &self.values }))
    }
}

/// The mean of the samples of one channel that are there.
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

/// Sampling rate in Hz from times in ns; `None` if there are fewer than two.
///
/// The median step tells what is a gap (more than half a step off); the mean of the others is the step. The median alone
/// would not do: times rounded to milliseconds at 120 Hz have the steps 8, 8, 9 ms, and a median of 125 Hz.
fn rate_from_times(times_ns: &[i64]) -> Option<f64> {
    let mut steps_ns: Vec<i64> = times_ns.windows(2).map(|pair| pair[1].saturating_sub(pair[0])).collect();
    steps_ns.sort_unstable();
    let median_ns = *steps_ns.get(steps_ns.len() / 2)?;
    let regular = steps_ns.iter().filter(|step_ns| (**step_ns - median_ns).abs() <= median_ns / 2);
    let (count, total_ns) =
        regular.fold((0_u32, 0_i64), |(count, total), step| (count + 1, total.saturating_add(*step)));
    Some(1e9 * f64::from(count) / total_ns as f64)
}

#[cfg(test)]
mod tests;
