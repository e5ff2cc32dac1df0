//! Decides which notices to send, to which receivers, and when. It has no clock: the time is an
//! argument.

use serde::{Deserialize, Serialize};
use spandrel_bus::{AlertMessage, AlertState, Name};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Duration;

/// Maximum number of notices in the queue of one receiver. When it is full, the oldest is dropped
/// and counted.
const MOST_WAITING: usize = 1_000;
/// Number of keys kept for a structure to detect duplicates. It exceeds the length of the alert
/// service's log.
const KEYS_REMEMBERED: usize = 1_000;
/// First and longest delay before a retry. The delay doubles with each attempt.
const RETRY_AFTER: (Duration, Duration) = (Duration::from_secs(2), Duration::from_secs(300));
/// Age after which an undelivered notice is dropped.
pub(crate) const GIVE_UP_AFTER: Duration = Duration::from_secs(24 * 3_600);
/// Factor by which a loss must grow before a revised alert is sent again.
///
/// An alert that grows from 5 % to 100 % is sent at most five times. A loss whose interval only
/// narrows is not sent again.
const LOUDER: f64 = 2.0;
/// Interval at which an active alert is repeated to receivers that require it.
const REPEAT_EVERY: Duration = Duration::from_secs(60);

/// The alerts that one receiver requests.
#[derive(Clone, Debug)]
pub(crate) struct Wish {
    /// Name of the receiver, the same after each restart and without secrets.
    pub(crate) name: String,
    pub(crate) states: Vec<AlertState>,
    /// Whether active alerts are repeated.
    pub(crate) repeats: bool,
}

impl Wish {
    /// Returns `true` if the receiver requests repetitions of this alert.
    ///
    /// An unconfirmed alert is also repeated if the receiver requests raised alerts.
    fn repeats(&self, alert: &AlertMessage) -> bool {
        let told_as = if alert.state == AlertState::Unconfirmed {
            AlertState::Raised
        } else {
            alert.state
        };
        self.repeats
            && alert.stands()
            && (self.states.contains(&alert.state) || self.states.contains(&told_as))
    }
}

/// One alert for one receiver.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Notice {
    pub(crate) receiver: usize,
    /// Key of the change, which lets a receiver detect duplicates.
    pub(crate) key: String,
    pub(crate) alert: AlertMessage,
}

#[derive(Debug)]
struct Waiting {
    notice: Notice,
    since: Duration,
    due: Duration,
    retry_after: Duration,
    /// Whether this is a repetition of an active alert, which checkpoints omit.
    is_repeated: bool,
}

impl Waiting {
    fn new(notice: Notice, since: Duration, now: Duration) -> Self {
        Self {
            notice,
            since,
            due: now,
            retry_after: RETRY_AFTER.0,
            is_repeated: false,
        }
    }
}

/// The queue of one receiver, in order.
#[derive(Debug)]
struct Receiver {
    wish: Wish,
    waiting: VecDeque<Waiting>,
    is_sending: bool,
    /// Active alerts, with the time of their next repetition.
    standing: BTreeMap<Subject, (AlertMessage, Duration)>,
}

/// The subject of an alert: structure and parameter.
type Subject = (Name, Name);

/// The checkpoint state of the notices of one structure.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Remembered {
    /// Keys of changes that have been processed, oldest first.
    keys: Vec<String>,
    /// The last change of each alert.
    last: Vec<AlertMessage>,
    /// Undelivered notices in the order of delivery.
    waiting: Vec<Undelivered>,
    /// The changes that were sent for each alert that is not over.
    told: Vec<AlertMessage>,
}

/// An alert that one receiver has not received yet.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Undelivered {
    receiver: String,
    alert: AlertMessage,
    /// Age when the checkpoint was written, in s.
    age_s: u64,
}

impl Remembered {
    /// Returns the number of undelivered notices.
    pub(crate) fn waiting(&self) -> usize {
        self.waiting.len()
    }
}

/// The queues of all receivers.
#[derive(Debug)]
pub(crate) struct Outbox {
    boxes: Vec<Receiver>,
    known: BTreeMap<Name, VecDeque<String>>,
    last: BTreeMap<Subject, AlertMessage>,
    /// The last change sent in each state, for each alert that is not over.
    told: BTreeMap<Subject, Vec<AlertMessage>>,
    /// Structures whose state has changed since the last checkpoint.
    changed: BTreeSet<Name>,
    pub(crate) sent: u64,
    pub(crate) failures: u64,
    pub(crate) given_up: u64,
}

