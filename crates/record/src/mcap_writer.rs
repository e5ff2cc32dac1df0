//! Writes MCAP recordings in chunks: one topic per channel, one JSON message per sample.
//!
//! Messages are `{"value":0.25}` with a JSON schema. Foxglove and other MCAP readers can therefore
//! plot `TOPIC.value` directly.

use std::{
    collections::BTreeMap,
    fmt::Write as _,
    fs::File,
    io::{BufWriter, Seek, Write},
    path::{Path, PathBuf},
};

use mcap::{WriteOptions, Writer, records::MessageHeader};

use crate::formats::mcap::{VALUE_FIELD, keys};
use crate::{ChannelColumn, ColumnMapping, RecordError, TimeOrigin};

/// Number of messages per chunk. Each complete chunk is written to the operating system, so a crash
/// loses at most one chunk. It covers a second of 20 channels at 200 Hz. Larger chunks compress
/// little better.
const CHUNK_MESSAGES: u32 = 4096;
const SCHEMA_NAME: &str = "spandrel.Sample";

/// The metadata of a channel in an MCAP recording.
#[derive(Debug, Clone, PartialEq)]
pub struct McapChannel {
    /// Name of the topic.
    pub name: String,
    /// Unit of the values; empty if unknown.
    pub unit: String,
    /// Location and direction; empty if unknown.
    pub description: String,
    /// Sampling rate in Hz, if known.
    pub sampling_rate_hz: Option<f64>,
    /// Reference of the times.
    pub origin: TimeOrigin,
}

/// A writer of MCAP recordings, sample by sample.
///
/// After every 4096 samples, a complete chunk is written to the operating system. If the process is
/// killed, the file is readable up to the last complete chunk.
pub struct McapWriter<W: Write + Seek = BufWriter<File>> {
    path: PathBuf,
    writer: Writer<W>,
    channels: Vec<(u16, u32)>,
    columns: Vec<ChannelColumn>,
    in_chunk: u32,
    text: String,
}

impl McapWriter {
    /// Creates or truncates the file, and writes the metadata of the channels.
    ///
    /// # Errors
    /// Returns an error if the file cannot be created or written.
    pub fn create(path: &Path, channels: &[McapChannel]) -> Result<Self, RecordError> {
        let file = File::create(path).map_err(|source| RecordError::Open {
            path: path.to_owned(),
            source,
        })?;
        Self::new(BufWriter::new(file), path, channels)
    }
}

impl<W: Write + Seek> McapWriter<W> {
    /// Writes the metadata of a file for rows at `rate_hz` (Hz), with the columns and units of
    /// `mapping`. Times are relative to the start of the recording. Errors name `path`.
    ///
    /// # Errors
    /// Returns an error if the output cannot be written.
    pub fn mapped(
        output: W,
        path: &Path,
        mapping: &ColumnMapping,
        rate_hz: f64,
    ) -> Result<Self, RecordError> {
        let stated = |column: &ChannelColumn| McapChannel {
            name: column.column().to_owned(),
            unit: column.stated_unit().to_owned(),
            description: String::new(),
            sampling_rate_hz: Some(rate_hz),
            origin: TimeOrigin::Start,
        };
        let channels: Vec<McapChannel> = mapping.channels().iter().map(stated).collect();
        Ok(Self {
            columns: mapping.channels().to_vec(),
            ..Self::new(output, path, &channels)?
        })
    }

    /// Creates a writer, and writes the metadata of the channels to `output`. Errors name `path`.
    ///
    /// # Errors
    /// Returns an error if the output cannot be written.
    pub fn new(output: W, path: &Path, channels: &[McapChannel]) -> Result<Self, RecordError> {
        let refused = |source| RecordError::WriteMcap {
            path: path.to_owned(),
            source: Box::new(source),
        };
        let mut writer = WriteOptions::new()
            .library(concat!("spandrel ", env!("CARGO_PKG_VERSION")))
            // Chunks are written when complete. An incomplete chunk would state a length of zero.
            .disable_seeking(true)
            // Compress on this thread. A separate thread is slower for chunks this small.
            .compression_threads(0)
            .create(output)
            .map_err(refused)?;
        let schema = writer
            .add_schema(SCHEMA_NAME, "jsonschema", schema().as_bytes())
            .map_err(refused)?;
        let mut numbers = Vec::new();
        for channel in channels {
            let number = writer
                .add_channel(schema, &channel.name, "json", &channel.metadata())
                .map_err(refused)?;
            numbers.push((number, 0));
        }
        Ok(Self {
            path: path.to_owned(),
            writer,
            channels: numbers,
            columns: Vec::new(),
            in_chunk: 0,
            text: String::new(),
        })
    }

