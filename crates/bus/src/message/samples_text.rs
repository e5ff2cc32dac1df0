//! JSON form of sample blocks, for sensor nodes that are scripts.
//!
//! The fields of the header are fields of the object. A script may omit every field whose value is
//! almost always the same. A missing sample is `null`, because JSON has no NaN.

use std::fmt;

use serde::de::{DeserializeSeed, Deserializer, Error as _, SeqAccess, Visitor};
use serde::ser::{Error as _, SerializeSeq};
use serde::{Deserialize, Serialize, Serializer};

use super::{Header, NodeState, Pace, SampleBlock};

/// The object as it is read. Unknown fields are errors, so that a misspelt field is not omitted.
#[derive(Deserialize)]
#[serde(deny_unknown_fields, rename = "samples")]
struct ReadSamples {
    source: String,
    epoch: u64,
    sequence: u64,
    time_ns: i64,
    sampling_rate_hz: f64,
    #[serde(default = "live")]
    pace: Pace,
    channels: Option<u16>,
    samples: Values,
    #[serde(default)]
    state: NodeState,
}

fn live() -> Pace {
    Pace::Live
}

/// Reads a block. Its counts still need [`Message::check`](super::Message::check).
pub(super) fn read_samples<'de, D: Deserializer<'de>>(
    deserializer: D,
) -> Result<SampleBlock, D::Error> {
    let read = ReadSamples::deserialize(deserializer)?;
    let Values { values, layout } = read.samples;
    let channels = match (layout, read.channels) {
        (Layout::Empty, None) => {
            return Err(D::Error::custom(
                "channels is missing, must be stated if samples is empty",
            ));
        }
        (Layout::Rows(found), Some(stated)) if found != usize::from(stated) => {
            return Err(D::Error::custom(format_args!(
                "channels is {stated}, must be {found}, the number of values in each row of samples"
            )));
        }
        (Layout::Rows(found), _) => u16::try_from(found).map_err(|_| {
            D::Error::custom(format_args!(
                "a row of samples has {found} values, must have at most {}",
                super::MAX_CHANNELS
            ))
        })?,
        (Layout::Empty | Layout::Flat, Some(stated)) => stated,
        (Layout::Flat, None) => 1,
    };
    Ok(SampleBlock {
        header: Header {
            source: read.source,
            epoch: read.epoch,
            sequence: read.sequence,
            time_ns: read.time_ns,
        },
        sampling_rate_hz: read.sampling_rate_hz,
        pace: read.pace,
        channels,
        samples: values,
        state: read.state,
        clock_quality: None,
    })
}

/// The arrangement of a list of samples.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Layout {
    /// The list has no items.
    Empty,
    /// The list contains numbers, sample by sample.
    Flat,
    /// The list contains rows, one per sample, each with this number of values.
    Rows(usize),
}

/// The values of a list of samples, sample by sample. NaN = missing.
struct Values {
    values: Vec<f64>,
    layout: Layout,
}

impl<'de> Deserialize<'de> for Values {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct List;
        impl<'de> Visitor<'de> for List {
            type Value = Values;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a list of samples")
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Values, A::Error> {
                // Rows share one list of values, so that a short row occupies no list of its own.
                let mut read = Values {
                    values: Vec::new(),
                    layout: Layout::Empty,
                };
                let mut number = 0;
                while let Some(layout) = items.next_element_seed(Item(&mut read.values))? {
                    if number > 0 && layout != read.layout {
                        return Err(differing(number, layout, read.layout));
                    }
                    read.layout = layout;
                    number += 1;
                }
                Ok(read)
            }
        }
        deserializer.deserialize_seq(List)
    }
}

/// The error of an item whose layout differs from the items before it.
fn differing<E: serde::de::Error>(number: usize, found: Layout, expected: Layout) -> E {
    let described = |layout: Layout| match layout {
        Layout::Rows(values) => format!("a row of {values} values"),
        Layout::Empty | Layout::Flat => "a number".to_owned(),
    };
    E::custom(format_args!(
        "item {number} of samples is {}, must be {} like the items before it",
        described(found),
        described(expected)
    ))
}

/// Reads one item of the list of samples: a number, or a row of numbers.
struct Item<'a>(&'a mut Vec<f64>);

impl<'de> DeserializeSeed<'de> for Item<'_> {
    type Value = Layout;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Layout, D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl Item<'_> {
    fn number(self, value: f64) -> Layout {
        self.0.push(value);
        Layout::Flat
    }
}

impl<'de> Visitor<'de> for Item<'_> {
    type Value = Layout;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a number, null for a missing sample, or a row with a number for each channel")
    }

    fn visit_f64<E>(self, value: f64) -> Result<Layout, E> {
        Ok(self.number(value))
    }

    fn visit_i64<E>(self, value: i64) -> Result<Layout, E> {
        Ok(self.number(value as f64))
    }

    fn visit_u64<E>(self, value: u64) -> Result<Layout, E> {
        Ok(self.number(value as f64))
    }

    fn visit_unit<E>(self) -> Result<Layout, E> {
        Ok(self.number(f64::NAN))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut row: A) -> Result<Layout, A::Error> {
        let mut count = 0;
        while let Some(value) = row.next_element::<Option<f64>>()? {
            self.0.push(value.unwrap_or(f64::NAN));
            count += 1;
        }
        if count == 0 {
            return Err(A::Error::custom("samples contains an empty row"));
        }
        Ok(Layout::Rows(count))
    }
}

/// The object as it is written, with all fields.
#[derive(Serialize)]
pub(super) struct WrittenSamples<'a> {
    source: &'a str,
    epoch: u64,
    sequence: u64,
    time_ns: i64,
    sampling_rate_hz: f64,
    pace: Pace,
    channels: u16,
    samples: Rows<'a>,
    state: NodeState,
}

impl<'a> WrittenSamples<'a> {
    pub(super) fn of(block: &'a SampleBlock) -> Self {
        Self {
            source: &block.header.source,
            epoch: block.header.epoch,
            sequence: block.header.sequence,
            time_ns: block.header.time_ns,
            sampling_rate_hz: block.sampling_rate_hz,
            pace: block.pace,
            channels: block.channels,
            samples: Rows(block),
            state: block.state,
        }
    }
}

/// The samples, one row per sample.
struct Rows<'a>(&'a SampleBlock);

impl Serialize for Rows<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut list = serializer.serialize_seq(Some(self.0.iter().len()))?;
        for row in self.0.iter() {
            // Otherwise an infinite value, which is a fault of the channel, would become `null`.
            if let Some(value) = row.iter().find(|value| value.is_infinite()) {
                return Err(S::Error::custom(format_args!(
                    "a sample is {value}, which JSON cannot represent"
                )));
            }
            list.serialize_element(row)?;
        }
        list.end()
    }
}
