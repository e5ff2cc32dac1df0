//! Controls how fast rows are published: the requested speed, and a window that limits the lead of
//! a source.

use std::collections::VecDeque;
use std::time::Duration;

use spandrel_bus::Progress;

/// Speed of a simulation or replay.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Speed {
    /// A multiple of the original speed; positive.
    Factor(f64),
    /// As fast as the downstream services process the rows.
    Max,
    /// Real time: a row is due when the wall clock reaches its timestamp. Live nodes must not wait
    /// for other services, so [`wait_for`](crate::SensorSettings::wait_for) should be empty.
    Live,
}

impl Speed {
    /// Returns when a row is due, relative to the first row.
    ///
    /// `None` means that the row is due immediately.
    #[must_use]
    pub fn due(self, first_ns: i64, time_ns: i64) -> Option<Duration> {
        match self {
            Self::Factor(factor) => {
                let seconds = time_ns.saturating_sub(first_ns).max(0) as f64 * 1e-9 / factor;
                Duration::try_from_secs_f64(seconds).ok()
            }
            Self::Live => Self::Factor(1.0).due(first_ns, time_ns),
            Self::Max => None,
        }
    }
}

/// The maximum number of rows in transit between a source and the services that it waits for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Window {
    /// Maximum number of published but unprocessed rows.
    ///
    /// The limit is in rows, not time, because a gap in a record contains no rows, whatever its
    /// duration.
    pub rows: u64,
    /// Time between two rows, ns.
    pub step_ns: i64,
    /// Largest amount by which the clock of any node is ahead of the times of the rows, ns. At
    /// least 0.
    pub clock_ahead_ns: i64,
    /// Lowest epoch of this run. Frames of lower epochs belong to an earlier run.
    pub min_epoch: u64,
}

/// The most recently published batches of rows, which cover at least the window.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RowsPut {
    /// Time of the last row (ns) and number of rows of each batch.
    batches: VecDeque<(i64, u64)>,
    rows: u64,
}

impl RowsPut {
    /// Adds a batch, and drops batches older than the window.
    pub fn push(&mut self, window: &Window, time_ns: i64, rows: u64) {
        self.batches.push_back((time_ns, rows));
        self.rows += rows;
        while let Some((_, oldest)) = self
            .batches
            .front()
            .filter(|(_, oldest)| self.rows - oldest > window.rows)
        {
            self.rows -= oldest;
            self.batches.pop_front();
        }
    }

    fn last_ns(&self) -> Option<i64> {
        self.batches.back().map(|(time_ns, _)| *time_ns)
    }

    /// Returns the number of rows in batches whose last row is later than `time_ns` (ns).
    fn after(&self, time_ns: i64) -> u64 {
        self.batches
            .iter()
            .filter(|(last_ns, _)| *last_ns > time_ns)
            .map(|(_, rows)| rows)
            .sum()
    }
}

impl Window {
    /// Returns `true` if a batch of `rows` rows may follow the batches in `put`, given the
    /// `progress` of one service. `None` means that the service has not reported any.
    ///
    /// Progress beyond the published rows belongs to an earlier run over the same record and is
    /// ignored.
    #[must_use]
    pub fn admits(&self, rows: u64, put: &RowsPut, progress: Option<&Progress>) -> bool {
        let furthest = put.last_ns().map_or(i64::MIN, |last_ns| {
            last_ns
                .saturating_add(self.clock_ahead_ns)
                .saturating_add(self.step_ns)
        });
        let of_this_run =
            |p: &&Progress| p.header.epoch >= self.min_epoch && p.header.time_ns <= furthest;
        let done_ns = progress
            .filter(of_this_run)
            .map_or(i64::MIN, |p| p.header.time_ns);
        put.after(done_ns) + rows <= self.rows.max(rows)
    }

    /// Returns `true` if the service that reports `progress` has processed everything up to the
    /// last sample, at `last_ns` (ns).
    #[must_use]
    pub fn all_done(&self, last_ns: i64, progress: &Progress) -> bool {
        // The frame of the last sample is at most half a step before it.
        let last_frame_ns = last_ns.saturating_sub(self.step_ns);
        progress.header.epoch >= self.min_epoch && progress.header.time_ns >= last_frame_ns
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use spandrel_bus::Header;

    const WINDOW: Window = Window {
        rows: 10,
        step_ns: 10,
        clock_ahead_ns: 0,
        min_epoch: 5,
    };

    fn progress(epoch: u64, time_ns: i64) -> Progress {
        Progress {
            header: Header {
                source: "identify".into(),
                epoch,
                sequence: 0,
                time_ns,
            },
            done: 0,
            kept: 0,
        }
    }

    /// Returns batches of 5 rows that end at these times, ns.
    fn put(times_ns: &[i64]) -> RowsPut {
        let mut put = RowsPut::default();
        times_ns
            .iter()
            .for_each(|time_ns| put.push(&WINDOW, *time_ns, 5));
        put
    }

    #[test]
    fn a_source_starts_without_progress_and_stops_at_the_window() {
        assert!(WINDOW.admits(5, &put(&[]), None));
        assert!(WINDOW.admits(5, &put(&[1050]), None));
        assert!(!WINDOW.admits(5, &put(&[1050, 1100]), None));
    }

    #[test]
    fn progress_moves_the_window() {
        assert!(WINDOW.admits(5, &put(&[1050, 1100]), Some(&progress(5, 1050))));
        assert!(!WINDOW.admits(5, &put(&[1050, 1100, 1150]), Some(&progress(5, 1050))));
    }

    #[test]
    fn a_hole_in_time_does_not_count() {
        assert!(WINDOW.admits(5, &put(&[1050, 1_000_000]), Some(&progress(5, 1050))));
    }

    #[test]
    fn batch_larger_than_the_window_is_sent_alone() {
        assert!(WINDOW.admits(50, &put(&[1050]), Some(&progress(5, 1050))));
        assert!(!WINDOW.admits(50, &put(&[1050]), None));
    }

    #[test]
    fn progress_of_an_earlier_run_does_not_count() {
        assert!(!WINDOW.admits(5, &put(&[1050, 1100]), Some(&progress(4, 1100))));
        assert!(!WINDOW.admits(5, &put(&[1050, 1100]), Some(&progress(5, 5000))));
        assert!(!WINDOW.all_done(1100, &progress(4, 1100)));
    }

    #[test]
    fn source_is_done_with_the_frame_of_its_last_sample() {
        assert!(!WINDOW.all_done(1100, &progress(5, 1080)));
        assert!(WINDOW.all_done(1100, &progress(5, 1095)));
    }

    #[test]
    fn speed_is_a_factor_of_measurement_time() {
        let second = 1_000_000_000;
        assert_eq!(
            Speed::Factor(10.0).due(0, 5 * second),
            Some(Duration::from_millis(500))
        );
        assert_eq!(Speed::Max.due(0, 5 * second), None);
        assert_eq!(
            Speed::Live.due(second, 5 * second),
            Some(Duration::from_secs(4))
        );
    }
}
