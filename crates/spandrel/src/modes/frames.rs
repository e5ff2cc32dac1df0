//! The channels of a recording as frames of equal times.

use crate::error::AppError;
use spandrel_record::{ReadOptions, RecordError, RecordedChannel, RecordedFile};
use spandrel_sensor::{open_record, recorded_rows};
use spandrel_structure::{ModalPlan, Structure};
use std::path::{Path, PathBuf};

/// Relative tolerance within which two sampling rates are equal.
const SAME_RATE: f64 = 1e-4;
/// Smallest number of channels from which shapes can be identified.
const LEAST_CHANNELS: usize = 2;
/// Largest number of time steps per sample of a channel, so that a wrong time cannot exhaust the
/// memory.
const MOST_STEPS_PER_SAMPLE: usize = 100;

/// Frames of a recording: one value per channel and time step, `NaN` where one is missing.
#[derive(Debug)]
pub struct Frames {
    /// Path of the recording.
    pub path: PathBuf,
    /// Names of the channels.
    pub names: Vec<String>,
    /// Sampling rate (Hz).
    pub rate_hz: f64,
    /// Time of the first frame, ns since the Unix epoch, UTC.
    pub start_ns: i64,
    /// Channels without use, each with the reason.
    pub left_out: Vec<(String, &'static str)>,
    /// Values, frame by frame.
    values: Vec<f64>,
}

/// Values of one channel with the position of their frames.
struct Column {
    name: String,
    values: Vec<(usize, f64)>,
}

/// The times of the frames.
#[derive(Clone, Copy)]
struct Grid<'p> {
    path: &'p Path,
    rate_hz: f64,
    start_ns: i64,
}

/// Which channels are used.
#[derive(Debug, Clone, Copy)]
pub struct Selection<'a> {
    /// Names of the channels; all if empty.
    pub only: &'a [String],
    /// Names of channels that are not used.
    pub without: &'a [String],
}

impl Selection<'_> {
    /// Returns `true` if the user has selected channels.
    pub fn is_some(&self) -> bool {
        !(self.only.is_empty() && self.without.is_empty())
    }

    fn takes(&self, name: &str) -> bool {
        (self.only.is_empty() || self.only.iter().any(|only| only == name))
            && !self.without.iter().any(|without| without == name)
    }

    /// Checks that all names exist.
    fn check<'n>(
        &self,
        path: &Path,
        known: impl Iterator<Item = &'n str> + Clone,
    ) -> Result<(), AppError> {
        let unknown = self
            .only
            .iter()
            .chain(self.without)
            .find(|name| !known.clone().any(|known| known == *name));
        unknown.map_or(Ok(()), |name| Err(unknown_channel(path, name, known)))
    }
}

/// Returns the error for a channel name that a recording does not have.
fn unknown_channel<'n>(path: &Path, name: &str, known: impl Iterator<Item = &'n str>) -> AppError {
    AppError::UnknownChannel {
        path: path.to_owned(),
        name: name.to_owned(),
        known: known.collect::<Vec<_>>().join(", "),
    }
}

impl Frames {
    /// Reads the channels of a recording as they are in the file.
    ///
    /// # Errors
    /// The file is not valid, a channel has no or another sampling rate, or fewer than two channels
    /// are of use.
    pub fn read(
        path: &Path,
        options: &ReadOptions,
        selection: Selection<'_>,
    ) -> Result<Self, AppError> {
        let file = RecordedFile::read(path, options)?;
        let all = file.channels();
        selection.check(path, all.iter().map(RecordedChannel::name))?;
        let chosen: Vec<&RecordedChannel> = all
            .iter()
            .filter(|channel| selection.takes(channel.name()))
            .collect();
        let rate_hz = common_rate(path, &chosen)?;
        let start_ns = chosen.iter().filter_map(|channel| channel.start_ns()).min();
        let start_ns = start_ns.unwrap_or(0);
        let columns = chosen
            .iter()
            .map(|channel| Column {
                name: channel.name().to_owned(),
                values: channel
                    .timed_samples()
                    .map(|(time_ns, value)| (frame_of(time_ns, start_ns, rate_hz), value))
                    .collect(),
            })
            .collect();
        let (used, left_out) = useful(columns);
        Self::of(
            Grid {
                path,
                rate_hz,
                start_ns,
            },
            used,
            left_out,
        )
    }

    /// Reads the channels of a structure, with the columns, units and rate of its structure file.
    ///
    /// # Errors
    /// As for [`Self::read()`]. Also, the recording does not match the structure file.
    pub fn of_structure(
        path: &Path,
        structure: &Structure,
        selection: Selection<'_>,
    ) -> Result<Self, AppError> {
        let names: Vec<&str> = structure.channels().map(|channel| channel.name()).collect();
        selection.check(path, names.iter().copied())?;
        let (start_ns, mut columns) = columns(path, structure)?;
        columns.retain(|column| selection.takes(&column.name));
        let (used, left_out) = useful(columns);
        let rate_hz = structure.sampling_rate_hz();
        Self::of(
            Grid {
                path,
                rate_hz,
                start_ns,
            },
            used,
            left_out,
        )
    }

