//! Cuts the rows of a structure into the sample blocks of its nodes: no clock, no network.

use spandrel_bus::{Block, Header, Name, NameError, Pace, SampleBlock, StreamState, TimeGrid};
use spandrel_structure::Structure;

/// A sample may be this share of a step away from the even spacing of its block, else a new block starts.
///
/// Times written with few digits are not evenly spaced to the nanosecond; a block gives them back evenly. A hundredth of a
/// step is ten times what the clock of a sensor is good for, and moves no sample to another frame that was not on the edge.
const UNEVEN_SHARE: f64 = 0.01;

/// One node as the cutter sees it.
#[derive(Clone, Debug, PartialEq)]
pub struct NodePlan {
    /// Its name.
    pub name: Name,
    /// Its channels.
    pub channels: u16,
    /// Its sampling rate, Hz.
    pub sampling_rate_hz: f64,
    /// Whether it is slower than the rows: rows without a sample of it are then no missing samples.
    pub pace: NodePace,
    /// How far its clock is ahead at the first row, ns.
    pub clock_offset_ns: i64,
    /// How much faster it runs, parts per million.
    pub clock_drift_ppm: f64,
}

/// How a node is sampled, compared with the rows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NodePace {
    /// Each row has a sample of the node, maybe with missing values.
    EveryRow,
    /// Rows in between have none.
    Slower,
}

impl NodePlan {
    /// The nodes of a structure, with the clocks of its simulation or with right ones.
    ///
    /// # Errors
    /// A node's name is no chunk of a key expression.
    pub fn of(structure: &Structure, clocks: Clocks) -> Result<Vec<Self>, NameError> {
        let simulated = |all: &[f64], index: usize| match clocks {
            Clocks::Right => 0.0,
            Clocks::AsSimulated => all.get(index).copied().unwrap_or(0.0),
        };
        let simulation = structure.simulation();
        let nodes = structure.nodes().iter().enumerate().map(|(index, node)| {
            Ok(Self {
                name: Name::new(node.name())?,
                channels: node.channels().len() as u16, // a structure has far fewer
                sampling_rate_hz: node
                    .sampling_rate_hz()
                    .unwrap_or(structure.sampling_rate_hz()),
                pace: node
                    .sampling_rate_hz()
                    .map_or(NodePace::EveryRow, |_| NodePace::Slower),
                clock_offset_ns: (simulated(simulation.clock_offsets_s(), index) * 1e9).round()
                    as i64,
                clock_drift_ppm: simulated(simulation.clock_drifts_ppm(), index),
            })
        });
        nodes.collect()
    }

    /// Returns how far its clock is ahead so long after the first row, ns.
    #[must_use]
    pub fn clock_ahead_ns(&self, elapsed_ns: i64) -> i64 {
        let drifted_ns = (elapsed_ns as f64 * self.clock_drift_ppm * 1e-6).round() as i64;
        self.clock_offset_ns.saturating_add(drifted_ns)
    }
}

/// Whose clocks are right.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Clocks {
    /// All: the times of a record are what was measured.
    Right,
    /// Off by what the structure file says of its simulation.
    AsSimulated,
}

/// Cuts rows into blocks, one open block per node.
///
/// A block is given out when the next sample comes, so that the end of a node travels with its last samples.
#[derive(Debug)]
pub struct Cutter {
    nodes: Vec<NodePlan>,
    open: Vec<SampleBlock>,
    /// Most samples of a block, per node.
    block_samples: Vec<u64>,
    /// Time of the first row, ns.
    first_ns: Option<i64>,
    /// Frames that are made already, and the number of the first that is not.
    resume: Option<(TimeGrid, u64)>,
}

impl Cutter {
    /// A cutter whose blocks have at most `block_samples` samples of the fastest node, and of the others what they take in
    /// that time: a frame waits for all its nodes.
    #[must_use]
    pub fn new(nodes: Vec<NodePlan>, epoch: u64, block_samples: u64) -> Self {
        let open = nodes.iter().map(|node| SampleBlock {
            header: Header {
                source: node.name.to_string(),
                epoch,
                sequence: 0,
                time_ns: 0,
            },
            sampling_rate_hz: node.sampling_rate_hz,
            pace: Pace::Replayed,
            channels: node.channels,
            samples: Vec::new(),
            state: StreamState::Running,
        });
        let fastest_hz = nodes
            .iter()
            .map(|node| node.sampling_rate_hz)
            .fold(0.0, f64::max);
        let of_node = |node: &NodePlan| {
            ((block_samples as f64 * node.sampling_rate_hz / fastest_hz) as u64).max(1)
        };
        let block_samples = nodes.iter().map(of_node).collect();
        Self {
            open: open.collect(),
            nodes,
            block_samples,
            first_ns: None,
            resume: None,
        }
    }

    /// Makes the blocks say this of their samples, in place of [`Pace::Replayed`].
    #[must_use]
    pub fn with_pace(mut self, pace: Pace) -> Self {
        self.open.iter_mut().for_each(|block| block.pace = pace);
        self
    }

