//! Merges the channels of a node to rows.
//!
//! Rows have numbers. A packet that continues the previous packet of its channel takes the next
//! numbers, so that a clock that drifts against the nominal rate neither doubles nor skips rows.
//! After a gap, and at the beginning, the time determines the number. The first channel that
//! reaches a row determines its time.

use std::collections::BTreeMap;

/// Maximum number of waiting rows. If there are more, the oldest is returned incomplete.
const MAX_PENDING: usize = 1 << 15;

/// The rows of one node.
#[derive(Clone, Debug)]
pub(crate) struct NodeRows {
    step_ns: f64,
    wait_ns: i64,
    lanes: Vec<Lane>,
    pending: BTreeMap<i64, PendingRow>,
    /// Number and time of the newest row.
    newest: Option<(i64, i64)>,
    /// First row number that has not been returned.
    open_from: i64,
}

/// The position of one channel.
#[derive(Clone, Copy, Debug)]
struct Lane {
    /// Whether a source feeds the channel.
    is_fed: bool,
    /// Number and time of its next row.
    next: Option<(i64, i64)>,
    /// Whether rows no longer wait for the channel, because one has waited in vain.
    is_absent: bool,
}

#[derive(Clone, Debug)]
struct PendingRow {
    time_ns: i64,
    arrived_ns: i64,
    values: Vec<f64>,
}

/// A row: one value per channel in SI units, NaN if missing.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Row {
    pub(crate) time_ns: i64,
    pub(crate) values: Vec<f64>,
}

/// The place of a packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Placement {
    /// The packet starts at this row.
    At {
        /// Row of the first sample that is not skipped.
        row: i64,
        /// Number of samples missing before it.
        missing: u64,
        /// Number of samples at its beginning whose times exist already.
        skip: usize,
    },
    /// All samples have times that exist already.
    Behind,
}

impl NodeRows {
    /// Creates the rows of a node with one lane per channel. `fed` states which channels have a
    /// source.
    pub(crate) fn new(rate_hz: f64, wait_ns: i64, fed: &[bool]) -> Self {
        let lane = |is_fed: &bool| Lane {
            is_fed: *is_fed,
            next: None,
            is_absent: false,
        };
        Self {
            step_ns: 1e9 / rate_hz,
            wait_ns,
            lanes: fed.iter().map(lane).collect(),
            pending: BTreeMap::new(),
            newest: None,
            open_from: i64::MIN,
        }
    }

    /// Returns the number of steps in a time, rounded.
    fn steps(&self, time_ns: i64) -> i64 {
        (time_ns as f64 / self.step_ns).round() as i64
    }

    fn after(&self, time_ns: i64, steps: usize) -> i64 {
        time_ns.saturating_add((steps as f64 * self.step_ns).round() as i64)
    }

    fn row_at(&self, time_ns: i64) -> i64 {
        self.newest.map_or(0, |(row, newest_ns)| {
            row.saturating_add(self.steps(time_ns.saturating_sub(newest_ns)))
        })
    }

    /// Returns the time of the next sample of a channel, ns.
    pub(crate) fn next_ns(&self, lane: usize) -> Option<i64> {
        self.lanes.get(lane)?.next.map(|(_, time_ns)| time_ns)
    }

    /// Returns the time of the newest row, ns.
    pub(crate) fn newest_ns(&self) -> Option<i64> {
        self.newest.map(|(_, time_ns)| time_ns)
    }

    /// Returns the time after `steps` samples of this node.
    pub(crate) fn time_after(&self, time_ns: i64, steps: usize) -> i64 {
        self.after(time_ns, steps)
    }

