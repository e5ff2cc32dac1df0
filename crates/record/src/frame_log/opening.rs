//! Determines the state of a log when it is opened, and repairs it.

use std::sync::Arc;

use super::folder::Folder;
use super::layout::StatedLayout;
use super::scan::{Scan, SegmentEnd, scan, start_of};
use super::segment::{SegmentName, mend, set_aside};
use super::{OpenedLog, payload};
use crate::RecordError;

/// Reads the newest segment that contains frames, checks its layout, and repairs its end.
pub(super) fn newest(folder: &Folder, stated: &StatedLayout) -> Result<OpenedLog, RecordError> {
    let mut opened = OpenedLog {
        last: None,
        was_closed: true,
        same_boot: true,
        is_complete: None,
        torn_bytes: 0,
        set_aside: Vec::new(),
    };
    let mut is_newest = true;
    loop {
        let Some(name) = folder.segments().newest() else {
            return Ok(opened);
        };
        let path = name.path(folder.path());
        let found = match scan(&path) {
            Ok(found) => found,
            Err(RecordError::ReadFile { .. }) => {
                opened.set_aside.push(set_aside(&path)?);
                opened.was_closed &= !is_newest;
                is_newest = false;
                folder.segments().forget(name);
                continue;
            }
            Err(error) => return Err(error),
        };
        if is_newest {
            opened.was_closed = found.end == SegmentEnd::InOrder;
            is_newest = false;
        }
        let Scan {
            stated: found_layout,
            foreign_encoding,
            last,
            ..
        } = &found;
        if let Some(encoding) = foreign_encoding {
            return Err(RecordError::OtherLog {
                folder: folder.path().to_owned(),
                what: "encoding of the frames",
                found: encoding.clone(),
                expected: payload::MESSAGE_ENCODING.to_owned(),
            });
        }
        if last.is_none() {
            match found.bytes < payload::SCHEMA.len() as u64 {
                // The segment was cut off before its first frame.
                true => {
                    opened.torn_bytes += found.bytes;
                    folder.delete(name)?;
                }
                false => {
                    opened.set_aside.push(set_aside(&path)?);
                    folder.segments().forget(name);
                }
            }
            continue;
        }
        if let Some(found_layout) = found_layout {
            stated.layout.agree(&found_layout.layout, folder.path())?;
            let is_known = !found_layout.boot_id.is_empty() && !stated.boot_id.is_empty();
            opened.same_boot = !is_known || found_layout.boot_id == stated.boot_id;
        }
        let bytes = match found.end {
            SegmentEnd::Torn => {
                opened.torn_bytes += found.bytes.saturating_sub(found.whole);
                mend(&path, found.whole)?
            }
            SegmentEnd::InOrder | SegmentEnd::Mended => found.bytes,
        };
        opened.last = found.last;
        let mut segments = folder.segments();
        segments.set_size(name, bytes);
        segments.keep_index(name, Arc::new(found.entries));
        drop(segments);
        return Ok(opened);
    }
}

/// Returns the time of the first frame of a segment, in ns, or `None` if it cannot be read.
pub(super) fn start_ns(folder: &Folder, name: SegmentName) -> Option<i64> {
    start_of(&name.path(folder.path())).ok()?
}
