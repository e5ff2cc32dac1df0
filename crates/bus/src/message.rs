//! Message types, one file per type, with a common encoding and validation.

mod acknowledgement;
mod alert;
mod annotation;
mod block;
mod bounded;
mod caught_up;
mod condition;
mod course;
mod description;
mod epoch;
mod estimates;
mod event;
mod feedback;
mod fit;
mod frames;
mod header;
mod history;
mod judgement;
mod judgement_log;
mod local;
mod loss;
mod maintenance;
mod mode;
mod model_class;
mod monitoring;
mod node;
mod noise;
mod outlier;
mod parameter;
mod probability;
mod progress;
mod report_page;
mod samples;
mod samples_text;
mod sensor_health;
mod spectrum;
mod state;
mod status;
mod text;
mod waveform;

use serde::Serialize;
use serde::de::DeserializeOwned;

pub use acknowledgement::Acknowledgement;
pub use alert::{AlertMessage, AlertState};
pub use annotation::{Annotation, AnnotationEffect, AnnotationKind};
pub use block::{Block, StreamState};
pub use caught_up::CaughtUp;
pub use condition::ConditionDisplay;
pub use course::{CourseCondition, CourseDelay, CourseReference, CourseRow, JudgementCourse};
pub use description::Description;
pub use epoch::{EpochCondition, EpochDisplay};
pub use estimates::{Estimate, EstimateBlock, EstimateFlags, Excluded, Phase};
pub use event::{Event, EventKind};
pub use feedback::FeedbackMessage;
pub use fit::{
    ChannelFitDisplay, FitDisplay, FitReason, FitReasons, FitVerdict, UndecidedBecause,
    fit_in_words,
};
pub use frames::FrameBlock;
pub use header::{Header, MAX_SOURCE_BYTES};
pub use history::{HistoryLog, HistoryRows, HistorySpan};
pub use judgement::{
    BudgetSpent, ChangeKind, ChangeSeen, DayExpectation, JudgementDisplay, JudgementState,
    LastingChange,
};
pub use judgement_log::{JudgementLog, LossChange};
pub use local::{
    LocalDensity, LocalMessage, MotionNumbers, NodeLineage, ScreenedChannel, ToldMotion,
    ToldSamples,
};
pub use loss::{LossDisplay, losses_agree, per_cent, per_cents};
pub use maintenance::Maintenance;
pub use mode::{ModeDisplay, ModeEstimate, ModeState, ShapeValue};
pub use model_class::{ClassCalibration, ClassPlausibility, ModelClassDisplay};
pub use monitoring::{
    ChannelMonitoring, MonitoringDisplay, MonitoringState, ParameterMonitoring, REFERENCE_IS_LEARNT,
};
pub use node::{NodeDisplay, NodeHealth};
pub use noise::NoiseDisplay;
pub use outlier::{ChannelState, MaskedSpan, OutlierDisplay};
pub use parameter::{CredibleInterval, ParameterDisplay};
pub use probability::RoundedProbability;
pub use progress::Progress;
pub use report_page::ReportPage;
pub use samples::{NodeState, Pace, SampleBlock};
pub use sensor_health::{ChannelHealthDisplay, FaultKind, SensorHealthDisplay, Soundness};
pub use spectrum::{ChannelSpectrum, MAX_FREQUENCIES, SpectrumDisplay};
pub use state::StateMessage;
pub use status::{
    InstrumentState, InstrumentStatus, Load, NodeClock, Standing, Status, is_without_date,
    reported_pace,
};
pub use text::MAX_LABEL_BYTES;
pub use waveform::{ChannelWaveform, MAX_BUCKETS, SampleLevel, WaveformDisplay};

use text::{check_label, check_text};

/// Maximum size of a payload, in bytes. Larger payloads are neither sent nor decoded.
pub const MAX_MESSAGE_BYTES: usize = 8 << 20;
/// Maximum number of channels of a node or structure, and of parameters.
pub const MAX_CHANNELS: usize = 4096;
/// Maximum number of items (samples, frames, estimates) in one block.
pub const MAX_ITEMS: usize = 65_536;

/// Format of a payload.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// Binary format for programs, at the sampling rate.
    Postcard,
    /// Text format for people and scripts, at display rate.
    Json,
}

