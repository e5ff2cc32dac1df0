//! Stored outcomes, which let a stopped run resume and a partial report show the other cases.

use crate::cases::Case;
use crate::error::ValidateError;
use crate::outcome::Outcome;
use crate::run::Length;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// A finished run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Done {
    /// Mark of the program that made the outcome.
    mark: String,
    /// Version of that program.
    pub(crate) version: String,
    /// Elapsed time of the run (s), including the effect of concurrent runs.
    pub(crate) seconds: f64,
    pub(crate) outcome: Outcome,
}

/// Directory of the stored outcomes, and mark of the program that writes them.
#[derive(Debug)]
pub(crate) struct Kept {
    directory: PathBuf,
    mark: String,
}

impl Done {
    /// Creates a finished run of this program.
    pub(crate) fn new(mark: &str, seconds: f64, outcome: Outcome) -> Self {
        Self {
            mark: mark.to_owned(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            seconds,
            outcome,
        }
    }
}

impl Kept {
    pub(crate) fn new(directory: &Path, mark: String) -> Self {
        Self {
            directory: directory.to_owned(),
            mark,
        }
    }

    pub(crate) fn mark(&self) -> &str {
        &self.mark
    }

    /// Creates the directory with a file that excludes it from version control, because outcomes
    /// contain every curve.
    pub(crate) fn prepare(&self) -> Result<(), ValidateError> {
        let path = &self.directory;
        let ignore = path.join(".gitignore");
        std::fs::create_dir_all(path)
            .and_then(|()| std::fs::write(&ignore, "*\n"))
            .map_err(|reason| ValidateError::File {
                path: path.clone(),
                reason,
            })
    }

    fn prefix(case: &Case, length: Length) -> String {
        let length = match length {
            Length::Full => "full",
            Length::Quick => "quick",
        };
        format!("{}.{length}.seed-", case.name)
    }

    fn path(&self, case: &Case, seed: u64, length: Length) -> PathBuf {
        self.directory
            .join(format!("{}{seed}.json", Self::prefix(case, length)))
    }

    fn any(&self, case: &Case, seed: u64, length: Length) -> Option<Done> {
        let text = std::fs::read_to_string(self.path(case, seed, length)).ok()?;
        // A truncated file counts as missing, and the case runs again.
        serde_json::from_str(&text).ok()
    }

    /// Returns the outcome of a run if this program made it.
    pub(crate) fn read(&self, case: &Case, seed: u64, length: Length) -> Option<Done> {
        self.any(case, seed, length)
            .filter(|done| done.mark == self.mark)
    }

    /// Returns all outcomes of a case by any program, in the order of their seeds.
    pub(crate) fn read_all(&self, case: &Case, length: Length) -> Vec<(u64, Done)> {
        let prefix = Self::prefix(case, length);
        let entries = std::fs::read_dir(&self.directory)
            .into_iter()
            .flatten()
            .flatten();
        let seed = |name: &str| {
            name.strip_prefix(&prefix)?
                .strip_suffix(".json")?
                .parse::<u64>()
                .ok()
        };
        let mut seeds: Vec<u64> = entries
            .filter_map(|entry| seed(entry.file_name().to_str()?))
            .collect();
        seeds.sort_unstable();
        seeds
            .into_iter()
            .filter_map(|seed| Some((seed, self.any(case, seed, length)?)))
            .collect()
    }

    /// Returns `true` if this program made the outcome.
    pub(crate) fn is_own(&self, done: &Done) -> bool {
        done.mark == self.mark
    }

    pub(crate) fn write(
        &self,
        case: &Case,
        seed: u64,
        length: Length,
        done: &Done,
    ) -> Result<(), ValidateError> {
        let path = self.path(case, seed, length);
        let text = serde_json::to_string(done).map_err(std::io::Error::from);
        let write = |text: String| {
            let unfinished = path.with_extension("json.part");
            std::fs::write(&unfinished, text)?;
            std::fs::rename(&unfinished, &path)
        };
        text.and_then(write).map_err(|reason| ValidateError::File {
            path: path.clone(),
            reason,
        })
    }
}