    /// Writes one row: `time_ns` in ns, and one value per column of the mapping in SI units, `NaN`
    /// if missing.
    ///
    /// # Errors
    /// Returns an error if the row has the wrong length, or if one of the errors of
    /// [`McapWriter::write`] occurs.
    pub fn write_row(&mut self, time_ns: i64, values: &[f64]) -> Result<(), RecordError> {
        if values.len() != self.columns.len() {
            let line = 1 + self
                .channels
                .first()
                .map_or(0, |(_, sequence)| u64::from(*sequence));
            let (path, found, expected) = (self.path.clone(), values.len(), self.columns.len());
            return Err(RecordError::RowLength {
                path,
                line,
                found,
                expected,
            });
        }
        for (place, value) in values.iter().enumerate() {
            let number = self.columns[place].number_from_si(*value);
            self.write(place, time_ns, number)?;
        }
        Ok(())
    }

    /// Writes a sample of the channel with index `place`. Skips a missing sample (`NaN`).
    ///
    /// # Errors
    /// Returns an error if the time is before 1970, the value is infinite, the channel does not
    /// exist, or the file cannot be written.
    pub fn write(&mut self, place: usize, time_ns: i64, value: f64) -> Result<(), RecordError> {
        if value.is_nan() {
            return Ok(());
        }
        let refused = |what: &'static str| RecordError::NotWritable {
            path: self.path.clone(),
            time_ns,
            value,
            what,
        };
        let log_time =
            u64::try_from(time_ns).map_err(|_| refused("the time must not be before 1970"))?;
        if value.is_infinite() {
            return Err(refused("the value must be finite, or NaN for missing"));
        }
        let (channel_id, sequence) = *self
            .channels
            .get(place)
            .ok_or_else(|| refused("the channel must exist"))?;
        if let Some((_, sequence)) = self.channels.get_mut(place) {
            *sequence = sequence.wrapping_add(1);
        }
        self.text.clear();
        // Debug format writes the shortest digits that read back as the same bits. Writing to a
        // `String` does not fail.
        let _ = write!(self.text, "{{\"{VALUE_FIELD}\":{value:?}}}");
        let header = MessageHeader {
            channel_id,
            sequence,
            log_time,
            publish_time: log_time,
        };
        self.writer
            .write_to_known_channel(&header, self.text.as_bytes())
            .map_err(|source| self.error(source))?;
        self.in_chunk += 1;
        if self.in_chunk >= CHUNK_MESSAGES {
            self.in_chunk = 0;
            self.writer.flush().map_err(|source| self.error(source))?;
        }
        Ok(())
    }

    /// Writes the index and the end of the file, and returns the output. Dropping the writer
    /// without this call may silently lose the last chunk.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written.
    pub fn finish(mut self) -> Result<W, RecordError> {
        match self.writer.finish() {
            Ok(_) => Ok(self.writer.into_inner()),
            Err(source) => Err(self.error(source)),
        }
    }

    fn error(&self, source: mcap::McapError) -> RecordError {
        RecordError::WriteMcap {
            path: self.path.clone(),
            source: Box::new(source),
        }
    }
}

impl McapChannel {
    fn metadata(&self) -> BTreeMap<String, String> {
        let origin = match self.origin {
            TimeOrigin::Epoch => "1970, UTC",
            TimeOrigin::Start => keys::START_OF_RECORD,
        };
        let rate = self
            .sampling_rate_hz
            .map(|rate_hz| rate_hz.to_string())
            .unwrap_or_default();
        let stated = [
            (keys::UNIT, self.unit.clone()),
            (keys::DESCRIPTION, self.description.clone()),
            (keys::SAMPLING_RATE, rate),
            (keys::TIME_ORIGIN, origin.to_owned()),
        ];
        stated
            .into_iter()
            .filter(|(_, text)| !text.is_empty())
            .map(|(key, text)| (key.to_owned(), text))
            .collect()
    }
}

/// Returns the JSON schema of a message.
fn schema() -> String {
    let value = serde_json::json!({ "type": "number", "description": "sample in the unit of the \
                                                                      channel's metadata" });
    let properties = serde_json::json!({ VALUE_FIELD: value });
    serde_json::json!({ "title": SCHEMA_NAME, "type": "object", "properties": properties, "required": [VALUE_FIELD] })
        .to_string()
}

#[cfg(test)]
mod tests;