/// A kind of message with its type, version and checks.
///
/// The Zenoh encoding of a message is `application/FORMAT;spandrel.TYPE.vVERSION`.
pub trait Message: Serialize + DeserializeOwned {
    /// Type in the encoding, such as `frames`.
    const TYPE: &'static str;
    /// Version in the encoding. Every change of the fields increments it, because postcard
    /// identifies fields by position.
    const VERSION: u16;
    /// Format in which the message is encoded.
    const FORMAT: Format;
    /// Formats that are decoded. Sensor nodes that are scripts send some binary messages as JSON.
    const ACCEPTED: &'static [Format] = &[Self::FORMAT];

    /// Checks constraints that the types do not enforce, after decoding and before encoding.
    ///
    /// # Errors
    /// Returns the first violation.
    fn check(&self) -> Result<(), Malformed>;

    /// Returns the Zenoh encoding.
    #[must_use]
    fn encoding() -> String {
        Self::encoding_as(Self::FORMAT)
    }

    /// Returns the Zenoh encoding of this message in a format.
    #[must_use]
    fn encoding_as(format: Format) -> String {
        let format = match format {
            Format::Postcard => "postcard",
            Format::Json => "json",
        };
        format!(
            "application/{format};spandrel.{}.v{}",
            Self::TYPE,
            Self::VERSION
        )
    }

    /// Returns the attachment that travels beside the payload. Readers of former versions ignore
    /// it. Replies to queries do not contain it.
    #[must_use]
    fn attachment(&self) -> Option<String> {
        None
    }

    /// Reads an attachment. An unknown or wrong attachment changes nothing.
    fn attach(&mut self, _attachment: &str) {}

    /// Encodes the message as a payload.
    ///
    /// # Errors
    /// Fails if a receiver would reject the message.
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

    /// Decodes a message. Arbitrary bytes are safe as input.
    ///
    /// The encoding of a JSON message may also be plain `application/json`, so that a script needs
    /// no schema.
    ///
    /// # Errors
    /// Fails if the type or version differs, if the payload is too large or cannot be decoded, or
    /// if the message is malformed.
    fn decode(encoding: &str, payload: &[u8]) -> Result<Self, DecodeError> {
        let Some(format) = accepted_format::<Self>(encoding) else {
            let accepted = Self::ACCEPTED.iter().copied().map(Self::encoding_as);
            return Err(DecodeError::Encoding {
                expected: accepted.collect::<Vec<_>>().join(" or "),
                found: encoding.chars().take(128).collect(),
            });
        };
        if payload.len() > MAX_MESSAGE_BYTES {
            return Err(DecodeError::TooLarge {
                bytes: payload.len(),
            });
        }
        let message: Self = match format {
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

/// Returns the format that an encoding names, or `None` if a type does not accept the encoding.
fn accepted_format<M: Message>(encoding: &str) -> Option<Format> {
    let names = |format: &Format| {
        let is_plain_json = *format == Format::Json && encoding == "application/json";
        is_plain_json || encoding == M::encoding_as(*format)
    };
    M::ACCEPTED.iter().copied().find(names)
}

/// A message with inconsistent parts, or with values beyond the needs of any structure.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Malformed {
    /// The sampling rate is outside its valid range.
    #[error("sampling rate is {found} Hz, must lie between 0.001 and 1000000")]
    Rate {
        /// Sampling rate found, Hz.
        found: f64,
    },
    /// A count is outside its valid range.
    #[error("{what} is {found}, must lie between {least} and {most}")]
    Count {
        /// Name of the count.
        what: &'static str,
        /// Count found.
        found: usize,
        /// Minimum.
        least: usize,
        /// Maximum.
        most: usize,
    },
    /// The number of values contradicts the counts in the message.
    #[error("{what} has {found} values, must have {expected}")]
    Length {
        /// Name of the list.
        what: &'static str,
        /// Length found.
        found: usize,
        /// Length required by the other fields.
        expected: usize,
    },
    /// A value is infinite, or NaN where no value may be missing.
    #[error("{what} is {found}, must be finite")]
    NotFinite {
        /// Name of the field.
        what: &'static str,
        /// Value found.
        found: f64,
    },
    /// A value lies outside its range.
    #[error("{what} is {found}, must {}", bounds(*low, *high))]
    Range {
        /// Name of the field.
        what: &'static str,
        /// Value found.
        found: f64,
        /// Minimum. [`f64::MIN`] if there is none.
        low: f64,
        /// Maximum. [`f64::MAX`] if there is none.
        high: f64,
    },
    /// A unit of a condition is unknown.
    #[error("unit is {found:?}, must be one of {}", units())]
    Unit {
        /// Unit found.
        found: String,
    },
    /// A text is too long.
    #[error("{what} has {found} bytes, must have at most {most}")]
    Text {
        /// Name of the field.
        what: &'static str,
        /// Length found, in bytes.
        found: usize,
        /// Maximum length, in bytes.
        most: usize,
    },
    /// A text contains a control character that databases and terminals might not accept.
    #[error("{what} has the control character {found:?}, must have {allowed}")]
    Control {
        /// Name of the field.
        what: &'static str,
        /// First such character.
        found: char,
        /// Description of the allowed control characters.
        allowed: &'static str,
    },
    /// The sequence numbers of the items exceed 64 bits.
    #[error(
        "block of {count} items starts at sequence number {sequence} and exceeds the largest \
         sequence number"
    )]
    SequenceOverflow {
        /// Sequence number of the first item.
        sequence: u64,
        /// Number of items in the block.
        count: u64,
    },
}