/// Returns the key of a change, which is the same for duplicates.
fn key(alert: &AlertMessage) -> String {
    format!(
        "{}/{}/{}/{}",
        alert.structure,
        alert.parameter,
        alert.time_ns,
        alert.state.as_str()
    )
}

fn subject(alert: &AlertMessage) -> Subject {
    (alert.structure.clone(), alert.parameter.clone())
}

impl Outbox {
    pub(crate) fn new(wishes: Vec<Wish>) -> Self {
        let empty = |wish| Receiver {
            wish,
            waiting: VecDeque::new(),
            is_sending: false,
            standing: BTreeMap::new(),
        };
        Self {
            boxes: wishes.into_iter().map(empty).collect(),
            known: BTreeMap::new(),
            last: BTreeMap::new(),
            told: BTreeMap::new(),
            changed: BTreeSet::new(),
            sent: 0,
            failures: 0,
            given_up: 0,
        }
    }

    /// Processes an alert. A duplicate has no effect.
    pub(crate) fn take(&mut self, alert: &AlertMessage, now: Duration) {
        let Some(key) = self.learn(alert) else { return };
        let of = subject(alert);
        // After a gap, an older change can arrive after a newer one.
        let is_latest = self
            .last
            .get(&of)
            .is_none_or(|last| last.time_ns <= alert.time_ns);
        if is_latest {
            self.last.insert(of.clone(), alert.clone());
        }
        let is_news = self.is_news(&of, alert);
        for (receiver, place) in self.boxes.iter_mut().enumerate() {
            let is_wished = place.wish.states.contains(&alert.state);
            if is_latest {
                // An alert that is over is no longer repeated, even to receivers that do not
                // request its last state.
                let due = place.standing.remove(&of).map(|(_, due)| due);
                if place.wish.repeats(alert) {
                    let next = due
                        .filter(|_| !(is_wished && is_news))
                        .unwrap_or(now + REPEAT_EVERY);
                    place.standing.insert(of.clone(), (alert.clone(), next));
                }
            }
            if is_wished && is_news {
                let notice = Notice {
                    receiver,
                    key: key.clone(),
                    alert: alert.clone(),
                };
                place.waiting.push_back(Waiting::new(notice, now, now));
                if place.waiting.len() > MOST_WAITING {
                    // The notice that is being sent remains first.
                    let lost = place.waiting.remove(usize::from(place.is_sending));
                    self.changed
                        .extend(lost.map(|lost| lost.notice.alert.structure));
                    self.given_up += 1;
                }
            }
        }
    }

    /// Returns `true` if an alert is worth sending, and records it as sent.
    ///
    /// A state that was sent before is sent again once its loss is at least [`LOUDER`] times the
    /// largest loss sent.
    fn is_news(&mut self, of: &Subject, alert: &AlertMessage) -> bool {
        let told = self.told.entry(of.clone()).or_default();
        let is_of_alert = |before: &AlertMessage| {
            !alert.stands()
                || (before.since_ns, before.rule_loss) == (alert.since_ns, alert.rule_loss)
        };
        let before = told
            .iter()
            .position(|before| before.state == alert.state && is_of_alert(before));
        let loss = |alert: &AlertMessage| alert.loss.unwrap_or(0.0);
        // A loss sent in one state is known in all states.
        let most = told
            .iter()
            .filter(|before| before.stands() && is_of_alert(before))
            .map(loss)
            .fold(0.0, f64::max);
        let is_louder = alert.stands() && loss(alert) >= LOUDER * most;
        let is_news = before.is_none() || is_louder;
        // After an active alert its end is news, and the reverse.
        told.retain(|before| {
            if alert.stands() {
                before.stands()
            } else {
                before.state == alert.state
            }
        });
        if is_news {
            told.retain(|before| before.state != alert.state);
            told.push(alert.clone());
        }
        is_news
    }

    /// Records an alert without sending it. Returns its key, or `None` if it is a duplicate.
    pub(crate) fn learn(&mut self, alert: &AlertMessage) -> Option<String> {
        let key = key(alert);
        let known = self.known.entry(alert.structure.clone()).or_default();
        if known.contains(&key) {
            return None;
        }
        known.push_back(key.clone());
        if known.len() > KEYS_REMEMBERED {
            known.pop_front();
        }
        self.changed.insert(alert.structure.clone());
        Some(key)
    }

    /// Returns the structures that have changed since the last call.
    pub(crate) fn take_changed(&mut self) -> BTreeSet<Name> {
        std::mem::take(&mut self.changed)
    }

