//! Decides what happens if a test cannot run on this machine.

#![allow(dead_code, reason = "each test file uses its part of it")]

use std::path::{Path, PathBuf};

/// Environment variable that makes a skipped test fail.
const REQUIRE_ALL: &str = "REQUIRE_ALL_TESTS";
/// Environment variable that permits skipping the tests that read real records, which are not part
/// of the repository.
const WITHOUT_RECORDS: &str = "WITHOUT_RECORDS";

/// Prints why a test is skipped. Panics if `REQUIRE_ALL_TESTS` is set.
#[track_caller]
pub fn skip(why: &str) {
    assert!(
        std::env::var_os(REQUIRE_ALL).is_none(),
        "{REQUIRE_ALL} is set, and this test cannot run: {why}"
    );
    println!("skipped: {why}");
}

/// Returns the path of a file or folder in `shared/data`, which is next to the repository.
///
/// Skips the test if it does not exist. Panics instead if `REQUIRE_ALL_TESTS` is set and
/// `WITHOUT_RECORDS` is not.
#[track_caller]
pub fn records_or_skip(name: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../../shared/data")
        .join(name);
    if path.exists() {
        return Some(path);
    }
    let why = format!("{} does not exist", path.display());
    if std::env::var_os(WITHOUT_RECORDS).is_some() {
        println!("skipped: {why}");
    } else {
        skip(&why);
    }
    None
}
