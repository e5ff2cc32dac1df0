//! Cuts the rows of a structure into the sample blocks of its nodes, without a clock or network.

use spandrel_bus::{Block, Header, Name, NameError, Pace, SampleBlock, StreamState, TimeGrid};
use spandrel_structure::Structure;

/// Maximum deviation of a sample from the even spacing of its block, as a fraction of the time
/// step. A larger deviation starts a new block.
///
/// Times written with few digits are not evenly spaced to the nanosecond, but the samples of a
/// block are. A hundredth of a step is ten times the precision of a sensor clock. It moves a sample
/// to another frame only if the sample lies on the edge between two frames.
const UNEVEN_SHARE: f64 = 0.01;

/// A node, as the [`Cutter`] requires it.
#[derive(Clone, Debug, PartialEq)]
pub struct NodePlan {
    /// Name of the node.
    pub name: Name,
    /// Number of channels.
    pub channels: u16,
    /// Sampling rate, Hz.
    pub sampling_rate_hz: f64,
    /// Sampling of the node in relation to the rows. If the node is slower, a row without its
    /// values is not a missing sample.
    pub pace: NodePace,
    /// Clock offset at the first row, ns; positive if the clock is ahead.
    pub clock_offset_ns: i64,
    /// Clock drift, parts per million; positive if the clock runs fast.
    pub clock_drift_ppm: f64,
}

/// The sampling rate of a node in relation to the rows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NodePace {
    /// Each row has a sample of the node, possibly with missing values.
    EveryRow,
    /// Some rows have no sample of the node.
    Slower,
}

impl NodePlan {
    /// Returns the nodes of a structure, with either simulated clock errors or exact clocks.
    ///
    /// # Errors
    /// Returns an error if the name of a node is not a valid chunk of a key expression.
    pub fn of(structure: &Structure, clocks: Clocks) -> Result<Vec<Self>, NameError> {
        let simulated = |all: &[f64], index: usize| match clocks {
            Clocks::Right => 0.0,
            Clocks::AsSimulated => all.get(index).copied().unwrap_or(0.0),
        };
        let simulation = structure.simulation();
        let nodes = structure.nodes().iter().enumerate().map(|(index, node)| {
            Ok(Self {
                name: Name::new(node.name())?,
                // A structure has far fewer channels than `u16::MAX`.
                channels: node.channels().len() as u16,
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

    /// Returns how far the node's clock is ahead (ns), `elapsed_ns` (ns) after the first row.
    #[must_use]
    pub fn clock_ahead_ns(&self, elapsed_ns: i64) -> i64 {
        let drifted_ns = (elapsed_ns as f64 * self.clock_drift_ppm * 1e-6).round() as i64;
        self.clock_offset_ns.saturating_add(drifted_ns)
    }
}

/// The clock errors of the nodes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Clocks {
    /// No errors: the times of a record are the measured times.
    Right,
    /// The offsets and drifts in the simulation section of the structure file.
    AsSimulated,
}

/// Cuts rows into blocks. Each node has one open block.
///
/// A complete block is returned only when the next sample arrives. The end of a stream therefore
/// travels with the last samples of the node.
#[derive(Debug)]
pub struct Cutter {
    nodes: Vec<NodePlan>,
    open: Vec<SampleBlock>,
    /// Maximum number of samples per block, for each node.
    block_samples: Vec<u64>,
    /// Time of the first row, ns.
    first_ns: Option<i64>,
    /// The frame grid and the sequence number of the first frame that does not exist yet.
    resume: Option<(TimeGrid, u64)>,
}

impl Cutter {
    /// Creates a cutter whose blocks have at most `block_samples` samples of the fastest node.
    ///
    /// Blocks of slower nodes cover the same time, because a frame waits for all its nodes.
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
            clock_quality: None,
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

    /// Sets the pace of the blocks, which is [`Pace::Replayed`] by default.
    #[must_use]
    pub fn with_pace(mut self, pace: Pace) -> Self {
        self.open.iter_mut().for_each(|block| block.pace = pace);
        self
    }

    /// Skips all samples whose nearest frame in the grid `frames` has a number below `next`. Ingest
    /// has already built these frames from the samples of an earlier run of the nodes.
    #[must_use]
    pub fn resuming(mut self, frames: TimeGrid, next: u64) -> Self {
        self.resume = Some((frames, next));
        self
    }

    /// Returns the nodes.
    #[must_use]
    pub fn nodes(&self) -> &[NodePlan] {
        &self.nodes
    }

    /// Adds the next row, and appends complete blocks to `blocks`, each with the index of its node.
    ///
    /// If `values` is shorter than a row, the remaining channels count as missing.
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

    /// Ends all nodes, and appends their last blocks to `blocks`.
    pub fn end(&mut self, blocks: &mut Vec<(usize, SampleBlock)>) {
        for (index, open) in self.open.iter_mut().enumerate() {
            let next = empty_after(open);
            let mut last = std::mem::replace(open, next);
            last.state = StreamState::Ended;
            blocks.push((index, last));
        }
    }
}

/// Returns `true` if a sample at `time_ns` continues the evenly spaced block.
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
    fn each_node_receives_its_channels() {
        let rows = [(0, vec![1.0, 2.0, 3.0]), (STEP, vec![4.0, 5.0, 6.0])];
        let blocks = cut(vec![node("a", 2), node("b", 1)], 10, &rows);
        assert_eq!(of_node(&blocks, 0)[0].samples, [1.0, 2.0, 4.0, 5.0]);
        assert_eq!(of_node(&blocks, 1)[0].samples, [3.0, 6.0]);
    }

    #[test]
    fn blocks_are_consecutive_and_the_last_one_ends_the_stream() {
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
    fn rounded_times_do_not_split_blocks() {
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
    fn clock_offset_shifts_only_the_times_of_its_node() {
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
    fn clock_drift_accumulates_in_the_block_times_of_its_node() {
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
        // 20 samples of 5 ms take 100 ms, so a drift of 50 ppm adds 5 µs.
        assert_eq!(
            (times(0), times(1)),
            (vec![1000, 100_001_000], vec![1007, 100_006_007])
        );
    }

    #[test]
    fn samples_already_in_frames_are_omitted_per_node() {
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