    /// Returns the checkpoint state of a structure.
    pub(crate) fn remembered(&self, structure: &Name, now: Duration) -> Remembered {
        let of_structure = |waiting: &&Waiting| {
            waiting.notice.alert.structure == *structure && !waiting.is_repeated
        };
        let undelivered = |place: &Receiver| -> Vec<Undelivered> {
            let own = place.waiting.iter().filter(of_structure);
            own.map(|waiting| Undelivered {
                receiver: place.wish.name.clone(),
                alert: waiting.notice.alert.clone(),
                age_s: now.saturating_sub(waiting.since).as_secs(),
            })
            .collect()
        };
        Remembered {
            keys: self
                .known
                .get(structure)
                .into_iter()
                .flatten()
                .cloned()
                .collect(),
            last: self
                .last
                .iter()
                .filter(|(of, _)| of.0 == *structure)
                .map(|(_, alert)| alert.clone())
                .collect(),
            waiting: self.boxes.iter().flat_map(undelivered).collect(),
            told: self
                .told
                .iter()
                .filter(|(of, _)| of.0 == *structure)
                .flat_map(|(_, told)| told.clone())
                .collect(),
        }
    }

    /// Restores the state of an earlier run that ended `away` ago.
    ///
    /// Notices for receivers that no longer exist, or no longer request this state, are dropped.
    /// Returns their number.
    pub(crate) fn recall(
        &mut self,
        structure: &Name,
        remembered: Remembered,
        now: Duration,
        away: Duration,
    ) -> usize {
        let Remembered {
            keys,
            last,
            waiting,
            told,
        } = remembered;
        for alert in told {
            self.told.entry(subject(&alert)).or_default().push(alert);
        }
        self.known.insert(structure.clone(), keys.into());
        for alert in last {
            for place in &mut self.boxes {
                if place.wish.repeats(&alert) {
                    place.standing.insert(subject(&alert), (alert.clone(), now));
                }
            }
            self.last.insert(subject(&alert), alert);
        }
        let mut lost = 0;
        for Undelivered {
            receiver: name,
            alert,
            age_s,
        } in waiting
        {
            let wants = |place: &Receiver| {
                place.wish.name == name && place.wish.states.contains(&alert.state)
            };
            let Some((receiver, place)) = self
                .boxes
                .iter_mut()
                .enumerate()
                .find(|(_, place)| wants(place))
            else {
                lost += 1;
                continue;
            };
            let since = now.saturating_sub(Duration::from_secs(age_s) + away);
            place.waiting.push_back(Waiting::new(
                Notice {
                    receiver,
                    key: key(&alert),
                    alert,
                },
                since,
                now,
            ));
        }
        self.given_up += lost as u64;
        lost
    }

