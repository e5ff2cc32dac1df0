//! Decides when the clock of a node is worth a notice: as soon as it is wrong, and once it has been
//! right for a time. It has no clock: the time is an argument.

use crate::state::NoticeState;
use serde::{Deserialize, Serialize};
use spandrel_bus::{Event, EventKind, Name, Status};
use std::collections::BTreeMap;
use std::time::Duration;

/// Time for which a clock must no longer be wrong before a notice reports it.
///
/// A clock that is wrong again within this time causes no further notice. After a restart, ingest
/// needs some seconds to find a wrong clock again.
const RIGHT_AFTER: Duration = Duration::from_secs(60);

/// The clock of a node has become wrong or right.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct ClockChange {
    pub(crate) structure: Name,
    pub(crate) node: Name,
    /// Wall-clock time, ns since the Unix epoch, UTC. The measurement time depends on the clocks in
    /// question.
    pub(crate) time_ns: i64,
    pub(crate) is_wrong: bool,
    /// What happened, with the difference, as in the event.
    pub(crate) what: String,
    /// The reason, as in the event.
    pub(crate) why: String,
}

impl ClockChange {
    pub(crate) fn state(&self) -> NoticeState {
        match self.is_wrong {
            true => NoticeState::ClockWrong,
            false => NoticeState::ClockRight,
        }
    }
}

/// The clocks of the nodes of one structure, as notified.
#[derive(Debug)]
pub(crate) struct Clocks {
    structure: Name,
    nodes: Vec<Name>,
    /// Nodes whose clock was notified as wrong.
    wrong: BTreeMap<Name, Wrong>,
}

#[derive(Debug)]
struct Wrong {
    /// Whether the status of ingest lists the clock as wrong. It does not list clocks that differ
    /// without a majority.
    is_listed: bool,
    /// Time since which no message has reported the clock as wrong.
    ended: Option<Duration>,
}

impl Clocks {
    /// Creates the state of the nodes of a structure. An earlier run has notified the clocks of
    /// `wrong`.
    pub(crate) fn new(structure: Name, nodes: Vec<Name>, wrong: Vec<Name>) -> Self {
        let listed = || Wrong {
            is_listed: true,
            ended: None,
        };
        Self {
            structure,
            nodes,
            wrong: wrong.into_iter().map(|node| (node, listed())).collect(),
        }
    }

    /// Processes an event. Returns the change if it is worth a notice at once. `wall_ns` is the
    /// wall-clock time, ns since the Unix epoch, UTC.
    pub(crate) fn take_event(
        &mut self,
        event: &Event,
        now: Duration,
        wall_ns: i64,
    ) -> Option<ClockChange> {
        let node = self
            .nodes
            .iter()
            .find(|node| node.as_str() == event.subject)?;
        let known = self.wrong.get_mut(node);
        match (event.kind, known) {
            (EventKind::ClockWrong, Some(known)) => {
                known.ended = None;
                None
            }
            (EventKind::ClockWrong, None) => {
                let (what, why) = (event.what.clone(), event.why.clone());
                Some(self.begin(&node.clone(), false, wall_ns, what, why))
            }
            (EventKind::ClockRight, Some(known)) => {
                known.is_listed = false;
                known.ended.get_or_insert(now);
                None
            }
            _ => None,
        }
    }

    /// Processes a status of ingest. Returns the wrong clocks whose event was missed.
    pub(crate) fn take_status(
        &mut self,
        of_ingest: &Status,
        now: Duration,
        wall_ns: i64,
    ) -> Vec<ClockChange> {
        // Ingest has just started, and knows nothing of the clocks of its former run.
        let is_first = of_ingest.pace.is_none();
        let difference_s = |node: &Name| of_ingest.clocks.get(node)?.difference_s;
        for (node, known) in &mut self.wrong {
            let was_listed = std::mem::replace(&mut known.is_listed, difference_s(node).is_some());
            if known.is_listed {
                known.ended = None;
            } else if was_listed || is_first {
                known.ended.get_or_insert(now);
            }
        }
        let is_new = |node: &&Name| !self.wrong.contains_key(*node);
        let missed = self.nodes.iter().filter(is_new);
        let missed: Vec<(Name, f64)> = missed
            .filter_map(|node| Some((node.clone(), difference_s(node)?)))
            .collect();
        let begin = |(node, difference_s): (Name, f64)| {
            let side = match difference_s < 0.0 {
                true => "behind",
                false => "ahead of",
            };
            let seconds = difference_s.abs();
            let what = format!("the clock of the node is {seconds:.1} s {side} most nodes");
            let why = "samples of this node are dropped until its clock is right".to_owned();
            self.begin(&node, true, wall_ns, what, why)
        };
        missed.into_iter().map(begin).collect()
    }

    /// Returns the clocks that have been right for long enough.
    pub(crate) fn look(&mut self, now: Duration, wall_ns: i64) -> Vec<ClockChange> {
        let is_over = |_: &Name, known: &mut Wrong| {
            let lasted = known.ended.map(|ended| now.saturating_sub(ended));
            lasted.is_some_and(|lasted| lasted >= RIGHT_AFTER)
        };
        let over = self.wrong.extract_if(.., is_over);
        let change = |(node, _): (Name, Wrong)| ClockChange {
            structure: self.structure.clone(),
            node,
            time_ns: wall_ns,
            is_wrong: false,
            what: "the clock of the node is right again".to_owned(),
            why: format!(
                "ingest has not found it wrong for {} s",
                RIGHT_AFTER.as_secs()
            ),
        };
        over.map(change).collect()
    }

