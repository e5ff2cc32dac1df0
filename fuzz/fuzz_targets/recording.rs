//! Fuzzes the readers of recordings.

#![no_main]

#[path = "../decoders/folder.rs"]
mod folder;
#[path = "../decoders/recording.rs"]
mod recording;

use std::path::PathBuf;
use std::sync::LazyLock;

static FOLDER: LazyLock<PathBuf> = LazyLock::new(folder::folder);

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    assert_ne!(recording::decode(&FOLDER, bytes), Err(String::new()), "a reason");
});
