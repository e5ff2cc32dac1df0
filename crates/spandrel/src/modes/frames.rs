//! The channels of a recording as frames of equal times.

use crate::error::AppError;
use spandrel_record::{Format, ReadOptions, RecordError, RecordedChannel, RecordedFile};
use spandrel_sensor::{open_record, recorded_rows};
use spandrel_structure::{Channel, ModalPlan, Structure};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use tracing::warn;

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

/// Where recordings come from, and how they are read.
#[derive(Debug, Clone, Copy)]
pub enum Reading<'a> {
    /// All channels of each file.
    Files(&'a ReadOptions, Selection<'a>),
    /// The channels of a structure, with the columns, units and rate of its structure file.
    Structure(&'a Structure, Selection<'a>),
    /// The channels of a table `[modal]`. All of them are kept, as in live frames.
    Plan(&'a Structure, &'a ModalPlan),
}

/// The columns of one recording.
struct Loaded<'p> {
    grid: Grid<'p>,
    columns: Vec<Column>,
}

/// Returns the recordings of a folder: its files if all of them have the same two or more channels,
/// and otherwise the folder as a whole.
///
/// # Errors
/// Returns an error if the folder or one of its files cannot be read.
pub fn recordings(path: &Path, options: &ReadOptions) -> Result<Vec<PathBuf>, AppError> {
    let whole = vec![path.to_owned()];
    if !path.is_dir() {
        return Ok(whole);
    }
    let file = RecordedFile::read(path, options)?;
    // Channels of one name have the name of their file before it.
    let mut of_file: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for channel in file.channels() {
        match channel.name().split_once('/') {
            Some((stem, name)) => of_file.entry(stem).or_default().push(name),
            None => return Ok(whole),
        }
    }
    let mut channels = of_file.values();
    let first = channels.next();
    let is_same = first
        .is_some_and(|first| first.len() >= LEAST_CHANNELS && channels.all(|other| other == first));
    if file.format() != Format::Folder || of_file.len() < 2 || !is_same {
        return Ok(whole);
    }
    let cannot_list = |source| AppError::Io {
        what: format!("{}: cannot be listed", path.display()),
        source,
    };
    let mut members = Vec::new();
    for entry in std::fs::read_dir(path).map_err(cannot_list)? {
        let member = entry.map_err(cannot_list)?.path();
        let stem = member.file_stem().map(|stem| stem.to_string_lossy());
        if stem.is_some_and(|stem| of_file.contains_key(&*stem)) {
            members.push(member);
        }
    }
    members.sort_unstable();
    Ok(members)
}

impl Frames {
    /// Reads recordings of the same channels at the same rate.
    ///
    /// # Errors
    /// Returns an error if a file is not valid or does not match the structure file, a channel has
    /// no or another sampling rate, a recording has other channels than the first, or fewer than
    /// two channels are of use.
    pub fn read(paths: &[PathBuf], reading: Reading<'_>) -> Result<Vec<Self>, AppError> {
        let loaded = paths.iter().map(|path| Loaded::read(path, reading));
        let loaded: Vec<Loaded<'_>> = loaded.collect::<Result<_, _>>()?;
        if let Some(first) = loaded.first() {
            loaded.iter().try_for_each(|other| other.check(first))?;
        }
        let count = loaded.first().map_or(0, |loaded| loaded.columns.len());
        let useless: Vec<Option<&'static str>> = (0..count)
            .map(|position| match reading {
                Reading::Plan(..) => None,
                Reading::Files(..) => uselessness(&loaded, position),
                Reading::Structure(structure, selection) => {
                    excitation(structure, selection, &loaded, position)
                        .or_else(|| uselessness(&loaded, position))
                }
            })
            .collect();
        let frames = loaded.into_iter().map(|loaded| {
            let mut left_out = Vec::new();
            let mut used = Vec::new();
            for (column, useless) in loaded.columns.into_iter().zip(&useless) {
                match useless {
                    Some(reason) => left_out.push((column.name, *reason)),
                    None => used.push(column),
                }
            }
            Self::of(loaded.grid, used, left_out)
        });
        frames.collect()
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
    /// Returns an error if no used channel has this name. The error lists the names.
    pub fn position(&self, name: &str) -> Result<usize, AppError> {
        let names = || self.names.iter().map(String::as_str);
        names()
            .position(|known| known == name)
            .ok_or_else(|| unknown_channel(&self.path, name, names()))
    }
}

impl<'p> Loaded<'p> {
    fn read(path: &'p Path, reading: Reading<'_>) -> Result<Self, AppError> {
        match reading {
            Reading::Files(options, selection) => Self::of_file(path, options, selection),
            Reading::Structure(structure, selection) => {
                let names: Vec<&str> = structure.channels().map(Channel::name).collect();
                selection.check(path, names.iter().copied())?;
                let mut loaded = Self::of_structure(path, structure)?;
                loaded
                    .columns
                    .retain(|column| selection.takes(&column.name));
                Ok(loaded)
            }
            Reading::Plan(structure, plan) => {
                let loaded = Self::of_structure(path, structure)?;
                let numbered = loaded.columns.into_iter().enumerate();
                let used = numbered.filter(|(position, _)| plan.channels.contains(position));
                Ok(Self {
                    columns: used.map(|(_, column)| column).collect(),
                    ..loaded
                })
            }
        }
    }

