//! Reply of a buffer that has no newer items.

use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::{Format, Header, Malformed, Message, StreamState};

/// Reply that the buffer has no item at or after the requested number.
///
/// As for [`SampleBlock`](super::SampleBlock), the derived functions of serde write the postcard
/// format only.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(remote = "Self")]
pub struct CaughtUp {
    /// Source and epoch of the stream. `sequence` is the number of its next item, which is not yet
    /// published; time is 0.
    pub header: Header,
    /// Whether the stream continues.
    pub state: StreamState,
}

/// The JSON form, in which the fields of the header are fields of the object.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename = "caught-up")]
struct CaughtUpText {
    source: String,
    epoch: u64,
    sequence: u64,
    #[serde(default)]
    state: StreamState,
}

impl Serialize for CaughtUp {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        if !serializer.is_human_readable() {
            return Self::serialize(self, serializer);
        }
        let text = CaughtUpText {
            source: self.header.source.clone(),
            epoch: self.header.epoch,
            sequence: self.header.sequence,
            state: self.state,
        };
        text.serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for CaughtUp {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        if !deserializer.is_human_readable() {
            return Self::deserialize(deserializer);
        }
        let text = CaughtUpText::deserialize(deserializer)?;
        let header = Header {
            source: text.source,
            epoch: text.epoch,
            sequence: text.sequence,
            time_ns: 0,
        };
        Ok(Self {
            header,
            state: text.state,
        })
    }
}

impl Message for CaughtUp {
    const TYPE: &'static str = "caught-up";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Postcard;
    const ACCEPTED: &'static [Format] = &[Format::Postcard, Format::Json];

    fn check(&self) -> Result<(), Malformed> {
        self.header.check(0)
    }
}
