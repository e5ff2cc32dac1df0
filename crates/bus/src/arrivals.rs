//! Tells what arrives live from what is read again.
//!
//! After a restart identify reads frames from the recording, as fast as it can. What follows from them is shown with its times,
//! but is no sign that anything is measured now. How far the recording goes is what ingest first says of its progress.

use std::time::Duration;

/// What was heard of one structure, and what ingest has said of its frames.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Arrivals {
    recorded: Option<Recorded>,
    /// Ingest has gone since: its next word is a first one again.
    has_left: bool,
    /// Measurement time (ns) of the last value.
    last_ns: Option<i64>,
    /// When the last live value came.
    heard: Option<Duration>,
    /// The same when ingest was seen to go: what came since may have been read again.
    heard_before: Option<Duration>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
struct Recorded {
    epoch: u64,
    /// Measurement time (ns) of the last frame of the epoch that was there when ingest was first heard of; none where the epoch
    /// has begun since.
    until_ns: Option<i64>,
}

impl Arrivals {
    /// Takes a value measured at `time_ns` that has come `now`, on the clock of whoever listens.
    pub fn value(&mut self, time_ns: i64, now: Duration) {
        if self.is_live(time_ns) {
            self.heard = Some(now);
        }
        self.last_ns = Some(time_ns);
    }

    /// Takes how far ingest has come: its epoch, and the time (ns) of its last frame. Tells whether that was the first word of it;
    /// then of what was heard before only what it does not know to be recorded counts.
    pub fn ingested(&mut self, epoch: u64, time_ns: i64) -> bool {
        let is_first = self.recorded.is_none() || self.has_left;
        if is_first
            || self
                .recorded
                .as_ref()
                .is_none_or(|recorded| epoch > recorded.epoch)
        {
            self.recorded = Some(Recorded {
                epoch,
                until_ns: is_first.then_some(time_ns),
            });
        }
        if is_first && self.is_from_the_recording() {
            self.heard = self.heard_before;
        }
        self.has_left = false;
        is_first
    }

    /// Ingest is not there any more. When it comes back, what it has recorded is read again.
    pub fn ingest_left(&mut self) {
        self.has_left = true;
        self.heard_before = self.heard;
    }

    /// Whether something measured at this time (ns) was not yet recorded when ingest was first heard of. Without a word of ingest
    /// everything is taken for live.
    #[must_use]
    pub fn is_live(&self, time_ns: i64) -> bool {
        let until_ns = self
            .recorded
            .as_ref()
            .and_then(|recorded| recorded.until_ns);
        until_ns.is_none_or(|until_ns| time_ns > until_ns)
    }

    /// Whether the last value was read again from the recording.
    #[must_use]
    pub fn is_from_the_recording(&self) -> bool {
        self.last_ns.is_some_and(|last_ns| !self.is_live(last_ns))
    }

    /// When the last live value came, on the clock of whoever listens.
    #[must_use]
    pub fn heard(&self) -> Option<Duration> {
        self.heard
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const AT: fn(u64) -> Duration = Duration::from_secs;

    #[test]
    fn what_was_recorded_before_is_not_live_and_what_comes_after_is() {
        let mut arrivals = Arrivals::default();
        assert!(arrivals.is_live(10), "nothing is known of a recording");
        assert!(arrivals.ingested(7, 100));
        assert!(!arrivals.is_live(100) && arrivals.is_live(101));
        assert!(
            !arrivals.ingested(7, 200),
            "what was recorded since is live"
        );
        assert!(arrivals.is_live(101));
    }

    #[test]
    fn an_epoch_that_begins_later_is_live_at_any_time() {
        let mut arrivals = Arrivals::default();
        arrivals.ingested(7, 100);
        arrivals.ingested(6, 300);
        assert!(!arrivals.is_live(50), "an epoch that is over says nothing");
        arrivals.ingested(8, 20);
        assert!(arrivals.is_live(-5));
    }

    #[test]
    fn what_is_read_again_was_not_heard() {
        let mut arrivals = Arrivals::default();
        arrivals.value(50, AT(1));
        assert_eq!(
            arrivals.heard(),
            Some(AT(1)),
            "nothing is known of a recording"
        );
        arrivals.ingested(7, 100);
        assert_eq!(
            (arrivals.heard(), arrivals.is_from_the_recording()),
            (None, true)
        );
        arrivals.value(100, AT(2));
        assert_eq!(
            (arrivals.heard(), arrivals.is_from_the_recording()),
            (None, true)
        );
        arrivals.value(101, AT(3));
        assert_eq!(
            (arrivals.heard(), arrivals.is_from_the_recording()),
            (Some(AT(3)), false)
        );
    }

    #[test]
    fn what_was_recorded_when_ingest_comes_back_is_not_live() {
        let mut arrivals = Arrivals::default();
        arrivals.ingested(7, 100);
        arrivals.value(150, AT(1));
        arrivals.ingest_left();
        arrivals.value(120, AT(5));
        assert!(arrivals.ingested(7, 200));
        assert_eq!(
            arrivals.heard(),
            Some(AT(1)),
            "what came before it spoke was read again"
        );
        assert!(!arrivals.is_live(150) && arrivals.is_live(201));
        assert!(!arrivals.ingested(7, 210));
        arrivals.value(201, AT(6));
        assert_eq!(arrivals.heard(), Some(AT(6)));
    }
}
