//! Stored data of a channel: the tail of its regular samples, and its recent residuals.

use serde::{Deserialize, Serialize};
use std::collections::VecDeque;

/// Window of the latest regular samples. Only the samples in the tail are stored, because no others
/// are needed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Window {
    size: u64,
    /// Number of regular samples so far.
    taken: u64,
    /// Sequence number and absolute normalised residual of the samples above the lower bound.
    tail: VecDeque<(u64, f64)>,
}

impl Window {
    pub(super) fn new(size: usize) -> Self {
        // The tail of a Gaussian beyond 2 contains 4.6 %. The screening limits its growth.
        Self {
            size: size as u64,
            taken: 0,
            tail: VecDeque::with_capacity(size / 8 + 64),
        }
    }

    /// Returns `N[R]`, the number of samples in the window.
    pub(super) fn len(&self) -> usize {
        self.taken.min(self.size) as usize
    }

    /// Returns `κ`, the number of stored samples with a residual of at least `epsilon`.
    ///
    /// It is correct only for `epsilon` above the lower bound.
    pub(super) fn at_least(&self, epsilon: f64) -> usize {
        self.tail
            .iter()
            .filter(|(_, value)| *value >= epsilon)
            .count()
    }

    /// Adds a regular sample and removes the samples that leave the window, (4.28).
    pub(super) fn push(&mut self, epsilon: f64, lower: f64) {
        if epsilon > lower {
            self.tail.push_back((self.taken, epsilon));
        }
        self.taken += 1;
        while self
            .tail
            .front()
            .is_some_and(|(number, _)| number + self.size < self.taken)
        {
            self.tail.pop_front();
        }
    }

    pub(super) fn clear(&mut self) {
        self.taken = 0;
        self.tail.clear();
    }
}

/// The latest absolute residuals, with a mark on the rejected ones.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Recent {
    size: usize,
    taken: u64,
    rejected: usize,
    ring: VecDeque<(f64, bool)>,
}

impl Recent {
    pub(super) fn new(size: usize) -> Self {
        Self {
            size,
            taken: 0,
            rejected: 0,
            ring: VecDeque::with_capacity(size),
        }
    }

    /// Returns the number of samples since the last clearing.
    pub(super) fn taken(&self) -> u64 {
        self.taken
    }

    pub(super) fn push(&mut self, residual: f64, rejected: bool) {
        if self.ring.len() == self.size
            && let Some((_, was_rejected)) = self.ring.pop_front()
        {
            self.rejected -= usize::from(was_rejected);
        }
        self.ring.push_back((residual, rejected));
        self.rejected += usize::from(rejected);
        self.taken += 1;
    }

    pub(super) fn is_full(&self) -> bool {
        self.ring.len() == self.size
    }

    /// Returns `true` if the number of samples is a multiple of `window`.
    pub(super) fn is_due(&self, window: usize) -> bool {
        self.taken.is_multiple_of(window as u64)
    }

    pub(super) fn rejected_share(&self) -> f64 {
        self.rejected as f64 / self.ring.len().max(1) as f64
    }

    /// Returns the largest residual, or 0 if none are stored.
    pub(super) fn largest(&self) -> f64 {
        self.ring
            .iter()
            .fold(0.0, |largest, (residual, _)| residual.max(largest))
    }

    /// Returns the residual that the given share of the latest `count` residuals does not exceed,
    /// or 0 if none are stored.
    pub(super) fn percentile(&self, share: f64, count: usize, sorted: &mut Vec<f64>) -> f64 {
        sorted.clear();
        sorted.extend(
            self.ring
                .iter()
                .rev()
                .take(count)
                .map(|(residual, _)| *residual),
        );
        if sorted.is_empty() {
            return 0.0;
        }
        let rank = (share * sorted.len() as f64).ceil() as usize;
        let at = rank.saturating_sub(1).min(sorted.len() - 1);
        *sorted.select_nth_unstable_by(at, f64::total_cmp).1
    }

    /// Clears the marks on rejected residuals.
    pub(super) fn forgive(&mut self) {
        self.ring
            .iter_mut()
            .for_each(|(_, rejected)| *rejected = false);
        self.rejected = 0;
    }

    pub(super) fn clear(&mut self) {
        self.taken = 0;
        self.rejected = 0;
        self.ring.clear();
    }
}
