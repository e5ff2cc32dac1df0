//! Output covariances of a stream, accumulated block by block.
//!
//! The memory is *B* · (2*i* − 1) · *l* · *r* numbers, independent of the length of the epoch.
//! Blocks tile the epoch: the product y(n + k) y_ref(n)ᵀ belongs to the block of sample n, even if
//! sample n + k is in the block after. No product is lost or counted twice, and no window is
//! applied. With the block of sample n + k instead, the covariances of a free decay would grow with
//! the lag, and its damping ratio would be negative.
//!
//! Source: Peeters & De Roeck (1999), Mech. Syst. Signal Process. 13, 855–878, for the covariances
//! with references; Döhler & Mevel (2013), Mech. Syst. Signal Process. 38, 346–366, for their
//! division into blocks.

use nalgebra::DMatrix;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;

/// Number of frames that are multiplied at once, so that the sums are read and written less often.
const TILE: usize = 4;

/// Sums over the samples of one block.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct BlockSums {
    /// Σ y(n + k) y_ref(n)ᵀ: for each reference, lags 1 to 2*i* − 1 with *l* channels each.
    products: Vec<f64>,
    /// Σ y(n + k), in the same order.
    later: Vec<f64>,
    /// Σ y(n) of each channel.
    outputs: Vec<f64>,
    /// Σ y(n)² of each channel.
    squares: Vec<f64>,
}

/// Accumulates covariances of decimated frames.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct CovarianceStream {
    references: Vec<usize>,
    lags: usize,
    block_length: usize,
    most_blocks: usize,
    /// Complete blocks, the oldest first, at most one epoch.
    blocks: VecDeque<BlockSums>,
    current: BlockSums,
    /// Number of frames in the current block, including the frames that wait.
    in_block: usize,
    /// The first frame that waits, and all later frames.
    history: Vec<f64>,
    /// Number of frames that have all their lags and wait for a complete tile.
    waiting: usize,
}

impl CovarianceStream {
    /// Creates an empty stream with `block_length` samples per block. At most `most_blocks` blocks
    /// are kept. `block_rows` is *i*.
    pub(crate) fn new(
        channels: usize,
        references: Vec<usize>,
        block_rows: usize,
        block_length: usize,
        most_blocks: usize,
    ) -> Self {
        let lags = 2 * block_rows - 1;
        let current = BlockSums {
            products: vec![0.0; channels * lags * references.len()],
            later: vec![0.0; lags * channels],
            outputs: vec![0.0; channels],
            squares: vec![0.0; channels],
        };
        Self {
            references,
            lags,
            block_length,
            most_blocks,
            blocks: VecDeque::new(),
            current,
            in_block: 0,
            history: Vec::new(),
            waiting: 0,
        }
    }

    /// Forgets everything.
    pub(crate) fn reset(&mut self) {
        self.blocks.clear();
        self.clear_current();
        self.history.clear();
        self.waiting = 0;
    }

    fn clear_current(&mut self) {
        let sums = &mut self.current;
        for sums in [
            &mut sums.products,
            &mut sums.later,
            &mut sums.outputs,
            &mut sums.squares,
        ] {
            sums.fill(0.0);
        }
        self.in_block = 0;
    }

    /// Adds a frame. Returns `true` if it completes a block.
    ///
    /// A frame counts once the 2*i* − 1 frames after it are known, so that every lag has the same
    /// number of products.
    pub(crate) fn push(&mut self, frame: &[f64]) -> bool {
        self.history.extend_from_slice(frame);
        if self.history.len() <= (self.lags + self.waiting) * frame.len() {
            return false;
        }
        self.waiting += 1;
        self.in_block += 1;
        let is_complete = self.in_block == self.block_length;
        if is_complete || self.waiting == TILE {
            self.multiply(frame.len());
        }
        if is_complete {
            self.complete_block();
        }
        is_complete
    }

    /// Adds the products of all waiting frames.
    fn multiply(&mut self, channels: usize) {
        let width = self.lags * channels;
        let sums = &mut self.current;
        let frames: Vec<(&[f64], &[f64])> = (0..self.waiting)
            .map(|position| {
                self.history[position * channels..][..channels + width].split_at(channels)
            })
            .collect();
        for (&reference, row) in self
            .references
            .iter()
            .zip(sums.products.chunks_exact_mut(width))
        {
            if let [(y0, h0), (y1, h1), (y2, h2), (y3, h3)] = frames[..] {
                let (y0, y1, y2, y3) = (y0[reference], y1[reference], y2[reference], y3[reference]);
                for j in 0..width {
                    row[j] += (y0 * h0[j] + y1 * h1[j]) + (y2 * h2[j] + y3 * h3[j]);
                }
            } else {
                for (y, later) in &frames {
                    for (sum, value) in row.iter_mut().zip(*later) {
                        *sum += y[reference] * value;
                    }
                }
            }
        }
        for (y, later) in &frames {
            for (sum, value) in sums.later.iter_mut().zip(*later) {
                *sum += value;
            }
            for (channel, value) in y.iter().enumerate() {
                sums.outputs[channel] += value;
                sums.squares[channel] += value * value;
            }
        }
        self.history.drain(..self.waiting * channels);
        self.waiting = 0;
    }

    fn complete_block(&mut self) {
        if self.blocks.len() == self.most_blocks {
            self.blocks.pop_front();
        }
        self.blocks.push_back(self.current.clone());
        self.clear_current();
    }

    /// Returns the covariances of the last epoch, or `None` if its blocks are not complete.
    ///
    /// `usable` states for each channel whether it takes part.
    pub(crate) fn epoch(&self, usable: &[bool]) -> Option<EpochCovariances> {
        (self.blocks.len() == self.most_blocks).then(|| self.covariances(usable))
    }

