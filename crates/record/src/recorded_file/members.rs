//! Reads the recordings in an archive or folder.

use std::collections::BTreeMap;
use std::io::{Read, Seek};
use std::path::{Path, PathBuf};

use super::{Contents, FileLocation, Reading, fault};
use crate::fault::Fault;
use crate::source::Source;
use crate::{Format, RecordError, RecordedChannel};

/// Maximum number of files in an archive or folder.
const MOST_MEMBERS: usize = 10_000;

/// The files read so far.
#[derive(Default)]
struct Members {
    files: Vec<Member>,
    remarks: Vec<String>,
    /// Names of files in no known format.
    left_out: Vec<String>,
}

/// A file of an archive or folder that is a recording.
struct Member {
    name: String,
    channels: Vec<RecordedChannel>,
}

impl Reading<'_> {
    /// Reads all recordings in a folder.
    pub(super) fn folder(&self, path: &Path) -> Result<Contents, RecordError> {
        let mut members = Members::default();
        for file in folder_files(path)? {
            let source = Source::open(&file)?;
            let location = FileLocation {
                depth: 1,
                ..FileLocation::of(&file)
            };
            // A file in a folder may unpack as much as if it were read alone.
            Self::of(self.options).member(&mut members, name_of(&file), source, &location)?;
        }
        members.finish(path, Format::Folder)
    }

    /// Reads all recordings in a zip archive.
    pub(super) fn zip(
        &self,
        input: impl Read + Seek + Send,
        location: &FileLocation,
    ) -> Result<Contents, RecordError> {
        let path = location.path.as_path();
        let refused = |what: String, error: zip::result::ZipError| {
            fault(
                path,
                Format::Zip,
                Fault::of_file(what, format!("damaged ({error})"), "whole"),
            )
        };
        let mut archive = zip::ZipArchive::new(self.packed(input, location))
            .map_err(|error| refused("archive".to_owned(), error))?;
        if archive.len() > MOST_MEMBERS {
            let found = Fault::of_file(
                "number of files",
                archive.len(),
                format!("at most {MOST_MEMBERS}"),
            );
            return Err(fault(path, Format::Zip, found));
        }
        let mut members = Members::default();
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
            let inside = location.inside(Format::Zip, path.join(&name));
            let unreadable = |error| inside.unreadable(error);
            let stated = member.size();
            let source = Source::new(self.budget.unpacked(member)).map_err(unreadable)?;
            if Format::of_content(source.head()).is_some() {
                let rest = stated.saturating_sub(source.head().len() as u64);
                self.budget.check_stated(rest).map_err(unreadable)?;
            }
            self.member(&mut members, name, source, &inside)?;
        }
        members.finish(path, Format::Zip)
    }

    /// Adds a file if it is a recording.
    fn member(
        &self,
        members: &mut Members,
        name: String,
        source: Source<'_>,
        location: &FileLocation,
    ) -> Result<(), RecordError> {
        // Only the content counts, because an archive may also contain readme files.
        if Format::of_content(source.head()).is_none() {
            members.left_out.push(name);
            return Ok(());
        }
        let contents = self.source(source, location)?;
        let remarks = contents.remarks.into_iter();
        members
            .remarks
            .extend(remarks.map(|remark| format!("{name}: {remark}")));
        members.files.push(Member {
            name,
            channels: contents.channels,
        });
        Ok(())
    }
}

impl Members {
    /// Returns all channels. If a channel name is not unique, the name of its file is prepended.
    fn finish(self, path: &Path, format: Format) -> Result<Contents, RecordError> {
        let Self {
            mut files,
            mut remarks,
            left_out,
        } = self;
        if files.iter().all(|file| file.channels.is_empty()) {
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
        let repeated = remove_repeated(&mut files);
        if !repeated.is_empty() {
            remarks.push(format!(
                "skipped, other files have the same channels and samples: {}",
                repeated.join(", ")
            ));
        }
        let mut times: BTreeMap<String, usize> = BTreeMap::new();
        for channel in files.iter().flat_map(|file| &file.channels) {
            *times.entry(channel.name().to_owned()).or_default() += 1;
        }
        let mut channels = Vec::new();
        for file in files {
            let stem = Path::new(&file.name).with_extension("");
            let unique = |channel: RecordedChannel| match times.get(channel.name()) {
                Some(2..) => {
                    let name = format!("{}/{}", stem.display(), channel.name());
                    channel.with_name(name)
                }
                _ => channel,
            };
            channels.extend(file.channels.into_iter().map(unique));
        }
        Ok(Contents {
            format,
            channels,
            remarks,
        })
    }
}

/// Removes each file whose channels are all in other files as well, and returns its name.
///
/// Some archives have the same data twice, as one file of all channels and as one file per channel.
/// Channels with a missing sample (`NaN`) count as different.
fn remove_repeated(files: &mut Vec<Member>) -> Vec<String> {
    let mut repeated = Vec::new();
    let mut place = 0;
    while let Some(file) = files.get(place) {
        let is_elsewhere = |channel: &RecordedChannel| {
            let others = files
                .iter()
                .enumerate()
                .filter(|(other, _)| *other != place);
            others
                .flat_map(|(_, other)| &other.channels)
                .any(|other| other == channel)
        };
        if !file.channels.is_empty() && file.channels.iter().all(is_elsewhere) {
            repeated.push(files.remove(place).name);
        } else {
            place += 1;
        }
    }
    repeated
}

/// Returns the files of a folder, sorted by name.
pub(super) fn folder_files(path: &Path) -> Result<Vec<PathBuf>, RecordError> {
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

pub(super) fn name_of(file: &Path) -> String {
    file.file_name()
        .map(|name| name.to_string_lossy().into_owned())
        .unwrap_or_default()
}
