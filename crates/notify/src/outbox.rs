//! Decides which notices to send, to which receivers, and when. It has no clock: the time is an
//! argument.

use crate::content::{Concern, Content, Report, Subject};
use crate::muting::{Change, Muting};
use crate::origin::Origin;
use crate::quiet::Quiet;
use crate::state::NoticeState;
use serde::{Deserialize, Serialize};
use spandrel_bus::{AlertMessage, AlertState, Maintenance, Name};
use spandrel_checkpoint::Failures;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Duration;

use queue::{Held, Receiver, Waiting};

/// Maximum number of notices in the queue of one receiver, and maximum number that it holds back.
/// Beyond it, the oldest is dropped and counted.
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

/// The present moment on both clocks.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Moment {
    /// Monotonic time, which schedules retries and escalations.
    pub(crate) now: Duration,
    /// Wall-clock time, ns since the Unix epoch, UTC, which decides on quiet hours and maintenance.
    pub(crate) wall_ns: i64,
}

/// The notices that one receiver requests.
#[derive(Clone, Debug, Default)]
pub(crate) struct Wish {
    /// Name of the receiver, the same after each restart and without secrets.
    pub(crate) name: String,
    pub(crate) states: Vec<NoticeState>,
    /// Whether active alerts are repeated.
    pub(crate) repeats: bool,
    /// Whether simulated and replayed samples cause notices.
    pub(crate) simulations: bool,
    /// Time without reaction after which the receiver gets a notice. Zero for immediate notices.
    pub(crate) after: Duration,
    pub(crate) quiet: Vec<Quiet>,
}

impl Wish {
    /// Returns `true` if the receiver requests a notice of this state. A summary has none.
    fn wants(&self, state: Option<NoticeState>) -> bool {
        state.is_none_or(|state| self.states.contains(&state))
    }

    /// Returns `true` if the receiver requests repetitions of this notice.
    ///
    /// An unconfirmed alert is also repeated if the receiver requests raised alerts.
    fn repeats(&self, content: &Content) -> bool {
        let stands = match &content.report {
            Report::Alert(alert) => alert.stands(),
            Report::Monitoring(_) | Report::Judgement(_) | Report::Clock(_) => content.is_open(),
            Report::Summary(_) | Report::Earthquake(_) => false,
        };
        let told_as = match content.state() {
            Some(NoticeState::Unconfirmed) => Some(NoticeState::Raised),
            state => state,
        };
        self.repeats && stands && (self.wants(content.state()) || self.wants(told_as))
    }

    fn is_quiet(&self, content: &Content, wall_ns: i64) -> bool {
        let mut quiet = self.quiet.iter();
        quiet.any(|quiet| quiet.holds(content.state(), wall_ns))
    }
}

/// One notice for one receiver.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Notice {
    pub(crate) receiver: usize,
    pub(crate) content: Content,
    /// Whether the receiver has got this notice before, and requires repetitions.
    pub(crate) is_repeated: bool,
}

/// The checkpoint state of the notices of one structure.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Remembered {
    /// Keys of changes that have been processed, oldest first.
    keys: Vec<String>,
    /// The last change of each subject.
    last: Vec<Content>,
    /// Undelivered notices in the order of delivery.
    waiting: Vec<Undelivered>,
    /// The changes that were sent for each alert that is not over.
    told: Vec<AlertMessage>,
    /// Subjects whose open state was sent to a receiver with a delay, with its name.
    /// A lasting change is not stored, because notify receives it again.
    escalated: Vec<(String, (Name, Option<Name>))>,
    /// Present maintenance.
    maintenance: Vec<Maintenance>,
}

/// A notice that one receiver has not received yet.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Undelivered {
    receiver: String,
    content: Content,
    /// Age when the checkpoint was written, in s.
    age_s: u64,
    held: Option<HeldBack>,
}

/// The state of a notice that is held back.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct HeldBack {
    /// Time until its escalation, in s, for a receiver with a delay.
    due_in_s: Option<u64>,
    muted_by: Option<String>,
    over: Option<String>,
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
    muting: Muting,
    known: BTreeMap<Name, VecDeque<String>>,
    last: BTreeMap<Subject, Content>,
    /// The last change sent in each state, for each alert that is not over.
    told: BTreeMap<Subject, Vec<AlertMessage>>,
    /// States of the monitoring since each structure was last watched. Not in the checkpoint.
    sights: BTreeMap<Subject, BTreeSet<NoticeState>>,
    /// Structures whose state has changed since the last checkpoint.
    changed: BTreeSet<Name>,
    pub(crate) sent: u64,
    pub(crate) failures: u64,
    pub(crate) given_up: u64,
    /// Notices about simulated or replayed samples that a receiver does not request.
    pub(crate) simulated: u64,
    /// Notices that maintenance has muted.
    pub(crate) muted: u64,
}

