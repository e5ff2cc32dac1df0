//! What has to be sent to whom, and when: pure, time is an input.

use spandrel_bus::{AlertMessage, AlertState};
use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

/// Notices that wait for one receiver at most; the oldest make room and are counted.
const MOST_WAITING: usize = 1_000;
/// Keys remembered, so that what comes again is not sent again.
const KEYS_REMEMBERED: usize = 10_000;
/// Time until a notice that failed is sent again: doubled each time, from this to that.
const RETRY_AFTER: (Duration, Duration) = (Duration::from_secs(2), Duration::from_secs(300));
/// A notice that could not be sent for so long is given up.
const GIVE_UP_AFTER: Duration = Duration::from_secs(24 * 3_600);
/// How often an alert that stands is told again to receivers that want that.
const REPEAT_EVERY: Duration = Duration::from_secs(60);

/// What one receiver wants.
#[derive(Clone, Debug)]
pub(crate) struct Wish {
    pub(crate) states: Vec<AlertState>,
    /// Whether alerts that stand are told again and again.
    pub(crate) repeats: bool,
}

/// One alert for one receiver.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Notice {
    pub(crate) receiver: usize,
    /// The same for the same change of the same alert, so that a receiver can drop what it has.
    pub(crate) key: String,
    pub(crate) alert: AlertMessage,
}

#[derive(Debug)]
struct Waiting {
    notice: Notice,
    since: Duration,
    due: Duration,
    retry_after: Duration,
}

/// What waits for one receiver, in order.
#[derive(Debug)]
struct Receiver {
    wish: Wish,
    waiting: VecDeque<Waiting>,
    is_sending: bool,
    /// Alerts that stand, with the time of their next repetition.
    standing: BTreeMap<(String, String), (AlertMessage, Duration)>,
}

/// What waits for everybody.
#[derive(Debug)]
pub(crate) struct Outbox {
    boxes: Vec<Receiver>,
    known: VecDeque<String>,
    pub(crate) sent: u64,
    pub(crate) failures: u64,
    pub(crate) given_up: u64,
}

/// The same for the same change of the same alert.
fn key(alert: &AlertMessage) -> String {
    format!("{}/{}/{}/{}", alert.structure, alert.parameter, alert.time_ns, alert.state.as_str())
}

impl Outbox {
    pub(crate) fn new(wishes: Vec<Wish>) -> Self {
        let empty = |wish| Receiver { wish, waiting: VecDeque::new(), is_sending: false, standing: BTreeMap::new() };
        Self {
            boxes: wishes.into_iter().map(empty).collect(),
            known: VecDeque::new(),
            sent: 0,
            failures: 0,
            given_up: 0,
        }
    }

    /// Takes an alert; one that was taken before changes nothing.
    pub(crate) fn take(&mut self, alert: &AlertMessage, now: Duration) {
        let key = key(alert);
        if self.known.contains(&key) {
            return;
        }
        self.known.push_back(key.clone());
        if self.known.len() > KEYS_REMEMBERED {
            self.known.pop_front();
        }
        for (receiver, place) in self.boxes.iter_mut().enumerate() {
            let of = (alert.structure.to_string(), alert.parameter.to_string());
            // what is over stands no longer, whoever wants to know of it
            place.standing.remove(&of);
            if !place.wish.states.contains(&alert.state) {
                continue;
            }
            if place.wish.repeats && matches!(alert.state, AlertState::Raised | AlertState::Acknowledged) {
                place.standing.insert(of, (alert.clone(), now + REPEAT_EVERY));
            }
            let notice = Notice { receiver, key: key.clone(), alert: alert.clone() };
            place.waiting.push_back(Waiting { notice, since: now, due: now, retry_after: RETRY_AFTER.0 });
            if place.waiting.len() > MOST_WAITING {
                // one that is being sent stays the first
                place.waiting.remove(usize::from(place.is_sending));
                self.given_up += 1;
            }
        }
    }

    /// What is to be sent now: of each receiver the oldest, so that it hears everything in order.
    pub(crate) fn due(&mut self, now: Duration) -> Vec<Notice> {
        let mut due = Vec::new();
        for (receiver, place) in self.boxes.iter_mut().enumerate() {
            if place.waiting.is_empty() {
                for (alert, next) in place.standing.values_mut().filter(|(_, next)| *next <= now) {
                    *next = now + REPEAT_EVERY;
                    let notice = Notice { receiver, key: key(alert), alert: alert.clone() };
                    place.waiting.push_back(Waiting { notice, since: now, due: now, retry_after: RETRY_AFTER.0 });
                }
            }
            if place.is_sending {
                continue;
            }
            if let Some(first) = place.waiting.front().filter(|waiting| waiting.due <= now) {
                place.is_sending = true;
                due.push(first.notice.clone());
            }
        }
        due
    }

