//! Decides what happens if a test cannot run on this machine.

use std::path::{Path, PathBuf};

/// Environment variable that makes a skipped test fail.
const REQUIRE_ALL: &str = "REQUIRE_ALL_TESTS";
/// Environment variable that permits skipping the tests that read real records, which are not part
/// of the repository.
const WITHOUT_RECORDS: &str = "WITHOUT_RECORDS";
/// Environment variable that names the folder of zenoh-pico, and one that permits skipping its
/// test.
const ZENOH_PICO: &str = "ZENOH_PICO";
const WITHOUT_ZENOH_PICO: &str = "WITHOUT_ZENOH_PICO";
/// Environment variable that names the file axe.min.js, and one that permits skipping its test.
const AXE: &str = "AXE";
const WITHOUT_AXE: &str = "WITHOUT_AXE";

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

/// Returns the folder of zenoh-pico, which is not part of the repository.
///
/// Skips the test if no folder is stated. Panics instead if `REQUIRE_ALL_TESTS` is set and
/// `WITHOUT_ZENOH_PICO` is not.
#[track_caller]
pub fn zenoh_pico_or_skip() -> Option<PathBuf> {
    if let Some(folder) = std::env::var_os(ZENOH_PICO) {
        return Some(folder.into());
    }
    let why = format!("{ZENOH_PICO} does not name the folder of zenoh-pico");
    if std::env::var_os(WITHOUT_ZENOH_PICO).is_some() {
        println!("skipped: {why}");
    } else {
        skip(&why);
    }
    None
}

/// Returns the script of axe-core, which checks the access to a page and is not part of the
/// repository.
///
/// Skips the test if no file is stated. Panics instead if `REQUIRE_ALL_TESTS` is set and
/// `WITHOUT_AXE` is not.
#[track_caller]
pub fn axe_or_skip() -> Option<PathBuf> {
    if let Some(file) = std::env::var_os(AXE) {
        return Some(file.into());
    }
    let why = format!("{AXE} does not name the file axe.min.js (npm pack axe-core)");
    if std::env::var_os(WITHOUT_AXE).is_some() {
        println!("skipped: {why}");
    } else {
        skip(&why);
    }
    None
}
