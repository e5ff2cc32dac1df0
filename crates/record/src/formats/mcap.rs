//! MCAP files with JSON messages or with the frames of a frame log, read with the crate `mcap`.
//!
//! Every number in the messages of a topic is a channel. Its name is `topic` if messages have only
//! the field `value`, and `topic.field` otherwise. The time of a sample is the log time of its
//! message. A file truncated by a crash is read up to its last complete chunk.

use std::collections::BTreeMap;

use ::mcap::McapError;
use ::mcap::records::Record;
use ::mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use serde_json::Value;

use super::frames::FrameRows;
use crate::fault::Fault;
use crate::frame_log::FRAMES_ENCODING;
use crate::mcap_record::parse_record;
use crate::recorded::{RecordedChannel, TimeOrigin};

/// Maximum length of records and chunks, in bytes. A damaged file may state any length.
const LONGEST_RECORD_BYTES: usize = 256 << 20;
/// Name of the field whose channel has the name of the topic.
pub(crate) const VALUE_FIELD: &str = "value";

/// Metadata keys of a channel that this crate writes.
pub(crate) mod keys {
    pub(crate) const UNIT: &str = "unit";
    pub(crate) const DESCRIPTION: &str = "description";
    pub(crate) const SAMPLING_RATE: &str = "sampling_rate_hz";
    pub(crate) const TIME_ORIGIN: &str = "time_origin";
    pub(crate) const START_OF_RECORD: &str = "start of the recording";
}

/// Returns `true` if a file begins like an MCAP file.
pub(crate) fn is_mcap(head: &[u8]) -> bool {
    head.starts_with(::mcap::MAGIC)
}

/// A topic with its metadata, and the samples of each number in its messages.
#[derive(Debug, Default)]
struct Topic {
    name: String,
    encoding: String,
    metadata: BTreeMap<String, String>,
    fields: BTreeMap<String, Vec<(i64, f64)>>,
}

/// Remark on a file without an end.
const CUT_OFF: &str = "the file is truncated: only its complete chunks are read";

/// Reads the frames of a frame log segment. Returns remarks for the user.
pub(crate) fn read_frames(bytes: &[u8], frames: &mut FrameRows) -> Result<Vec<String>, Fault> {
    let mut topics = BTreeMap::new();
    let is_whole = each_record(bytes, |place, record| {
        take(&mut topics, frames, place, record)
    })?;
    Ok(if is_whole {
        Vec::new()
    } else {
        vec![CUT_OFF.to_owned()]
    })
}

/// Reads all numbers. Also returns remarks for the user.
pub(crate) fn read(bytes: &[u8]) -> Result<(Vec<RecordedChannel>, Vec<String>), Fault> {
    let mut topics: BTreeMap<u16, Topic> = BTreeMap::new();
    let mut frames = FrameRows::default();
    let is_whole = each_record(bytes, |place, record| {
        take(&mut topics, &mut frames, place, record)
    })?;
    let (mut channels, mut remarks) = frames.channels();
    if !is_whole {
        remarks.push(CUT_OFF.to_owned());
    }
    let mut others = Vec::new();
    for topic in topics.into_values() {
        if topic.encoding == FRAMES_ENCODING {
            continue;
        }
        if topic.encoding != "json" {
            others.push(format!("{} ({})", topic.name, topic.encoding));
            continue;
        }
        channels.extend(topic.channels()?);
    }
    if channels.is_empty() {
        let found = if others.is_empty() {
            "no message".to_owned()
        } else {
            format!("the topics {}", others.join(", "))
        };
        return Err(Fault::of_file(
            "content",
            found,
            "messages in JSON with numbers, or frames",
        ));
    }
    if !others.is_empty() {
        remarks.push(format!(
            "skipped topics that are not JSON: {}",
            others.join(", ")
        ));
    }
    Ok((channels, remarks))
}

