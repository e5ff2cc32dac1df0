//! National Instruments TDMS, with DAQmx raw data and scales.
//!
//! A file consists of segments. Each segment has a lead-in of 28 bytes, metadata of its objects
//! (file, groups, channels) and raw data.
//!
//! No crate is used. The existing crates do not read DAQmx raw data, or allocate as much memory as
//! a damaged file states.
//!
//! Source: National Instruments, *TDMS file format internal structure* (2023).

mod metadata;
mod raw;
mod scale;

use std::collections::BTreeMap;

use metadata::{Index, Metadata};

use crate::bytes::{ByteOrder, Bytes};
use crate::fault::Fault;
use crate::rate::rate_from_step;
use crate::recorded::{RecordedChannel, Segment, TimeOrigin};

const LEAD_IN_BYTES: usize = 28;
/// Offset in a segment whose writer was interrupted.
const UNFINISHED: u64 = u64::MAX;
/// Seconds from 1904, the epoch of TDMS, to 1970.
const SECONDS_1904_TO_1970: i64 = 2_082_844_800;

/// Bits in the table of contents of a segment.
mod contents {
    pub(super) const METADATA: u32 = 1 << 1;
    pub(super) const NEW_OBJECTS: u32 = 1 << 2;
    pub(super) const RAW_DATA: u32 = 1 << 3;
    pub(super) const INTERLEAVED: u32 = 1 << 5;
    pub(super) const BIG_ENDIAN: u32 = 1 << 6;
}

/// Returns `true` if a file begins like a TDMS file.
pub(crate) fn is_tdms(head: &[u8]) -> bool {
    head.starts_with(b"TDSm")
}

/// A property of an object.
#[derive(Debug, Clone, PartialEq)]
enum Property {
    Number(f64),
    Text(String),
    /// Nanoseconds since 1970.
    Time(i64),
    Other,
}

/// A channel, group or file, with its data.
#[derive(Debug, Clone, Default)]
struct Object {
    properties: BTreeMap<String, Property>,
    /// Layout of its raw data, for segments that do not state a new one.
    index: Option<Index>,
    /// Samples by scaler. DAQmx channels may have several scalers, and other channels have only
    /// number 0.
    samples: BTreeMap<u32, Vec<f64>>,
    place: usize,
}

/// Reads all channels with numbers. Their names are `group/channel`.
pub(crate) fn read(bytes: &[u8]) -> Result<Vec<RecordedChannel>, Fault> {
    let mut objects: BTreeMap<String, Object> = BTreeMap::new();
    // The order of the raw data persists from segment to segment.
    let mut order: Vec<String> = Vec::new();
    let mut start = 0;
    while start < bytes.len() {
        let length = read_segment(&bytes[start..], &mut objects, &mut order)
            .map_err(|fault| fault.moved_by(start))?;
        start += length;
    }
    let mut paths: Vec<(usize, &String)> = objects
        .iter()
        .map(|(path, object)| (object.place, path))
        .collect();
    paths.sort_unstable();
    let channels: Vec<RecordedChannel> = paths
        .into_iter()
        .filter_map(|(_, path)| channel(path, &objects).transpose())
        .collect::<Result<_, _>>()?;
    match channels.is_empty() {
        true => Err(Fault::of_file(
            "number of channels with numbers",
            0,
            "at least 1",
        )),
        false => Ok(channels),
    }
}

