//! Reports values that cannot count because of a time ahead of the clock of the machine.

use crate::error::utc;
use spandrel_bus::{ConditionDisplay, Event, EventKind, Name};
use std::collections::BTreeMap;
use std::time::Duration;

/// Minimum time between two reports about the same source. Values can arrive ten times a second.
const REPORT_EVERY: Duration = Duration::from_secs(3600);
const NS_PER_S: i64 = 1_000_000_000;

/// What is ahead of the clock.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Ahead {
    /// The values of a quantity or condition, at this time (ns since 1970-01-01 UTC).
    Values { of: Name, time_ns: i64 },
    /// The last closed epoch, which ends at this time (ns since 1970-01-01 UTC).
    Epoch { end_ns: i64 },
}

/// Limits the rate of the reports.
#[derive(Debug, Default)]
pub(crate) struct AheadReports {
    /// Time of the last report of each quantity and condition. `None` is the closed epoch.
    reported: BTreeMap<Option<Name>, Duration>,
    waiting: Vec<Ahead>,
}

impl AheadReports {
    /// Takes what is ahead at `now`, the time since a fixed moment.
    pub(crate) fn take(&mut self, ahead: Ahead, now: Duration) {
        let source = match &ahead {
            Ahead::Values { of, .. } => Some(of.clone()),
            Ahead::Epoch { .. } => None,
        };
        let last = self.reported.get(&source);
        if last.is_none_or(|last| now.saturating_sub(*last) >= REPORT_EVERY) {
            self.reported.insert(source, now);
            self.waiting.push(ahead);
        }
    }

    /// Returns what is not reported yet.
    pub(crate) fn drain(&mut self) -> Vec<Ahead> {
        std::mem::take(&mut self.waiting)
    }
}

impl Ahead {
    /// Returns the event about it. `clock_ns` is the time of the machine (ns since 1970-01-01 UTC).
    pub(crate) fn event(&self, structure: &Name, clock_ns: i64) -> Event {
        let (subject, what, why) = match self {
            Self::Values { of, time_ns } => (
                of.to_string(),
                "values ahead of the clock are not judged".to_owned(),
                format!(
                    "a value has a time {} s ahead of the clock of this machine, more than {} s",
                    time_ns.saturating_sub(clock_ns) / NS_PER_S,
                    ConditionDisplay::MAX_AHEAD_NS / NS_PER_S
                ),
            ),
            Self::Epoch { end_ns } => (
                "judge".to_owned(),
                format!("no value counts until {}", utc(*end_ns)),
                "the last epoch is ahead of the clock of this machine, which is wrong now or was \
                 wrong then"
                    .to_owned(),
            ),
        };
        Event {
            structure: structure.clone(),
            time_ns: clock_ns,
            kind: EventKind::Gap,
            subject,
            what,
            why,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{S, name};
    use spandrel_bus::Message as _;

    #[test]
    fn each_source_is_reported_once_an_hour() {
        let mut reports = AheadReports::default();
        let of = |source| Ahead::Values {
            of: name(source),
            time_ns: 90 * S,
        };
        let epoch = Ahead::Epoch { end_ns: 900 * S };
        for second in [0, 1, 3599] {
            for ahead in [of("pier"), of("deck"), epoch.clone()] {
                reports.take(ahead, Duration::from_secs(second));
            }
        }
        assert_eq!(reports.drain(), [of("pier"), of("deck"), epoch]);
        reports.take(of("pier"), Duration::from_secs(3600));
        assert_eq!(reports.drain(), [of("pier")]);
        assert_eq!(reports.drain(), []);
    }

    #[test]
    fn the_event_states_the_difference_or_the_end_and_is_a_message() {
        let values = Ahead::Values {
            of: name("pier"),
            time_ns: 100 * S,
        };
        let event = values.event(&name("bridge"), 10 * S);
        assert_eq!((event.subject.as_str(), event.time_ns), ("pier", 10 * S));
        assert!(event.why.contains("90 s ahead"), "{}", event.why);
        event.check().unwrap();
        let epoch = Ahead::Epoch { end_ns: 900 * S };
        let event = epoch.event(&name("bridge"), 10 * S);
        assert_eq!(event.what, "no value counts until 1970-01-01T00:15:00Z");
        event.check().unwrap();
    }
}
