//! State, counts and last error of one source.

use spandrel_bus::{InstrumentState, InstrumentStatus};

use crate::core_input::{Link, Moment};

/// Time without a usable sample after which a source counts as silent or failed, ns.
const SILENT_AFTER_NS: i64 = 10_000_000_000;
/// Maximum length of an error in a status, in bytes.
const MAX_ERROR_BYTES: usize = 400;

/// The state of one source.
#[derive(Clone, Debug)]
pub(crate) struct Instrument {
    link: InstrumentState,
    state: InstrumentState,
    since_ns: i64,
    silent_after_ns: i64,
    samples: u64,
    errors: u64,
    last_error: Option<(String, i64)>,
    /// Monotonic times of the last usable sample and of the last error.
    sample_at_ns: Option<i64>,
    error_at_ns: Option<i64>,
}

impl Instrument {
    /// Creates the state of a source whose rows wait `wait_ns` for each other. Its packets can
    /// arrive as rarely as that.
    pub(crate) fn new(wait_ns: i64) -> Self {
        Self {
            link: InstrumentState::Connecting,
            state: InstrumentState::Connecting,
            since_ns: 0,
            silent_after_ns: SILENT_AFTER_NS.max(wait_ns.saturating_mul(2)),
            samples: 0,
            errors: 0,
            last_error: None,
            sample_at_ns: None,
            error_at_ns: None,
        }
    }

    /// Creates the state of a source that is silent after `silent_after_ns` without a value.
    pub(crate) fn slow(silent_after_ns: i64) -> Self {
        Self {
            silent_after_ns: SILENT_AFTER_NS.max(silent_after_ns),
            ..Self::new(0)
        }
    }

    /// Records a change of the connection. Returns the error to log, if there is one.
    pub(crate) fn link(&mut self, link: Link, at: Moment) -> Option<(String, u64)> {
        let (state, why) = match link {
            Link::Connecting => (InstrumentState::Connecting, None),
            Link::Open => (InstrumentState::Connected, None),
            Link::Failed { why } => (InstrumentState::Failed, Some(why)),
            Link::Ended => (InstrumentState::Ended, None),
        };
        if state == InstrumentState::Connected && self.link != state {
            // Samples and errors of an earlier connection do not describe this one.
            (self.sample_at_ns, self.error_at_ns) = (None, None);
        }
        self.link = state;
        why.and_then(|why| self.error(why, 1, at))
    }

    /// Records usable samples.
    pub(crate) fn accepted(&mut self, samples: u64, at: Moment) {
        self.samples = self.samples.saturating_add(samples);
        if samples > 0 {
            self.sample_at_ns = Some(at.elapsed_ns);
        }
    }

    /// Records `count` errors. Returns the error and the count if the count has doubled since it
    /// was last returned.
    pub(crate) fn error(
        &mut self,
        mut why: String,
        count: u64,
        at: Moment,
    ) -> Option<(String, u64)> {
        why.retain(|c| !c.is_control());
        why.truncate(why.floor_char_boundary(MAX_ERROR_BYTES));
        let before = self.errors;
        self.errors = self.errors.saturating_add(count);
        let has_doubled = before.checked_ilog2() != self.errors.checked_ilog2();
        self.last_error = Some((why.clone(), at.wall_ns));
        self.error_at_ns = Some(at.elapsed_ns);
        has_doubled.then_some((why, self.errors))
    }

    /// Returns the new state if it has changed.
    pub(crate) fn changed(&mut self, at: Moment) -> Option<InstrumentState> {
        let state = self.state_at(at);
        if state == self.state && self.since_ns != 0 {
            return None;
        }
        (self.state, self.since_ns) = (state, at.wall_ns);
        Some(state)
    }

    fn state_at(&self, at: Moment) -> InstrumentState {
        if self.link != InstrumentState::Connected {
            return self.link;
        }
        let is_recent = |time_ns: i64| at.elapsed_ns.saturating_sub(time_ns) < self.silent_after_ns;
        match (self.sample_at_ns, self.error_at_ns) {
            (Some(sample_ns), _) if is_recent(sample_ns) => InstrumentState::Receiving,
            (sample_ns, Some(error_ns)) if sample_ns.is_none_or(|at_ns| at_ns <= error_ns) => {
                InstrumentState::Failed
            }
            (Some(_), _) => InstrumentState::Silent,
            (None, _) => InstrumentState::Connected,
        }
    }

    /// Returns the last error, if there is one.
    pub(crate) fn last_error(&self) -> Option<&str> {
        self.last_error.as_ref().map(|(why, _)| why.as_str())
    }

    /// Returns the status.
    pub(crate) fn status(&self) -> InstrumentStatus {
        InstrumentStatus {
            state: self.state,
            since_ns: self.since_ns,
            samples: self.samples,
            errors: self.errors,
            last_error: self.last_error().map(str::to_owned),
            last_error_ns: self.last_error.as_ref().map(|(_, time_ns)| *time_ns),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(seconds: i64) -> Moment {
        Moment {
            wall_ns: 1_795_000_000_000_000_000 + seconds * 1_000_000_000,
            elapsed_ns: seconds * 1_000_000_000,
        }
    }

    #[test]
    fn state_follows_connection_samples_and_errors() {
        let mut shake = Instrument::new(0);
        assert_eq!(shake.changed(at(0)), Some(InstrumentState::Connecting));
        shake.link(Link::Open, at(0));
        assert_eq!(shake.changed(at(0)), Some(InstrumentState::Connected));
        shake.accepted(25, at(1));
        assert_eq!(shake.changed(at(1)), Some(InstrumentState::Receiving));
        assert_eq!(shake.changed(at(2)), None);
        assert_eq!(shake.changed(at(11)), Some(InstrumentState::Silent));
        shake.error("malformed".to_owned(), 1, at(12));
        assert_eq!(shake.changed(at(12)), Some(InstrumentState::Failed));
        assert_eq!(shake.status().last_error.as_deref(), Some("malformed"));
        shake.accepted(25, at(13));
        assert_eq!(shake.changed(at(13)), Some(InstrumentState::Receiving));
        let why = "refused".to_owned();
        shake.link(Link::Failed { why }, at(14));
        assert_eq!(shake.changed(at(14)), Some(InstrumentState::Failed));
    }

    #[test]
    fn repeated_errors_are_returned_each_time_their_count_doubles() {
        let mut shake = Instrument::new(0);
        let returned = (0..1000).filter(|_| shake.error("x".to_owned(), 1, at(0)).is_some());
        assert_eq!(returned.count(), 10); // 1, 2, 4, …, 512
        assert_eq!(shake.status().errors, 1000);
    }
}
