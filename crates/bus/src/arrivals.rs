//! Distinguishes live values from values of the recording.
//!
//! After a restart, identify reads frames from the recording at full speed. The results have the
//! correct times, but they do not indicate that anything is measured now. The first progress
//! message of ingest states the end of the recording.

use std::time::Duration;

/// Arrival times of the values of one structure, and the progress of ingest.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Arrivals {
    recorded: Option<Recorded>,
    /// Whether ingest has gone offline, so that its next progress message is again a first one.
    has_left: bool,
    /// Measurement time of the last value, ns since the Unix epoch, UTC.
    last_ns: Option<i64>,
    /// Arrival time of the last live value.
    heard: Option<Duration>,
    /// Value of `heard` when ingest went offline. Later values may come from the recording.
    heard_before: Option<Duration>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
struct Recorded {
    epoch: u64,
    /// Measurement time of the last frame of the epoch when ingest was first observed, ns since the
    /// Unix epoch, UTC. `None` if the epoch began later.
    until_ns: Option<i64>,
}

impl Arrivals {
    /// Records a value measured at `time_ns` that has arrived at `now`, on the clock of the caller.
    pub fn value(&mut self, time_ns: i64, now: Duration) {
        if self.is_live(time_ns) {
            self.heard = Some(now);
        }
        self.last_ns = Some(time_ns);
    }

    /// Records the progress of ingest: its epoch, and the time of its last frame (ns since the Unix
    /// epoch, UTC).
    ///
    /// Returns `true` if this is the first progress message since the start or since ingest went
    /// offline. In this case, earlier arrivals of recorded values no longer count as live.
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

    /// Records that ingest has gone offline. When it returns, identify may read the recording
    /// again.
    pub fn ingest_left(&mut self) {
        self.has_left = true;
        self.heard_before = self.heard;
    }

    /// Returns `true` if a value measured at this time (ns since the Unix epoch, UTC) was not yet
    /// recorded when ingest was first observed.
    ///
    /// All values are live until the first progress message of ingest.
    #[must_use]
    pub fn is_live(&self, time_ns: i64) -> bool {
        let until_ns = self
            .recorded
            .as_ref()
            .and_then(|recorded| recorded.until_ns);
        until_ns.is_none_or(|until_ns| time_ns > until_ns)
    }

    /// Returns `true` if the last value comes from the recording.
    #[must_use]
    pub fn is_from_the_recording(&self) -> bool {
        self.last_ns.is_some_and(|last_ns| !self.is_live(last_ns))
    }

    /// Returns the arrival time of the last live value, on the clock of the caller. Returns `None`
    /// before the first live value.
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
    fn values_recorded_before_the_start_are_not_live_and_later_values_are() {
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
    fn values_of_a_later_epoch_are_live_at_any_time() {
        let mut arrivals = Arrivals::default();
        arrivals.ingested(7, 100);
        arrivals.ingested(6, 300);
        assert!(!arrivals.is_live(50), "an epoch that is over says nothing");
        arrivals.ingested(8, 20);
        assert!(arrivals.is_live(-5));
    }

    #[test]
    fn reread_values_do_not_count_as_live_arrivals() {
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
    fn values_recorded_before_ingest_returns_are_not_live() {
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
