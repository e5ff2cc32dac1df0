//! Reads a folder that contains a frame log.

use std::path::Path;

use super::members::{folder_files, name_of};
use super::{Contents, fault};
use crate::formats::frames::FrameRows;
use crate::formats::mcap;
use crate::source::Source;
use crate::{Format, RecordError, frame_log};

/// Returns `true` if a folder contains a frame log.
pub(super) fn is_there(path: &Path) -> Result<bool, RecordError> {
    Ok(folder_files(path)?
        .iter()
        .any(|file| frame_log::is_segment(&name_of(file))))
}

/// Reads all segments of a frame log as one recording.
pub(super) fn read(path: &Path) -> Result<Contents, RecordError> {
    let mut frames = FrameRows::default();
    let (mut remarks, mut left_out) = (Vec::new(), Vec::new());
    for file in folder_files(path)? {
        let name = name_of(&file);
        if frame_log::is_segment(&name) {
            let unreadable = |source| RecordError::ReadFile {
                path: file.clone(),
                source,
            };
            let bytes = Source::open(&file)?.into_bytes().map_err(unreadable)?;
            let read = mcap::read_frames(&bytes, &mut frames);
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
