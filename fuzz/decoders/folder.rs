//! The folder of a fuzzing process.

use std::path::PathBuf;

/// Returns a new folder of this process, in memory if the system has such a place.
pub fn folder() -> PathBuf {
    let shared = PathBuf::from("/dev/shm");
    let parent = if shared.is_dir() { shared } else { std::env::temp_dir() };
    let folder = parent.join(format!("spandrel-fuzz-{}", std::process::id()));
    std::fs::create_dir_all(&folder).expect("the folder of temporary files can be written");
    folder
}
