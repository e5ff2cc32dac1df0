//! Tests of the built binary with `spandrel modes`: modes, machines and dead channels of
//! recordings, the report, and wrong input.

use crate::support::records_or_skip;
use serde_json::Value;
use std::f64::consts::TAU;
use std::fmt::Write as _;
use std::path::Path;
use std::process::{Command, Output};

const RATE_HZ: f64 = 50.0;
const MODES_HZ: [f64; 2] = [1.5, 4.0];
const DAMPING: f64 = 0.02;
const MACHINE_HZ: f64 = 9.0;

fn modes(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_spandrel"))
        .arg("modes")
        .args(arguments)
        .output()
        .unwrap()
}

#[track_caller]
fn done(arguments: &[&str]) -> String {
    let output = modes(arguments);
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    String::from_utf8(output.stdout).unwrap()
}

#[track_caller]
fn json(arguments: &[&str]) -> Value {
    serde_json::from_str(&done(arguments)).unwrap()
}

/// Returns the message of a run that ends with this exit code.
#[track_caller]
fn failed(code: i32, arguments: &[&str]) -> String {
    let output = modes(arguments);
    let message = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(code), "{message}");
    message
}

/// Samples without correlation between −1 and 1: a linear congruential generator.
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> f64 {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
    }
}

/// Writes a table with the channels `a` and `b`, which move with two resonances and a sine, and the
/// constant channel `dead`.
fn record(path: &Path, length_s: f64, motion: f64, machine: f64) -> String {
    let mut noise = Noise(7);
    let mut states = [[0.0; 2]; 2];
    let mut text = "time [s],a,b,dead\n".to_owned();
    for step in 0..(length_s * RATE_HZ) as usize {
        let time_s = step as f64 / RATE_HZ;
        for (state, frequency_hz) in states.iter_mut().zip(MODES_HZ) {
            let rotation = TAU * frequency_hz / RATE_HZ;
            let radius = (-DAMPING * rotation).exp();
            let angle = rotation * (1.0 - DAMPING * DAMPING).sqrt();
            let next = 2.0 * radius * angle.cos() * state[0] - radius * radius * state[1];
            *state = [next + noise.next(), state[0]];
        }
        let [first, second] = states.map(|state| motion * state[0]);
        let sine = machine * (TAU * MACHINE_HZ * time_s).sin();
        let a = first + second + sine + 0.1 * noise.next();
        let b = 0.5 * first - second + 0.7 * sine + 0.1 * noise.next();
        writeln!(text, "{time_s},{a},{b},0.25").unwrap();
    }
    std::fs::write(path, text).unwrap();
    path.display().to_string()
}

fn sources<'v>(found: &'v Value, source: &str) -> Vec<&'v Value> {
    let all = found["modes"].as_array().unwrap().iter();
    all.filter(|mode| mode["source"] == source).collect()
}

fn nearest<'v>(modes: &[&'v Value], frequency_hz: f64) -> &'v Value {
    let distance = |mode: &Value| (mode["frequency_hz"].as_f64().unwrap() - frequency_hz).abs();
    modes
        .iter()
        .min_by(|one, other| distance(one).total_cmp(&distance(other)))
        .unwrap()
}

#[test]
fn modes_machine_and_dead_channel_of_a_record_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let record = record(&folder.path().join("record.csv"), 900.0, 1.0, 3.0);
    let found = json(&[&record, "--json"]);
    assert_eq!(found["channels"], serde_json::json!(["a", "b"]));
    assert_eq!(found["left_out"][0]["channel"], "dead");
    assert_eq!(found["left_out"][0]["reason"], "constant");
    for (frequency_hz, of_b) in MODES_HZ.into_iter().zip([0.5, -1.0]) {
        let mode = nearest(&sources(&found, "mode"), frequency_hz);
        let number = |name: &str| mode[name].as_f64().unwrap();
        assert!(
            (number("frequency_hz") / frequency_hz - 1.0).abs() < 0.01,
            "{mode}"
        );
        assert!(
            (number("damping") - DAMPING).abs() < 4.0 * number("damping_std"),
            "{mode}"
        );
        // The value at `b` relative to `a`, whatever channel has 1.
        let at = |channel: usize| mode["shape"][channel]["real"].as_f64().unwrap();
        assert!((at(1) / at(0) - of_b).abs() < 0.1, "{mode}");
    }
    let machines = sources(&found, "machine");
    assert_eq!(machines.len(), 1, "{machines:?}");
    let machine_hz = machines[0]["frequency_hz"].as_f64().unwrap();
    assert!((machine_hz - MACHINE_HZ).abs() < 0.01, "{machine_hz}");
    let near_machine = nearest(&sources(&found, "mode"), MACHINE_HZ)["frequency_hz"].as_f64();
    assert!((near_machine.unwrap() - MACHINE_HZ).abs() > 0.1);

    let table = done(&[&record]);
    assert!(table.contains("left out: dead (constant)"), "{table}");
    assert!(table.contains("a machine, not a mode"), "{table}");
}