    /// Finds the place of `count` samples that start at `start_ns`.
    pub(crate) fn place(
        &self,
        lane: usize,
        start_ns: i64,
        count: usize,
        tolerance_ns: i64,
    ) -> Placement {
        let Some((next, next_ns)) = self.lanes.get(lane).and_then(|lane| lane.next) else {
            return Placement::At {
                row: self.row_at(start_ns),
                missing: 0,
                skip: 0,
            };
        };
        let off_ns = start_ns.saturating_sub(next_ns);
        if off_ns.unsigned_abs() <= tolerance_ns.unsigned_abs() {
            return Placement::At {
                row: next,
                missing: 0,
                skip: 0,
            };
        }
        if off_ns > 0 {
            return Placement::At {
                row: self.row_at(start_ns).max(next),
                missing: self.steps(off_ns).max(1).unsigned_abs(),
                skip: 0,
            };
        }
        let overlap = self.steps(off_ns.saturating_neg()).unsigned_abs();
        match usize::try_from(overlap) {
            Ok(skip) if skip < count => Placement::At {
                row: next,
                missing: 0,
                skip,
            },
            _ => Placement::Behind,
        }
    }

    /// Adds the samples of a channel from row `row` on. The first one was measured at `start_ns`
    /// and arrived at `arrived_ns` (monotonic clock).
    ///
    /// Returns the number of samples that are too late for their rows.
    pub(crate) fn insert(
        &mut self,
        lane: usize,
        row: i64,
        start_ns: i64,
        values: &[f64],
        arrived_ns: i64,
    ) -> u64 {
        let channels = self.lanes.len();
        let mut late = 0;
        for (index, value) in values.iter().enumerate() {
            let number = row.saturating_add(index as i64);
            if number < self.open_from {
                late += 1;
                continue;
            }
            let time_ns = self.after(start_ns, index);
            let pending = self.pending.entry(number).or_insert_with(|| PendingRow {
                time_ns,
                arrived_ns,
                values: vec![f64::NAN; channels],
            });
            if let Some(place) = pending.values.get_mut(lane) {
                *place = *value;
            }
            if self.newest.is_none_or(|(newest, _)| newest < number) {
                self.newest = Some((number, time_ns));
            }
        }
        let next = (
            row.saturating_add(values.len() as i64),
            self.after(start_ns, values.len()),
        );
        if let Some(lane) = self.lanes.get_mut(lane) {
            lane.next = Some(next);
            lane.is_absent = false;
        }
        late
    }

    /// Returns the rows that need not wait any longer at `now_ns` (monotonic clock), in order.
    pub(crate) fn release(&mut self, now_ns: i64) -> Vec<Row> {
        let mut rows = Vec::new();
        while let Some((number, first)) = self.pending.first_key_value() {
            let number = *number;
            let is_awaited = |lane: &Lane| {
                lane.is_fed && !lane.is_absent && lane.next.is_none_or(|(next, _)| next <= number)
            };
            if self.lanes.iter().any(is_awaited) {
                let has_waited = now_ns.saturating_sub(first.arrived_ns) >= self.wait_ns;
                if !has_waited && self.pending.len() <= MAX_PENDING {
                    break;
                }
                for lane in self.lanes.iter_mut().filter(|lane| is_awaited(lane)) {
                    lane.is_absent = true;
                }
            }
            self.pop(&mut rows);
        }
        rows
    }

    /// Returns all waiting rows.
    pub(crate) fn release_all(&mut self) -> Vec<Row> {
        let mut rows = Vec::new();
        while !self.pending.is_empty() {
            self.pop(&mut rows);
        }
        rows
    }

    fn pop(&mut self, rows: &mut Vec<Row>) {
        if let Some((number, row)) = self.pending.pop_first() {
            self.open_from = number.saturating_add(1);
            // A row of missing samples only is a gap in time.
            if row.values.iter().any(|value| !value.is_nan()) {
                rows.push(Row {
                    time_ns: row.time_ns,
                    values: row.values,
                });
            }
        }
    }

    /// Starts again on another time scale. No row may wait.
    pub(crate) fn restart(&mut self) {
        self.pending.clear();
        self.newest = None;
        self.open_from = i64::MIN;
        for lane in &mut self.lanes {
            lane.next = None;
        }
    }
}

#[cfg(test)]
mod tests;
