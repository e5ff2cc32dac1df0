//! The queue of one receiver: what is sent, repeated, and held back.

use super::{MOST_WAITING, Moment, RETRY_AFTER, Wish};
use crate::content::{Content, Report, Subject, Summary};
use crate::muting::Muting;
use spandrel_bus::Name;
use spandrel_checkpoint::Failures;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Duration;

/// A notice that is due or being retried.
#[derive(Debug)]
pub(super) struct Waiting {
    pub(super) content: Content,
    pub(super) since: Duration,
    pub(super) due: Duration,
    pub(super) retry_after: Duration,
    /// Whether this is a repetition of an active alert, which checkpoints omit.
    pub(super) is_repeated: bool,
}

impl Waiting {
    pub(super) fn new(content: Content, since: Duration, now: Duration) -> Self {
        Self {
            content,
            since,
            due: now,
            retry_after: RETRY_AFTER.0,
            is_repeated: false,
        }
    }
}

/// A notice that is held back during quiet hours or maintenance, or until its escalation.
#[derive(Debug)]
pub(super) struct Held {
    pub(super) content: Content,
    pub(super) since: Duration,
    /// Time of the escalation, for a receiver with a delay.
    pub(super) due: Option<Duration>,
    /// The maintenance that has muted the notice.
    pub(super) muted_by: Option<String>,
    /// How the state has ended meanwhile.
    pub(super) over: Option<String>,
}

/// The queue of one receiver, in order.
#[derive(Debug)]
pub(super) struct Receiver {
    pub(super) wish: Wish,
    pub(super) waiting: VecDeque<Waiting>,
    pub(super) is_sending: bool,
    /// Active alerts, with the time of their next repetition.
    pub(super) standing: BTreeMap<Subject, (Content, Duration)>,
    pub(super) held: Vec<Held>,
    /// Subjects whose open state was sent. Only they have an end for a receiver with a delay.
    pub(super) escalated: BTreeSet<Subject>,
    /// Failed attempts in a row.
    pub(super) failures: Failures,
    /// Notices that were given up and are not reported yet.
    pub(super) lost: u64,
}

impl Receiver {
    /// Queues a notice, or holds it back.
    pub(super) fn admit(&mut self, content: &Content, moment: Moment) {
        let of = content.subject();
        let is_delayed = !self.wish.after.is_zero();
        if is_delayed && !content.is_open() {
            if !self.escalated.contains(&of) {
                return; // the receiver knows nothing of what has ended
            }
            let stands = matches!(&content.report, Report::Alert(alert) if alert.stands());
            if !stands {
                self.escalated.remove(&of);
            }
        }
        // A state that was sent before needs no second delay.
        let waits = is_delayed && content.is_open() && !self.escalated.contains(&of);
        let delayed = waits.then(|| moment.now + self.wish.after);
        // The newest notice of a subject replaces the former one, and keeps its delay.
        let is_former = |held: &Held| held.over.is_none() && held.content.subject() == of;
        let former = self.held.iter().position(is_former);
        let former = former.map(|index| self.held.remove(index));
        let span = former
            .filter(|former| former.content.is_open() && content.is_open())
            .map(|former| (former.since, former.due));
        let (since, due) = span.unwrap_or((moment.now, delayed));
        self.held.push(Held {
            content: content.clone(),
            since,
            due,
            muted_by: None,
            over: None,
        });
    }

    /// Marks the notices that are held back for a state that has ended. Returns `true` if this
    /// makes the notice of the end superfluous.
    pub(super) fn end_held(&mut self, end: &Content) -> bool {
        let of = end.subject();
        let mut ends = false;
        for held in &mut self.held {
            if held.content.subject() == of && held.content.is_open() && held.over.is_none() {
                held.over = Some(end.end());
                ends = true;
            }
        }
        ends
    }

    /// Queues the notices that nothing holds back any longer.
    ///
    /// A notice is sent if its state lasts. The others, and all notices that maintenance has muted,
    /// become lines of a summary, which is sent first. A state that ended before its escalation is
    /// dropped.
    pub(super) fn release(
        &mut self,
        muting: &Muting,
        moment: Moment,
        changed: &mut BTreeSet<Name>,
    ) {
        let wish = &self.wish;
        let is_free = |held: &mut Held| {
            let content = &held.content;
            if let Some(period) = muting.of(&content.subject()) {
                held.muted_by = Some(format!("maintenance by {} ({})", period.who, period.reason));
                return false;
            }
            let waits = held.due.is_some_and(|due| due > moment.now) && held.over.is_none();
            !waits && !wish.is_quiet(content, moment.wall_ns)
        };
        let free: Vec<Held> = self.held.extract_if(.., is_free).collect();
        if free.is_empty() {
            return;
        }
        changed.extend(free.iter().map(|held| held.content.structure().clone()));
        let mut summaries: BTreeMap<(Name, String), Vec<String>> = BTreeMap::new();
        let mut lasting: Vec<Held> = Vec::new();
        for held in free {
            let of = held.content.subject();
            if held.over.is_some() && held.due.is_some() && held.muted_by.is_none() {
                continue;
            }
            let cause = held.muted_by.clone();
            if held.over.is_some() || cause.is_some() {
                let cause = cause.unwrap_or_else(|| "quiet hours".to_owned());
                let lines = summaries.entry((of.0.clone(), cause)).or_default();
                let end = held.over.as_ref().map(|end| format!("; {end}"));
                lines.push(held.content.line() + &end.unwrap_or_default());
            }
            if held.over.is_none() {
                lasting.push(held);
            }
        }
        let is_summarised = !self.wish.repeats; // Alertmanager summarises by itself
        let summaries = summaries.into_iter().filter(|_| is_summarised);
        for (index, ((structure, cause), lines)) in (0..).zip(summaries) {
            let summary = Report::Summary(Summary {
                structure,
                time_ns: moment.wall_ns + index, // each has its own key
                cause,
                lines,
            });
            let of_first = lasting
                .first()
                .map(|held| held.content.circumstances.clone());
            let mut content = Content::new(summary, of_first.unwrap_or_default());
            content.circumstances.advice = "Read the lines below. A separate notice follows for \
                                            each state that lasts."
                .to_owned();
            self.waiting
                .push_back(Waiting::new(content, moment.now, moment.now));
        }
        for held in lasting {
            let mut content = held.content;
            if held.due.is_some() {
                let unanswered = moment.now.saturating_sub(held.since);
                content.unanswered_s = Some(unanswered.as_secs());
            }
            if content.is_open() && !self.wish.after.is_zero() {
                self.escalated.insert(content.subject());
            }
            self.waiting
                .push_back(Waiting::new(content, moment.now, moment.now));
        }
    }

    /// Drops the oldest notices beyond the limit. Returns their number.
    pub(super) fn limit(&mut self, changed: &mut BTreeSet<Name>) -> u64 {
        let mut dropped = 0;
        while self.waiting.len() > MOST_WAITING {
            // The notice that is being sent remains first.
            let lost = self.waiting.remove(usize::from(self.is_sending));
            changed.extend(lost.map(|lost| lost.content.structure().clone()));
            dropped += 1;
        }
        while self.held.len() > MOST_WAITING {
            changed.insert(self.held.remove(0).content.structure().clone());
            dropped += 1;
        }
        self.lost += dropped;
        dropped
    }
}
