//! Fuzzes the frame log.

#![no_main]

#[path = "../decoders/folder.rs"]
mod folder;
#[path = "../decoders/frame_log.rs"]
mod frame_log;

use std::path::PathBuf;
use std::sync::LazyLock;

static FOLDER: LazyLock<PathBuf> = LazyLock::new(folder::folder);

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    assert_ne!(frame_log::decode(&FOLDER, bytes), Err(String::new()), "a reason");
});
