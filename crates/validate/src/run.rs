//! A run of a case: its seed, its length, its records and its progress.

use crate::error::ValidateError;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

/// Simulated length of the published records.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Length {
    /// Complete records.
    Full,
    /// Shortened records, with requirements that apply to them.
    Quick,
}

/// One run of a case.
pub struct Run<'a> {
    /// Seed of all random numbers.
    pub seed: u64,
    /// Simulated length.
    pub length: Length,
    /// Folder with the records of real structures.
    pub(crate) records: Option<&'a Path>,
    pub(crate) advanced: &'a (dyn Fn(f64) + Sync),
    pub(crate) stopped: &'a AtomicBool,
}

impl Run<'_> {
    /// Returns `full` or `quick`, depending on the length of the run.
    pub fn pick<T>(&self, full: T, quick: T) -> T {
        match self.length {
            Length::Full => full,
            Length::Quick => quick,
        }
    }

    /// Returns the folder with the records of real structures.
    ///
    /// # Errors
    /// Returns an error if the plan has no records.
    pub(crate) fn records(&self) -> Result<&Path, ValidateError> {
        self.records.ok_or(ValidateError::NoRecords)
    }

    /// Reports this share of the case (0 to 1) as done. Returns `true` if the run should continue.
    pub fn advance(&self, share: f64) -> bool {
        (self.advanced)(share.clamp(0.0, 1.0));
        !self.stopped.load(Ordering::Relaxed)
    }
}
