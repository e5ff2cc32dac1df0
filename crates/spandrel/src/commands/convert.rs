//! `spandrel convert`: converts a recording to another format, and to another rate on request.

use super::{counted, in_place_of, print, refuse_overwriting};
use crate::cli::ConvertArguments;
use crate::error::AppError;
use spandrel_record::{OutputFormat, RecordedFile};

/// Reads a recording and writes it as CSV or MCAP, in SI units if its units are known.
///
/// # Errors
/// Returns an error if the recording is not valid or cannot be written in that format.
pub fn run(arguments: &ConvertArguments) -> Result<(), AppError> {
    refuse_overwriting(&arguments.output, [arguments.record.as_path()])?;
    OutputFormat::of(&arguments.output)?;
    let file = RecordedFile::read(&arguments.record, &arguments.reading.options())?;
    let file = match arguments.resample {
        Some(rate_hz) => file.resampled(rate_hz)?,
        None => file,
    };
    let replacing = in_place_of(&arguments.output);
    file.write(&arguments.output)?;
    let channels = counted(file.channels().len(), "channel", "channels");
    let mut text = format!(
        "{}: {channels} of {}{replacing}\n",
        arguments.output.display(),
        arguments.record.display()
    );
    file.remarks()
        .iter()
        .for_each(|remark| text += &format!("  {remark}\n"));
    print(&text)
}
