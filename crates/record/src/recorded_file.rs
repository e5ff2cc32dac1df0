//! Reads the channels of a file of any format.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Cursor, Read};
use std::path::{Path, PathBuf};

use crate::column_mapping::places_of;
use crate::fault::Fault;
use crate::formats::frames::FrameRows;
use crate::formats::{at2, cosmos, csmip, matlab, mcap, mini_seed, smc, table, tdms, uff58};
use crate::frame_log;
use crate::table_layout::HEAD_BYTES;
use crate::unpacked::UnpackingBudget;
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
}

/// Maximum nesting depth of archives.
const DEEPEST: usize = 3;
/// Maximum number of files in an archive or folder.
const MOST_MEMBERS: usize = 10_000;

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
    /// The format is unknown, or the content violates it. The error states the position.
    pub fn read(path: &Path, options: &ReadOptions) -> Result<Self, RecordError> {
        if let Some(found_hz) = options
            .sampling_rate_hz
            .filter(|rate_hz| !(rate_hz.is_finite() && *rate_hz > 0.0))
        {
            return Err(RecordError::DeclaredRate { found_hz });
        }
        let contents = match path.is_dir() {
            true if has_frame_log(path)? => frame_log_folder(path)?,
            true => Reading::of(options).members(folder_members(path)?, path, Format::Folder, 0)?,
            false => Reading::of(options).bytes(file_bytes(path)?, path, 0)?,
        };
        let declared = |channel: RecordedChannel| match options.sampling_rate_hz {
            Some(rate_hz) => channel.with_declared_rate(rate_hz),
            None => channel,
        };
        let Contents {
            format,
            channels,
            remarks,
        } = contents;
        let channels = channels.into_iter().map(declared).collect();
        Ok(Self {
            path: path.to_owned(),
            format,
            channels,
            remarks,
        })
    }

    /// Creates a recording from existing channels.
    pub fn from_channels(path: &Path, format: Format, channels: Vec<RecordedChannel>) -> Self {
        Self {
            path: path.to_owned(),
            format,
            channels,
            remarks: Vec::new(),
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

fn file_bytes(path: &Path) -> Result<Vec<u8>, RecordError> {
    let mut file = File::open(path).map_err(|source| RecordError::Open {
        path: path.to_owned(),
        source,
    })?;
    let mut bytes = Vec::new();
    file.read_to_end(&mut bytes)
        .map_err(|source| RecordError::ReadFile {
            path: path.to_owned(),
            source,
        })?;
    Ok(bytes)
}

fn head_of(bytes: &[u8]) -> &[u8] {
    &bytes[..bytes.len().min(HEAD_BYTES as usize)]
}

fn fault(path: &Path, format: Format, fault: Fault) -> RecordError {
    RecordError::Format {
        path: path.to_owned(),
        format: format.name(),
        fault: Box::new(fault),
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
            budget: UnpackingBudget::new(),
        }
    }

    /// Reads the content of a file.
    fn bytes(
        &mut self,
        bytes: Vec<u8>,
        path: &Path,
        depth: usize,
    ) -> Result<Contents, RecordError> {
        let Some(format) = Format::of(head_of(&bytes), path) else {
            return Err(RecordError::UnknownFormat {
                path: path.to_owned(),
                allowed: Format::names(),
            });
        };
        let refused = |source: Fault| fault(path, format, source);
        let mut remarks = Vec::new();
        let channels = match format {
            Format::Table => table::read(bytes, path, self.options)?,
            Format::MiniSeed => mini_seed::read(&bytes).map_err(refused)?,
            Format::Cosmos => cosmos::read(&bytes).map_err(refused)?,
            Format::Csmip => csmip::read(&bytes).map_err(refused)?,
            Format::Matlab => matlab::read(&bytes).map_err(refused)?,
            Format::Uff58 => uff58::read(&bytes).map_err(refused)?,
            Format::At2 => at2::read(&bytes).map_err(refused)?,
            Format::Smc => smc::read(&bytes).map_err(refused)?,
            Format::Tdms => tdms::read(&bytes).map_err(refused)?,
            Format::Mcap => {
                let (channels, told) = mcap::read(&bytes).map_err(refused)?;
                remarks = told;
                channels
            }
            Format::Gzip | Format::Zip if depth >= DEEPEST => {
                return Err(refused(Fault::of_file(
                    "depth of archives in archives",
                    depth + 1,
                    format!("at most {DEEPEST}"),
                )));
            }
            Format::Gzip => {
                let inner = self
                    .budget
                    .unpack(flate2::read::MultiGzDecoder::new(bytes.as_slice()))
                    .map_err(|found| {
                        refused(Fault::of_file("compressed content", found, "gzip data"))
                    })?;
                return self.bytes(inner, &path.with_extension(""), depth + 1);
            }
            Format::Zip => {
                let members = zip_members(&bytes, path, &mut self.budget)?;
                return self.members(members, path, format, depth);
            }
            // A path can be a folder, but bytes cannot.
            Format::Folder => Vec::new(),
        };
        Ok(Contents {
            format,
            channels,
            remarks,
        })
    }

    /// Reads all members that are recordings. If a channel name is not unique, the name of its file
    /// is prepended.
    fn members(
        &mut self,
        members: Members,
        path: &Path,
        format: Format,
        depth: usize,
    ) -> Result<Contents, RecordError> {
        let mut channels: Vec<(String, RecordedChannel)> = Vec::new();
        let (mut remarks, mut left_out) = (Vec::new(), Vec::new());
        for (name, bytes) in members {
            // Only the content counts, because an archive may also contain readme files.
            if Format::of_content(head_of(&bytes)).is_none() {
                left_out.push(name);
                continue;
            }
            let contents = self.bytes(bytes, &path.join(&name), depth + 1)?;
            let stem = Path::new(&name)
                .with_extension("")
                .to_string_lossy()
                .into_owned();
            remarks.extend(
                contents
                    .remarks
                    .into_iter()
                    .map(|remark| format!("{name}: {remark}")),
            );
            channels.extend(
                contents
                    .channels
                    .into_iter()
                    .map(|channel| (stem.clone(), channel)),
            );
        }
        if channels.is_empty() {
            let found = if left_out.is_empty() {
                "no file".to_owned()
            } else {
                left_out.join(", ")
            };
            return Err(fault(
                path,
                format,
                Fault::of_file("content", found, "at least one recording of a known format"),
            ));
        }
        if !left_out.is_empty() {
            remarks.push(format!("skipped, unknown format: {}", left_out.join(", ")));
        }
        let mut times: BTreeMap<String, usize> = BTreeMap::new();
        for (_, channel) in &channels {
            *times.entry(channel.name().to_owned()).or_default() += 1;
        }
        let unique = |(stem, channel): (String, RecordedChannel)| match times.get(channel.name()) {
            Some(2..) => {
                let name = format!("{stem}/{}", channel.name());
                channel.with_name(name)
            }
            _ => channel,
        };
        Ok(Contents {
            format,
            channels: channels.into_iter().map(unique).collect(),
            remarks,
        })
    }
}

/// The files of an archive or folder: name and content.
type Members = Vec<(String, Vec<u8>)>;

fn zip_members(
    bytes: &[u8],
    path: &Path,
    budget: &mut UnpackingBudget,
) -> Result<Members, RecordError> {
    let refused = |what: String, error: zip::result::ZipError| {
        fault(
            path,
            Format::Zip,
            Fault::of_file(what, format!("damaged ({error})"), "whole"),
        )
    };
    let mut archive = zip::ZipArchive::new(Cursor::new(bytes))
        .map_err(|error| refused("archive".to_owned(), error))?;
    if archive.len() > MOST_MEMBERS {
        let found = Fault::of_file(
            "number of files",
            archive.len(),
            format!("at most {MOST_MEMBERS}"),
        );
        return Err(fault(path, Format::Zip, found));
    }
    let mut members = Vec::new();
    for index in 0..archive.len() {
        let member = archive
            .by_index(index)
            .map_err(|error| refused(format!("file {}", index + 1), error))?;
        if member.is_dir() {
            continue;
        }
        let name = member
            .name()
            .map_err(|error| refused(format!("name of file {}", index + 1), error))?
            .into_owned();
        let content = budget.unpack(member).map_err(|found| {
            fault(
                &path.join(&name),
                Format::Zip,
                Fault::of_file("compressed content", found, "whole"),
            )
        })?;
        members.push((name, content));
    }
    Ok(members)
}

/// Returns the files of a folder, sorted by name.
fn folder_files(path: &Path) -> Result<Vec<PathBuf>, RecordError> {
    let refused = |source| RecordError::ReadFile {
        path: path.to_owned(),
        source,
    };
    let mut files = Vec::new();
    for entry in std::fs::read_dir(path).map_err(refused)? {
        let file = entry.map_err(refused)?.path();
        if file.is_file() {
            files.push(file);
        }
        if files.len() > MOST_MEMBERS {
            let found =
                Fault::of_file("number of files", "more", format!("at most {MOST_MEMBERS}"));
            return Err(fault(path, Format::Folder, found));
        }
    }
    files.sort_unstable();
    Ok(files)
}

fn name_of(file: &Path) -> String {
    file.file_name()
        .map(|name| name.to_string_lossy().into_owned())
        .unwrap_or_default()
}

fn folder_members(path: &Path) -> Result<Members, RecordError> {
    folder_files(path)?
        .into_iter()
        .map(|file| Ok((name_of(&file), file_bytes(&file)?)))
        .collect()
}

/// Returns `true` if a folder contains a frame log.
fn has_frame_log(path: &Path) -> Result<bool, RecordError> {
    Ok(folder_files(path)?
        .iter()
        .any(|file| frame_log::is_segment(&name_of(file))))
}

/// Reads all segments of a frame log as one recording.
fn frame_log_folder(path: &Path) -> Result<Contents, RecordError> {
    let mut frames = FrameRows::default();
    let (mut remarks, mut left_out) = (Vec::new(), Vec::new());
    for file in folder_files(path)? {
        let name = name_of(&file);
        if frame_log::is_segment(&name) {
            let read = mcap::read_frames(&file_bytes(&file)?, &mut frames);
            let told = read.map_err(|source| fault(&file, Format::Mcap, source))?;
            remarks.extend(told.into_iter().map(|remark| format!("{name}: {remark}")));
        } else if !frame_log::is_lock(&name) {
            left_out.push(name);
        }
    }
    if !left_out.is_empty() {
        remarks.push(format!(
            "skipped, not segments of the frame log: {}",
            left_out.join(", ")
        ));
    }
    let (channels, told) = frames.channels();
    remarks.extend(told);
    Ok(Contents {
        format: Format::Folder,
        channels,
        remarks,
    })
}

#[cfg(test)]
mod tests;
