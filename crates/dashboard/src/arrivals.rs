//! Tells what arrives live from what is read again.
//!
//! After a restart identify reads frames from the recording, as fast as it can. What follows from them is shown with its times,
//! but is no sign that anything is measured now. How far the recording goes is what ingest first says of its progress.

/// What ingest has said of its frames.
#[derive(Debug, Default)]
pub(crate) struct Arrivals {
    recorded: Option<Recorded>,
}

#[derive(Debug)]
struct Recorded {
    epoch: u64,
    /// Measurement time (ns) of the last frame of the epoch that was there when ingest was first heard of; none where the epoch
    /// has begun since.
    until_ns: Option<i64>,
}

impl Arrivals {
    /// Takes how far ingest has come: its epoch, and the time (ns) of its last frame. Tells whether that was the first word of it.
    pub(crate) fn ingested(&mut self, epoch: u64, time_ns: i64) -> bool {
        let is_first = self.recorded.is_none();
        if self.recorded.as_ref().is_none_or(|recorded| epoch > recorded.epoch) {
            self.recorded = Some(Recorded { epoch, until_ns: is_first.then_some(time_ns) });
        }
        is_first
    }

    /// Whether something measured at this time (ns) was not yet recorded when ingest was first heard of. Without a word of ingest
    /// everything is taken for live.
    pub(crate) fn is_live(&self, time_ns: i64) -> bool {
        let until_ns = self.recorded.as_ref().and_then(|recorded| recorded.until_ns);
        until_ns.is_none_or(|until_ns| time_ns > until_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_recorded_before_is_not_live_and_what_comes_after_is() {
        let mut arrivals = Arrivals::default();
        assert!(arrivals.is_live(10), "nothing is known of a recording");
        assert!(arrivals.ingested(7, 100));
        assert!(!arrivals.is_live(100) && arrivals.is_live(101));
        assert!(!arrivals.ingested(7, 200), "what was recorded since is live");
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
}
