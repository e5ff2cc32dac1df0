//! Reads the channels of a file of any format.

mod frame_log_folder;
mod members;
mod starts;

use std::io::{self, BufReader, Cursor};
use std::path::{Path, PathBuf};

use crate::column_mapping::places_of;
use crate::fault::Fault;
use crate::format::wide_encoding;
use crate::formats::{at2, cosmos, csmip, matlab, mcap, mini_seed, smc, table, tdms, uff58};
use crate::source::{Source, open_file};
use crate::unpacked::{Packed, Refusal, UnpackingBudget};
use crate::{ColumnMapping, Format, RecordError, RecordedChannel, TimeUnit};

/// Properties that a file may not state itself.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ReadOptions {
    /// Name of the time column of a table.
    pub time_column: Option<String>,
    /// Unit of numeric times in a table; seconds if `None`.
    pub time_unit: Option<TimeUnit>,
    /// Sampling rate in Hz of channels for which the file does not state one.
    pub sampling_rate_hz: Option<f64>,
}

/// A recording as stored in a file, completely in memory.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordedFile {
    path: PathBuf,
    format: Format,
    channels: Vec<RecordedChannel>,
    remarks: Vec<String>,
    doubts: Vec<String>,
}

/// Maximum nesting depth of archives.
const DEEPEST: usize = 3;

/// The content of a file.
struct Contents {
    format: Format,
    channels: Vec<RecordedChannel>,
    remarks: Vec<String>,
}

impl RecordedFile {
    /// Reads a file of any known format, detected by its content and then by its name, or all
    /// recordings in a folder.
    ///
    /// # Errors
    /// Returns an error if the format is unknown, or if the content violates it. The error states
    /// the position.
    pub fn read(path: &Path, options: &ReadOptions) -> Result<Self, RecordError> {
        if let Some(found_hz) = options
            .sampling_rate_hz
            .filter(|rate_hz| !(rate_hz.is_finite() && *rate_hz > 0.0))
        {
            return Err(RecordError::DeclaredRate { found_hz });
        }
        let contents = match path.is_dir() {
            true if frame_log_folder::is_there(path)? => frame_log_folder::read(path)?,
            true => Reading::of(options).folder(path)?,
            false => Reading::of(options).source(Source::open(path)?, &FileLocation::of(path))?,
        };
        let declared = |channel: RecordedChannel| match options.sampling_rate_hz {
            Some(rate_hz) => channel.with_declared_rate(rate_hz),
            None => channel,
        };
        let Contents {
            format,
            channels,
            mut remarks,
        } = contents;
        let (channels, doubts) = starts::align(format, channels);
        remarks.extend_from_slice(&doubts);
        let channels = channels.into_iter().map(declared).collect();
        Ok(Self {
            path: path.to_owned(),
            format,
            channels,
            remarks,
            doubts,
        })
    }

    /// Creates a recording from existing channels.
    pub fn from_channels(path: &Path, format: Format, channels: Vec<RecordedChannel>) -> Self {
        Self {
            path: path.to_owned(),
            format,
            channels,
            remarks: Vec::new(),
            doubts: Vec::new(),
        }
    }

    /// Returns the path of the file or folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the format.
    pub fn format(&self) -> Format {
        self.format
    }

    /// Returns the channels, in the order of the file.
    pub fn channels(&self) -> &[RecordedChannel] {
        &self.channels
    }

    /// Returns remarks for the user, such as a truncated file or ignored files of an archive.
    pub fn remarks(&self) -> &[String] {
        &self.remarks
    }

    /// Returns those remarks that a computation with the recording should repeat: the times of some
    /// channels are assumed, or do not fit together.
    pub fn doubts(&self) -> &[String] {
        &self.doubts
    }

    /// Keeps only the channels of a mapping, or all channels if none matches. Later steps report
    /// missing channels.
    pub(crate) fn only(self, mapping: &ColumnMapping) -> Self {
        let names = self.channels.iter().map(RecordedChannel::name);
        let mut mapped: Vec<usize> = mapping
            .channels()
            .iter()
            .flat_map(|column| places_of(column.column(), names.clone()))
            .collect();
        mapped.sort_unstable();
        mapped.dedup();
        let channels = match mapped.is_empty() {
            false => mapped
                .into_iter()
                .filter_map(|place| self.channels.get(place))
                .cloned()
                .collect(),
            true => self.channels.clone(),
        };
        self.with_channels(channels)
    }

    /// Returns the same recording with other channels.
    pub(crate) fn with_channels(self, channels: Vec<RecordedChannel>) -> Self {
        Self { channels, ..self }
    }
}

fn fault(path: &Path, format: Format, fault: Fault) -> RecordError {
    RecordError::Format {
        path: path.to_owned(),
        format: format.name(),
        fault: Box::new(fault),
    }
}

/// The position of a file: its path, with the names of archives around it, and their number.
#[derive(Debug, Clone)]
struct FileLocation {
    path: PathBuf,
    depth: usize,
    /// The innermost archive around the file.
    archive: Option<(PathBuf, Format)>,
}

impl FileLocation {
    fn of(path: &Path) -> Self {
        Self {
            path: path.to_owned(),
            depth: 0,
            archive: None,
        }
    }