    /// Leaves out the samples of frames before number `next`, which ingest has made of what an earlier life of the nodes put.
    #[must_use]
    pub fn resuming(mut self, frames: TimeGrid, next: u64) -> Self {
        self.resume = Some((frames, next));
        self
    }

    /// The nodes.
    #[must_use]
    pub fn nodes(&self) -> &[NodePlan] {
        &self.nodes
    }

    /// Takes the next row; blocks that are complete are appended to `blocks`, each with the place of its node.
    ///
    /// Channels that the row lacks are missing.
    pub fn push(&mut self, time_ns: i64, values: &[f64], blocks: &mut Vec<(usize, SampleBlock)>) {
        let elapsed_ns = time_ns.saturating_sub(*self.first_ns.get_or_insert(time_ns));
        let mut values = values.iter().copied().chain(std::iter::repeat(f64::NAN));
        let nodes = self
            .nodes
            .iter()
            .zip(&mut self.open)
            .zip(&self.block_samples);
        for (index, ((node, open), block_samples)) in nodes.enumerate() {
            let sample: Vec<f64> = values.by_ref().take(usize::from(node.channels)).collect();
            if node.pace == NodePace::Slower && sample.iter().all(|value| value.is_nan()) {
                continue;
            }
            let time_ns = time_ns.saturating_add(node.clock_ahead_ns(elapsed_ns));
            if self
                .resume
                .is_some_and(|(frames, next)| frames.nearest(time_ns) < next as i64)
            {
                continue;
            }
            let full = open.count() >= *block_samples;
            if open.count() > 0 && (full || !continues(open, time_ns)) {
                let next = empty_after(open);
                blocks.push((index, std::mem::replace(open, next)));
            }
            if open.samples.is_empty() {
                open.header.time_ns = time_ns;
            }
            open.samples.extend(sample);
        }
    }

    /// Ends all nodes; their last blocks are appended to `blocks`.
    pub fn end(&mut self, blocks: &mut Vec<(usize, SampleBlock)>) {
        for (index, open) in self.open.iter_mut().enumerate() {
            let next = empty_after(open);
            let mut last = std::mem::replace(open, next);
            last.state = StreamState::Ended;
            blocks.push((index, last));
        }
    }
}

/// Whether a sample of this time is the next of an evenly spaced block.
fn continues(block: &SampleBlock, time_ns: i64) -> bool {
    let Some(grid) = TimeGrid::new(block.header.time_ns, block.sampling_rate_hz) else {
        return false;
    };
    let away = grid.time_ns(block.count()).abs_diff(time_ns);
    away as f64 <= UNEVEN_SHARE * grid.step_ns() as f64
}

