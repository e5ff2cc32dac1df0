//! A run of a case: its seed, its length, its records and its progress.

use crate::error::ValidateError;
use spandrel_earthquake::{Coverage, EventJudgement};
use spandrel_structure::Structure;
use std::path::PathBuf;
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

/// Records of real structures.
#[derive(Debug, Clone)]
pub struct Records {
    /// Folder with one folder per structure.
    pub folder: PathBuf,
    /// Judges recordings of earthquakes by the steps of `spandrel earthquake`.
    pub judge_earthquakes: JudgeEarthquakes,
}

/// Judges recordings of a structure, which are in the order of time.
///
/// Returns the stiffnesses of each recording, the whole structure first, or an error in words.
pub type JudgeEarthquakes = fn(&Structure, &[PathBuf]) -> Result<Vec<Vec<JudgedStiffness>>, String>;

/// One stiffness after an earthquake.
#[derive(Debug, Clone)]
pub struct JudgedStiffness {
    /// What the earthquake and the earlier ones show.
    pub judgement: EventJudgement,
    /// How often an earthquake lies in the interval that all others predict, among all so far.
    pub coverage: Coverage,
}

/// One run of a case.
pub struct Run<'a> {
    /// Seed of all random numbers.
    pub seed: u64,
    /// Simulated length.
    pub length: Length,
    /// Records of real structures.
    pub(crate) records: Option<&'a Records>,
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

    /// Returns the records of real structures.
    ///
    /// # Errors
    /// Returns an error if the plan has no records.
    pub(crate) fn records(&self) -> Result<&Records, ValidateError> {
        self.records.ok_or(ValidateError::NoRecords)
    }

    /// Reports this share of the case (0 to 1) as done. Returns `true` if the run should continue.
    pub fn advance(&self, share: f64) -> bool {
        (self.advanced)(share.clamp(0.0, 1.0));
        !self.stopped.load(Ordering::Relaxed)
    }
}