    fn covariances(&self, usable: &[bool]) -> EpochCovariances {
        let total = (self.block_length * self.blocks.len()) as f64;
        let mean: Vec<f64> = (0..usable.len())
            .map(|c| self.blocks.iter().map(|sums| sums.outputs[c]).sum::<f64>() / total)
            .collect();
        let outputs: Vec<usize> = (0..usable.len()).filter(|c| usable[*c]).collect();
        let references: Vec<usize> = (0..self.references.len())
            .filter(|position| usable[self.references[*position]])
            .collect();
        let std: Vec<f64> = outputs
            .iter()
            .map(|&c| {
                let squares: f64 = self.blocks.iter().map(|sums| sums.squares[c]).sum();
                (squares / total - mean[c] * mean[c])
                    .max(f64::MIN_POSITIVE)
                    .sqrt()
            })
            .collect();
        let blocks = self
            .blocks
            .iter()
            .map(|sums| self.block_covariances(sums, &mean, &outputs, &references))
            .collect();
        EpochCovariances {
            reference_of: references
                .iter()
                .map(|position| {
                    let channel = self.references[*position];
                    outputs.iter().filter(|other| **other < channel).count()
                })
                .collect(),
            outputs,
            std,
            blocks,
            lags: self.lags,
        }
    }

    /// Returns R_k = (Σ y y_refᵀ − (Σ y) m_refᵀ − m (Σ y_ref)ᵀ + L m m_refᵀ) / L for lags 1 to 2*i*
    /// − 1, side by side. *m* is the mean of the epoch and *L* the length of the block.
    fn block_covariances(
        &self,
        sums: &BlockSums,
        mean: &[f64],
        outputs: &[usize],
        references: &[usize],
    ) -> DMatrix<f64> {
        let width = self.lags * mean.len();
        let length = self.block_length as f64;
        DMatrix::from_fn(
            outputs.len(),
            self.lags * references.len(),
            |row, column| {
                let (channel, lag) = (outputs[row], column / references.len());
                let reference = references[column % references.len()];
                let at = lag * mean.len() + channel;
                let of_reference = self.references[reference];
                (sums.products[reference * width + at]
                    - sums.later[at] * mean[of_reference]
                    - mean[channel] * sums.outputs[of_reference]
                    + length * mean[channel] * mean[of_reference])
                    / length
            },
        )
    }
}

/// Output covariances of an epoch, one set per block.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EpochCovariances {
    /// Positions of the usable channels among all channels.
    pub(crate) outputs: Vec<usize>,
    /// Position of each usable reference among the usable channels.
    pub(crate) reference_of: Vec<usize>,
    /// Standard deviation of each usable channel, in its unit.
    pub(crate) std: Vec<f64>,
    /// R_1 … R_{2i−1} of each block side by side, each *l* × *r*.
    blocks: Vec<DMatrix<f64>>,
    lags: usize,
}

impl EpochCovariances {
    /// Returns the number of blocks.
    #[must_use]
    pub fn blocks(&self) -> usize {
        self.blocks.len()
    }

    /// Returns the standard deviation of a channel in the band of the epoch, in its unit. `None` if
    /// the channel takes no part.
    #[must_use]
    pub fn channel_std(&self, channel: usize) -> Option<f64> {
        let at = self.outputs.iter().position(|output| *output == channel)?;
        self.std.get(at).copied()
    }

    /// Returns the epoch without one of its blocks, for a jackknife.
    #[must_use]
    pub fn without_block(&self, block: usize) -> Self {
        let mut rest = self.clone();
        rest.blocks.remove(block);
        rest
    }

    /// Returns the mean of the covariances of all blocks, with channels scaled to unit variance.
    pub(crate) fn mean(&self) -> DMatrix<f64> {
        let (rows, columns) = self.blocks[0].shape();
        let mut mean = DMatrix::zeros(rows, columns);
        for block in &self.blocks {
            mean += block;
        }
        mean /= self.blocks.len() as f64;
        self.scale_mut(&mut mean);
        mean
    }

    /// Returns the difference of the covariances of one block from their `mean`.
    pub(crate) fn difference(&self, block: usize, mean: &DMatrix<f64>) -> DMatrix<f64> {
        let mut difference = self.blocks[block].clone();
        self.scale_mut(&mut difference);
        difference - mean
    }

    fn scale_mut(&self, covariances: &mut DMatrix<f64>) {
        let references = self.reference_of.len();
        for column in 0..covariances.ncols() {
            let reference = self.std[self.reference_of[column % references]];
            for row in 0..covariances.nrows() {
                covariances[(row, column)] /= self.std[row] * reference;
            }
        }
    }

    /// Returns the block Hankel matrix of covariances, *i* *l* × *i* *r*: block (a, b) is
    /// R_{a+b+1}.
    ///
    /// Its columns are those of the block Toeplitz matrix in reverse, so both have the same left
    /// singular vectors.
    pub(crate) fn hankel(&self, covariances: &DMatrix<f64>) -> DMatrix<f64> {
        let (l, r) = (self.std.len(), self.reference_of.len());
        let rows = self.lags.div_ceil(2);
        let mut hankel = DMatrix::zeros(rows * l, rows * r);
        for a in 0..rows {
            for b in 0..rows {
                let covariance = covariances.view((0, (a + b) * r), (l, r));
                hankel
                    .view_mut((a * l, b * r), (l, r))
                    .copy_from(&covariance);
            }
        }
        hankel
    }
}
