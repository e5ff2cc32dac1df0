//! The messages: one file per kind, all encoded, checked and refused in the same way.

mod acknowledgement;
mod alert;
mod block;
mod bounded;
mod caught_up;
mod description;
mod estimates;
mod event;
mod feedback;
mod fit;
mod frames;
mod header;
mod history;
mod local;
mod model_class;
mod node;
mod noise;
mod outlier;
mod parameter;
mod probability;
mod progress;
mod samples;
mod state;
mod status;
mod text;

use serde::Serialize;
use serde::de::DeserializeOwned;

pub use acknowledgement::Acknowledgement;
pub use alert::{AlertMessage, AlertState};
pub use block::{Block, StreamState};
pub use caught_up::CaughtUp;
pub use description::Description;
pub use estimates::{Estimate, EstimateBlock, EstimateFlags, Phase};
pub use event::{Event, EventKind};
pub use feedback::FeedbackMessage;
pub use fit::{
    ChannelFitDisplay, FitDisplay, FitReason, FitReasons, FitVerdict, UndecidedBecause,
    fit_in_words,
};
pub use frames::FrameBlock;
pub use header::{Header, MAX_SOURCE_BYTES};
pub use history::{HistoryLog, HistoryRows, HistorySpan};
pub use local::{
    LocalDensity, LocalMessage, MotionNumbers, NodeLineage, ScreenedChannel, ToldMotion,
    ToldSamples,
};
pub use model_class::{ClassCalibration, ClassPlausibility, ModelClassDisplay};
pub use node::{NodeDisplay, NodeHealth};
pub use noise::NoiseDisplay;
pub use outlier::{ChannelState, MaskedSpan, OutlierDisplay};
pub use parameter::{CredibleInterval, ParameterDisplay};
pub use probability::RoundedProbability;
pub use progress::Progress;
pub use samples::{NodeState, Pace, SampleBlock};
pub use state::StateMessage;
pub use status::{Load, Standing, Status, is_without_date, pace_told};
pub use text::MAX_LABEL_BYTES;

use text::{check_label, check_text};

/// Largest payload accepted, in bytes; nothing larger is ever decoded or sent.
pub const MAX_MESSAGE_BYTES: usize = 8 << 20;
/// Most channels of a node or structure, and most parameters.
pub const MAX_CHANNELS: usize = 4096;
/// Most items (samples, frames, estimates) of one block.
pub const MAX_ITEMS: usize = 65_536;

/// How the payload is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// Read by programs, at the sampling rate.
    Postcard,
    /// Read by people and scripts, at display rate.
    Json,
}

/// A kind of message with its type, version and checks.
///
/// The Zenoh encoding of a message is `application/FORMAT;spandrel.TYPE.vVERSION`.
pub trait Message: Serialize + DeserializeOwned {
    /// The type in the encoding, such as `frames`.
    const TYPE: &'static str;
    /// Raised with every change of the fields: postcard is positional.
    const VERSION: u16;
    /// How the payload is written.
    const FORMAT: Format;

    /// Checks what the types cannot say; done after decoding and before encoding.
    ///
    /// # Errors
    /// The first thing wrong.
    fn check(&self) -> Result<(), Malformed>;

    /// The Zenoh encoding.
    #[must_use]
    fn encoding() -> String {
        let format = match Self::FORMAT {
            Format::Postcard => "postcard",
            Format::Json => "json",
        };
        format!(
            "application/{format};spandrel.{}.v{}",
            Self::TYPE,
            Self::VERSION
        )
    }

    /// The payload.
    ///
    /// # Errors
    /// A message that a receiver would refuse is not sent.
    fn encode(&self) -> Result<Vec<u8>, EncodeError> {
        self.check()?;
        let payload = match Self::FORMAT {
            Format::Postcard => postcard::to_stdvec(self)?,
            Format::Json => serde_json::to_vec(self)?,
        };
        if payload.len() > MAX_MESSAGE_BYTES {
            return Err(EncodeError::TooLarge {
                bytes: payload.len(),
            });
        }
        Ok(payload)
    }

    /// Reads a message; total on arbitrary bytes.
    ///
    /// JSON is also taken under plain `application/json`, so that a script needs no schema.
    ///
    /// # Errors
    /// Another type or version, too many bytes, bytes that are no such message, or a message whose parts disagree.
    fn decode(encoding: &str, payload: &[u8]) -> Result<Self, DecodeError> {
        let expected = Self::encoding();
        let plain_json = Self::FORMAT == Format::Json && encoding == "application/json";
        if encoding != expected && !plain_json {
            let found = encoding.chars().take(128).collect();
            return Err(DecodeError::Encoding { expected, found });
        }
        if payload.len() > MAX_MESSAGE_BYTES {
            return Err(DecodeError::TooLarge {
                bytes: payload.len(),
            });
        }
        let message: Self = match Self::FORMAT {
            Format::Postcard => {
                let (message, rest) = postcard::take_from_bytes(payload)?;
                if !rest.is_empty() {
                    return Err(DecodeError::Trailing { bytes: rest.len() });
                }
                message
            }
            Format::Json => serde_json::from_slice(payload)?,
        };
        message.check()?;
        Ok(message)
    }
}

