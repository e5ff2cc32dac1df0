//! The log of a period: changes of alerts and events.
//!
//! The dashboard keeps only the newest ones. The history service supplies those of earlier periods.
//! The reply states whether it did, so that an empty list is not taken for a quiet period.

use crate::history::{Refused, time};
use crate::store::Store;
use crate::view::{ChangeView, changes};
use axum::Json;
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use spandrel_bus::{Event, HistoryLog, SpanQuery};
use std::ops::RangeInclusive;

/// Default number of messages to read from the history.
const MESSAGES: usize = 1_000;
/// Maximum number of messages to read from the history.
const MOST_MESSAGES: usize = 4_000;

/// A request before validation.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Asked {
    /// Seconds since the Unix epoch (UTC), or ISO 8601.
    from: Option<String>,
    to: Option<String>,
    most: Option<usize>,
}

/// A requested period.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct WantedLog {
    from_ns: i64,
    to_ns: i64,
    most: usize,
}

/// Whether the history service has supplied its messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum FromHistory {
    Read,
    /// It runs, but has not replied in time.
    NoReply,
    /// It does not run.
    Absent,
}

/// The log of a period, newest first.
#[derive(Debug, Serialize)]
struct LogView<'s> {
    structure: &'s str,
    history: FromHistory,
    /// Time before which the period may contain more (s since the Unix epoch, UTC). `None` if the
    /// log is complete as far as the history goes.
    cut_at_s: Option<f64>,
    changes: Vec<ChangeView<'s>>,
    events: Vec<&'s Event>,
}

impl WantedLog {
    /// Checks a request.
    pub(crate) fn new(asked: &Asked) -> Result<Self, Refused> {
        let refuse = |what: String, allowed: String| Err(Refused { what, allowed });
        let most = asked.most.unwrap_or(MESSAGES);
        if !(1..=MOST_MESSAGES).contains(&most) {
            let allowed = format!("must be from 1 to {MOST_MESSAGES}");
            return refuse(format!("most is {most}"), allowed);
        }
        let from_ns = time("from", asked.from.as_ref(), i64::MIN)?;
        let to_ns = time("to", asked.to.as_ref(), i64::MAX)?;
        if from_ns > to_ns {
            let allowed = "from must come before to".to_owned();
            return refuse("from is after to".to_owned(), allowed);
        }
        Ok(Self {
            from_ns,
            to_ns,
            most,
        })
    }

    /// Returns the query for the history service.
    pub(crate) fn query(self) -> SpanQuery {
        SpanQuery {
            from_ns: self.from_ns,
            to_ns: self.to_ns,
            points: self.most,
            ..SpanQuery::default()
        }
    }

    /// Writes the reply from the past that the dashboard keeps, and from that of the history. A long
    /// log takes up to tens of milliseconds, so that this must not run on a thread of requests.
    pub(crate) fn response(
        self,
        mut past: Store,
        history: FromHistory,
        log: Option<HistoryLog>,
    ) -> Response {
        let cut_ns = log.as_ref().and_then(|log| self.cut_ns(log));
        if let Some(log) = log {
            past.join(log);
        }
        Json(self.view(&past, history, cut_ns)).into_response()
    }

    /// Returns the time of the oldest message if the history may have more than was requested (ns).
    fn cut_ns(self, log: &HistoryLog) -> Option<i64> {
        let alerts = log.alerts.iter().map(|alert| alert.time_ns);
        let notes = log.acknowledgements.iter().map(|note| note.time_ns);
        let events = log.events.iter().map(|event| event.time_ns);
        let times = alerts.chain(notes).chain(events);
        if times.clone().count() < self.most {
            return None;
        }
        times.min()
    }

    fn view(self, past: &Store, history: FromHistory, cut_ns: Option<i64>) -> LogView<'_> {
        // Before the cut, only some of the messages are known.
        let span: RangeInclusive<i64> = cut_ns.unwrap_or(self.from_ns)..=self.to_ns;
        LogView {
            structure: &past.about.name,
            history,
            cut_at_s: cut_ns.map(|time_ns| time_ns as f64 / 1e9),
            changes: changes(past, usize::MAX)
                .into_iter()
                .filter(|change| span.contains(&change.changed_ns()))
                .collect(),
            events: past
                .events
                .iter()
                .filter(|event| span.contains(&event.time_ns))
                .collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{alert, demo, name};
    use spandrel_bus::{AlertState, EventKind};
    use spandrel_listener::Input;

    fn event(time_ns: i64) -> Event {
        Event {
            structure: name("demo"),
            time_ns,
            kind: EventKind::Restart,
            subject: "identify".into(),
            what: "restarted".into(),
            why: format!("for the test at {time_ns}"),
        }
    }

    fn logged(times_ns: impl Iterator<Item = i64>) -> HistoryLog {
        HistoryLog {
            structure: name("demo"),
            alerts: vec![alert("storey-2", 7, AlertState::Raised)],
            acknowledgements: vec![],
            events: times_ns.map(event).collect(),
        }
    }

    fn wanted(from_ns: i64, to_ns: i64, most: usize) -> WantedLog {
        WantedLog {
            from_ns,
            to_ns,
            most,
        }
    }

    #[test]
    fn log_contains_more_than_the_dashboard_keeps() {
        let mut store = demo();
        (900..1_300).for_each(|time_ns| store.handle(Input::Event(event(time_ns))));
        let mut past = store.past();
        past.join(logged(1..1_000));
        let wanted = wanted(5, 1_250, 4_000);
        let view = wanted.view(&past, FromHistory::Read, wanted.cut_ns(&logged(1..1_000)));
        let times: Vec<i64> = view.events.iter().map(|event| event.time_ns).collect();
        let expected: Vec<i64> = (1_100..=1_250).rev().chain((5..1_000).rev()).collect();
        assert_eq!(
            times, expected,
            "the store keeps 200 events, the log has 999"
        );
        assert_eq!(view.changes.len(), 1);
        assert_eq!(view.cut_at_s, None);
    }

    #[test]
    fn log_with_the_requested_number_of_messages_may_be_cut() {
        let log = logged(8..12);
        assert_eq!(wanted(0, 20, 6).cut_ns(&log), None);
        assert_eq!(wanted(0, 20, 5).cut_ns(&log), Some(7));
    }

    #[test]
    fn period_and_number_are_checked() {
        let asked = |from: &str, to: &str, most| Asked {
            from: Some(from.to_owned()),
            to: Some(to.to_owned()),
            most,
        };
        assert_eq!(
            WantedLog::new(&asked("1", "2", None)).unwrap(),
            wanted(1_000_000_000, 2_000_000_000, MESSAGES)
        );
        let what = |asked: &Asked| WantedLog::new(asked).unwrap_err().what;
        assert_eq!(what(&asked("2", "1", None)), "from is after to");
        assert_eq!(what(&asked("1", "2", Some(0))), "most is 0");
        assert_eq!(what(&asked("1", "2", Some(4_001))), "most is 4001");
    }
}
