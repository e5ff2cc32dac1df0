//! Writes MCAP recordings: a topic per channel, a JSON message per sample, in chunks.
//!
//! Foxglove and other readers of MCAP plot `TOPIC.value` as it stands: messages are `{"value":0.25}` with a JSON schema.

use std::{
    collections::BTreeMap,
    fmt::Write as _,
    fs::File,
    io::BufWriter,
    path::{Path, PathBuf},
};

use mcap::{WriteOptions, Writer, records::MessageHeader};

use crate::formats::mcap::{VALUE_FIELD, keys};
use crate::{ChannelColumn, ColumnMapping, RecordError, TimeOrigin};

/// Messages after which a chunk is ended and handed to the operating system: what a crash may cost. At 20 channels of
/// 200 Hz that is a second; compression gains little beyond.
const CHUNK_MESSAGES: u32 = 4096;
const SCHEMA_NAME: &str = "spandrel.Sample";

/// What a recording states of a channel.
#[derive(Debug, Clone, PartialEq)]
pub struct McapChannel {
    /// Topic.
    pub name: String,
    /// Unit of the values, empty if it is not known.
    pub unit: String,
    /// Place and direction, empty if they are not known.
    pub description: String,
    /// Sampling rate in Hz, if it is known.
    pub sampling_rate_hz: Option<f64>,
    /// What the times count from.
    pub origin: TimeOrigin,
}

/// Writes an MCAP recording sample by sample.
///
/// After every 4096 samples a chunk is whole and with the operating system: a process that is killed leaves a file that is
/// readable up to there.
pub struct McapWriter {
    path: PathBuf,
    writer: Writer<BufWriter<File>>,
    channels: Vec<(u16, u32)>,
    columns: Vec<ChannelColumn>,
    in_chunk: u32,
    text: String,
}

impl McapWriter {
    /// Creates the file, or empties it, and writes what it states of its channels.
    ///
    /// # Errors
    /// The file cannot be created or written.
    pub fn create(path: &Path, channels: &[McapChannel]) -> Result<Self, RecordError> {
        let file = File::create(path).map_err(|source| RecordError::Open {
            path: path.to_owned(),
            source,
        })?;
        let refused = |source| RecordError::WriteMcap {
            path: path.to_owned(),
            source: Box::new(source),
        };
        let mut writer = WriteOptions::new()
            .library(concat!("spandrel ", env!("CARGO_PKG_VERSION")))
            .disable_seeking(true) // a chunk goes out when it is whole: half of one would state a length of zero
            .compression_threads(0) // here: a thread for chunks this small only costs
            .create(BufWriter::new(file))
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

    /// Creates the file for rows at a rate in Hz, with the columns and units that `mapping` reads; times count from the first row.
    ///
    /// # Errors
    /// The file cannot be created or written.
    pub fn create_mapped(
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
            ..Self::create(path, &channels)?
        })
    }

    /// Writes one row: `time_ns` in ns, and one value per column of the mapping in SI units, `NaN` where it is missing.
    ///
    /// # Errors
    /// The row has the wrong length, or as [`McapWriter::write`].
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

    /// Writes a sample of the channel at `place` in the list; a missing one (`NaN`) is no message.
    ///
    /// # Errors
    /// The time is before 1970, the value is infinite, there is no such channel, or the file cannot be written.
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
            .ok_or_else(|| refused("there must be such a channel"))?;
        if let Some((_, sequence)) = self.channels.get_mut(place) {
            *sequence = sequence.wrapping_add(1);
        }
        self.text.clear();
        // shortest digits that read back as the same bits; writing to a String does not fail
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

    /// Writes the index and the end; a writer that is dropped without it may lose the last chunk unseen.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn finish(mut self) -> Result<(), RecordError> {
        match self.writer.finish() {
            Ok(_) => Ok(()),
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

/// The JSON schema of a message.
fn schema() -> String {
    let value = serde_json::json!({ "type": "number", "description": "sample in the unit of the channel's metadata" });
    let properties = serde_json::json!({ VALUE_FIELD: value });
    serde_json::json!({ "title": SCHEMA_NAME, "type": "object", "properties": properties, "required": [VALUE_FIELD] })
        .to_string()
}

#[cfg(test)]
mod tests;