fn empty_after(block: &SampleBlock) -> SampleBlock {
    let mut next = block.clone();
    next.skip(block.count());
    next
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP: i64 = 5_000_000;

    fn node(name: &str, channels: u16) -> NodePlan {
        NodePlan {
            name: Name::new(name).unwrap(),
            channels,
            sampling_rate_hz: 200.0,
            pace: NodePace::EveryRow,
            clock_offset_ns: 0,
            clock_drift_ppm: 0.0,
        }
    }

    fn cut(
        nodes: Vec<NodePlan>,
        block_samples: u64,
        rows: &[(i64, Vec<f64>)],
    ) -> Vec<(usize, SampleBlock)> {
        let mut cutter = Cutter::new(nodes, 1, block_samples);
        let mut blocks = Vec::new();
        for (time_ns, values) in rows {
            cutter.push(*time_ns, values, &mut blocks);
        }
        cutter.end(&mut blocks);
        blocks
    }

    fn of_node(blocks: &[(usize, SampleBlock)], node: usize) -> Vec<&SampleBlock> {
        blocks
            .iter()
            .filter(|(index, _)| *index == node)
            .map(|(_, block)| block)
            .collect()
    }

    #[test]
    fn each_node_gets_its_channels() {
        let rows = [(0, vec![1.0, 2.0, 3.0]), (STEP, vec![4.0, 5.0, 6.0])];
        let blocks = cut(vec![node("a", 2), node("b", 1)], 10, &rows);
        assert_eq!(of_node(&blocks, 0)[0].samples, [1.0, 2.0, 4.0, 5.0]);
        assert_eq!(of_node(&blocks, 1)[0].samples, [3.0, 6.0]);
    }

    #[test]
    fn blocks_follow_each_other_and_the_last_one_ends() {
        let rows: Vec<_> = (0..6).map(|n| (n * STEP, vec![n as f64])).collect();
        let blocks = cut(vec![node("a", 1)], 3, &rows);
        let heads: Vec<_> = blocks
            .iter()
            .map(|(_, b)| (b.header.sequence, b.header.time_ns, b.state))
            .collect();
        assert_eq!(
            heads,
            [
                (0, 0, StreamState::Running),
                (3, 3 * STEP, StreamState::Ended)
            ]
        );
    }

    #[test]
    fn a_gap_in_time_starts_a_new_block() {
        let rows = [(0, vec![1.0]), (STEP, vec![2.0]), (5 * STEP, vec![3.0])];
        let blocks = cut(vec![node("a", 1)], 10, &rows);
        let heads: Vec<_> = blocks
            .iter()
            .map(|(_, b)| (b.header.sequence, b.header.time_ns))
            .collect();
        assert_eq!(heads, [(0, 0), (2, 5 * STEP)]);
    }

    #[test]
    fn times_with_few_digits_do_not_tear_blocks_apart() {
        let rows: Vec<_> = (0..100)
            .map(|n: i64| ((n * 25_000_000 / 3) / 10_000 * 10_000, vec![0.0]))
            .collect();
        let plan = NodePlan {
            sampling_rate_hz: 120.0,
            ..node("a", 1)
        };
        assert_eq!(cut(vec![plan], 1000, &rows).len(), 1);
    }

    #[test]
    fn a_slower_node_has_no_samples_in_between() {
        let plan = NodePlan {
            sampling_rate_hz: 100.0,
            pace: NodePace::Slower,
            ..node("a", 1)
        };
        let rows: Vec<_> = (0..4)
            .map(|n| (n * STEP, vec![if n % 2 == 0 { n as f64 } else { f64::NAN }]))
            .collect();
        let blocks = cut(vec![plan], 10, &rows);
        assert_eq!(blocks.len(), 1);
        assert_eq!(blocks[0].1.samples, [0.0, 2.0]);
    }

    #[test]
    fn blocks_of_a_slower_node_last_as_long_as_those_of_the_fastest() {
        let slow = NodePlan {
            sampling_rate_hz: 20.0,
            pace: NodePace::Slower,
            ..node("b", 1)
        };
        let rows: Vec<_> = (0..100)
            .map(|n| {
                (
                    n * STEP,
                    vec![0.0, if n % 10 == 0 { 1.0 } else { f64::NAN }],
                )
            })
            .collect();
        let blocks = cut(vec![node("a", 1), slow], 40, &rows);
        let counts = |node| {
            of_node(&blocks, node)
                .iter()
                .map(|block| block.count())
                .collect::<Vec<_>>()
        };
        assert_eq!((counts(0), counts(1)), (vec![40, 40, 20], vec![4, 4, 2]));
    }

    #[test]
    fn a_clock_that_is_ahead_shifts_the_times_of_its_node_only() {
        let ahead = NodePlan {
            clock_offset_ns: 7,
            ..node("b", 1)
        };
        let blocks = cut(vec![node("a", 1), ahead], 10, &[(100, vec![1.0, 2.0])]);
        assert_eq!(
            (blocks[0].1.header.time_ns, blocks[1].1.header.time_ns),
            (100, 107)
        );
    }

    #[test]
    fn a_clock_that_runs_fast_moves_the_blocks_of_its_node_further_and_further() {
        let fast = NodePlan {
            clock_offset_ns: 7,
            clock_drift_ppm: 50.0,
            ..node("b", 1)
        };
        let rows: Vec<_> = (0..40).map(|n| (1000 + n * STEP, vec![0.0, 0.0])).collect();
        let blocks = cut(vec![node("a", 1), fast], 20, &rows);
        let times = |node| {
            of_node(&blocks, node)
                .iter()
                .map(|block| block.header.time_ns)
                .collect::<Vec<_>>()
        };
        // 20 samples of 5 ms are 100 ms, of which 50 ppm are 5 µs
        assert_eq!(
            (times(0), times(1)),
            (vec![1000, 100_001_000], vec![1007, 100_006_007])
        );
    }

    #[test]
    fn what_is_in_frames_already_is_left_out_node_by_node() {
        let ahead = NodePlan {
            clock_offset_ns: STEP,
            ..node("b", 1)
        };
        let mut cutter = Cutter::new(vec![node("a", 1), ahead], 2, 10)
            .resuming(TimeGrid::new(0, 200.0).unwrap(), 3);
        let mut blocks = Vec::new();
        (0..6).for_each(|n| cutter.push(n * STEP, &[n as f64, n as f64], &mut blocks));
        cutter.end(&mut blocks);
        let heads: Vec<_> = blocks
            .iter()
            .map(|(node, b)| (*node, b.header.sequence, b.header.time_ns))
            .collect();
        assert_eq!(heads, [(0, 0, 3 * STEP), (1, 0, 3 * STEP)]);
        assert_eq!(
            (&*blocks[0].1.samples, &*blocks[1].1.samples),
            (&[3.0, 4.0, 5.0][..], &[2.0, 3.0, 4.0, 5.0][..])
        );
    }

    #[test]
    fn nodes_end_even_without_samples() {
        let blocks = cut(vec![node("a", 1)], 10, &[]);
        assert_eq!(
            (blocks[0].1.count(), blocks[0].1.state),
            (0, StreamState::Ended)
        );
    }
}
