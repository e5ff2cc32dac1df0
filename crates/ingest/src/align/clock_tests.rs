//! Nodes whose clocks are far off, with the vote on the clocks and the deadline of frames.

use std::time::Duration;

use spandrel_bus::{Block, FrameBlock, Header, Name, Pace, SampleBlock, StreamState};

use super::{Alignment, AlignmentInput};
use crate::layout::{Layout, NodeLayout};
use crate::timekeeping::Timekeeping;

const S: i64 = 1_000_000_000;
const T0: i64 = 1_700_000_000 * S;
const STEP: i64 = 10_000_000;
/// Rows of a block, and its length.
const ROWS: usize = 10;
const BLOCK: Duration = Duration::from_millis(100);
const LATENESS: Duration = Duration::from_secs(2);

/// A structure with live nodes of 100 Hz. The value of a sample is its true time since the start,
/// in steps.
struct Site {
    alignment: Alignment,
    timekeeping: Timekeeping,
    now: Duration,
    sequences: Vec<u64>,
    frames: Vec<FrameBlock>,
}

impl Site {
    fn new(nodes: usize) -> Self {
        let layouts = (0..nodes).map(|node| NodeLayout {
            name: Name::new(format!("node-{node}")).unwrap(),
            ranges: vec![1e9],
        });
        let layout = Layout::new(layouts.collect(), 100.0, 0.005).unwrap();
        Self {
            alignment: Alignment::new(layout, "ingest".into(), 1),
            timekeeping: Timekeeping::new(LATENESS, nodes),
            now: Duration::from_secs(1000),
            sequences: vec![0; nodes],
            frames: Vec::new(),
        }
    }

    fn handle(&mut self, input: AlignmentInput) {
        let epoch = self.alignment.epoch();
        self.alignment.handle(input, &mut self.frames);
        if self.alignment.epoch() != epoch {
            self.timekeeping.begin_run();
        }
    }

    /// Lets some nodes deliver for `seconds`. Each is given with the error of its clock, s.
    fn run(&mut self, seconds: u32, nodes: &[(usize, i64)]) {
        for _ in 0..10 * seconds {
            let steps = self.steps();
            for (node, off_s) in nodes {
                self.deliver(*node, steps, *off_s);
            }
            self.wait(BLOCK);
        }
    }

    fn wait(&mut self, duration: Duration) {
        self.now += duration;
        for input in self.timekeeping.count_votes(self.now) {
            self.handle(input);
        }
        if let Some(deadline) = self.timekeeping.deadline(self.now) {
            self.handle(deadline);
        }
    }

    /// Returns the number of steps since the start.
    fn steps(&self) -> i64 {
        (self.now - Duration::from_secs(1000)).as_nanos() as i64 / STEP
    }

    fn block(&mut self, node: usize, steps: i64, off_s: i64) -> SampleBlock {
        let block = SampleBlock {
            header: Header {
                source: format!("node-{node}"),
                epoch: 1,
                sequence: self.sequences[node],
                time_ns: T0 + steps * STEP + off_s * S,
            },
            sampling_rate_hz: 100.0,
            pace: Pace::Live,
            channels: 1,
            samples: (0..ROWS).map(|row| (steps + row as i64) as f64).collect(),
            state: StreamState::Running,
            clock_quality: None,
        };
        self.sequences[node] = block.end();
        block
    }

    /// Returns the rows of frames with their time since the start in steps.
    fn rows(&self) -> Vec<(i64, Vec<f64>)> {
        let rows = self.frames.iter().flat_map(|block| {
            let grid = block.grid().unwrap();
            let time = move |number: u64| (grid.time_ns(number) - T0) / STEP;
            block
                .iter()
                .map(move |(number, row)| (time(number), row.to_vec()))
        });
        rows.collect()
    }

    /// Checks that the last seconds of frames contain the samples of some nodes at their true
    /// times, and none of the others. Returns the number of frames without any sample.
    fn check(&self, seconds: usize, healthy: &[usize], case: &str) -> usize {
        let rows = self.rows();
        let last = rows.last().map_or(0, |(steps, _)| *steps);
        // Frames may be as far behind as they wait.
        assert!(
            self.steps() - last <= 250,
            "{case}: {last} of {}",
            self.steps()
        );
        assert!(rows.len() >= 100 * seconds, "{case}: {} frames", rows.len());
        for (steps, row) in &rows[rows.len() - 100 * seconds..] {
            for (node, value) in row.iter().enumerate() {
                match healthy.contains(&node) {
                    true => assert_eq!(*value, *steps as f64, "{case}: node {node} at {steps}"),
                    false => assert!(value.is_nan(), "{case}: node {node} at {steps}: {value}"),
                }
            }
        }
        rows.iter()
            .filter(|(_, row)| row.iter().all(|value| value.is_nan()))
            .count()
    }