#[test]
fn report_contains_both_diagrams_and_the_modes_of_each_epoch() {
    let folder = tempfile::tempdir().unwrap();
    let record = record(&folder.path().join("record.csv"), 500.0, 1.0, 0.0);
    let report = folder.path().join("report");
    let csv = folder.path().join("modes.csv").display().to_string();
    let found = json(&[
        &record,
        "--epoch",
        "120",
        "--json",
        "--csv",
        &csv,
        "--report",
        report.to_str().unwrap(),
    ]);
    let epochs = found["epochs"].as_array().unwrap();
    assert!(epochs.len() >= 3, "{}", epochs.len());
    for name in ["stabilisation.svg", "singular-values.svg"] {
        let diagram = std::fs::read_to_string(report.join(name)).unwrap();
        assert!(
            diagram.starts_with("<svg") && diagram.contains("frequency (Hz)"),
            "{name}"
        );
    }
    let of_file: Value =
        serde_json::from_str(&std::fs::read_to_string(report.join("modes.json")).unwrap()).unwrap();
    assert_eq!(of_file, found);
    let rows: usize = epochs
        .iter()
        .map(|epoch| epoch["modes"].as_array().unwrap().len())
        .sum();
    let table = std::fs::read_to_string(csv).unwrap();
    assert_eq!(table.lines().count(), 1 + rows);
    assert_eq!(
        table,
        std::fs::read_to_string(report.join("modes.csv")).unwrap()
    );
}

#[test]
fn wrong_recordings_and_options_are_bad_input() {
    let folder = tempfile::tempdir().unwrap();
    let good = record(&folder.path().join("good.csv"), 300.0, 1.0, 0.0);
    let short = record(&folder.path().join("short.csv"), 10.0, 1.0, 0.0);
    let constant = folder.path().join("constant.csv");
    let rows: String = (0..5000)
        .map(|step| format!("{},1,2\n", step as f64 / RATE_HZ))
        .collect();
    std::fs::write(&constant, format!("time,a,b\n{rows}")).unwrap();
    let constant = constant.display().to_string();
    // The two channels of a folder with two rates.
    let unequal = folder.path().join("unequal");
    std::fs::create_dir(&unequal).unwrap();
    for (name, rate_hz) in [("slow", 20.0), ("fast", 50.0)] {
        let rows: String = (0..5000)
            .map(|step| format!("{},{}\n", f64::from(step) / rate_hz, step % 7))
            .collect();
        std::fs::write(
            unequal.join(format!("{name}.csv")),
            format!("time,{name}\n{rows}"),
        )
        .unwrap();
    }
    let unequal = unequal.display().to_string();
    let timeless = folder.path().join("timeless.csv");
    std::fs::write(&timeless, "a,b\n1,2\n2,4\n3,5\n").unwrap();
    let timeless = timeless.display().to_string();
    let cases: [(&[&str], &str); 12] = [
        (
            &[&timeless],
            "timeless.csv: states no sampling rate for channel `a`; state it with --rate HZ",
        ),
        (&[&short], "is 10.00 s long, must be at least"),
        (&[&good, "--epoch", "10"], "must be at least"),
        (&[&good, "--epoch", "900"], "no epoch of 900.0 s"),
        (
            &[&good, "--channels", "a"],
            "1 channels with samples that vary, must be at least 2",
        ),
        (&[&constant], "left out: a (constant), b (constant)"),
        (&[&unequal], "Hz"),
        (
            &[&good, "--band", "0..30"],
            "must increase, start at 0 Hz or above, and end at most at 20 Hz",
        ),
        (&[&good, "--band", "12..3"], "two increasing frequencies"),
        (
            &[&good, "--without", "roof"],
            "no channel `roof`, must be one of: a, b, dead",
        ),
        (
            &[&good, "--references", "dead"],
            "no channel `dead`, must be one of: a, b",
        ),
        (&["absent.csv"], "absent.csv"),
    ];
    for (arguments, expected) in cases {
        let message = failed(2, arguments);
        assert!(message.contains(expected), "{arguments:?}: {message}");
    }
    let kept = std::fs::read(&good).unwrap();
    assert!(failed(2, &[&good, "--csv", &good]).contains("would be overwritten"));
    assert_eq!(std::fs::read(&good).unwrap(), kept);
}

