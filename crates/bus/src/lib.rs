//! Typed messages and lossless streams between the Spandrel services, over Zenoh.
//!
//! This crate contains all key expressions and encodings. It numbers and checks messages, and
//! recovers lost blocks.
//!
//! ```
//! use spandrel_bus::{Block, FrameBlock, Header, Keys, Message, StreamState};
//!
//! let keys = Keys::parse("spandrel", "tower")?;
//! let block = FrameBlock {
//!     header: Header { source: "ingest-1".into(), epoch: 1, sequence: 0, time_ns: 0 },
//!     t0_ns: 0,
//!     sampling_rate_hz: 200.0,
//!     channels: 2,
//!     values: vec![0.1, 0.2, f64::NAN, 0.3], // two frames; one value is missing
//!     state: StreamState::Running,
//! };
//! let payload = block.encode()?;
//! let received = FrameBlock::decode("application/postcard;spandrel.frames.v1", &payload)?;
//! assert_eq!((keys.frames().as_str(), received.count()), ("spandrel/tower/frames", 2));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! - [`Name`], [`Keys`]: names, and the key expressions built from them
//! - [`Message`], [`Block`]: encoding and checks; numbered blocks of a lossless stream
//! - [`Ring`], [`Follower`]: buffer of the latest items of a stream; ordering of received blocks
//!   (pure, no network)
//! - [`Bus`]: the session, whose methods declare:
//!   - [`NumberedPublisher`] and [`Stream`] for streams that must be complete
//!   - [`DisplayPublisher`] and [`Subscription`] for values that people view
//!   - [`LiveToken`] and [`LiveWatch`] for the presence of services and nodes
//!   - [`Claim`] and [`Claims`] for the election of a leader
//!   - [`ProgressPublisher`] and [`ProgressWatch`] for the progress of a service
//! - [`Arrivals`]: distinguishes live values from replayed recordings (pure, no network)
//!
//! Recordings on disk and decisions do not belong in this crate. It does not interpret the values
//! that it transports.

mod name;

mod decimation;
mod grid;
mod keys;
mod message;
mod range;
mod refusals;
mod span;

mod archive;
mod arrivals;
mod flood;
mod follow;
mod kept;
mod ring;

mod buffer;
mod endpoint;
mod error;
mod leader;
mod live;
mod past;
mod progress;
mod protection;
mod publish;
mod questions;
mod receive;
mod session;
mod small_file;
mod stream;
mod subscribe;
mod tls;

#[cfg(test)]
mod testing;

/// A boxed future, as returned by long-running methods of the bus and the services.
///
/// Boxed code is compiled once, in its own crate. An `async fn` is compiled again in every program
/// that awaits it, and the project has dozens of test programs.
pub type BoxedFuture<'a, T> = std::pin::Pin<Box<dyn Future<Output = T> + Send + 'a>>;

pub use archive::Archive;
pub use arrivals::Arrivals;
pub use decimation::Decimation;
pub use endpoint::{in_order, is_loopback};
pub use error::{BusError, ZenohError};
pub use follow::{Action, Delivery, FollowCounts, Follower, Gap, Patience, Silence, Start};
pub use grid::{MAX_RATE_HZ, MIN_RATE_HZ, TimeGrid};
pub use keys::{DEFAULT_ROOT, KeyFamily, Keys, Service, Topic, parse_key};
pub use leader::{Claim, Claims};
pub use live::{LiveToken, LiveWatch};
pub use message::{
    Acknowledgement, AlertMessage, AlertState, Annotation, AnnotationEffect, AnnotationKind, Block,
    BudgetSpent, CaughtUp, ChangeKind, ChangeSeen, ChannelFitDisplay, ChannelHealthDisplay,
    ChannelMonitoring, ChannelSpectrum, ChannelState, ChannelWaveform, ClassCalibration,
    ClassPlausibility, ConditionDisplay, CourseCondition, CourseDelay, CourseReference, CourseRow,
    CredibleInterval, DayExpectation, DecodeError, Description, EncodeError, EpochCondition,
    EpochDisplay, Estimate, EstimateBlock, EstimateFlags, Event, EventKind, Excluded, FaultKind,
    FeedbackMessage, FitDisplay, FitReason, FitReasons, FitVerdict, Format, FrameBlock, Header,
    HistoryLog, HistoryRows, HistorySpan, InstrumentState, InstrumentStatus, JudgementCourse,
    JudgementDisplay, JudgementLog, JudgementState, LastingChange, Load, LocalDensity,
    LocalMessage, LossChange, LossDisplay, MAX_BUCKETS, MAX_CHANNELS, MAX_FREQUENCIES, MAX_ITEMS,
    MAX_LABEL_BYTES, MAX_MESSAGE_BYTES, MAX_SOURCE_BYTES, Maintenance, Malformed, MaskedSpan,
    Message, ModeDisplay, ModeEstimate, ModeState, ModelClassDisplay, MonitoringDisplay,
    MonitoringState, MotionNumbers, NodeClock, NodeDisplay, NodeHealth, NodeLineage, NodeState,
    NoiseDisplay, OutlierDisplay, Pace, ParameterDisplay, ParameterMonitoring, Phase, Progress,
    REFERENCE_IS_LEARNT, ReportPage, RoundedProbability, SampleBlock, SampleLevel, ScreenedChannel,
    SensorHealthDisplay, ShapeValue, Soundness, SpectrumDisplay, Standing, StateMessage, Status,
    StreamState, ToldMotion, ToldSamples, UndecidedBecause, WaveformDisplay, fit_in_words,
    is_without_date, losses_agree, per_cent, per_cents, reported_pace,
};
pub use name::{MAX_NAME_BYTES, Name, NameError};
pub use progress::{ProgressPublisher, ProgressWatch};
pub use publish::{
    DisplayPublisher, LatestPublisher, NumberedPublisher, NumberedStandby, NumberedStream, Older,
};
pub use questions::{Question, Questions};
pub use range::{QueryRange, RangeError};
pub use ring::{Answer, Forget, Keep, NotConsecutive, Ring};
pub use session::{AROUND_THE_PAYLOAD, Bus, BusConfig, DEFAULT_ENDPOINT, Mode};
pub use small_file::{check_regular_file, read_small_file, read_small_text, read_text_up_to};
pub use span::{SpanError, SpanQuery, TIMES, time_ns};
pub use stream::{
    Check, POSITION_TIMEOUT, Reading, Stream, StreamCounts, StreamGroup, StreamSettings,
};
pub use subscribe::Subscription;
pub use tls::{AUTHORITY_FILE, TlsConfig, TlsError, read_pair};
