//! Connects instruments to the bus. It publishes their samples as sensor nodes do.
//!
//! A [source](SourcePlan) is a connection to one instrument, or to a server of many. It delivers
//! [packets](Packet): consecutive samples of one channel. The [core](Feed) converts them to SI
//! units, assigns times to them, merges the channels of a node to rows, and cuts the rows into
//! numbered blocks. The shell publishes the blocks on `sensor/NODE/samples`. Slow quantities, such
//! as temperatures, are conditions: the shell publishes each value on `condition/NAME`.
//!
//! ```
//! use spandrel_feed::LineFormat;
//! let packets = LineFormat::RaspberryShake.parse("{'EHZ', 1507760140.530, 614, 916, 1095}")?;
//! assert_eq!(packets[0].label, "EHZ");
//! assert_eq!(packets[0].start_ns, Some(1_507_760_140_530_000_000));
//! assert_eq!(packets[0].values, [614.0, 916.0, 1095.0]);
//! # Ok::<(), spandrel_feed::LineFault>(())
//! ```
//!
//! - [`FeedSettings`], [`FeedConfig`]: the configuration as read, and as checked
//! - [`SourcePlan`], [`ChannelPlan`], [`ConditionPlan`]: one source, and one of its channels
//! - [`Packet`], [`LineFormat`]: samples as they arrive, and the formats of text lines
//! - [`Calibration`], [`StationXml`]: conversion to SI units
//! - [`Feed`]: the core, without a clock or network
//! - [`FeedService`]: the shell, as a service of a process
//! - [`listen`]: connects and counts without a bus, for commissioning
//!
//! To publish a recording, use `spandrel replay` instead. A program that can use Zenoh needs no
//! feed: it publishes sample blocks itself.

mod calibration;
mod error;
mod lines;
mod mistake;
mod packet;
mod section;
mod settings;
mod source_plan;
mod station_xml;

mod blocks;
mod condition_feed;
mod core_input;
mod feed;
mod gap;
mod instrument;
mod node_feed;
mod node_rows;
mod rate_check;
mod timing;

mod check;
mod connect;
mod gate;
mod shell;

pub use blocks::BLOCK_S;
pub use calibration::Calibration;
pub use check::{CheckedChannel, CheckedCondition, CheckedSource, listen};
pub use core_input::{FeedInput, Link, Moment, Output, Recorded};
pub use error::FeedError;
pub use feed::Feed;
pub use gap::{GapReport, LostBecause};
pub use lines::{LineFault, LineFormat, RawFormat, RawNumber, TimeField};
pub use mistake::Mistake;
pub use packet::Packet;
pub use settings::{FeedConfig, FeedSettings};
pub use shell::{FeedPlan, FeedService, WhenEnded};
pub use source_plan::{
    ChannelPlan, ConditionPlan, DropFolder, GrowingFile, Login, MqttSession, MqttTopic, NodePlan,
    Payload, SeedLinkServer, SeedLinkVersion, SourceKind, SourcePlan, Stamps, StartAt,
    StructurePlan,
};
pub use station_xml::StationXml;
