//! Status of a service.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::{
    FitVerdict, Format, MAX_CHANNELS, Maintenance, Malformed, Message, Pace, UndecidedBecause,
    bounded, check_count, check_finite, check_label, check_range, check_text,
};
use crate::name::Name;

/// Maximum number of reasons in one status. The reasons come from a closed set.
const MAX_REASONS: usize = 1024;

/// Maximum number of instruments in one status.
const MAX_INSTRUMENTS: usize = 1024;

/// When a node samples.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct NodeClock {
    /// Time from the frame to the sample of the node, s. Values at the time of the frame are
    /// interpolated. It is at most half a sampling interval, unless time stamps jitter.
    pub offset_s: f64,
    /// Largest minus smallest deviation of the recent time stamps from evenly spaced samples, s.
    pub jitter_s: f64,
    /// Clock of the node minus clock of most nodes, s: positive if the node is ahead. Its samples
    /// are dropped. `None` if its clock agrees with theirs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub difference_s: Option<f64>,
    /// Quality of its times as the source last stated it, from 0 to 100 per cent. `None` if the
    /// source states none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub quality_percent: Option<u8>,
}

/// Whether a service keeps up with its input.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Load {
    /// The service keeps up.
    Normal,
    /// The service is overloaded and publishes display values at a tenth of their rate.
    DisplayShed,
    /// The service is behind despite the lower display rate, and reads from the recording.
    Behind,
    /// The service was behind and is catching up.
    CatchingUp,
}

impl Load {
    /// Returns the name of the state, as in the message.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Normal => "normal",
            Self::DisplayShed => "display-shed",
            Self::Behind => "behind",
            Self::CatchingUp => "catching-up",
        }
    }
}

/// Role of a process in a service with a standby.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Standing {
    /// The leader, which publishes its results.
    Leading,
    /// A standby, which processes the same data as the leader and publishes nothing.
    StandingBy,
    /// A future standby that has not yet received the state of the leader.
    Joining,
}

/// State of the connection to an instrument.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum InstrumentState {
    /// The connection is being established.
    Connecting,
    /// The connection exists, but no usable sample has arrived.
    Connected,
    /// Usable samples arrive.
    Receiving,
    /// The connection exists, but usable samples no longer arrive.
    Silent,
    /// The connection is lost or rejected, or the instrument sends nothing usable.
    Failed,
    /// The instrument has ended its data, as at the end of standard input.
    Ended,
}

impl InstrumentState {
    /// Returns the name of the state, as in the message.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Connecting => "connecting",
            Self::Connected => "connected",
            Self::Receiving => "receiving",
            Self::Silent => "silent",
            Self::Failed => "failed",
            Self::Ended => "ended",
        }
    }
}

/// State and counts of one instrument.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct InstrumentStatus {
    /// State of the connection.
    pub state: InstrumentState,
    /// Wall-clock time of the last change of the state, ns since the Unix epoch, UTC.
    pub since_ns: i64,
    /// Number of accepted samples, counted per channel.
    pub samples: u64,
    /// Number of errors: failed connections, and rejected messages and samples.
    pub errors: u64,
    /// The last error, in words.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub last_error: Option<String>,
    /// Wall-clock time of the last error, ns since the Unix epoch, UTC.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub last_error_ns: Option<i64>,
}

/// Status of a service, published once per second and when the load changes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Status {
    /// Name of the structure.
    pub structure: Name,
    /// Name of the service, as in the key.
    pub service: Name,
    /// Id of the instance, as in the key.
    pub id: Name,
    /// Wall-clock time, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// Wall-clock time minus time of the last processed item, s. `None` before the first item.
    pub lag_s: Option<f64>,
    /// Whether the samples are live or replayed. Only ingest, and fuse in distributed
    /// identification, report it, after the first samples.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pace: Option<Pace>,
    /// Role of the process. Only identify, which supports a standby, reports it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub state: Option<Standing>,
    /// Number of the first unprocessed item.
    pub done: u64,
    /// Load of the service. Only identify reports it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub load: Option<Load>,
    /// Number of frames of ingest that the service has not yet processed, if known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frames_behind: Option<u64>,
    /// Verdict on the fit after the last frame. Only identify reports it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fit: Option<FitVerdict>,
    /// Number of watched parameters without a decision, by reason. Only the alert service reports
    /// it.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub undecided: BTreeMap<UndecidedBecause, u64>,
    /// State of each instrument by its name. Only feed reports it.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub instruments: BTreeMap<String, InstrumentStatus>,
    /// When the nodes sample. Only ingest reports it. It contains nodes that do not sample at the
    /// times of the frames, and nodes whose clock differs from that of most nodes. Nodes whose
    /// source states the quality of its clock are there as well.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub clocks: BTreeMap<Name, NodeClock>,
    /// Share of the last 5 s of frames without a sample of the channel, by channel, 0 to 1. Only
    /// ingest reports it. Channels without a missing sample are omitted.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub missing: BTreeMap<Name, f64>,
    /// Present maintenance of the structure. Only notify reports it.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub maintenance: Vec<Maintenance>,
    /// Number of dropped, lost or recovered items since the start, by reason.
    #[serde(deserialize_with = "bounded::counts::<_, MAX_REASONS>")]
    pub drops: BTreeMap<String, u64>,
    /// Number of restarts since the start.
    pub restarts: u64,
    /// Version of the program.
    pub version: String,
}