    /// Reads the channels of a table `[modal]`. All of them are kept, as in live frames.
    ///
    /// # Errors
    /// As for [`Self::of_structure()`].
    pub fn of_plan(path: &Path, structure: &Structure, plan: &ModalPlan) -> Result<Self, AppError> {
        let (start_ns, columns) = columns(path, structure)?;
        let numbered = columns.into_iter().enumerate();
        let used = numbered.filter(|(position, _)| plan.channels.contains(position));
        let rate_hz = structure.sampling_rate_hz();
        let grid = Grid {
            path,
            rate_hz,
            start_ns,
        };
        Self::of(grid, used.map(|(_, column)| column).collect(), Vec::new())
    }

    fn of(
        grid: Grid<'_>,
        used: Vec<Column>,
        left_out: Vec<(String, &'static str)>,
    ) -> Result<Self, AppError> {
        let Grid {
            path,
            rate_hz,
            start_ns,
        } = grid;
        if used.len() < LEAST_CHANNELS {
            return Err(AppError::TooFewChannels {
                path: path.to_owned(),
                found: used.len(),
                left_out: listed(&left_out),
            });
        }
        let frames = used.iter().flat_map(|column| &column.values);
        let steps = frames.map(|(frame, _)| *frame).max().unwrap_or(0);
        let samples = used.iter().map(|column| column.values.len()).max();
        let samples = samples.unwrap_or(0);
        if steps > MOST_STEPS_PER_SAMPLE.saturating_mul(samples) {
            return Err(AppError::TooSparse {
                path: path.to_owned(),
                samples,
                steps,
            });
        }
        let length = steps + 1;
        let mut values = vec![f64::NAN; length * used.len()];
        for (position, column) in used.iter().enumerate() {
            for (frame, value) in &column.values {
                values[frame * used.len() + position] = *value;
            }
        }
        Ok(Self {
            path: path.to_owned(),
            names: used.into_iter().map(|column| column.name).collect(),
            rate_hz,
            start_ns,
            left_out,
            values,
        })
    }

    /// Returns the frames in order.
    pub fn iter(&self) -> impl Iterator<Item = &[f64]> {
        self.values.chunks_exact(self.names.len())
    }

    /// Returns the length of the recording (s).
    pub fn length_s(&self) -> f64 {
        (self.values.len() / self.names.len()) as f64 / self.rate_hz
    }

    /// Returns the position of a channel.
    ///
    /// # Errors
    /// No used channel has this name. The error lists the names.
    pub fn position(&self, name: &str) -> Result<usize, AppError> {
        let names = || self.names.iter().map(String::as_str);
        names()
            .position(|known| known == name)
            .ok_or_else(|| unknown_channel(&self.path, name, names()))
    }
}

/// Formats channels without use, each with its reason.
pub fn listed(left_out: &[(String, &'static str)]) -> String {
    let each = left_out
        .iter()
        .map(|(name, reason)| format!("{name} ({reason})"));
    each.collect::<Vec<_>>().join(", ")
}

/// Reads the channels of a structure, with the time of the first frame (ns).
fn columns(path: &Path, structure: &Structure) -> Result<(i64, Vec<Column>), AppError> {
    let rate_hz = structure.sampling_rate_hz();
    let mut columns: Vec<Column> = structure
        .channels()
        .map(|channel| Column {
            name: channel.name().to_owned(),
            values: Vec::new(),
        })
        .collect();
    let mut start_ns = None;
    for row in recorded_rows(open_record(structure, path)?, 0) {
        let row = row?;
        let start_ns = *start_ns.get_or_insert(row.time_ns);
        let frame = frame_of(row.time_ns, start_ns, rate_hz);
        for (column, value) in columns.iter_mut().zip(&row.values) {
            column.values.push((frame, *value));
        }
    }
    Ok((start_ns.unwrap_or(0), columns))
}

/// Divides columns into used ones, and those without use with the reason.
fn useful(columns: Vec<Column>) -> (Vec<Column>, Vec<(String, &'static str)>) {
    let mut left_out = Vec::new();
    let mut used = Vec::new();
    for column in columns {
        match uselessness(&column) {
            Some(reason) => left_out.push((column.name, reason)),
            None => used.push(column),
        }
    }
    (used, left_out)
}

fn frame_of(time_ns: i64, start_ns: i64, rate_hz: f64) -> usize {
    // A time before the start saturates to frame 0.
    (time_ns.saturating_sub(start_ns) as f64 * rate_hz / 1e9).round() as usize
}

/// Returns why a channel is of no use, or `None` if it is.
fn uselessness(column: &Column) -> Option<&'static str> {
    let mut present = column.values.iter().map(|(_, value)| *value);
    let first = present.find(|value| value.is_finite());
    match first {
        None => Some("no sample"),
        Some(first) => present
            .filter(|value| value.is_finite())
            .all(|value| value == first)
            .then_some("constant"),
    }
}

fn common_rate(path: &Path, channels: &[&RecordedChannel]) -> Result<f64, RecordError> {
    let rate = |channel: &RecordedChannel| {
        channel
            .sampling_rate_hz()
            .ok_or_else(|| RecordError::NoSamplingRate {
                path: path.to_owned(),
                channel: channel.name().to_owned(),
            })
    };
    let Some(first) = channels.first() else {
        return Ok(1.0); // too few channels, which is reported later
    };
    let first_hz = rate(first)?;
    for channel in channels {
        let found_hz = rate(channel)?;
        if (found_hz - first_hz).abs() > SAME_RATE * first_hz {
            return Err(RecordError::UnequalRates {
                path: path.to_owned(),
                channel: channel.name().to_owned(),
                found_hz,
                first: first.name().to_owned(),
                first_hz,
            });
        }
    }
    Ok(first_hz)
}