/// Calls `take` with each record and the position of the reader in the file. Returns `true` if the
/// file has an end.
fn each_record(
    bytes: &[u8],
    mut take: impl FnMut(usize, Record<'_>) -> Result<(), Fault>,
) -> Result<bool, Fault> {
    let options = LinearReaderOptions::default()
        .with_prevalidate_chunk_crcs(true) // rejects messages of damaged or incomplete chunks
        .with_record_length_limit(LONGEST_RECORD_BYTES);
    let mut reader = LinearReader::new_with_options(options);
    let mut used = 0;
    while let Some(event) = reader.next_event() {
        match event {
            Ok(LinearReadEvent::ReadRequest(wanted)) => {
                // Limit the request to the existing bytes, because the stated length may be wrong.
                let given = wanted.min(bytes.len() - used);
                reader
                    .insert(given)
                    .copy_from_slice(&bytes[used..used + given]);
                reader.notify_read(given);
                used += given;
            }
            Ok(LinearReadEvent::Record { data, opcode }) => {
                let record = parse_record(opcode, data).map_err(|error| {
                    Fault::at_byte(used, "record", told(&error), "an MCAP record")
                })?;
                take(used, record)?;
            }
            Err(McapError::UnexpectedEof) if used == bytes.len() => return Ok(false),
            Err(error) => {
                return Err(Fault::at_byte(
                    used,
                    "preceding record",
                    told(&error),
                    "complete and undamaged",
                ));
            }
        }
    }
    Ok(true)
}

/// Formats an error of the crate `mcap`.
fn told(error: &McapError) -> String {
    format!("invalid ({error})")
}

fn take(
    topics: &mut BTreeMap<u16, Topic>,
    frames: &mut FrameRows,
    place: usize,
    record: Record<'_>,
) -> Result<(), Fault> {
    match record {
        Record::Channel(channel) => {
            if channel.message_encoding == FRAMES_ENCODING {
                frames.take_layout(&channel.metadata)?;
            }
            let topic = Topic {
                name: channel.topic,
                encoding: channel.message_encoding,
                metadata: channel.metadata,
                fields: BTreeMap::new(),
            };
            topics.entry(channel.id).or_insert(topic);
        }
        Record::Message { header, data } => {
            let topic = topics.get_mut(&header.channel_id).ok_or_else(|| {
                Fault::at_byte(
                    place,
                    "channel of a message",
                    header.channel_id,
                    "declared earlier in the file",
                )
            })?;
            if topic.encoding == FRAMES_ENCODING {
                return frames.take(place, &data);
            }
            if topic.encoding != "json" {
                return Ok(());
            }
            let time_ns = i64::try_from(header.log_time).map_err(|_| {
                Fault::at_byte(
                    place,
                    "log time of a message",
                    header.log_time,
                    "below 2^63 ns, before the year 2262",
                )
            })?;
            let message: Value = serde_json::from_slice(&data).map_err(|error| {
                Fault::at_byte(
                    place,
                    format!("message of {}", topic.name),
                    format!("invalid ({error})"),
                    "JSON",
                )
            })?;
            take_numbers(&message, &mut String::new(), time_ns, &mut topic.fields);
        }
        // Schemas add nothing to the JSON itself. Indices and attachments contain no samples.
        _ => {}
    }
    Ok(())
}

/// Collects the numbers of a message by field name.
fn take_numbers(
    value: &Value,
    path: &mut String,
    time_ns: i64,
    fields: &mut BTreeMap<String, Vec<(i64, f64)>>,
) {
    match value {
        Value::Number(number) => {
            let number = number.as_f64().unwrap_or(f64::NAN);
            match fields.get_mut(path.as_str()) {
                Some(samples) => samples.push((time_ns, number)),
                None => {
                    fields.insert(path.clone(), vec![(time_ns, number)]);
                }
            }
        }
        Value::Object(object) => {
            for (name, value) in object {
                let length = path.len();
                if length > 0 {
                    path.push('.');
                }
                path.push_str(name);
                take_numbers(value, path, time_ns, fields);
                path.truncate(length);
            }
        }
        Value::Null | Value::Bool(_) | Value::String(_) | Value::Array(_) => {}
    }
}

impl Topic {
    fn channels(self) -> Result<Vec<RecordedChannel>, Fault> {
        let Self {
            name,
            metadata,
            fields,
            ..
        } = self;
        let is_alone = fields.len() == 1;
        let rate_hz = metadata
            .get(keys::SAMPLING_RATE)
            .and_then(|rate| rate.parse::<f64>().ok());
        let rate_hz = rate_hz.filter(|rate_hz| rate_hz.is_finite() && *rate_hz > 0.0);
        let is_relative = metadata
            .get(keys::TIME_ORIGIN)
            .is_some_and(|origin| origin == keys::START_OF_RECORD);
        let origin = if is_relative {
            TimeOrigin::Start
        } else {
            TimeOrigin::Epoch
        };
        let stated = |key: &str| metadata.get(key).cloned().unwrap_or_default();
        let mut channels = Vec::new();
        for (field, mut samples) in fields {
            let name = if is_alone && field == VALUE_FIELD {
                name.clone()
            } else {
                format!("{name}.{field}")
            };
            samples.sort_by_key(|(time_ns, _)| *time_ns);
            if let Some(pair) = samples.windows(2).find(|pair| pair[0].0 == pair[1].0) {
                let found = format!("present twice at {} ns", pair[0].0);
                return Err(Fault::of_file(
                    format!("sample of {name}"),
                    found,
                    "present at most once per time",
                ));
            }
            let (times_ns, values): (Vec<i64>, Vec<f64>) = samples.into_iter().unzip();
            let channel =
                RecordedChannel::from_times(name, rate_hz, &times_ns, &values).with_origin(origin);
            channels.push(
                channel
                    .with_unit(stated(keys::UNIT))
                    .with_description(stated(keys::DESCRIPTION)),
            );
        }
        Ok(channels)
    }
}
