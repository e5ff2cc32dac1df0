//! Recordings of every format, which the content identifies.

use spandrel_record::{ReadOptions, RecordedFile};
use std::path::Path;

/// Reads one input as a file in `folder`. Returns the reason if the file is rejected.
pub fn decode(folder: &Path, bytes: &[u8]) -> Result<(), String> {
    let path = folder.join("recording");
    std::fs::write(&path, bytes).expect("the folder can be written");
    let options = ReadOptions {
        sampling_rate_hz: Some(100.0),
        ..ReadOptions::default()
    };
    let file = RecordedFile::read(&path, &options).map_err(|error| error.to_string())?;
    assert!(file.channels().len() <= bytes.len());
    Ok(())
}