/// Reads a segment and returns its length.
fn read_segment(
    bytes: &[u8],
    objects: &mut BTreeMap<String, Object>,
    order: &mut Vec<String>,
) -> Result<usize, Fault> {
    let mut lead_in = Bytes::new(bytes, ByteOrder::Little);
    let tag = lead_in.take(4)?;
    if tag != b"TDSm" {
        let found = format!("`{}`", tag.escape_ascii());
        return Err(Fault::at_byte(0, "start of a segment", found, "`TDSm`"));
    }
    let contents = lead_in.u32()?;
    if contents & contents::BIG_ENDIAN != 0 {
        lead_in.order = ByteOrder::Big;
    }
    let version = lead_in.u32()?;
    if !matches!(version, 4712 | 4713) {
        return Err(Fault::at_byte(8, "version", version, "4712 or 4713"));
    }
    let (next, raw_start) = (lead_in.u64()?, lead_in.u64()?);
    let left = bytes.len() - LEAD_IN_BYTES;
    let is_unfinished = next == UNFINISHED;
    let segment_length = match usize::try_from(next) {
        Ok(next) if next <= left => next,
        _ if is_unfinished => left,
        _ => {
            let allowed = format!("at most {left}, the bytes to the end of the file");
            return Err(Fault::at_byte(12, "length of the segment", next, allowed));
        }
    };
    let raw_start = usize::try_from(raw_start)
        .ok()
        .filter(|start| *start <= segment_length)
        .ok_or_else(|| {
            Fault::at_byte(
                20,
                "start of the raw data",
                raw_start,
                format!("at most {segment_length}, the end of the segment"),
            )
        })?;
    let segment = &bytes[LEAD_IN_BYTES..LEAD_IN_BYTES + segment_length];
    let byte_order = lead_in.order;
    if contents & contents::NEW_OBJECTS != 0 {
        order.clear();
    }
    if contents & contents::METADATA != 0 {
        let metadata = Bytes::new(&segment[..raw_start], byte_order);
        let metadata =
            Metadata::read(metadata, objects).map_err(|fault| fault.moved_by(LEAD_IN_BYTES))?;
        metadata.apply(objects, order);
    }
    if contents & contents::RAW_DATA != 0 {
        let data = Bytes::new(&segment[raw_start..], byte_order);
        let is_interleaved = contents & contents::INTERLEAVED != 0;
        raw::read(data, is_interleaved, is_unfinished, objects, order)
            .map_err(|fault| fault.moved_by(LEAD_IN_BYTES + raw_start))?;
    }
    Ok(LEAD_IN_BYTES + segment_length)
}

/// Creates the channel of an object. Returns `None` for groups, files and text.
fn channel(
    path: &str,
    objects: &BTreeMap<String, Object>,
) -> Result<Option<RecordedChannel>, Fault> {
    let (Some(object), Some(name)) = (objects.get(path), name_of(path)) else {
        return Ok(None);
    };
    if object.samples.is_empty() {
        return Ok(None);
    }
    let samples = scale::scaled(&name, object)?;
    let number = |key: &str| match object.properties.get(key) {
        Some(Property::Number(number)) => Some(*number),
        Some(Property::Text(_) | Property::Time(_) | Property::Other) | None => None,
    };
    let text = |key: &str| match object.properties.get(key) {
        Some(Property::Text(text)) => Some(text.clone()),
        Some(Property::Number(_) | Property::Time(_) | Property::Other) | None => None,
    };
    let rate_hz = number("wf_increment")
        .filter(|step_s| step_s.is_finite() && *step_s > 0.0)
        .map(rate_from_step);
    let offset_ns = (number("wf_start_offset").unwrap_or(0.0) * 1e9).round() as i64;
    let start_ns = match object.properties.get("wf_start_time") {
        // LabVIEW writes zero for a waveform without a date.
        Some(Property::Time(time_ns)) if *time_ns != -SECONDS_1904_TO_1970 * 1_000_000_000 => {
            Some(*time_ns)
        }
        _ => None,
    };
    let origin = if start_ns.is_some() {
        TimeOrigin::Epoch
    } else {
        TimeOrigin::Start
    };
    let segment = Segment::new(start_ns.unwrap_or(0).saturating_add(offset_ns), samples);
    let channel = RecordedChannel::new(name, rate_hz, vec![segment]).with_origin(origin);
    let channel = channel.with_unit(text("unit_string").unwrap_or_default());
    Ok(Some(
        channel.with_description(text("description").unwrap_or_default()),
    ))
}

/// Converts `/'group'/'channel'` to `group/channel`. A quote within a name is doubled.
fn name_of(path: &str) -> Option<String> {
    let inner = path.strip_prefix("/'")?.strip_suffix('\'')?;
    let (group, channel) = inner.split_once("'/'")?;
    Some(format!("{}/{}", group.trim(), channel.trim()).replace("''", "'"))
}

#[cfg(test)]
mod tests;