impl Outbox {
    pub(crate) fn new(wishes: Vec<Wish>) -> Self {
        let empty = |wish| Receiver {
            wish,
            waiting: VecDeque::new(),
            is_sending: false,
            standing: BTreeMap::new(),
            held: Vec::new(),
            escalated: BTreeSet::new(),
            failures: Failures::default(),
            lost: 0,
        };
        Self {
            boxes: wishes.into_iter().map(empty).collect(),
            muting: Muting::default(),
            known: BTreeMap::new(),
            last: BTreeMap::new(),
            told: BTreeMap::new(),
            sights: BTreeMap::new(),
            changed: BTreeSet::new(),
            sent: 0,
            failures: 0,
            given_up: 0,
            simulated: 0,
            muted: 0,
        }
    }

    /// Processes a change. A duplicate has no effect.
    pub(crate) fn take(&mut self, content: &Content, moment: Moment) {
        if !self.learn(content.structure(), &content.key) {
            return;
        }
        let of = content.subject();
        // After a gap, an older change can arrive after a newer one.
        let is_latest = self
            .last
            .get(&of)
            .is_none_or(|last| last.time_ns() <= content.time_ns());
        if is_latest {
            self.last.insert(of.clone(), content.clone());
        }
        let is_news = match &content.report {
            Report::Alert(alert) => self.is_news(&of, alert),
            Report::Monitoring(_)
            | Report::Summary(_)
            | Report::Judgement(_)
            | Report::Earthquake(_)
            | Report::Clock(_) => true,
        };
        let ended = self.ended_sights(&of, content);
        for place in &mut self.boxes {
            // Whoever does not know that a structure was not watched needs no notice of the end.
            let knows =
                ended.is_empty() || ended.iter().any(|state| place.wish.wants(Some(*state)));
            let is_wished = place.wish.wants(content.state()) && knows;
            let is_real = content.circumstances.origin == Origin::Measured;
            if !is_real && !place.wish.simulations {
                place.standing.remove(&of);
                self.simulated += u64::from(is_wished && is_news);
                continue;
            }
            if is_latest {
                // An alert that is over is no longer repeated, even to receivers that do not
                // request its last state.
                let due = place.standing.remove(&of).map(|(_, due)| due);
                if place.wish.repeats(content) {
                    let next = due
                        .filter(|_| !(is_wished && is_news))
                        .unwrap_or(moment.now + REPEAT_EVERY);
                    place.standing.insert(of.clone(), (content.clone(), next));
                }
            }
            // A structure that is degraded is no longer blind.
            let is_end = !content.is_open()
                || (content.state() == Some(NoticeState::Degraded) && !is_wished);
            let ends_held = is_latest && is_end && place.end_held(content);
            if is_wished && is_news && !ends_held {
                place.admit(content, moment);
                let period = self.muting.of(&of);
                self.muted += u64::from(period.is_some());
                place.release(&self.muting, moment, &mut self.changed);
                self.given_up += place.limit(&mut self.changed);
            }
        }
    }

    /// Records the state of a monitoring. Returns the states that have ended if the structure is
    /// watched again.
    fn ended_sights(&mut self, of: &Subject, content: &Content) -> BTreeSet<NoticeState> {
        let (Report::Monitoring(_), Some(state)) = (&content.report, content.state()) else {
            return BTreeSet::new();
        };
        if content.is_open() {
            self.sights.entry(of.clone()).or_default().insert(state);
            return BTreeSet::new();
        }
        self.sights.remove(of).unwrap_or_default()
    }

