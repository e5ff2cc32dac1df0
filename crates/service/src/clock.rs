//! The wall clock.

use std::time::{SystemTime, UNIX_EPOCH};

/// The wall clock of a service. A test can fix its time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Clock {
    /// Time at which the clock stands still, ns since the Unix epoch. `None` for the clock of the
    /// machine.
    fixed_ns: Option<i64>,
}

impl Clock {
    /// Returns the clock of the machine.
    #[must_use]
    pub fn of_machine() -> Self {
        Self::default()
    }

    /// Returns a clock that always shows the same time, ns since the Unix epoch.
    #[must_use]
    pub fn fixed(time_ns: i64) -> Self {
        Self {
            fixed_ns: Some(time_ns),
        }
    }

    /// Returns the time, ns since the Unix epoch, UTC. A clock before 1970 shows 0.
    #[must_use]
    pub fn now_ns(self) -> i64 {
        self.fixed_ns.unwrap_or_else(|| {
            #[expect(
                clippy::disallowed_methods,
                reason = "this is the one place where services read the wall clock"
            )]
            let now = SystemTime::now();
            now.duration_since(UNIX_EPOCH).map_or(0, |since| {
                i64::try_from(since.as_nanos()).unwrap_or(i64::MAX)
            })
        })
    }

    /// Returns the epoch of a source that starts now. It is at least 1, and increases with time.
    #[must_use]
    pub fn epoch(self) -> u64 {
        self.now_ns().max(1).unsigned_abs()
    }

    /// Returns the time since `time_ns`, in seconds. It is negative for a time in the future.
    #[must_use]
    pub fn seconds_since(self, time_ns: i64) -> f64 {
        self.now_ns().saturating_sub(time_ns) as f64 / 1e9
    }
}