#[test]
fn record_with_a_machine_alone_has_no_mode() {
    let folder = tempfile::tempdir().unwrap();
    let record = record(&folder.path().join("record.csv"), 300.0, 0.0, 1.0);
    let message = failed(1, &[&record, "--order", "2", "--band", "0..20"]);
    assert!(message.contains("no mode found"), "{message}");
}

#[test]
fn modes_of_the_z24_bridge_are_the_published_ones() {
    for (name, published_hz) in [
        ("ref1-setup1", [3.92, 5.12, 9.93, 10.52]),
        ("settle80mm-setup1", [3.76, 5.01, 9.37, 9.90]),
    ] {
        let file = format!("z24-damage-test/{name}.csv.gz");
        let Some(record) = records_or_skip(&file) else {
            return;
        };
        let record = record.display().to_string();
        let found = json(&[
            &record, "--rate", "100", "--epoch", "160", "--band", "0..20", "--json",
        ]);
        let modes = sources(&found, "mode");
        let mode = |frequency_hz: f64| nearest(&modes, frequency_hz)["frequency_hz"].as_f64();
        assert!((mode(published_hz[0]).unwrap() - published_hz[0]).abs() < 0.03);
        for frequency_hz in published_hz {
            let found_hz = mode(frequency_hz).unwrap();
            assert!(
                (found_hz / frequency_hz - 1.0).abs() < 0.03,
                "{frequency_hz}: {found_hz}"
            );
        }
    }
}

/// Returns the first natural frequency of the first two epochs of a record of the Z24 bridge, and
/// its standard deviation (Hz).
fn first_frequencies(folder: &Path, name: &str) -> Option<[[f64; 2]; 2]> {
    let record = records_or_skip(&format!("z24-damage-test/{name}.csv.gz"))?;
    let csv = folder.join(format!("{name}.csv")).display().to_string();
    let record = record.display().to_string();
    done(&[
        &record, "--rate", "100", "--epoch", "160", "--band", "2..20", "--csv", &csv,
    ]);
    let text = std::fs::read_to_string(csv).unwrap();
    let mut rows = text.lines().map(|row| row.split(',').collect::<Vec<_>>());
    let head = rows.next().unwrap();
    let column = |name: &str| head.iter().position(|head| *head == name).unwrap();
    // The mode with the lowest frequency of each epoch.
    let (mode, frequency, std) = (
        column("mode"),
        column("frequency [Hz]"),
        column("frequency std [Hz]"),
    );
    let mut first = rows.filter(|row| row[mode] == "1");
    let mut next = || {
        let row = first.next().expect("an epoch with the mode");
        [frequency, std].map(|column| row[column].parse().unwrap())
    };
    Some([next(), next()])
}

/// One or two epochs after the pier was lowered, the loss of stiffness exceeds 3 % with a
/// probability of 0.99. Between two epochs of one state, it does not.
#[test]
fn two_epochs_tell_the_lowered_pier_of_the_z24_bridge() {
    const QUANTILE: f64 = 2.326;
    let folder = tempfile::tempdir().unwrap();
    let sound = first_frequencies(folder.path(), "ref1-setup1");
    let lowered = first_frequencies(folder.path(), "settle80mm-setup1");
    let (Some(sound), Some(lowered)) = (sound, lowered) else {
        return;
    };
    let exceeds = |before: [f64; 2], after: [f64; 2]| {
        let change = 2.0 * (after[0] / before[0]).ln();
        let std = 2.0 * (before[1] / before[0]).hypot(after[1] / after[0]);
        println!("{before:?}, {after:?}: {change:.4}, standard deviation {std:.4}");
        change + QUANTILE * std < f64::ln(0.97)
    };
    for before in &sound {
        for after in &lowered {
            assert!(exceeds(*before, *after));
        }
    }
    assert!(!exceeds(sound[0], sound[1]));
    assert!(!exceeds(lowered[0], lowered[1]));
}

