//! What a channel remembers: the tail of its regular samples, and its recent residuals.

use serde::{Deserialize, Serialize};
use std::collections::VecDeque;

/// The latest regular samples, of which only those in the tail are kept: no other is ever asked for.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Window {
    size: u64,
    /// regular samples so far
    taken: u64,
    /// number and absolute normalised residual of those above the lower bound
    tail: VecDeque<(u64, f64)>,
}

impl Window {
    pub(super) fn new(size: usize) -> Self {
        // the tail of a Gaussian beyond 2 holds 4.6 %; the screening keeps it from growing
        Self {
            size: size as u64,
            taken: 0,
            tail: VecDeque::with_capacity(size / 8 + 64),
        }
    }

    /// `N[R]`.
    pub(super) fn len(&self) -> usize {
        self.taken.min(self.size) as usize
    }

    /// `κ`: remembered samples at least as far out; right for values above the lower bound only.
    pub(super) fn at_least(&self, epsilon: f64) -> usize {
        self.tail
            .iter()
            .filter(|(_, value)| *value >= epsilon)
            .count()
    }

    /// Takes a regular sample and forgets the one that leaves the window, (4.28).
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

/// The latest absolute residuals, and which of them were rejected.
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

    /// Samples taken since the last clearing.
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

    /// Says whether a whole window has passed since a multiple of it.
    pub(super) fn is_due(&self, window: usize) -> bool {
        self.taken.is_multiple_of(window as u64)
    }

    pub(super) fn rejected_share(&self) -> f64 {
        self.rejected as f64 / self.ring.len().max(1) as f64
    }

    /// The residual that this share of the remembered ones does not exceed; 0 without any.
    pub(super) fn percentile(&self, share: f64, sorted: &mut Vec<f64>) -> f64 {
        sorted.clear();
        sorted.extend(self.ring.iter().map(|(residual, _)| *residual));
        if sorted.is_empty() {
            return 0.0;
        }
        let rank = (share * sorted.len() as f64).ceil() as usize;
        let at = rank.saturating_sub(1).min(sorted.len() - 1);
        *sorted.select_nth_unstable_by(at, f64::total_cmp).1
    }

    /// Forgets what was rejected.
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
