//! A disk that is soon full.

use std::path::{Path, PathBuf};
use std::process::Command;

/// A small file system of its own on a folder, until it is dropped.
pub struct SmallDisk(PathBuf);

impl SmallDisk {
    /// Mounts one of this size, such as `2m`. Without the right to do so the test says that it was skipped.
    pub fn or_skip(folder: &Path, size: &str) -> Option<Self> {
        let options = format!("size={size}");
        let mounted = Command::new("mount")
            .args(["-t", "tmpfs", "-o", &options, "tmpfs"])
            .arg(folder)
            .output();
        if mounted.is_ok_and(|output| output.status.success()) {
            return Some(Self(folder.to_owned()));
        }
        let why = "skipped: a small disk cannot be mounted here";
        assert!(std::env::var_os("REQUIRE_ALL_TESTS").is_none(), "{why}");
        println!("{why}");
        None
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        // it goes with the machine at the latest
        let _ = Command::new("umount").arg("-l").arg(&self.0).status();
    }
}
