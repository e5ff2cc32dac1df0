//! `spandrel info`: describes a recording.

use super::print;
use crate::cli::InfoArguments;
use crate::error::AppError;
use spandrel_record::{RecordedFile, RecordingSummary};

/// Reads a recording and prints its channels, time span, gaps, statistics and spectral peaks.
///
/// # Errors
/// Returns an error if the recording is not valid.
pub fn run(arguments: &InfoArguments) -> Result<(), AppError> {
    let file = RecordedFile::read(&arguments.record, &arguments.reading.options())?;
    let summary = RecordingSummary::of(&file);
    print(&if arguments.json {
        summary.json()
    } else {
        summary.to_string()
    })
}
