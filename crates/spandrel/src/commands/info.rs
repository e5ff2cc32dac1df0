//! `spandrel info`: what a recording holds.

use super::print;
use crate::cli::InfoArguments;
use crate::error::AppError;
use spandrel_record::{RecordedFile, RecordingSummary};

/// Reads a recording and prints its channels, span, gaps, statistics and the peaks of their spectra.
///
/// # Errors
/// When the recording is wrong.
pub fn run(arguments: &InfoArguments) -> Result<(), AppError> {
    let file = RecordedFile::read(&arguments.record, &arguments.reading.options())?;
    let summary = RecordingSummary::of(&file);
    print(&if arguments.json {
        summary.json()
    } else {
        summary.to_string()
    })
}
