//! What makes a report from a recording.

use std::fmt;
use std::path::Path;

/// The report of a recording.
#[derive(Clone, Debug, PartialEq)]
pub struct MadeReport {
    /// The report as a page, HTML without scripts.
    pub html: String,
    /// The report as JSON, with the same numbers as the page.
    pub json: String,
    /// How soon an inspector is needed, in words.
    pub urgency: String,
    /// The result in one or two sentences.
    pub headline: String,
}

/// The list of all reports.
#[derive(Clone, Debug, PartialEq)]
pub struct ReportIndex {
    /// The report as a page, HTML without scripts.
    pub html: String,
    /// The list as JSON, with the same content as the page.
    pub json: String,
}

/// Makes the reports of one structure.
pub trait ReportMaker: fmt::Debug + Send + Sync {
    /// Begins with the first event of the structure.
    ///
    /// # Errors
    /// Returns the reason in words if the structure cannot be reported.
    fn begin(&self) -> Result<Box<dyn ReportCourse>, String>;

    /// Returns the list of the reports in a folder, with sentences about what waits.
    ///
    /// # Errors
    /// Returns the reason in words if the folder cannot be read.
    fn index(&self, folder: &Path, waiting: &[String]) -> Result<ReportIndex, String>;
}

/// Reports the recordings of one structure in chronological order.
pub trait ReportCourse: fmt::Debug + Send {
    /// Reports a recording that is later than all others. `occasion` says why it was recorded, or
    /// is empty for an earthquake. `standing` are the open alerts of the structure, in words.
    ///
    /// The recording is a CSV file with a column `time` (s since 1970-01-01 UTC) and one column per
    /// channel (SI).
    ///
    /// # Errors
    /// Returns the reason in words if the recording cannot be reported.
    fn report(
        &mut self,
        record: &Path,
        occasion: &str,
        standing: &[String],
    ) -> Result<MadeReport, String>;
}