    fn of_file(
        path: &'p Path,
        options: &ReadOptions,
        selection: Selection<'_>,
    ) -> Result<Self, AppError> {
        let file = RecordedFile::read(path, options)?;
        for doubt in file.doubts() {
            warn!(record = %path.display(), doubt, "times of channels are in doubt");
        }
        let all = file.channels();
        selection.check(path, all.iter().map(RecordedChannel::name))?;
        let chosen: Vec<&RecordedChannel> = all
            .iter()
            .filter(|channel| selection.takes(channel.name()))
            .collect();
        let rate_hz = common_rate(path, &chosen)?;
        let start_ns = chosen.iter().filter_map(|channel| channel.start_ns()).min();
        let start_ns = start_ns.unwrap_or(0);
        let columns = chosen.iter().map(|channel| Column {
            name: channel.name().to_owned(),
            values: channel
                .timed_samples()
                .map(|(time_ns, value)| (frame_of(time_ns, start_ns, rate_hz), value))
                .collect(),
        });
        Ok(Self {
            grid: Grid {
                path,
                rate_hz,
                start_ns,
            },
            columns: columns.collect(),
        })
    }

    /// Reads the channels of a structure, with the time of the first frame.
    fn of_structure(path: &'p Path, structure: &Structure) -> Result<Self, AppError> {
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
        Ok(Self {
            grid: Grid {
                path,
                rate_hz,
                start_ns: start_ns.unwrap_or(0),
            },
            columns,
        })
    }

    /// Checks that the recording has the channels and the rate of the first one.
    fn check(&self, first: &Self) -> Result<(), AppError> {
        let names = |loaded: &Self| {
            let names = loaded.columns.iter().map(|column| column.name.as_str());
            names.collect::<Vec<_>>().join(", ")
        };
        let same_rate = SAME_RATE * first.grid.rate_hz;
        let (found, expected) = match (names(self), names(first)) {
            (found, expected) if found != expected => {
                (format!("channels {found}"), format!("channels {expected}"))
            }
            _ if (self.grid.rate_hz - first.grid.rate_hz).abs() > same_rate => (
                format!("{} Hz", self.grid.rate_hz),
                format!("{} Hz", first.grid.rate_hz),
            ),
            _ => return Ok(()),
        };
        Err(AppError::UnlikeRecordings {
            path: self.grid.path.to_owned(),
            found,
            first: first.grid.path.to_owned(),
            expected,
        })
    }
}

/// Formats the channels that are not used, each with its reason.
pub fn listed(left_out: &[(String, &'static str)]) -> String {
    let each = left_out
        .iter()
        .map(|(name, reason)| format!("{name} ({reason})"));
    each.collect::<Vec<_>>().join(", ")
}

fn frame_of(time_ns: i64, start_ns: i64, rate_hz: f64) -> usize {
    // A time before the start saturates to frame 0.
    (time_ns.saturating_sub(start_ns) as f64 * rate_hz / 1e9).round() as usize
}

/// Returns why a channel of a structure does not take part unless the user names it: its motion has
/// the peaks of the excitation.
fn excitation(
    structure: &Structure,
    selection: Selection<'_>,
    loaded: &[Loaded<'_>],
    position: usize,
) -> Option<&'static str> {
    let name = &loaded.first()?.columns[position].name;
    let channel = structure
        .channels()
        .find(|channel| channel.name() == name)?;
    let is_left_out = selection.only.is_empty() && channel.quantity().is_excitation();
    is_left_out.then_some("measures the excitation")
}

/// Returns why a channel is of no use in any of the recordings, or `None` if it is in one.
fn uselessness(loaded: &[Loaded<'_>], position: usize) -> Option<&'static str> {
    let reasons = loaded.iter().map(|loaded| {
        let values = &loaded.columns[position].values;
        let mut present = values.iter().map(|(_, value)| *value);
        match present.find(|value| value.is_finite()) {
            None => Some("no sample"),
            Some(first) => present
                .filter(|value| value.is_finite())
                .all(|value| value == first)
                .then_some("constant"),
        }
    });
    reasons.reduce(|one, other| one.and(other)).flatten()
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

#[cfg(test)]
mod tests {
    use super::*;

    const TABLE: &str = include_str!("../../../../docs/examples/shake-table-stiff.toml");

    /// Returns the frames of a recording of the table, with the channels that `only` names.
    fn frames(only: &[String]) -> Frames {
        let structure = Structure::parse(TABLE, Path::new("table.toml")).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("record.csv");
        let mut text = "time_s,ground_mps2,floor1_mps2,floor2_mps2,floor3_mps2\n".to_owned();
        for row in 0..120 {
            text += &format!("{:.6},{row},{row},{row},{row}\n", f64::from(row) / 120.0);
        }
        std::fs::write(&path, text).unwrap();
        let selection = Selection { only, without: &[] };
        let all = Frames::read(&[path], Reading::Structure(&structure, selection));
        all.unwrap().remove(0)
    }

    #[test]
    fn measured_excitation_of_a_structure_takes_part_only_if_it_is_named() {
        let all = frames(&[]);
        assert_eq!(all.names, ["floor-1", "floor-2", "floor-3"]);
        assert_eq!(listed(&all.left_out), "ground (measures the excitation)");
        let named = frames(&["ground", "floor-3"].map(str::to_owned));
        assert_eq!(named.names, ["ground", "floor-3"]);
        assert_eq!(named.left_out, []);
    }
}