/// A message whose parts disagree or lie outside what any structure needs.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Malformed {
    /// The sampling rate is no rate.
    #[error("sampling rate is {found} Hz, must lie between 0.001 and 1000000")]
    Rate {
        /// The rate found, Hz.
        found: f64,
    },
    /// A count is zero or absurd.
    #[error("{what} is {found}, must lie between {least} and {most}")]
    Count {
        /// What is counted.
        what: &'static str,
        /// The count found.
        found: usize,
        /// The least accepted.
        least: usize,
        /// The most accepted.
        most: usize,
    },
    /// The number of values does not fit the counts of the message.
    #[error("{what} has {found} values, must have {expected}")]
    Length {
        /// The list.
        what: &'static str,
        /// Its length.
        found: usize,
        /// The length that the other fields demand.
        expected: usize,
    },
    /// A value is infinite, or not a number where none may be missing.
    #[error("{what} is {found}, must be finite")]
    NotFinite {
        /// The field.
        what: &'static str,
        /// The value found.
        found: f64,
    },
    /// A value lies outside its range.
    #[error("{what} is {found}, must lie between {low} and {high}")]
    Range {
        /// The field.
        what: &'static str,
        /// The value found.
        found: f64,
        /// Lowest value allowed.
        low: f64,
        /// Highest value allowed.
        high: f64,
    },
    /// A text is longer than allowed.
    #[error("{what} has {found} bytes, must have at most {most}")]
    Text {
        /// The field.
        what: &'static str,
        /// Its length in bytes.
        found: usize,
        /// The most accepted.
        most: usize,
    },
    /// A text has a character that is none to be read, and that databases and terminals may not take.
    #[error("{what} has the control character {found:?}, must have {allowed}")]
    Control {
        /// The field.
        what: &'static str,
        /// The first such character.
        found: char,
        /// Those that it may have.
        allowed: &'static str,
    },
    /// The numbers of the items of the block do not fit 64 bits.
    #[error("block of {count} items starts at number {sequence}, past the end of the numbers")]
    SequenceOverflow {
        /// Number of the first item.
        sequence: u64,
        /// Items of the block.
        count: u64,
    },
}

/// Why a message could not be written.
#[derive(Debug, thiserror::Error)]
pub enum EncodeError {
    /// A receiver would refuse it.
    #[error("message is malformed")]
    Malformed(#[from] Malformed),
    /// A receiver would refuse it.
    #[error("message has {bytes} bytes, must have at most {MAX_MESSAGE_BYTES}")]
    TooLarge {
        /// Its size.
        bytes: usize,
    },
    /// The serialiser refused.
    #[error("cannot write the message as postcard")]
    Postcard(#[from] postcard::Error),
    /// The serialiser refused.
    #[error("cannot write the message as JSON")]
    Json(#[from] serde_json::Error),
}

/// Why a message was refused.
#[derive(Debug, thiserror::Error)]
pub enum DecodeError {
    /// Another type or version.
    #[error("encoding is {found:?}, expected {expected:?}")]
    Encoding {
        /// What this program reads.
        expected: String,
        /// What the message says, at most 128 characters of it.
        found: String,
    },
    /// Too large to be looked at.
    #[error("message has {bytes} bytes, must have at most {MAX_MESSAGE_BYTES}")]
    TooLarge {
        /// Its size.
        bytes: usize,
    },
    /// No such message.
    #[error("bytes are no postcard message of this type")]
    Postcard(#[from] postcard::Error),
    /// No such message.
    #[error("text is no JSON message of this type")]
    Json(#[from] serde_json::Error),
    /// Something follows the message.
    #[error("{bytes} bytes follow the message")]
    Trailing {
        /// How many.
        bytes: usize,
    },
    /// The parts of the message disagree.
    #[error("message is malformed")]
    Malformed(#[from] Malformed),
}

impl DecodeError {
    /// The reason under which the refusal is counted.
    #[must_use]
    pub fn reason(&self) -> &'static str {
        match self {
            Self::Encoding { .. } => "encoding",
            Self::TooLarge { .. } => "too-large",
            Self::Postcard(_) | Self::Json(_) | Self::Trailing { .. } => "undecodable",
            Self::Malformed(_) => "malformed",
        }
    }
}

fn check_count(
    what: &'static str,
    found: usize,
    least: usize,
    most: usize,
) -> Result<(), Malformed> {
    if (least..=most).contains(&found) {
        return Ok(());
    }
    Err(Malformed::Count {
        what,
        found,
        least,
        most,
    })
}

fn check_finite(what: &'static str, found: f64) -> Result<(), Malformed> {
    if found.is_finite() {
        return Ok(());
    }
    Err(Malformed::NotFinite { what, found })
}

fn check_finite_list(what: &'static str, values: &[f64]) -> Result<(), Malformed> {
    values
        .iter()
        .try_for_each(|value| check_finite(what, *value))
}

/// NaN is a missing value; infinity is a mistake.
fn check_finite_or_missing(what: &'static str, values: &[f64]) -> Result<(), Malformed> {
    match values.iter().find(|v| v.is_infinite()) {
        Some(&found) => Err(Malformed::NotFinite { what, found }),
        None => Ok(()),
    }
}

fn check_range(what: &'static str, found: f64, low: f64, high: f64) -> Result<(), Malformed> {
    if (low..=high).contains(&found) {
        return Ok(());
    }
    Err(Malformed::Range {
        what,
        found,
        low,
        high,
    })
}

#[cfg(test)]
mod tests;