/// Reason why a message cannot be encoded.
#[derive(Debug, thiserror::Error)]
pub enum EncodeError {
    /// The message is malformed, so that a receiver would reject it.
    #[error("message is malformed")]
    Malformed(#[from] Malformed),
    /// The payload is too large, so that a receiver would reject it.
    #[error("message has {bytes} bytes, must have at most {MAX_MESSAGE_BYTES}")]
    TooLarge {
        /// Size of the payload.
        bytes: usize,
    },
    /// Serialisation as postcard failed.
    #[error("cannot write the message as postcard")]
    Postcard(#[from] postcard::Error),
    /// Serialisation as JSON failed.
    #[error("cannot write the message as JSON")]
    Json(#[from] serde_json::Error),
}

/// Reason for rejecting a received message.
#[derive(Debug, thiserror::Error)]
pub enum DecodeError {
    /// The message has another type or version.
    #[error("encoding is {found:?}, expected {expected:?}")]
    Encoding {
        /// Supported encodings.
        expected: String,
        /// Encoding of the message, cut to 128 characters.
        found: String,
    },
    /// The payload is too large to decode.
    #[error("message has {bytes} bytes, must have at most {MAX_MESSAGE_BYTES}")]
    TooLarge {
        /// Size of the payload.
        bytes: usize,
    },
    /// The bytes are not a postcard message of this type.
    #[error("bytes are not a postcard message of this type")]
    Postcard(#[from] postcard::Error),
    /// The text is not a JSON message of this type.
    #[error("text is not a JSON message of this type")]
    Json(#[from] serde_json::Error),
    /// Bytes follow the message.
    #[error("{bytes} bytes follow the message")]
    Trailing {
        /// Number of bytes after the message.
        bytes: usize,
    },
    /// The message is malformed.
    #[error("message is malformed")]
    Malformed(#[from] Malformed),
}

impl DecodeError {
    /// Returns the reason under which rejected messages are counted.
    #[must_use]
    pub fn reason(&self) -> &'static str {
        match self {
            Self::Encoding { .. } => "encoding",
            Self::TooLarge { .. } => "too-large",
            Self::Postcard(_) | Self::Json(_) | Self::Trailing { .. } => "undecodable",
            Self::Malformed(_) => "malformed",
        }
    }

    /// Returns the text of this error with its cause, for a log.
    pub(crate) fn with_cause(&self) -> String {
        match std::error::Error::source(self) {
            Some(cause) => format!("{self}: {cause}"),
            None => self.to_string(),
        }
    }
}

/// Returns the units of conditions as a list for people.
fn units() -> String {
    ConditionDisplay::units().collect::<Vec<_>>().join(", ")
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

/// Checks that no value is infinite. NaN represents a missing value.
fn check_finite_or_missing(what: &'static str, values: &[f64]) -> Result<(), Malformed> {
    match values.iter().find(|v| v.is_infinite()) {
        Some(&found) => Err(Malformed::NotFinite { what, found }),
        None => Ok(()),
    }
}

/// Returns the bounds of a range in words. The largest numbers, which are no bounds, have 309
/// digits.
fn bounds(low: f64, high: f64) -> String {
    match (low > f64::MIN, high < f64::MAX) {
        (true, true) => format!("lie between {low} and {high}"),
        (true, false) => format!("be at least {low}"),
        (false, true) => format!("be at most {high}"),
        (false, false) => "be finite".to_owned(),
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
