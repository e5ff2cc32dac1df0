//! How a case is run: its seed, its length, and how far it has come.

use std::sync::atomic::{AtomicBool, Ordering};

/// How much of the published records is simulated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Length {
    /// All of them.
    Full,
    /// Shortened ones, with figures that hold for them.
    Quick,
}

/// One run of a case.
pub struct Run<'a> {
    /// Seed of all that is random.
    pub seed: u64,
    /// How much is simulated.
    pub length: Length,
    pub(crate) advanced: &'a (dyn Fn(f64) + Sync),
    pub(crate) stopped: &'a AtomicBool,
}

impl Run<'_> {
    /// Returns `full` or `quick`.
    pub fn pick<T>(&self, full: T, quick: T) -> T {
        match self.length {
            Length::Full => full,
            Length::Quick => quick,
        }
    }

    /// Tells that this share of the case (0 to 1) is done, and says whether it should go on.
    pub fn advance(&self, share: f64) -> bool {
        (self.advanced)(share.clamp(0.0, 1.0));
        !self.stopped.load(Ordering::Relaxed)
    }
}