    /// Returns `true` if an alert is worth sending, and records it as sent.
    ///
    /// A state that was sent before is sent again once its loss is at least [`LOUDER`] times the
    /// largest loss sent. So is an acknowledged alert that is raised again.
    fn is_news(&mut self, of: &Subject, alert: &AlertMessage) -> bool {
        let told = self.told.entry(of.clone()).or_default();
        if alert.state == AlertState::Acknowledged {
            told.retain(|before| before.state != AlertState::Raised);
        }
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

    /// Ends the lasting change of a quantity, which is no longer reported or which somebody has
    /// seen. It needs no notice.
    pub(crate) fn forget_change(&mut self, structure: &Name, quantity: &Name) {
        let of = (structure.clone(), Some(quantity.clone()), Concern::Lasting);
        if self.last.remove(&of).is_some() {
            self.changed.insert(structure.clone());
        }
        for place in &mut self.boxes {
            place.standing.remove(&of);
            place.escalated.remove(&of);
            place.held.retain(|held| held.content.subject() != of);
        }
    }

    /// Records a change without sending it. Returns `false` if it is a duplicate.
    pub(crate) fn learn(&mut self, structure: &Name, key: &str) -> bool {
        let known = self.known.entry(structure.clone()).or_default();
        if known.iter().any(|known| known == key) {
            return false;
        }
        known.push_back(key.to_owned());
        if known.len() > KEYS_REMEMBERED {
            known.pop_front();
        }
        self.changed.insert(structure.clone());
        true
    }

    /// Returns the nodes whose last notice says that their clock is wrong.
    pub(crate) fn wrong_clocks(&self, structure: &Name) -> Vec<Name> {
        let wrong = self
            .last
            .values()
            .filter_map(|content| match &content.report {
                Report::Clock(change) if change.is_wrong => Some(change),
                _ => None,
            });
        let own = wrong.filter(|change| change.structure == *structure);
        own.map(|change| change.node.clone()).collect()
    }

    /// Begins or ends maintenance. Returns the change.
    pub(crate) fn maintain(&mut self, message: Maintenance, wall_ns: i64) -> Option<Change> {
        self.changed.insert(message.structure.clone());
        self.muting.take(message, wall_ns)
    }

    /// Returns the present maintenance of a structure.
    pub(crate) fn maintenance(&self, structure: &Name) -> Vec<Maintenance> {
        self.muting.of_structure(structure)
    }

    /// Sends what no longer has to be held back. Returns the maintenance whose time is over.
    pub(crate) fn release(&mut self, moment: Moment) -> Vec<Change> {
        let expired = self.muting.expire(moment.wall_ns);
        for change in &expired {
            if let Change::Expired(period) = change {
                self.changed.insert(period.structure.clone());
            }
        }
        for place in &mut self.boxes {
            place.release(&self.muting, moment, &mut self.changed);
            self.given_up += place.limit(&mut self.changed);
        }
        expired
    }

    /// Marks a structure for the next checkpoint.
    pub(crate) fn mark_changed(&mut self, structure: &Name) {
        self.changed.insert(structure.clone());
    }

    /// Returns the structures that have changed since the last call.
    pub(crate) fn take_changed(&mut self) -> BTreeSet<Name> {
        std::mem::take(&mut self.changed)
    }

    /// Returns the checkpoint state of a structure.
    pub(crate) fn remembered(&self, structure: &Name, now: Duration) -> Remembered {
        let is_own = |content: &Content| content.structure() == structure;
        let age_s = |since: Duration| now.saturating_sub(since).as_secs();
        let undelivered = |place: &Receiver| -> Vec<Undelivered> {
            let own = place.waiting.iter();
            let own = own.filter(|waiting| is_own(&waiting.content) && !waiting.is_repeated);
            let waiting = own.map(|waiting| Undelivered {
                receiver: place.wish.name.clone(),
                content: waiting.content.clone(),
                age_s: age_s(waiting.since),
                held: None,
            });
            let held = place.held.iter().filter(|held| is_own(&held.content));
            let held = held.map(|held| Undelivered {
                receiver: place.wish.name.clone(),
                content: held.content.clone(),
                age_s: age_s(held.since),
                held: Some(HeldBack {
                    due_in_s: held.due.map(|due| due.saturating_sub(now).as_secs()),
                    muted_by: held.muted_by.clone(),
                    over: held.over.clone(),
                }),
            });
            waiting.chain(held).collect()
        };
        let escalated = |place: &Receiver| -> Vec<(String, (Name, Option<Name>))> {
            let is_own = |of: &&Subject| of.0 == *structure && of.2 == Concern::Present;
            let own = place.escalated.iter().filter(is_own);
            own.map(|of| (place.wish.name.clone(), (of.0.clone(), of.1.clone())))
                .collect()
        };
        let known = self.known.get(structure).into_iter();
        Remembered {
            keys: known.flatten().cloned().collect(),
            last: self
                .last
                .values()
                .filter(|content| is_own(content))
                .cloned()
                .collect(),
            waiting: self.boxes.iter().flat_map(undelivered).collect(),
            told: self
                .told
                .iter()
                .filter(|(of, _)| of.0 == *structure)
                .flat_map(|(_, told)| told.clone())
                .collect(),
            escalated: self.boxes.iter().flat_map(escalated).collect(),
            maintenance: self.muting.of_structure(structure),
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
            escalated,
            maintenance,
        } = remembered;
        self.muting.recall(maintenance);
        for alert in told {
            let part = Some(alert.parameter.clone());
            let of = (alert.structure.clone(), part, Concern::Present);
            self.told.entry(of).or_default().push(alert);
        }
        self.known.insert(structure.clone(), keys.into());
        for content in last {
            let is_real = content.circumstances.origin == Origin::Measured;
            for place in &mut self.boxes {
                if place.wish.repeats(&content) && (is_real || place.wish.simulations) {
                    place
                        .standing
                        .insert(content.subject(), (content.clone(), now));
                }
            }
            self.last.insert(content.subject(), content);
        }
        for (name, (structure, part)) in escalated {
            let mut boxes = self.boxes.iter_mut();
            if let Some(place) = boxes.find(|place| place.wish.name == name) {
                place.escalated.insert((structure, part, Concern::Present));
            }
        }
        let mut lost = 0;
        for undelivered in waiting {
            let Undelivered {
                receiver: name,
                content,
                age_s,
                held,
            } = undelivered;
            let wants = |place: &&mut Receiver| {
                place.wish.name == name && place.wish.wants(content.state())
            };
            let Some(place) = self.boxes.iter_mut().find(wants) else {
                lost += 1;
                continue;
            };
            let since = now.saturating_sub(Duration::from_secs(age_s) + away);
            match held {
                None => place.waiting.push_back(Waiting::new(content, since, now)),
                Some(HeldBack {
                    due_in_s,
                    muted_by,
                    over,
                }) => place.held.push(Held {
                    content,
                    since,
                    due: due_in_s.map(|s| (now + Duration::from_secs(s)).saturating_sub(away)),
                    muted_by,
                    over,
                }),
            }
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
                for (of, (content, next)) in &mut place.standing {
                    if *next > now || self.muting.of(of).is_some() {
                        continue;
                    }
                    *next = now + REPEAT_EVERY;
                    place.waiting.push_back(Waiting {
                        is_repeated: true,
                        ..Waiting::new(content.clone(), now, now)
                    });
                }
            }
            if place.is_sending {
                continue;
            }
            if let Some(first) = place.waiting.front().filter(|waiting| waiting.due <= now) {
                place.is_sending = true;
                due.push(Notice {
                    receiver,
                    content: first.content.clone(),
                    is_repeated: first.is_repeated,
                });
            }
        }
        due
    }

