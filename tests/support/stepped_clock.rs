//! A machine whose wall clock is set while programs run, as by NTP.

use super::preload::compile_or_skip;
use std::fs::OpenOptions;
use std::os::unix::fs::FileExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;

/// The wall clock of the programs that use it.
pub struct SteppedClock {
    library: PathBuf,
    file: PathBuf,
}

impl SteppedClock {
    /// Creates a clock that is right, with its files in `folder`. Skips the test without a C
    /// compiler.
    pub fn or_skip(folder: &Path) -> Option<Self> {
        let clock = Self {
            library: compile_or_skip("stepped_clock", folder)?,
            file: folder.join("stepped-clock"),
        };
        clock.set(0);
        Some(clock)
    }

    /// Makes a command use this clock.
    pub fn of(&self, command: &mut Command) {
        command
            .env("LD_PRELOAD", &self.library)
            .env("STEPPED_CLOCK_FILE", &self.file);
    }

    /// Sets the clock this far ahead of the true time (s).
    pub fn set(&self, ahead_s: i64) {
        // The programs have mapped the file, so that it must keep its identity and size.
        let mut options = OpenOptions::new();
        options.create(true).truncate(false).write(true);
        let file = options.open(&self.file).unwrap();
        let ahead_ns = ahead_s * 1_000_000_000;
        file.write_all_at(&ahead_ns.to_ne_bytes(), 0).unwrap();
    }
}