    /// Returns the position `path` of a file in an archive at this position.
    fn inside(&self, format: Format, path: PathBuf) -> Self {
        Self {
            path,
            depth: self.depth + 1,
            archive: Some((self.path.clone(), format)),
        }
    }

    /// Returns the error of reading a table. Damaged compressed data have no line.
    fn unreadable_table(&self, error: RecordError) -> RecordError {
        match error {
            RecordError::Read { source, .. } if self.archive.is_some() => {
                match source.into_kind() {
                    csv::ErrorKind::Io(error) => self.unreadable(error),
                    kind => self.unreadable(io::Error::other(format!("{kind:?}"))),
                }
            }
            error => error,
        }
    }

    /// Returns the error of reading the file.
    fn unreadable(&self, source: io::Error) -> RecordError {
        match &self.archive {
            Some((path, Format::Gzip)) => {
                let refusal = Refusal::of(&source, "gzip data");
                fault(path, Format::Gzip, refusal.of_file())
            }
            Some((_, format)) => {
                let refusal = Refusal::of(&source, "whole");
                fault(&self.path, *format, refusal.of_file())
            }
            None => RecordError::ReadFile {
                path: self.path.clone(),
                source,
            },
        }
    }
}

/// The state of reading a file and all files inside it.
struct Reading<'a> {
    options: &'a ReadOptions,
    budget: UnpackingBudget,
}

impl<'a> Reading<'a> {
    fn of(options: &'a ReadOptions) -> Self {
        Self {
            options,
            budget: UnpackingBudget::of_archive(),
        }
    }

    /// Reads the content of a file. Only tables are read row by row.
    fn source(&self, source: Source<'_>, location: &FileLocation) -> Result<Contents, RecordError> {
        let path = location.path.as_path();
        let Some(format) = Format::of(source.head(), path) else {
            let path = path.to_owned();
            return Err(match wide_encoding(source.head()) {
                Some(found) => RecordError::Encoding { path, found },
                None => RecordError::UnknownFormat {
                    path,
                    allowed: Format::names(),
                },
            });
        };
        match format {
            Format::Table => Ok(Contents {
                format,
                channels: table::read(source, path, self.options)
                    .map_err(|error| location.unreadable_table(error))?,
                remarks: Vec::new(),
            }),
            Format::Gzip | Format::Zip if location.depth >= DEEPEST => Err(fault(
                path,
                format,
                Fault::of_file(
                    "depth of archives in archives",
                    location.depth + 1,
                    format!("at most {DEEPEST}"),
                ),
            )),
            Format::Gzip => {
                let inner = location.inside(format, path.with_extension(""));
                let packed = self.packed(source.into_reader(), location);
                let decoder = flate2::read::MultiGzDecoder::new(packed);
                let unpacked = Source::new(self.budget.unpacked(decoder));
                self.source(unpacked.map_err(|error| inner.unreadable(error))?, &inner)
            }
            // An archive has its list of files at the end. A file can be read there without the
            // rest.
            Format::Zip if location.archive.is_none() => {
                self.zip(BufReader::new(open_file(path)?), location)
            }
            _ => {
                let bytes = source
                    .into_bytes()
                    .map_err(|error| location.unreadable(error))?;
                self.bytes(bytes, format, location)
            }
        }
    }

    /// Returns a reader of compressed data. Only the outermost archive is as large as the data on
    /// disk, so that only its bytes count.
    fn packed<R>(&self, input: R, location: &FileLocation) -> Packed<R> {
        match location.archive {
            None => self.budget.packed(input),
            Some(_) => UnpackingBudget::of_archive().packed(input),
        }
    }

    /// Reads a file of a format that requires the whole file.
    fn bytes(
        &self,
        bytes: Vec<u8>,
        format: Format,
        location: &FileLocation,
    ) -> Result<Contents, RecordError> {
        let refused = |source: Fault| fault(&location.path, format, source);
        let mut remarks = Vec::new();
        let channels = match format {
            Format::MiniSeed => mini_seed::read(&bytes).map_err(refused)?,
            Format::Cosmos => cosmos::read(&bytes).map_err(refused)?,
            Format::Csmip => csmip::read(&bytes).map_err(refused)?,
            Format::Matlab => {
                let of_file = UnpackingBudget::of_file();
                of_file.count_packed(bytes.len() as u64);
                let budget = match location.archive {
                    None => &of_file,
                    Some(_) => &self.budget,
                };
                matlab::read(&bytes, budget).map_err(refused)?
            }
            Format::Uff58 => uff58::read(&bytes).map_err(refused)?,
            Format::At2 => at2::read(&bytes).map_err(refused)?,
            Format::Smc => smc::read(&bytes).map_err(refused)?,
            Format::Tdms => tdms::read(&bytes).map_err(refused)?,
            Format::Mcap => {
                let (channels, told) = mcap::read(&bytes).map_err(refused)?;
                remarks = told;
                channels
            }
            Format::Zip => return self.zip(Cursor::new(bytes), location),
            // Tables and gzip are streams. A path can be a folder, but bytes cannot.
            Format::Table | Format::Gzip | Format::Folder => Vec::new(),
        };
        Ok(Contents {
            format,
            channels,
            remarks,
        })
    }
}

#[cfg(test)]
mod tests;