    /// Lets nodes that are `late_s` late deliver at twice real time until they are prompt.
    fn catch_up(&mut self, late_s: u32, late: &[usize], ahead: Option<(usize, i64)>) {
        for number in 0..10 * i64::from(late_s) {
            let due = self.steps();
            let first = due - 100 * i64::from(late_s) + number * ROWS as i64;
            for half in 0..2 {
                let steps = first + half * ROWS as i64;
                let late = late.iter().map(|node| (*node, steps, 0));
                let ahead = ahead.iter().map(|(node, off_s)| (*node, due, *off_s));
                let blocks: Vec<_> = late.chain(ahead.filter(|_| half == 0)).collect();
                for (node, steps, off_s) in blocks {
                    self.deliver(node, steps, off_s);
                }
            }
            self.wait(BLOCK);
        }
    }

    fn deliver(&mut self, node: usize, steps: i64, off_s: i64) {
        let block = self.block(node, steps, off_s);
        for input in self.timekeeping.arrived(node, &block, self.now) {
            self.handle(input);
        }
        self.handle(AlignmentInput::Samples { node, block });
    }

    fn wrong_clocks(&self) -> Vec<Option<f64>> {
        self.timekeeping.differences_s(self.now).collect()
    }
}

const OFF_S: [i64; 8] = [3600, 600, 30, 10, -10, -30, -600, -3600];

// The block that came first determined the time, and all other nodes were late for ever.
#[test]
fn majority_is_watched_whose_block_ever_comes_first() {
    for off_s in OFF_S {
        for alone_s in [0, 1, 3] {
            let mut site = Site::new(4);
            site.run(alone_s, &[(2, off_s)]);
            site.run(12, &[(2, off_s), (0, 0), (1, 0), (3, 0)]);
            let empty = site.check(6, &[0, 1, 3], &format!("{off_s} s, alone {alone_s} s"));
            // A gap of up to 10 s is filled.
            let filled = if off_s == -10 { 1000 } else { 0 };
            assert!(
                empty <= filled,
                "{empty} empty frames, clock off by {off_s} s"
            );
            let wrong = site.wrong_clocks();
            assert!((wrong[2].unwrap() - off_s as f64).abs() < 0.2, "{wrong:?}");
            assert_eq!(wrong.iter().flatten().count(), 1, "{wrong:?}");
        }
    }
}

#[test]
fn clock_that_jumps_loses_only_its_own_samples() {
    for off_s in OFF_S {
        let mut site = Site::new(4);
        site.run(5, &[(0, 0), (1, 0), (2, 0), (3, 0)]);
        site.run(12, &[(0, 0), (1, 0), (2, off_s), (3, 0)]);
        site.check(6, &[0, 1, 3], &format!("{off_s} s"));
        let rows = site.rows();
        let is_sound = |row: &(i64, Vec<f64>)| row.1[0] == row.0 as f64;
        assert!(rows.len() >= 1480 && rows.iter().all(is_sound));
        // Its samples are used again once it is right.
        site.run(8, &[(0, 0), (1, 0), (2, 0), (3, 0)]);
        assert_eq!(site.check(5, &[0, 1, 2, 3], "right again"), 0);
        assert_eq!(site.wrong_clocks(), [None; 4]);
    }
}

// 60,000 frames without samples were published, and the other nodes were late for ever.
#[test]
fn first_node_after_a_power_cut_does_not_decide_the_time_alone() {
    for off_s in OFF_S {
        for alone_s in [0, 1, 5, 8] {
            let mut site = Site::new(3);
            site.run(10, &[(0, 0), (1, 0), (2, 0)]);
            for node in 0..3 {
                site.handle(AlignmentInput::Lost { node });
            }
            site.wait(Duration::from_secs(20));
            site.run(alone_s, &[(1, off_s)]);
            site.run(10, &[(1, off_s), (0, 0), (2, 0)]);
            let empty = site.check(5, &[0, 2], &format!("{off_s} s, alone {alone_s} s"));
            // The gap of 20 s, and the time alone, are filled.
            assert!(
                empty <= 3100,
                "{empty} empty frames, clock off by {off_s} s"
            );
        }
    }
}