    /// Takes how it went.
    pub(crate) fn done(&mut self, receiver: usize, is_sent: bool, now: Duration) {
        let Some(place) = self.boxes.get_mut(receiver) else { return };
        place.is_sending = false;
        if is_sent {
            place.waiting.pop_front();
            self.sent += 1;
            return;
        }
        self.failures += 1;
        let Some(first) = place.waiting.front_mut() else { return };
        if now.saturating_sub(first.since) > GIVE_UP_AFTER {
            place.waiting.pop_front();
            self.given_up += 1;
            return;
        }
        first.due = now + first.retry_after;
        first.retry_after = (2 * first.retry_after).min(RETRY_AFTER.1);
    }

    /// Notices that wait.
    pub(crate) fn waiting(&self) -> usize {
        self.boxes.iter().map(|place| place.waiting.len()).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::message::tests::alert;

    fn s(seconds: u64) -> Duration {
        Duration::from_secs(seconds)
    }

    fn outbox(repeats: bool) -> Outbox {
        let states = vec![AlertState::Raised, AlertState::Cleared];
        Outbox::new(vec![Wish { states, repeats }, Wish { states: vec![AlertState::Acknowledged], repeats: false }])
    }

    #[test]
    fn each_change_is_sent_once_to_whom_it_concerns() {
        let mut outbox = outbox(false);
        for _ in 0..3 {
            outbox.take(&alert(10, AlertState::Pending), s(0));
            outbox.take(&alert(20, AlertState::Raised), s(0));
        }
        let due = outbox.due(s(0));
        assert_eq!(
            due.iter().map(|notice| (notice.receiver, notice.alert.state)).collect::<Vec<_>>(),
            [(0, AlertState::Raised)]
        );
        assert!(due[0].key.ends_with("/storey-2/20000000000/raised"), "{}", due[0].key);
        assert_eq!(outbox.due(s(1)), [], "it is on its way");
        outbox.done(0, true, s(1));
        outbox.take(&alert(30, AlertState::Acknowledged), s(2));
        assert_eq!(outbox.due(s(2)).iter().map(|notice| notice.receiver).collect::<Vec<_>>(), [1]);
        assert_eq!((outbox.sent, outbox.waiting()), (1, 1));
    }

    #[test]
    fn what_failed_is_sent_again_later_and_later_and_in_order() {
        let mut outbox = outbox(false);
        outbox.take(&alert(20, AlertState::Raised), s(0));
        outbox.take(&alert(40, AlertState::Cleared), s(0));
        let mut attempts = Vec::new();
        for second in 0..4_000 {
            for notice in outbox.due(s(second)) {
                assert_eq!(notice.alert.state, AlertState::Raised, "the second waits for the first");
                attempts.push(second);
                outbox.done(0, false, s(second));
            }
        }
        assert_eq!(attempts[..6], [0, 2, 6, 14, 30, 62]);
        assert!(attempts.windows(2).all(|pair| pair[1] - pair[0] <= 300));
        for notice in outbox.due(s(5_000)) {
            outbox.done(notice.receiver, true, s(5_000));
        }
        assert_eq!(outbox.due(s(5_000))[0].alert.state, AlertState::Cleared);
        outbox.done(0, false, s(5_000));
        // a receiver that never comes back is given up after a day
        for second in (5_000..200_000).step_by(100) {
            let due = outbox.due(s(second));
            due.iter().for_each(|notice| outbox.done(notice.receiver, false, s(second)));
        }
        assert_eq!((outbox.given_up, outbox.waiting()), (1, 0));
    }

    #[test]
    fn an_alert_that_stands_is_repeated_to_whoever_wants_that() {
        let mut outbox = outbox(true);
        outbox.take(&alert(20, AlertState::Raised), s(0));
        let mut sent = Vec::new();
        for second in 0..200 {
            if second == 150 {
                outbox.take(&alert(170, AlertState::Cleared), s(second));
            }
            for notice in outbox.due(s(second)) {
                sent.push((second, notice.alert.state));
                outbox.done(notice.receiver, true, s(second));
            }
        }
        let raised = AlertState::Raised;
        assert_eq!(sent, [(0, raised), (60, raised), (120, raised), (150, AlertState::Cleared)]);
    }

    #[test]
    fn what_waits_is_bounded() {
        let mut outbox = outbox(false);
        for second in 0..5_000 {
            outbox.take(&alert(second, AlertState::Raised), s(0));
        }
        assert_eq!((outbox.waiting(), outbox.given_up), (MOST_WAITING, 4_000));
    }
}
