//! `spandrel info` and `convert`, the built binary, and recordings of other formats than CSV in `estimate`.
#![expect(clippy::unwrap_used, reason = "a helper of tests may fail them")]

use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn spandrel(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_spandrel")).args(arguments).output().unwrap()
}

#[track_caller]
fn done(arguments: &[&str]) -> String {
    let output = spandrel(arguments);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

#[track_caller]
fn refused(arguments: &[&str]) -> String {
    let output = spandrel(arguments);
    assert_eq!(output.status.code(), Some(2));
    String::from_utf8(output.stderr).unwrap()
}

fn demo() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo.toml")
}

/// Ten seconds of the demo in this format.
fn simulated(folder: &Path, name: &str) -> String {
    let record = folder.join(name).display().to_string();
    done(&["simulate", demo().to_str().unwrap(), "--duration", "10", "--record", &record]);
    record
}

#[test]
fn info_tells_channels_for_people_and_for_programs() {
    let folder = tempfile::tempdir().unwrap();
    let record = simulated(folder.path(), "demo.csv");
    let text = done(&["info", &record]);
    assert!(text.starts_with(&format!("{record}: text table (CSV), 6 channels\n")), "{text}");
    assert!(text.contains("1000 samples at 100 Hz, 9.990 s"), "{text}");
    let json: Value = serde_json::from_str(&done(&["info", &record, "--json"])).unwrap();
    let channels = json["channels"].as_array().unwrap();
    assert_eq!(channels.len(), 6);
    assert!(
        channels.iter().all(|channel| channel["samples"] == 1000 && channel["statistics"]["std"].as_f64() > Some(0.0))
    );
}

#[test]
fn estimates_of_the_same_record_are_the_same_from_csv_and_mcap() {
    let folder = tempfile::tempdir().unwrap();
    let (csv, mcap) = (simulated(folder.path(), "demo.csv"), simulated(folder.path(), "demo.mcap"));
    let estimates = |record: &str, name: &str| {
        let output = folder.path().join(name).display().to_string();
        done(&["estimate", demo().to_str().unwrap(), "--record", record, "--output", &output]);
        std::fs::read_to_string(output).unwrap()
    };
    let converted = folder.path().join("converted.mcap").display().to_string();
    done(&["convert", &csv, &converted]);
    let from_csv = estimates(&csv, "from-csv.csv");
    assert_eq!(from_csv.lines().count(), 1001);
    assert!(from_csv == estimates(&mcap, "from-mcap.csv"), "a simulation written as MCAP");
    assert!(from_csv == estimates(&converted, "from-converted.csv"), "CSV converted to MCAP");
}

#[test]
fn record_of_another_rate_is_estimated_only_if_resampling_is_declared() {
    let folder = tempfile::tempdir().unwrap();
    let record = simulated(folder.path(), "demo.csv");
    let fast = folder.path().join("fast.csv").display().to_string();
    done(&["convert", &record, &fast, "--resample", "160"]);
    let estimate = |structure: &Path| {
        vec![
            "estimate".to_owned(),
            structure.display().to_string(),
            "--record".to_owned(),
            fast.clone(),
            "--json".to_owned(),
        ]
    };
    let told = refused(&estimate(&demo()).iter().map(String::as_str).collect::<Vec<_>>());
    assert!(told.contains("160.0000 Hz") && told.contains("100 Hz"), "{told}");
    let structure = folder.path().join("resampled.toml");
    std::fs::write(&structure, std::fs::read_to_string(demo()).unwrap() + "\n[record]\nresample = true\n").unwrap();
    let json = done(&estimate(&structure).iter().map(String::as_str).collect::<Vec<_>>());
    let summary: Value = serde_json::from_str(&json).unwrap();
    assert!(summary["frames"].as_u64().unwrap().abs_diff(1000) <= 1, "{summary}");
}

#[test]
fn wrong_recordings_and_outputs_are_bad_input() {
    let folder = tempfile::tempdir().unwrap();
    let record = simulated(folder.path(), "demo.csv");
    let told = refused(&["convert", &record, "demo.xlsx"]);
    assert!(told.contains("its name must end in .csv or .mcap"), "{told}");
    let told = refused(&["convert", &record, &record]);
    assert!(told.contains("would be written over"), "{told}");
    let damaged = folder.path().join("damaged.mseed");
    std::fs::write(&damaged, b"MS\x03\0too short").unwrap();
    let told = refused(&["info", damaged.to_str().unwrap()]);
    assert!(told.contains("damaged.mseed: miniSEED: byte "), "{told}");
    assert_eq!(spandrel(&["info", &record, "--rate", "0"]).status.code(), Some(2));
}
