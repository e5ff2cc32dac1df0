//! Recordings of every format, told by their content.

#![no_main]

use libfuzzer_sys::fuzz_target;
use spandrel_record::{ReadOptions, RecordedFile};
use std::path::PathBuf;
use std::sync::LazyLock;

/// A file of this process, in memory where the system has such a folder.
static FILE: LazyLock<PathBuf> = LazyLock::new(|| {
    let shared = PathBuf::from("/dev/shm");
    let folder = if shared.is_dir() { shared } else { std::env::temp_dir() };
    folder.join(format!("spandrel-fuzz-{}", std::process::id()))
});

fuzz_target!(|bytes: &[u8]| {
    std::fs::write(&*FILE, bytes).expect("the folder of temporary files can be written");
    let options = ReadOptions { sampling_rate_hz: Some(100.0), ..ReadOptions::default() };
    match RecordedFile::read(&FILE, &options) {
        Ok(file) => assert!(file.channels().len() <= bytes.len()),
        Err(error) => assert!(!error.to_string().is_empty()),
    }
});