    /// Records the result of an attempt. Returns `true` if a failure must be logged: the first
    /// consecutive failure of the receiver, and then each one that doubles their number.
    pub(crate) fn done(&mut self, receiver: usize, is_sent: bool, now: Duration) -> bool {
        let Some(place) = self.boxes.get_mut(receiver) else {
            return false;
        };
        place.is_sending = false;
        let mut is_logged = false;
        if is_sent {
            self.sent += 1;
            let _ = place.failures.succeeded(); // each success is logged
        } else {
            self.failures += 1;
            is_logged = place.failures.failed();
            let Some(first) = place.waiting.front_mut() else {
                return is_logged;
            };
            if now.saturating_sub(first.since) <= GIVE_UP_AFTER {
                first.due = now + first.retry_after;
                first.retry_after = (2 * first.retry_after).min(RETRY_AFTER.1);
                return is_logged;
            }
            self.given_up += 1;
            place.lost += 1;
        }
        let done = place.waiting.pop_front().filter(|done| !done.is_repeated);
        self.changed
            .extend(done.map(|done| done.content.structure().clone()));
        is_logged
    }

    /// Returns the number of notices that each receiver has lost since the last call, without the
    /// receivers that have lost none.
    pub(crate) fn take_lost(&mut self) -> Vec<(usize, u64)> {
        let lost = { self.boxes.iter_mut() }.map(|place| std::mem::take(&mut place.lost));
        lost.enumerate().filter(|(_, lost)| *lost > 0).collect()
    }

    /// Returns the number of notices in all queues, with those that are held back.
    pub(crate) fn waiting(&self) -> usize {
        let count = |place: &Receiver| place.waiting.len() + place.held.len();
        self.boxes.iter().map(count).sum()
    }
}

mod queue;
pub(crate) mod version_1;
pub(crate) mod version_2;

#[cfg(test)]
mod tests;