// The vote is new after a restart of the service, but the recording tells the time.
#[test]
fn power_cut_of_nodes_and_service_gives_no_empty_frames() {
    for off_s in [30, 600, 3600] {
        for alone_s in [3, 9, 15] {
            let mut site = Site::new(3);
            site.run(10, &[(0, 0), (1, 0), (2, 0)]);
            let last = site.frames.last().unwrap().clone();
            let places = site.alignment.places();
            let mut again = Site::new(3);
            again.alignment = again.alignment.going_on(&last, &places);
            (again.now, again.sequences) = (site.now, site.sequences);
            again.wait(Duration::from_secs(20));
            again.run(alone_s, &[(1, off_s)]);
            again.run(10, &[(1, off_s), (0, 0), (2, 0)]);
            let empty = again.check(5, &[0, 2], &format!("{off_s} s, alone {alone_s} s"));
            assert!(
                empty <= 3600,
                "{empty} empty frames, clock off by {off_s} s"
            );
        }
    }
}

#[test]
fn frames_of_nodes_that_agree_do_not_depend_on_the_order_of_blocks() {
    let orders = [[0, 1, 2], [2, 1, 0], [1, 2, 0]];
    let of = |order: &[usize; 3]| {
        let mut site = Site::new(3);
        let nodes: Vec<_> = order.iter().map(|node| (*node, 0)).collect();
        site.run(10, &nodes);
        site.rows()
    };
    let [first, second, third] = orders.each_ref().map(of);
    assert_eq!(first, second);
    assert_eq!(first, third);
    assert_eq!(first.len(), 1000);
}

#[test]
fn without_a_majority_both_clocks_are_reported_and_frames_follow_the_first() {
    for off_s in [30, 600, 3600] {
        let mut site = Site::new(2);
        let mut reports = Vec::new();
        for _ in 0..8 {
            site.run(1, &[(0, 0), (1, off_s)]);
            reports.extend(site.timekeeping.reports(site.now));
        }
        let nodes: Vec<usize> = reports.iter().map(|report| report.node).collect();
        assert_eq!(nodes, [0, 1], "{reports:?}");
        assert!(
            reports
                .iter()
                .all(|report| report.why.contains("no majority"))
        );
        let rows = site.rows();
        assert!(rows.len() > 500 && rows.iter().all(|(steps, row)| row[0] == *steps as f64));
    }
}

// The clock that was ahead kept the vote from moving with the others. All nodes were excluded, and
// new runs began.
#[test]
fn nodes_that_catch_up_together_stay_in_one_run_beside_a_clock_that_is_ahead() {
    for off_s in [3600, 30 * 86_400] {
        let mut site = Site::new(3);
        for _ in 0..100 {
            let steps = site.steps() - 2000;
            (0..3).for_each(|node| site.deliver(node, steps, 0));
            site.wait(BLOCK);
        }
        site.catch_up(20, &[0, 1], Some((2, off_s)));
        site.run(10, &[(0, 0), (1, 0), (2, off_s)]);
        assert_eq!(site.alignment.epoch(), 1, "{off_s} s");
        assert_eq!(site.check(30, &[0, 1], &format!("{off_s} s")), 0);
    }
}

// Their time became a deadline in the future, so that frames never waited for the other nodes
// again.
#[test]
fn clocks_that_are_ahead_for_a_moment_leave_no_deadline_in_the_future() {
    for (ahead_s, off_s) in [(1, 400 * 86_400), (1, 600), (5, 400 * 86_400), (5, 600)] {
        let mut site = Site::new(3);
        site.run(10, &[(0, 0), (1, 0), (2, 0)]);
        // The first block of node 0 is dropped, and the other two move the majority.
        let steps = site.steps();
        (0..3).for_each(|node| site.deliver(node, steps, off_s));
        site.wait(Duration::from_secs(ahead_s));
        site.run(12, &[(0, 0), (1, 0), (2, 0)]);
        // One node delivers half a second later than the others.
        for _ in 0..100 {
            let steps = site.steps();
            site.deliver(0, steps, 0);
            site.deliver(1, steps, 0);
            site.deliver(2, steps - 50, 0);
            site.wait(BLOCK);
        }
        site.check(7, &[0, 1, 2], &format!("{off_s} s ahead for {ahead_s} s"));
    }
}