    fn begin(
        &mut self,
        node: &Name,
        is_listed: bool,
        wall_ns: i64,
        what: String,
        why: String,
    ) -> ClockChange {
        let known = Wrong {
            is_listed,
            ended: None,
        };
        self.wrong.insert(node.clone(), known);
        ClockChange {
            structure: self.structure.clone(),
            node: node.clone(),
            time_ns: wall_ns,
            is_wrong: true,
            what,
            why,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{name, s};
    use spandrel_bus::{NodeClock, Pace};

    fn clocks(wrong: &[&str]) -> Clocks {
        let wrong = wrong.iter().map(|node| name(node)).collect();
        Clocks::new(name("house"), vec![name("ground"), name("roof")], wrong)
    }

    fn event(kind: EventKind, subject: &str) -> Event {
        Event {
            structure: name("house"),
            time_ns: 0,
            kind,
            subject: subject.to_owned(),
            what: "the clock of the node is 3600.0 s ahead of most nodes".to_owned(),
            why: "2 of 3 nodes agree on another time".to_owned(),
        }
    }

    /// Returns a status of ingest that lists the difference of the roof (s).
    fn status(pace: Option<Pace>, difference_s: Option<f64>) -> Status {
        let clock = NodeClock {
            difference_s,
            ..NodeClock::default()
        };
        Status {
            structure: name("house"),
            service: name("ingest"),
            id: name("ingest"),
            time_ns: 0,
            lag_s: None,
            pace,
            state: None,
            done: 0,
            load: None,
            frames_behind: None,
            fit: None,
            undecided: BTreeMap::new(),
            instruments: BTreeMap::new(),
            clocks: [(name("roof"), clock)].into(),
            missing: BTreeMap::new(),
            maintenance: Vec::new(),
            drops: BTreeMap::new(),
            restarts: 0,
            version: String::new(),
        }
    }

    fn listed(difference_s: Option<f64>) -> Status {
        status(Some(Pace::Live), difference_s)
    }

    /// Returns whether each notice reports a wrong clock.
    fn kinds(changes: &[ClockChange]) -> Vec<bool> {
        changes.iter().map(|change| change.is_wrong).collect()
    }

    #[test]
    fn wrong_clock_is_notified_at_once_and_once_until_it_has_been_right() {
        let mut clocks = clocks(&[]);
        let mut at = |second, kind| clocks.take_event(&event(kind, "roof"), s(second), 7);
        let first = at(1, EventKind::ClockWrong).unwrap();
        assert_eq!((first.node.as_str(), first.time_ns), ("roof", 7));
        assert_eq!(first.what, event(EventKind::ClockWrong, "").what);
        // A clock that is wrong every other second causes no flood of notices.
        for second in 2..60 {
            assert_eq!(at(second, EventKind::ClockRight), None);
            assert_eq!(at(second, EventKind::ClockWrong), None);
        }
        assert_eq!(at(60, EventKind::ClockRight), None);
        assert_eq!(clocks.look(s(119), 8), []);
        let over = clocks.look(s(120), 8);
        assert_eq!(kinds(&over), [false]);
        assert_eq!(over[0].time_ns, 8);
        let again = clocks.take_event(&event(EventKind::ClockWrong, "roof"), s(121), 9);
        assert!(again.unwrap().is_wrong);
    }

    #[test]
    fn events_of_unknown_nodes_and_ends_without_a_beginning_are_no_notices() {
        let mut clocks = clocks(&[]);
        for (kind, node) in [
            (EventKind::ClockWrong, "nobody"),
            (EventKind::ClockRight, "roof"),
            (EventKind::ClockMoved, "roof"),
        ] {
            assert_eq!(clocks.take_event(&event(kind, node), s(1), 0), None);
        }
        assert_eq!(clocks.look(s(1000), 0), []);
    }

    #[test]
    fn status_supplies_an_event_that_was_missed() {
        let mut clocks = clocks(&[]);
        let missed = clocks.take_status(&listed(Some(-600.0)), s(1), 5);
        assert_eq!(kinds(&missed), [true]);
        assert_eq!(
            missed[0].what,
            "the clock of the node is 600.0 s behind most nodes"
        );
        assert_eq!(clocks.take_status(&listed(Some(-600.0)), s(2), 5), []);
        assert_eq!(clocks.take_status(&listed(None), s(3), 5), []);
        assert_eq!(kinds(&clocks.look(s(63), 5)), [false]);
    }

    #[test]
    fn restart_repeats_no_notice_and_forgets_no_end() {
        // Without a majority, no status lists the clock. Ingest finds it wrong again.
        let mut still = clocks(&[]);
        let wrong = event(EventKind::ClockWrong, "roof");
        assert!(still.take_event(&wrong, s(0), 0).is_some());
        assert_eq!(still.take_status(&listed(None), s(1), 0), []);
        assert_eq!(still.look(s(100), 0), []);
        assert_eq!(still.take_status(&status(None, None), s(101), 0), []);
        assert_eq!(still.take_event(&wrong, s(105), 0), None);
        assert_eq!(still.look(s(600), 0), []);
        // Notify was restarted as well, and the clock was set right meanwhile.
        let mut right = clocks(&["roof"]);
        assert_eq!(right.take_status(&status(None, None), s(1), 0), []);
        assert_eq!(kinds(&right.look(s(61), 0)), [false]);
    }
}
