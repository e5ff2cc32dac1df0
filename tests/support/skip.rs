//! Decides what happens if a test cannot run on this machine.

#![allow(dead_code, reason = "each test file uses its part of it")]

use std::path::{Path, PathBuf};

/// Environment variable that makes a skipped test fail.
const REQUIRE_ALL: &str = "REQUIRE_ALL_TESTS";

/// Prints why a test is skipped. Panics if `REQUIRE_ALL_TESTS` is set.
#[track_caller]
pub fn skip(why: &str) {
    assert!(
        std::env::var_os(REQUIRE_ALL).is_none(),
        "{REQUIRE_ALL} is set, and this test cannot run: {why}"
    );
    println!("skipped: {why}");
}

/// Returns the path of a file or folder in `shared/data`, which is next to the repository. Skips
/// the test if it does not exist.
#[track_caller]
pub fn records_or_skip(name: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../../shared/data")
        .join(name);
    if path.exists() {
        return Some(path);
    }
    skip(&format!("{} does not exist", path.display()));
    None
}
