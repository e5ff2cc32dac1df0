//! The samples of one node: rows, blocks, repeated samples and steps of the clock.

use std::collections::BTreeMap;

use spandrel_bus::SampleBlock;

use crate::blocks::Blocks;
use crate::core_input::{Moment, Recorded};
use crate::gap::{GapCount, GapReport, LostBecause};
use crate::node_rows::{NodeRows, Placement};
use crate::source_plan::NodePlan;

/// Measurement time of samples behind the newest one, after which the clock counts as set back, s.
/// Repetitions after a reconnection are shorter in wall-clock time.
const BACK_S: f64 = 2.0;
/// Wall-clock time that these samples must take, ns. A repetition of stored samples arrives faster.
const BACK_ELAPSED_NS: i64 = 1_000_000_000;
/// Measurement time that may pass in addition to the wall-clock time between two packets of a
/// channel, ns. A packet that is further ahead is confirmed by the next one, or dropped.
const AHEAD_NS: i64 = 2_000_000_000;
/// Minimum wall-clock time that a packet ahead waits for the next one, ns.
const AHEAD_WAIT_NS: i64 = 10_000_000_000;
/// Maximum number of packets kept until it is clear whether the clock was set back.
const MAX_BEHIND: usize = 4096;

/// Samples of one channel in SI units with a time.
#[derive(Clone, Debug)]
pub(crate) struct Series {
    pub(crate) start_ns: i64,
    pub(crate) values: Vec<f64>,
}

/// Options of one packet.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Arrival {
    pub(crate) at: Moment,
    /// Allowed deviation from the time of the previous packet, ns.
    pub(crate) tolerance_ns: i64,
    /// Whether the source delivers earlier samples again after a restart.
    pub(crate) can_repeat: bool,
    /// Whether earlier times mean that the clock of the source was set back.
    pub(crate) can_go_back: bool,
    /// Whether the time of this packet was set again.
    pub(crate) is_resynchronised: bool,
}

/// A step back of the clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct SetBack {
    pub(crate) from_ns: i64,
    pub(crate) to_ns: i64,
}

/// What a node returns.
#[derive(Debug, Default)]
pub(crate) struct NodeOutput {
    pub(crate) blocks: Vec<SampleBlock>,
    pub(crate) lost: Vec<GapReport>,
    pub(crate) set_back: Option<SetBack>,
    /// Faults of the source.
    pub(crate) faults: Vec<String>,
}

/// One node.
#[derive(Debug)]
pub(crate) struct NodeFeed {
    index: usize,
    rate_hz: f64,
    wait_ns: i64,
    rows: NodeRows,
    blocks: Blocks,
    lanes: Vec<Lane>,
    recorded: Option<Recorded>,
    counts: BTreeMap<&'static str, u64>,
    newest_ns: Option<i64>,
    published: u64,
}

/// One channel.
#[derive(Debug, Default)]
struct Lane {
    channel: String,
    has_begun: bool,
    /// Quality of the time that its source has stated last, per cent.
    clock_quality: Option<u8>,
    /// Monotonic arrival time of the last packet that was placed, ns.
    placed_ns: i64,
    /// A packet whose time is far ahead, with its arrival, until it is clear whether its time is
    /// right.
    ahead: Option<(Series, Arrival)>,
    behind: Vec<Series>,
    /// Monotonic arrival time of the first packet behind.
    behind_since_ns: i64,
    gaps: GapCount,
}

impl NodeFeed {
    /// Creates a node. `fed` contains the channels with a source, by position.
    pub(crate) fn new(
        index: usize,
        plan: &NodePlan,
        fed: &BTreeMap<usize, String>,
        wait_ns: i64,
        epoch: u64,
    ) -> Self {
        let is_fed: Vec<bool> = (0..plan.channels)
            .map(|position| fed.contains_key(&position))
            .collect();
        let lanes = (0..plan.channels).map(|position| Lane {
            channel: fed.get(&position).cloned().unwrap_or_default(),
            ..Lane::default()
        });
        // The check of the structure limits the channels to `MAX_CHANNELS`.
        let channels = u16::try_from(plan.channels).unwrap_or(u16::MAX);
        Self {
            index,
            rate_hz: plan.rate_hz,
            wait_ns,
            rows: NodeRows::new(plan.rate_hz, wait_ns, &is_fed),
            blocks: Blocks::new(&plan.name, channels, plan.rate_hz, epoch),
            lanes: lanes.collect(),
            recorded: None,
            counts: BTreeMap::new(),
            newest_ns: None,
            published: 0,
        }
    }

