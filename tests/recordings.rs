//! Tests of the built binary with `spandrel info` and `convert`, and of `estimate` with recordings
//! other than CSV.
//!
//! One test requires Python 3 with the package `mcap`, as `python3` or as the program in `PYTHON`.
//! Without it, the test reports that it was skipped, or fails if `REQUIRE_ALL_TESTS` is set.

use crate::support::skip;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn spandrel(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_spandrel"))
        .args(arguments)
        .output()
        .unwrap()
}

#[track_caller]
fn done(arguments: &[&str]) -> String {
    let output = spandrel(arguments);
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
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

/// Returns the path of ten seconds of the demo in this format.
fn simulated(folder: &Path, name: &str) -> String {
    let record = folder.join(name).display().to_string();
    done(&[
        "simulate",
        demo().to_str().unwrap(),
        "--duration",
        "10",
        "--record",
        &record,
    ]);
    record
}

#[test]
fn info_lists_channels_as_text_and_as_json() {
    let folder = tempfile::tempdir().unwrap();
    let record = simulated(folder.path(), "demo.csv");
    let text = done(&["info", &record]);
    assert!(
        text.starts_with(&format!("{record}: text table (CSV), 6 channels\n")),
        "{text}"
    );
    assert!(text.contains("1000 samples at 100 Hz, 9.990 s"), "{text}");
    let json: Value = serde_json::from_str(&done(&["info", &record, "--json"])).unwrap();
    let channels = json["channels"].as_array().unwrap();
    assert_eq!(channels.len(), 6);
    assert!(
        channels.iter().all(|channel| channel["samples"] == 1000
            && channel["statistics"]["std"].as_f64() > Some(0.0))
    );
}

#[test]
fn estimates_of_a_record_are_identical_from_csv_and_mcap() {
    let folder = tempfile::tempdir().unwrap();
    let (csv, mcap) = (
        simulated(folder.path(), "demo.csv"),
        simulated(folder.path(), "demo.mcap"),
    );
    let estimates = |record: &str, name: &str| {
        let output = folder.path().join(name).display().to_string();
        done(&[
            "estimate",
            demo().to_str().unwrap(),
            "--record",
            record,
            "--output",
            &output,
        ]);
        std::fs::read_to_string(output).unwrap()
    };
    let converted = folder.path().join("converted.mcap").display().to_string();
    done(&["convert", &csv, &converted]);
    let from_csv = estimates(&csv, "from-csv.csv");
    assert_eq!(from_csv.lines().count(), 1001);
    assert!(
        from_csv == estimates(&mcap, "from-mcap.csv"),
        "a simulation written as MCAP"
    );
    assert!(
        from_csv == estimates(&converted, "from-converted.csv"),
        "CSV converted to MCAP"
    );
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
    let told = refused(
        &estimate(&demo())
            .iter()
            .map(String::as_str)
            .collect::<Vec<_>>(),
    );
    assert!(
        told.contains("160.0000 Hz") && told.contains("100 Hz"),
        "{told}"
    );
    let structure = folder.path().join("resampled.toml");
    std::fs::write(
        &structure,
        std::fs::read_to_string(demo()).unwrap() + "\n[record]\nresample = true\n",
    )
    .unwrap();
    let json = done(
        &estimate(&structure)
            .iter()
            .map(String::as_str)
            .collect::<Vec<_>>(),
    );
    let summary: Value = serde_json::from_str(&json).unwrap();
    assert!(
        summary["frames"].as_u64().unwrap().abs_diff(1000) <= 1,
        "{summary}"
    );
}

#[test]
fn wrong_recordings_and_outputs_are_bad_input() {
    let folder = tempfile::tempdir().unwrap();
    let record = simulated(folder.path(), "demo.csv");
    let told = refused(&["convert", &record, "demo.xlsx"]);
    assert!(
        told.contains("its name must end in .csv or .mcap or .mseed"),
        "{told}"
    );
    let told = refused(&["convert", &record, &record]);
    assert!(told.contains("would be overwritten"), "{told}");
    let damaged = folder.path().join("damaged.mseed");
    std::fs::write(&damaged, b"MS\x03\0too short").unwrap();
    let told = refused(&["info", damaged.to_str().unwrap()]);
    assert!(told.contains("damaged.mseed: miniSEED: byte "), "{told}");
    assert_eq!(
        spandrel(&["info", &record, "--rate", "0"]).status.code(),
        Some(2)
    );
}

/// Reads one file with the public Python reader by its index, and a truncated file from the start.
const READER: &str = r"
import json, sys
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap.exceptions import EndOfFile, McapError

whole, cut = sys.argv[1:]
with open(whole, 'rb') as file:
    reader = make_reader(file, validate_crcs=True)
    summary = reader.get_summary()
    assert summary.statistics.message_count == 6000, summary.statistics
    topics = {channel.topic: channel.metadata['unit'] for channel in summary.channels.values()}
    assert topics == {name: 'm/s2' for name in ['ground'] + [f'floor-{n}' for n in range(1, 6)]}, topics
    schema, = summary.schemas.values()
    assert schema.encoding == 'jsonschema' and json.loads(schema.data)['properties']['value']['type'] == 'number'
    times = []
    for _, channel, message in reader.iter_messages(topics=['floor-5']):
        assert type(json.loads(message.data)['value']) is float
        times.append(message.log_time)
    assert times == [10_000_000 * k for k in range(1000)]
messages = 0
with open(cut, 'rb') as file:
    try:
        for record in StreamReader(file, validate_crcs=True).records:
            messages += isinstance(record, Message)
        raise SystemExit('the end of a file that was cut off was found')
    except (EndOfFile, McapError):
        pass
assert messages == 4096, messages
";

#[test]
fn an_independent_reader_reads_recordings_in_mcap() {
    let python = std::env::var("PYTHON").unwrap_or_else(|_| "python3".to_owned());
    if !Command::new(&python)
        .args(["-c", "import mcap.reader"])
        .output()
        .is_ok_and(|output| output.status.success())
    {
        skip("python3 with the package mcap is not installed");
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let whole = simulated(folder.path(), "demo.mcap");
    // As left by a writer that is killed during its second chunk.
    let bytes = std::fs::read(&whole).unwrap();
    let cut = folder.path().join("cut.mcap");
    std::fs::write(&cut, &bytes[..bytes.len() / 5 * 4]).unwrap();
    let output = Command::new(python)
        .args(["-c", READER, &whole])
        .arg(&cut)
        .output()
        .unwrap();
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    let told = done(&["info", cut.to_str().unwrap(), "--json"]);
    let channels: Value = serde_json::from_str(&told).unwrap();
    let samples = channels["channels"]
        .as_array()
        .unwrap()
        .iter()
        .map(|channel| channel["samples"].as_u64().unwrap());
    assert_eq!(samples.sum::<u64>(), 4096);
}
