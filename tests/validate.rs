//! `spandrel validate` with the records of real structures.

use crate::support::records_or_skip;
use std::process::Command;

/// Cases that read records, and the folders with these records.
const CASES: [&str; 3] = ["judge.z24", "judge.sciri-tower", "judge.painter"];
const FOLDERS: [&str; 3] = ["z24-monitoring", "sciri-tower", "painter-street-bridge"];

/// Runs the acceptance of the judgement of real structures. The figures are in docs/validation.md.
#[test]
fn lasting_change_of_real_structures_is_judged_as_required() {
    let folders: Option<Vec<_>> = FOLDERS.into_iter().map(records_or_skip).collect();
    let Some(folders) = folders else {
        return;
    };
    let mut command = Command::new(env!("CARGO_BIN_EXE_spandrel"));
    command.arg("validate").args(CASES).arg("--quick");
    command.arg("--records").arg(folders[0].parent().unwrap());
    let output = command.output().unwrap();
    println!("{}", String::from_utf8_lossy(&output.stdout));
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{stderr}");
}

/// A case without its records must not pass.
#[test]
fn real_structures_without_their_records_fail() {
    let folder = tempfile::tempdir().unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_spandrel"));
    command.args(["validate", "judge.sciri-tower", "--records"]);
    let output = command.arg(folder.path()).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    let stdout = String::from_utf8_lossy(&output.stdout);
    assert!(
        stdout.contains("tower_frequencies_temperatures.csv: "),
        "{stdout}"
    );
}
