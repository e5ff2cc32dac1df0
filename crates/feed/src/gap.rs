//! Lost samples of one channel, counted and reported at a limited rate.

use std::fmt;

/// Minimum time between two reports of one channel, ns. Samples that are lost meanwhile are added
/// to the next report.
const REPORT_EVERY_NS: i64 = 10_000_000_000;

/// The reason why samples are lost.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum LostBecause {
    /// The source did not deliver them.
    NotDelivered,
    /// They were measured while the feed did not run, and the source cannot repeat them.
    FeedStopped,
    /// They arrived after their row had been published.
    Late,
    /// They arrived too early or too late for their number, so that the time was set again.
    Resynchronised,
}

impl LostBecause {
    /// Returns the name of the counter.
    #[must_use]
    pub fn counter(self) -> &'static str {
        match self {
            Self::NotDelivered => "undelivered-samples",
            Self::FeedStopped => "stopped-samples",
            Self::Late => "late-samples",
            Self::Resynchronised => "resynchronised-samples",
        }
    }
}

impl fmt::Display for LostBecause {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::NotDelivered => "the instrument did not deliver them",
            Self::FeedStopped => {
                "the feed was not running, and the instrument cannot send them again"
            }
            Self::Late => "they arrived after wait-s, when their rows had been published",
            Self::Resynchronised => "their arrival deviated from their time by more than jitter-s",
        })
    }
}

/// Lost samples of one channel.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GapReport {
    /// Index of the node in the configuration.
    pub node: usize,
    /// Name of the channel in the structure file.
    pub channel: String,
    /// Number of lost samples.
    pub samples: u64,
    /// Time of the first lost sample, ns since the Unix epoch.
    pub from_ns: i64,
    /// Time of the first sample after them, ns since the Unix epoch.
    pub to_ns: i64,
    /// The reason.
    pub because: LostBecause,
}

/// Adds up the lost samples of a channel between two reports.
#[derive(Clone, Debug, Default)]
pub(crate) struct GapCount {
    open: Option<GapReport>,
    reported_ns: Option<i64>,
}

impl GapCount {
    /// Adds lost samples. Another reason ends the open report, which is returned.
    pub(crate) fn add(&mut self, lost: GapReport) -> Option<GapReport> {
        if lost.samples == 0 {
            return None;
        }
        match &mut self.open {
            Some(open) if open.because == lost.because => {
                open.samples = open.samples.saturating_add(lost.samples);
                open.to_ns = open.to_ns.max(lost.to_ns);
                None
            }
            open => open.replace(lost),
        }
    }

    /// Returns the report that is due at `elapsed_ns` (monotonic clock).
    pub(crate) fn due(&mut self, elapsed_ns: i64) -> Option<GapReport> {
        let is_early = self
            .reported_ns
            .is_some_and(|reported_ns| elapsed_ns.saturating_sub(reported_ns) < REPORT_EVERY_NS);
        if is_early || self.open.is_none() {
            return None;
        }
        self.reported_ns = Some(elapsed_ns);
        self.open.take()
    }

    /// Returns the open report at once.
    pub(crate) fn end(&mut self) -> Option<GapReport> {
        self.open.take()
    }
}