/// End of the times that belong to a record without dates, which begins at 0. Three years exceed
/// any record.
const WITHOUT_DATES_BEFORE_NS: u64 = 100_000_000_000_000_000;
/// Returns whether the samples of a structure are live or replayed, from the newest status that
/// reports it.
///
/// For replayed samples, the lag behind the wall clock is meaningless. Returns `None` if no status
/// reports it.
#[must_use]
pub fn reported_pace<'s>(statuses: impl Iterator<Item = &'s Status>) -> Option<Pace> {
    statuses
        .filter(|status| status.pace.is_some())
        .max_by_key(|status| status.time_ns)?
        .pace
}

/// Returns `true` if a time (ns since the Unix epoch) belongs to a record without dates, which
/// begins at 0.
#[must_use]
pub fn is_without_date(time_ns: i64) -> bool {
    time_ns.unsigned_abs() < WITHOUT_DATES_BEFORE_NS
}

impl Message for Status {
    const TYPE: &'static str = "status";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        if let Some(lag) = self.lag_s {
            check_finite("lag", lag)?;
        }
        check_count("instruments", self.instruments.len(), 0, MAX_INSTRUMENTS)?;
        for (name, instrument) in &self.instruments {
            check_label("instrument", name)?;
            if let Some(error) = &instrument.last_error {
                check_text("last error", error)?;
            }
        }
        check_count("clocks", self.clocks.len(), 0, MAX_CHANNELS)?;
        for clock in self.clocks.values() {
            check_finite("clock offset", clock.offset_s)?;
            check_finite("clock jitter", clock.jitter_s)?;
            check_finite("clock difference", clock.difference_s.unwrap_or(0.0))?;
            let quality = f64::from(clock.quality_percent.unwrap_or(0));
            check_range("clock quality", quality, 0.0, 100.0)?;
        }
        check_count("missing", self.missing.len(), 0, MAX_CHANNELS)?;
        for share in self.missing.values() {
            check_range("missing share", *share, 0.0, 1.0)?;
        }
        check_count("maintenance", self.maintenance.len(), 0, MAX_CHANNELS)?;
        for maintenance in &self.maintenance {
            maintenance.check()?;
        }
        check_count("drops", self.drops.len(), 0, MAX_REASONS)?;
        for reason in self.drops.keys() {
            check_label("drop reason", reason)?;
        }
        check_label("version", &self.version)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn status(pace: Option<Pace>) -> Status {
        Status {
            structure: Name::new("tower").unwrap(),
            service: Name::new("ingest").unwrap(),
            id: Name::new("ingest").unwrap(),
            time_ns: 1_795_000_000_000_000_000,
            lag_s: Some(1.0),
            pace,
            state: None,
            done: 7,
            load: None,
            frames_behind: None,
            fit: None,
            undecided: BTreeMap::new(),
            instruments: BTreeMap::new(),
            clocks: BTreeMap::new(),
            missing: BTreeMap::new(),
            maintenance: Vec::new(),
            drops: BTreeMap::new(),
            restarts: 0,
            version: String::new(),
        }
    }

    #[test]
    fn newest_reported_pace_counts() {
        let at = |time_ns: i64, pace| Status {
            time_ns,
            ..status(pace)
        };
        let told = |all: &[Status]| reported_pace(all.iter());
        assert_eq!(told(&[]), None);
        assert_eq!(told(&[status(None)]), None);
        let [live, replayed] = [Some(Pace::Live), Some(Pace::Replayed)];
        assert_eq!(told(&[at(1, live), at(2, replayed), at(3, None)]), replayed);
        assert_eq!(told(&[at(3, live), at(2, replayed)]), live);
    }

    #[test]
    fn time_near_1970_means_a_record_without_dates() {
        assert!(
            is_without_date(0) && is_without_date(-5) && !is_without_date(status(None).time_ns)
        );
    }

    #[test]
    fn status_without_pace_and_load_omits_both_fields() {
        let text = String::from_utf8(status(None).encode().unwrap()).unwrap();
        for word in ["pace", "load", "frames_behind"] {
            assert!(!text.contains(word), "{text}");
        }
        assert_eq!(
            Status::decode("application/json", text.as_bytes()).unwrap(),
            status(None)
        );
        let text = String::from_utf8(status(Some(Pace::Replayed)).encode().unwrap()).unwrap();
        assert!(text.contains(r#""pace":"replayed""#), "{text}");
        for load in [
            Load::Normal,
            Load::DisplayShed,
            Load::Behind,
            Load::CatchingUp,
        ] {
            let text = String::from_utf8(
                Status {
                    load: Some(load),
                    ..status(None)
                }
                .encode()
                .unwrap(),
            )
            .unwrap();
            assert!(
                text.contains(&format!(r#""load":"{}""#, load.as_str())),
                "{text}"
            );
        }
    }
}