#[test]
fn dead_sensors_of_a_floating_bridge_are_named() {
    let file = "bergsoysund-bridge/NTNU142M-2014-11-16_11-02-45_low.mat";
    let Some(record) = records_or_skip(file) else {
        return;
    };
    let found = json(&[record.to_str().unwrap(), "--json"]);
    let left_out = found["left_out"].as_array().unwrap();
    assert_eq!(left_out.len(), 6, "{left_out:?}"); // three directions of 6S and 6N
    for channel in left_out {
        assert!(
            channel["channel"].as_str().unwrap().contains('6'),
            "{channel}"
        );
        assert_eq!(channel["reason"], "no sample");
    }
}

/// Regression test: the standard deviation of the damping ratio of one epoch decided, so that
/// lightly damped fundamental modes were not listed.
#[test]
fn all_modes_of_a_lightly_damped_structure_are_listed() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name).display().to_string();
    let example = include_str!("../docs/examples/modes/ambient.toml");
    let light = example.replace("\nratio = 0.02", "\nratio = 0.003");
    assert_ne!(light, example);
    std::fs::write(file("light.toml"), light).unwrap();
    let simulated = Command::new(env!("CARGO_BIN_EXE_spandrel"))
        .args(["simulate", &file("light.toml"), "--duration", "1800"])
        .args(["--seed", "2", "--record", &file("light.csv")])
        .output()
        .unwrap();
    assert!(simulated.status.success(), "{simulated:?}");
    let found = json(&[&file("light.csv"), "--epoch", "150", "--json"]);
    let modes = sources(&found, "mode");
    for frequency_hz in [1.00, 2.92, 4.60, 5.91, 6.74] {
        let mode = nearest(&modes, frequency_hz);
        let error = mode["frequency_hz"].as_f64().unwrap() / frequency_hz - 1.0;
        assert!(error.abs() < 0.005, "{frequency_hz} Hz: {mode}");
    }
}

/// Returns the structure file of the test tower, whose modes update a shear chain.
fn tower(folder: &Path) -> String {
    let file = folder.join("tower.toml");
    let text = include_str!("../crates/validate/src/robustness/records/tower-modes.toml");
    std::fs::write(&file, text).unwrap();
    file.display().to_string()
}

#[test]
fn stiffnesses_of_a_sound_tower_are_consistent_between_its_records() {
    let folder = tempfile::tempdir().unwrap();
    let structure = tower(folder.path());
    for order in [[1, 2, 3], [3, 1, 2], [2, 3, 1]] {
        let mut files = Vec::new();
        for number in order {
            let Some(record) = records_or_skip(&format!("unison-tower/wn_0{number}.dat")) else {
                return;
            };
            files.push(record.display().to_string());
        }
        // The first two records are the commissioning, and the last one is judged.
        let mut arguments: Vec<&str> = files.iter().map(String::as_str).collect();
        arguments.extend([structure.as_str(), "--json"]);
        let found = json(&arguments);
        let reference = &found["stiffness"]["reference"];
        assert_eq!(
            reference["modes_of_model"],
            serde_json::json!([1, 2, 3, 4, 5])
        );
        let epochs = found["stiffness"]["epochs"].as_array().unwrap();
        assert_eq!(epochs.len(), 1, "{found}");
        for parameter in epochs[0]["parameters"].as_array().unwrap() {
            let number = |key: &str| parameter[key].as_f64().unwrap();
            assert!(
                number("low") < 1.0 && number("high") > 1.0,
                "{order:?}: {parameter}"
            );
            assert!(
                number("high") - number("low") < 0.3,
                "{order:?}: {parameter}"
            );
            assert_eq!(parameter["raised"], false, "{order:?}: {parameter}");
        }
    }
}

#[test]
fn a_loss_of_one_storey_is_found_by_the_modes_and_in_no_other_storey() {
    let folder = tempfile::tempdir().unwrap();
    let record = folder.path().join("record.csv").display().to_string();
    let structure = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../docs/examples/modes/stiffness.toml"
    );
    let simulated = Command::new(env!("CARGO_BIN_EXE_spandrel"))
        .args([
            "simulate",
            structure,
            "--duration",
            "3000",
            "--record",
            &record,
        ])
        .output()
        .unwrap();
    assert!(simulated.status.success(), "{simulated:?}");
    let found = json(&[&record, structure, "--json"]);
    let epochs = found["stiffness"]["epochs"].as_array().unwrap();
    let last = epochs.last().unwrap();
    for parameter in last["parameters"].as_array().unwrap() {
        let raised = parameter["parameter"] == "storey-2";
        assert_eq!(parameter["raised"], raised, "{last}");
    }
    let text = done(&[&record, structure]);
    assert!(
        text.contains("stiffness: commissioned in 6 epochs"),
        "{text}"
    );
}
