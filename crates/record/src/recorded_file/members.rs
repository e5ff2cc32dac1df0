//! Reads the recordings in an archive or folder.

use std::collections::BTreeMap;
use std::io::{Read, Seek};
use std::path::{Path, PathBuf};

use super::{Contents, Place, Reading, fault};
use crate::fault::Fault;
use crate::source::Source;
use crate::{Format, RecordError, RecordedChannel};

/// Maximum number of files in an archive or folder.
const MOST_MEMBERS: usize = 10_000;

/// The channels of the files read so far.
#[derive(Default)]
struct Members {
    /// Name of the file without its extension, and channel.
    channels: Vec<(String, RecordedChannel)>,
    remarks: Vec<String>,
    /// Names of files in no known format.
    left_out: Vec<String>,
}

impl Reading<'_> {
    /// Reads all recordings in a folder.
    pub(super) fn folder(&self, path: &Path) -> Result<Contents, RecordError> {
        let mut members = Members::default();
        for file in folder_files(path)? {
            let source = Source::open(&file)?;
            let place = Place {
                depth: 1,
                ..Place::of(&file)
            };
            self.member(&mut members, name_of(&file), source, &place)?;
        }
        members.finish(path, Format::Folder)
    }

    /// Reads all recordings in a zip archive.
    pub(super) fn zip(
        &self,
        input: impl Read + Seek + Send,
        place: &Place,
    ) -> Result<Contents, RecordError> {
        let path = place.path.as_path();
        let refused = |what: String, error: zip::result::ZipError| {
            fault(
                path,
                Format::Zip,
                Fault::of_file(what, format!("damaged ({error})"), "whole"),
            )
        };
        let mut archive = zip::ZipArchive::new(self.packed(input, place))
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
            let inside = place.inside(Format::Zip, path.join(&name));
            let source = Source::new(self.budget.unpacked(member))
                .map_err(|error| inside.unreadable(error))?;
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
        place: &Place,
    ) -> Result<(), RecordError> {
        // Only the content counts, because an archive may also contain readme files.
        if Format::of_content(source.head()).is_none() {
            members.left_out.push(name);
            return Ok(());
        }
        let contents = self.source(source, place)?;
        let stem = Path::new(&name)
            .with_extension("")
            .to_string_lossy()
            .into_owned();
        let remarks = contents.remarks.into_iter();
        members
            .remarks
            .extend(remarks.map(|remark| format!("{name}: {remark}")));
        let channels = contents.channels.into_iter();
        members
            .channels
            .extend(channels.map(|channel| (stem.clone(), channel)));
        Ok(())
    }
}

impl Members {
    /// Returns all channels. If a channel name is not unique, the name of its file is prepended.
    fn finish(self, path: &Path, format: Format) -> Result<Contents, RecordError> {
        let Self {
            channels,
            mut remarks,
            left_out,
        } = self;
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
