//! A disk that fills up quickly.

use super::skip;
use std::path::{Path, PathBuf};
use std::process::Command;

/// A small file system mounted on a folder until it is dropped.
pub struct SmallDisk(PathBuf);

impl SmallDisk {
    /// Mounts a file system of this size, such as `2m`. Skips the test without permission to mount.
    pub fn or_skip(folder: &Path, size: &str) -> Option<Self> {
        let options = format!("size={size}");
        let mounted = Command::new("mount")
            .args(["-t", "tmpfs", "-o", &options, "tmpfs"])
            .arg(folder)
            .output();
        if mounted.is_ok_and(|output| output.status.success()) {
            return Some(Self(folder.to_owned()));
        }
        skip("a small disk cannot be mounted here");
        None
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        // At the latest, it disappears with the machine.
        let _ = Command::new("umount").arg("-l").arg(&self.0).status();
    }
}
