//! How a service is doing.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::{
    FitVerdict, Format, Malformed, Message, Pace, UndecidedBecause, bounded, check_count,
    check_finite, check_label,
};
use crate::name::Name;

/// Most reasons in one status: they come from a closed set.
const MAX_REASONS: usize = 1024;

/// How a service keeps up with what it is given.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Load {
    /// It keeps up.
    Normal,
    /// It is overloaded: values for people are put at a tenth of their rate.
    DisplayShed,
    /// That was not enough: it falls behind, and reads from the recording.
    Behind,
    /// It was behind, and comes nearer.
    CatchingUp,
}

impl Load {
    /// The state as a word.
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

/// Whether a service does its work, or waits to take it over.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Standing {
    /// It puts what it does.
    Leading,
    /// It does the same as the one that leads, and puts nothing.
    StandingBy,
    /// It has not yet what it needs for that: the state of the one that leads.
    Joining,
}

/// Put once per second by every service, and when its load changes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Status {
    /// The structure.
    pub structure: Name,
    /// The service, as in its key.
    pub service: Name,
    /// The instance, as in its key.
    pub id: Name,
    /// Wall clock, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// Wall clock minus time of the last item done, s; none before the first.
    pub lag_s: Option<f64>,
    /// Whether the samples come as they are measured or from a record or simulation, of those that know: ingest, and fuse where nodes
    /// identify for themselves, once some have come.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pace: Option<Pace>,
    /// Where it stands, of a service that several processes may be ready for: identify.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub state: Option<Standing>,
    /// Number of the first item not yet done.
    pub done: u64,
    /// How it keeps up, of a service that tells: identify.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub load: Option<Load>,
    /// Frames that ingest has made and this service has not done, where that is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frames_behind: Option<u64>,
    /// The verdict on the fit after the last frame, of identify.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fit: Option<FitVerdict>,
    /// Number of watched parameters on which nothing is decided, by reason, of alert.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub undecided: BTreeMap<UndecidedBecause, u64>,
    /// What was dropped, lost or mended, counted by reason since the start.
    #[serde(deserialize_with = "bounded::counts::<_, MAX_REASONS>")]
    pub drops: BTreeMap<String, u64>,
    /// Restarts since the start.
    pub restarts: u64,
    /// Version of the program.
    pub version: String,
}

/// Times before this are those of a record that begins at 0: three years, longer than any.
const WITHOUT_DATES_BEFORE_NS: u64 = 100_000_000_000_000_000;
/// Whether the samples of a structure come as they are measured, by the newest status that says so. Of those that do not, a lag behind
/// the clock on the wall says nothing. None before anybody has said so.
#[must_use]
pub fn pace_told<'s>(statuses: impl Iterator<Item = &'s Status>) -> Option<Pace> {
    statuses
        .filter(|status| status.pace.is_some())
        .max_by_key(|status| status.time_ns)?
        .pace
}

/// Whether a time (ns since the Unix epoch) is that of a record without dates, which begins at 0.
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
            drops: BTreeMap::new(),
            restarts: 0,
            version: String::new(),
        }
    }

    #[test]
    fn the_newest_word_on_the_pace_counts() {
        let at = |time_ns: i64, pace| Status {
            time_ns,
            ..status(pace)
        };
        let told = |all: &[Status]| pace_told(all.iter());
        assert_eq!(told(&[]), None);
        assert_eq!(told(&[status(None)]), None);
        let [live, replayed] = [Some(Pace::Live), Some(Pace::Replayed)];
        assert_eq!(told(&[at(1, live), at(2, replayed), at(3, None)]), replayed);
        assert_eq!(told(&[at(3, live), at(2, replayed)]), live);
    }

    #[test]
    fn a_time_near_1970_is_that_of_a_record_without_dates() {
        assert!(
            is_without_date(0) && is_without_date(-5) && !is_without_date(status(None).time_ns)
        );
    }

    #[test]
    fn a_status_without_pace_is_that_of_before() {
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