    /// Returns the notices to send now. Each receiver gets only its oldest one, so that all arrive
    /// in order.
    pub(crate) fn due(&mut self, now: Duration) -> Vec<Notice> {
        let mut due = Vec::new();
        for (receiver, place) in self.boxes.iter_mut().enumerate() {
            if place.waiting.is_empty() {
                for (alert, next) in place.standing.values_mut().filter(|(_, next)| *next <= now) {
                    *next = now + REPEAT_EVERY;
                    let notice = Notice {
                        receiver,
                        key: key(alert),
                        alert: alert.clone(),
                    };
                    place.waiting.push_back(Waiting {
                        is_repeated: true,
                        ..Waiting::new(notice, now, now)
                    });
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

    /// Records the result of an attempt.
    pub(crate) fn done(&mut self, receiver: usize, is_sent: bool, now: Duration) {
        let Some(place) = self.boxes.get_mut(receiver) else {
            return;
        };
        place.is_sending = false;
        if is_sent {
            self.sent += 1;
        } else {
            self.failures += 1;
            let Some(first) = place.waiting.front_mut() else {
                return;
            };
            if now.saturating_sub(first.since) <= GIVE_UP_AFTER {
                first.due = now + first.retry_after;
                first.retry_after = (2 * first.retry_after).min(RETRY_AFTER.1);
                return;
            }
            self.given_up += 1;
        }
        let done = place.waiting.pop_front().filter(|done| !done.is_repeated);
        self.changed
            .extend(done.map(|done| done.notice.alert.structure));
    }

    /// Returns the number of notices in all queues.
    pub(crate) fn waiting(&self) -> usize {
        self.boxes.iter().map(|place| place.waiting.len()).sum()
    }
}

pub(crate) mod version_1;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::message::tests::alert;

    fn s(seconds: u64) -> Duration {
        Duration::from_secs(seconds)
    }

    fn outbox(repeats: bool) -> Outbox {
        let states = vec![AlertState::Raised, AlertState::Cleared];
        let wish = |name: &str, states, repeats| Wish {
            name: name.to_owned(),
            states,
            repeats,
        };
        Outbox::new(vec![
            wish("hook", states, repeats),
            wish("mail", vec![AlertState::Acknowledged], false),
        ])
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
            due.iter()
                .map(|notice| (notice.receiver, notice.alert.state))
                .collect::<Vec<_>>(),
            [(0, AlertState::Raised)]
        );
        assert!(
            due[0].key.ends_with("/storey-2/20000000000/raised"),
            "{}",
            due[0].key
        );
        assert_eq!(outbox.due(s(1)), [], "it is on its way");
        outbox.done(0, true, s(1));
        outbox.take(&alert(30, AlertState::Acknowledged), s(2));
        assert_eq!(
            outbox
                .due(s(2))
                .iter()
                .map(|notice| notice.receiver)
                .collect::<Vec<_>>(),
            [1]
        );
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
                assert_eq!(
                    notice.alert.state,
                    AlertState::Raised,
                    "the second waits for the first"
                );
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
        // A receiver that never recovers is given up after a day.
        for second in (5_000..200_000).step_by(100) {
            let due = outbox.due(s(second));
            due.iter()
                .for_each(|notice| outbox.done(notice.receiver, false, s(second)));
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
        assert_eq!(
            sent,
            [
                (0, raised),
                (60, raised),
                (120, raised),
                (150, AlertState::Cleared)
            ]
        );
    }

    /// Returns the notices sent for one alert with these states and losses.
    fn sent(states: &[(AlertState, f64)]) -> Vec<(AlertState, f64)> {
        let mut outbox = outbox(false);
        let mut sent = Vec::new();
        for (second, (state, loss)) in (20..).zip(states) {
            outbox.take(
                &AlertMessage {
                    loss: Some(*loss),
                    ..alert(second, *state)
                },
                s(0),
            );
            while let Some(notice) = outbox.due(s(0)).pop() {
                sent.push((notice.alert.state, notice.alert.loss.unwrap()));
                outbox.done(notice.receiver, true, s(0));
            }
        }
        sent
    }

    #[test]
    fn revision_is_told_once_the_loss_has_doubled() {
        use AlertState::{Acknowledged, Cleared, Raised};
        let losses = [0.12, 0.15, 0.2, 0.25, 0.4, 0.49, 0.51].map(|loss| (Raised, loss));
        assert_eq!(
            sent(&losses),
            [(Raised, 0.12), (Raised, 0.25), (Raised, 0.51)]
        );
        let seen = [
            (Raised, 0.12),
            (Acknowledged, 0.12),
            (Acknowledged, 0.2),
            (Cleared, 0.0),
            (Raised, 0.12),
        ];
        assert_eq!(sent(&seen), [seen[0], seen[1], seen[3], seen[4]]);
    }

    #[test]
    fn alert_that_is_confirmed_again_and_end_that_is_told_again_are_no_news() {
        use AlertState::{Cleared, Raised, Unconfirmed};
        let states =
            [Raised, Unconfirmed, Raised, Cleared, Cleared, Raised].map(|state| (state, 0.12));
        assert_eq!(sent(&states), [states[0], states[3], states[5]]);
    }

    #[test]
    fn end_of_each_alert_is_told() {
        use AlertState::{Cleared, Raised};
        let states = [Raised, Cleared, Raised, Cleared].map(|state| (state, 0.12));
        assert_eq!(sent(&states), states);
    }

    #[test]
    fn what_was_told_is_no_news_in_the_next_life() {
        let mut first = outbox(false);
        first.take(&alert(20, AlertState::Raised), s(0));
        let house = alert(20, AlertState::Raised).structure;
        let mut second = outbox(false);
        second.recall(&house, first.remembered(&house, s(0)), s(0), s(0));
        second.take(
            &AlertMessage {
                revision: 1,
                ..alert(21, AlertState::Raised)
            },
            s(0),
        );
        assert_eq!(second.waiting(), 1);
    }

    #[test]
    fn an_alert_that_is_not_confirmed_is_repeated_and_a_revision_does_not_put_it_off() {
        let mut outbox = outbox(true);
        for (second, state) in [
            (20, AlertState::Raised),
            (50, AlertState::Raised),
            (70, AlertState::Unconfirmed),
        ] {
            outbox.take(&alert(second, state), s(second as u64));
            outbox
                .due(s(second as u64))
                .iter()
                .for_each(|notice| outbox.done(notice.receiver, true, s(second as u64)));
        }
        assert_eq!(outbox.due(s(79)), []);
        assert_eq!(outbox.due(s(80))[0].alert.state, AlertState::Unconfirmed);
    }

    #[test]
    fn what_waits_is_bounded() {
        let mut outbox = outbox(false);
        for second in 0..5_000 {
            outbox.take(
                &AlertMessage {
                    since_ns: Some(second),
                    ..alert(second, AlertState::Raised)
                },
                s(0),
            );
        }
        assert_eq!((outbox.waiting(), outbox.given_up), (MOST_WAITING, 4_000));
    }

    #[test]
    fn another_life_goes_on_with_what_was_not_delivered_and_tells_nothing_twice() {
        let mut first = outbox(false);
        for (second, state) in [
            (20, AlertState::Raised),
            (30, AlertState::Cleared),
            (40, AlertState::Raised),
        ] {
            first.take(&alert(second, state), s(0));
        }
        let told = first.due(s(0)).remove(0);
        first.done(0, true, s(1));
        let house = alert(20, AlertState::Raised).structure;
        assert_eq!(
            first.take_changed().into_iter().collect::<Vec<_>>(),
            std::slice::from_ref(&house)
        );
        let remembered = first.remembered(&house, s(10));
        assert_eq!(remembered.waiting(), 2);

        let mut second = outbox(false);
        assert_eq!(second.recall(&house, remembered.clone(), s(100), s(5)), 0);
        second.take(&told.alert, s(100));
        let mut keys = Vec::new();
        while let Some(notice) = second.due(s(100)).pop() {
            keys.push(notice.key);
            second.done(0, true, s(100));
        }
        assert_eq!(
            keys,
            [
                "house/storey-2/30000000000/cleared",
                "house/storey-2/40000000000/raised"
            ]
        );
        assert_eq!(second.remembered(&house, s(100)).waiting(), 0);

        // Notices for one receiver do not go to a receiver with another name or other states.
        let wish = Wish {
            name: "another".to_owned(),
            states: vec![AlertState::Raised],
            repeats: false,
        };
        let mut other = Outbox::new(vec![wish]);
        assert_eq!(
            (
                other.recall(&house, remembered, s(0), s(0)),
                other.waiting(),
                other.given_up
            ),
            (2, 0, 2)
        );
    }

    #[test]
    fn an_alert_that_stood_is_repeated_in_the_next_life_and_repetitions_are_not_remembered() {
        let mut first = outbox(true);
        first.take(&alert(20, AlertState::Raised), s(0));
        first.due(s(0));
        first.done(0, true, s(0));
        first.take_changed();
        assert_eq!(first.due(s(60)).len(), 1);
        let house = alert(20, AlertState::Raised).structure;
        let remembered = first.remembered(&house, s(60));
        assert_eq!(remembered.waiting(), 0);
        first.done(0, true, s(60));
        assert!(first.take_changed().is_empty());

        let mut second = outbox(true);
        second.recall(&house, remembered, s(0), s(0));
        assert_eq!(second.due(s(0)).len(), 1, "it stands");
        second.done(0, true, s(0));
        second.take(&alert(50, AlertState::Cleared), s(1));
        assert_eq!(second.due(s(1))[0].alert.state, AlertState::Cleared);
        second.done(0, true, s(1));
        // A missed change that arrives late does not make the alert active again.
        second.take(&alert(30, AlertState::Raised), s(2));
        second.due(s(2));
        second.done(0, true, s(2));
        assert_eq!(second.due(s(200)), []);
    }

    #[test]
    fn time_away_counts_until_a_notice_is_given_up() {
        let mut first = outbox(false);
        first.take(&alert(20, AlertState::Raised), s(0));
        let house = alert(20, AlertState::Raised).structure;
        let (start, day) = (GIVE_UP_AFTER, GIVE_UP_AFTER);
        let mut second = outbox(false);
        second.recall(
            &house,
            first.remembered(&house, s(3_600)),
            start,
            day - s(3_600),
        );
        assert_eq!(second.due(start).len(), 1);
        second.done(0, false, start);
        assert_eq!(second.waiting(), 1, "exactly a day");
        assert_eq!(second.due(start + s(2)).len(), 1);
        second.done(0, false, start + s(2));
        assert_eq!((second.waiting(), second.given_up), (0, 1));
    }

    #[test]
    fn what_is_remembered_is_bounded() {
        let mut outbox = outbox(false);
        for second in 0..5_000 {
            outbox.take(
                &AlertMessage {
                    since_ns: Some(second),
                    ..alert(second, AlertState::Raised)
                },
                s(0),
            );
        }
        let remembered = outbox.remembered(&alert(0, AlertState::Raised).structure, s(0));
        assert_eq!(
            (
                remembered.keys.len(),
                remembered.waiting(),
                remembered.last.len()
            ),
            (KEYS_REMEMBERED, MOST_WAITING, 1)
        );
    }
}