    /// Sets the frames that exist already.
    pub(crate) fn set_recorded(&mut self, recorded: Recorded) {
        self.recorded = Some(recorded);
    }

    /// Returns the counts of samples by reason.
    pub(crate) fn counts(&self) -> &BTreeMap<&'static str, u64> {
        &self.counts
    }

    /// Returns the time of the newest published sample, ns, and the number of published samples.
    pub(crate) fn published(&self) -> (Option<i64>, u64) {
        (self.newest_ns, self.published)
    }

    /// Returns the time after `steps` samples, ns.
    pub(crate) fn time_after(&self, time_ns: i64, steps: usize) -> i64 {
        self.rows.time_after(time_ns, steps)
    }

    /// Records the quality of the times that the source of a channel states, per cent. The blocks
    /// of the node have the lowest quality of its channels.
    ///
    /// Many programs write 0 if they do not know the quality. 0 therefore counts only for a channel
    /// whose source has stated another quality before.
    pub(crate) fn state_clock_quality(&mut self, lane: usize, stated: Option<u8>) {
        if let Some(state) = self.lanes.get_mut(lane) {
            let is_known = |quality: &u8| *quality > 0 || state.clock_quality.is_some();
            state.clock_quality = stated.filter(is_known);
        }
        let qualities = self.lanes.iter().filter_map(|lane| lane.clock_quality);
        self.blocks.set_clock_quality(qualities.min());
    }

    /// Adds the samples of a channel.
    pub(crate) fn take(
        &mut self,
        lane: usize,
        series: Series,
        arrival: Arrival,
        out: &mut NodeOutput,
    ) {
        let Some(series) = self.without_recorded(lane, series, arrival) else {
            return;
        };
        self.confirm(lane, &series, arrival, out);
        if self.is_ahead(lane, series.start_ns, arrival) {
            if let Some(state) = self.lanes.get_mut(lane) {
                state.ahead = Some((series, arrival));
            }
            return;
        }
        self.take_timed(lane, series, arrival, out);
    }

    /// Adds the samples of a channel at their times.
    fn take_timed(&mut self, lane: usize, series: Series, arrival: Arrival, out: &mut NodeOutput) {
        self.note_pause(lane, &series, arrival, out);
        if !self.place(lane, &series, arrival, out) {
            self.hold(lane, series, arrival, out);
        }
    }

    /// Returns `true` if a packet is further ahead of the previous one of its channel than the
    /// wall-clock time between them.
    fn is_ahead(&self, lane: usize, start_ns: i64, arrival: Arrival) -> bool {
        let (Some(expected_ns), Some(state)) = (self.rows.next_ns(lane), self.lanes.get(lane))
        else {
            return false;
        };
        let elapsed_ns = arrival.at.elapsed_ns.saturating_sub(state.placed_ns);
        let limit_ns = elapsed_ns
            .saturating_add(AHEAD_NS)
            .max(arrival.tolerance_ns);
        start_ns.saturating_sub(expected_ns) > limit_ns
    }

    /// Decides on the packet ahead by the next one: it is right unless the next one is earlier.
    fn confirm(&mut self, lane: usize, next: &Series, arrival: Arrival, out: &mut NodeOutput) {
        let Some(state) = self.lanes.get_mut(lane) else {
            return;
        };
        let Some((ahead, arrived)) = state.ahead.take() else {
            return;
        };
        let end_ns = self.rows.time_after(ahead.start_ns, ahead.values.len());
        if next.start_ns >= end_ns.saturating_sub(arrival.tolerance_ns) {
            return self.take_timed(lane, ahead, arrived, out);
        }
        let samples = ahead.values.len();
        let by_ns = ahead.start_ns.saturating_sub(next.start_ns);
        out.faults.push(format!(
            "{}: the time of a packet is {:.3} s after that of the next one; its {samples} \
             samples are dropped",
            state.channel,
            by_ns as f64 / 1e9
        ));
        self.count("stray-samples", samples as u64);
    }

    /// Takes the packets ahead that have waited long enough for the next one, or all of them.
    fn take_ahead(&mut self, before_ns: i64, out: &mut NodeOutput) {
        for lane in 0..self.lanes.len() {
            let is_due = |ahead: &mut (Series, Arrival)| ahead.1.at.elapsed_ns <= before_ns;
            let state = self.lanes.get_mut(lane);
            let due = state.and_then(|state| state.ahead.take_if(is_due));
            if let Some((series, arrival)) = due {
                self.take_timed(lane, series, arrival, out);
            }
        }
    }

    /// Drops the samples at the beginning that are part of recorded frames.
    fn without_recorded(
        &mut self,
        lane: usize,
        mut series: Series,
        arrival: Arrival,
    ) -> Option<Series> {
        let has_begun = self.lanes.get(lane)?.has_begun;
        let Some(recorded) = self.recorded.filter(|_| arrival.can_repeat && !has_begun) else {
            return Some(series);
        };
        let is_recorded = |index: usize| {
            let time_ns = self.rows.time_after(series.start_ns, index);
            i128::from(recorded.frames.nearest(time_ns)) < i128::from(recorded.next)
        };
        let known = (0..series.values.len())
            .take_while(|index| is_recorded(*index))
            .count();
        if known > 0 {
            self.count("recorded-samples", known as u64);
            series.start_ns = self.rows.time_after(series.start_ns, known);
            series.values.drain(..known);
        }
        (!series.values.is_empty()).then_some(series)
    }

    /// Reports the samples between the last recorded frame and the first sample of a channel.
    fn note_pause(&mut self, lane: usize, series: &Series, arrival: Arrival, out: &mut NodeOutput) {
        let (index, rate_hz) = (self.index, self.rate_hz);
        let recorded = self.recorded;
        let Some(state) = self.lanes.get_mut(lane) else {
            return;
        };
        if std::mem::replace(&mut state.has_begun, true) {
            return;
        }
        let Some(recorded) = recorded else {
            return;
        };
        let Some(last) = recorded.next.checked_sub(1) else {
            return;
        };
        let last_ns = recorded.frames.time_ns(last);
        let steps = series.start_ns.saturating_sub(last_ns) as f64 * rate_hz / 1e9;
        let because = match arrival.can_repeat {
            true => LostBecause::NotDelivered,
            false => LostBecause::FeedStopped,
        };
        // The first sample after the frame is one step later. A negative number is no pause.
        let samples = (steps.round() - 1.0).max(0.0) as u64;
        let lost = GapReport {
            node: index,
            channel: state.channel.clone(),
            samples,
            from_ns: last_ns,
            to_ns: series.start_ns,
            because,
        };
        out.lost.extend(state.gaps.add(lost));
        self.count(because.counter(), samples);
    }

    /// Places samples in rows. Returns `false` if all of them have times that exist already.
    fn place(
        &mut self,
        lane: usize,
        series: &Series,
        arrival: Arrival,
        out: &mut NodeOutput,
    ) -> bool {
        let count = series.values.len();
        let expected_ns = self.rows.next_ns(lane);
        let placement = self
            .rows
            .place(lane, series.start_ns, count, arrival.tolerance_ns);
        let Placement::At { row, missing, skip } = placement else {
            return false;
        };
        if let Some(state) = self.lanes.get_mut(lane) {
            state.placed_ns = arrival.at.elapsed_ns;
        }
        self.drop_behind(lane);
        self.count("repeated-samples", skip as u64);
        if missing > 0 {
            let because = match arrival.is_resynchronised {
                true => LostBecause::Resynchronised,
                false => LostBecause::NotDelivered,
            };
            let from_ns = expected_ns.unwrap_or(series.start_ns);
            self.lose(lane, missing, from_ns, series.start_ns, because, out);
        }
        let start_ns = self.rows.time_after(series.start_ns, skip);
        let values = series.values.get(skip..).unwrap_or_default();
        let late = self
            .rows
            .insert(lane, row, start_ns, values, arrival.at.elapsed_ns);
        let late_end_ns = self.rows.time_after(start_ns, late as usize);
        self.lose(lane, late, start_ns, late_end_ns, LostBecause::Late, out);
        true
    }

    /// Counts lost samples of a channel.
    pub(crate) fn lose(
        &mut self,
        lane: usize,
        samples: u64,
        from_ns: i64,
        to_ns: i64,
        because: LostBecause,
        out: &mut NodeOutput,
    ) {
        self.count(because.counter(), samples);
        let node = self.index;
        if let Some(state) = self.lanes.get_mut(lane) {
            let lost = GapReport {
                node,
                channel: state.channel.clone(),
                samples,
                from_ns,
                to_ns,
                because,
            };
            out.lost.extend(state.gaps.add(lost));
        }
    }

    /// Keeps samples whose times exist already, until it is clear whether they are repetitions or
    /// the clock was set back.
    ///
    /// Drops them at once if the clock of the source cannot go back.
    fn hold(&mut self, lane: usize, series: Series, arrival: Arrival, out: &mut NodeOutput) {
        if !arrival.can_go_back {
            return self.count("older-samples", series.values.len() as u64);
        }
        let Some(state) = self.lanes.get(lane) else {
            return;
        };
        let end_ns = |rows: &NodeRows, series: &Series| {
            rows.time_after(series.start_ns, series.values.len())
        };
        let continues = state.behind.last().is_some_and(|last| {
            let off_ns = series.start_ns.abs_diff(end_ns(&self.rows, last));
            off_ns <= arrival.tolerance_ns.unsigned_abs()
        });
        if !continues || state.behind.len() >= MAX_BEHIND {
            self.drop_behind(lane);
        }
        let Some(state) = self.lanes.get_mut(lane) else {
            return;
        };
        if state.behind.is_empty() {
            state.behind_since_ns = arrival.at.elapsed_ns;
        }
        state.behind.push(series);
        let samples: usize = state.behind.iter().map(|series| series.values.len()).sum();
        let is_long = samples as f64 >= BACK_S * self.rate_hz;
        let is_slow =
            arrival.at.elapsed_ns.saturating_sub(state.behind_since_ns) >= BACK_ELAPSED_NS;
        if is_long && is_slow {
            self.set_back(lane, arrival, out);
        }
    }

    fn drop_behind(&mut self, lane: usize) {
        let Some(state) = self.lanes.get_mut(lane) else {
            return;
        };
        let samples: usize = state.behind.iter().map(|series| series.values.len()).sum();
        state.behind.clear();
        self.count("repeated-samples", samples as u64);
    }

    /// Starts a new epoch with the samples behind.
    fn set_back(&mut self, lane: usize, arrival: Arrival, out: &mut NodeOutput) {
        let to_ns = self
            .lanes
            .get(lane)
            .and_then(|state| state.behind.first())
            .map_or(0, |first| first.start_ns);
        let from_ns = self.rows.newest_ns().unwrap_or(to_ns);
        self.end_rows(out);
        self.rows.restart();
        let epoch = self.blocks.epoch().saturating_add(1);
        self.blocks.restart(epoch);
        self.recorded = None;
        out.set_back = Some(SetBack { from_ns, to_ns });
        self.count("clock-set-back", 1);
        for lane in 0..self.lanes.len() {
            let behind = match self.lanes.get_mut(lane) {
                Some(state) => std::mem::take(&mut state.behind),
                None => Vec::new(),
            };
            for series in behind {
                self.place(lane, &series, arrival, out);
            }
        }
    }

    /// Returns the rows that need not wait any longer.
    pub(crate) fn release(&mut self, at: Moment, out: &mut NodeOutput) {
        let rows = self.rows.release(at.elapsed_ns);
        self.note_published(&rows);
        self.blocks.push(rows, &mut out.blocks);
    }

    /// Lets time pass: returns rows, the open block and reports that are due.
    pub(crate) fn tick(&mut self, at: Moment, out: &mut NodeOutput) {
        let wait_ns = AHEAD_WAIT_NS.max(self.wait_ns.saturating_mul(2));
        self.take_ahead(at.elapsed_ns.saturating_sub(wait_ns), out);
        self.release(at, out);
        self.blocks.flush(&mut out.blocks);
        for lane in &mut self.lanes {
            out.lost.extend(lane.gaps.due(at.elapsed_ns));
        }
    }

    /// Returns everything that waits.
    pub(crate) fn stop(&mut self, out: &mut NodeOutput) {
        self.take_ahead(i64::MAX, out);
        self.end_rows(out);
        for lane in &mut self.lanes {
            out.lost.extend(lane.gaps.end());
        }
    }

    fn end_rows(&mut self, out: &mut NodeOutput) {
        let rows = self.rows.release_all();
        self.note_published(&rows);
        self.blocks.push(rows, &mut out.blocks);
        self.blocks.flush(&mut out.blocks);
    }

    fn note_published(&mut self, rows: &[crate::node_rows::Row]) {
        self.published += rows.len() as u64;
        if let Some(last) = rows.last() {
            self.newest_ns = Some(last.time_ns);
        }
    }

    fn count(&mut self, reason: &'static str, samples: u64) {
        if samples > 0 {
            *self.counts.entry(reason).or_default() += samples;
        }
    }
}
