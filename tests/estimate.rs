//! Tests of the built binary with `spandrel estimate`: its summary of a recording, and the particle
//! filter compared with the Kalman filter.

use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn spandrel(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_spandrel"))
        .args(arguments)
        .output()
        .unwrap()
}

fn example(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../docs/examples")
        .join(name)
}

fn simulate(structure: &Path, record: &Path, seconds: &str) {
    let arguments = [
        "simulate",
        structure.to_str().unwrap(),
        "--duration",
        seconds,
        "--record",
        record.to_str().unwrap(),
    ];
    let output = spandrel(&arguments);
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
}

#[track_caller]
fn estimate(structure: &Path, record: &Path, more: &[&str]) -> Output {
    let mut arguments = vec![
        "estimate",
        structure.to_str().unwrap(),
        "--record",
        record.to_str().unwrap(),
    ];
    arguments.extend(more);
    let output = spandrel(&arguments);
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    output
}

#[track_caller]
fn summary(structure: &Path, record: &Path, more: &[&str]) -> Value {
    let output = estimate(structure, record, &[more, &["--json"]].concat());
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn the_summary_reports_missing_and_discarded_samples_and_the_misfit() {
    let folder = tempfile::tempdir().unwrap();
    let (structure, record) = (example("demo.toml"), folder.path().join("demo.csv"));
    simulate(&structure, &record, "40");
    let sound = summary(&structure, &record, &[]);
    assert!(
        sound["samples"].is_null(),
        "nothing is wrong with them: {sound}"
    );
    let misfit = sound["misfit"].as_f64().unwrap();
    assert!((0.9..1.1).contains(&misfit), "{misfit}");

    // floor-3 is silent for 50 samples, and floor-5 reports 1e9 m/s² twice.
    let text = std::fs::read_to_string(&record).unwrap();
    let header = text.lines().find(|line| line.contains("floor-3")).unwrap();
    let column = |name: &str| {
        header
            .split(',')
            .position(|cell| cell.starts_with(name))
            .unwrap()
    };
    let (third, fifth) = (column("floor-3"), column("floor-5"));
    let first = text.lines().position(|line| line == header).unwrap() + 1;
    let spoilt: Vec<String> = text
        .lines()
        .enumerate()
        .map(|(index, line)| {
            let mut cells: Vec<&str> = line.split(',').collect();
            if (first + 1000..first + 1050).contains(&index) {
                cells[third] = "";
            }
            if [first + 2000, first + 2001].contains(&index) {
                cells[fifth] = "1e9";
            }
            cells.join(",")
        })
        .collect();
    let spoilt_record = folder.path().join("spoilt.csv");
    std::fs::write(&spoilt_record, spoilt.join("\n") + "\n").unwrap();
    let told = summary(&structure, &spoilt_record, &[]);
    assert_eq!(
        told["samples"]["missing"],
        serde_json::json!({ "floor-3": 50, "floor-5": 2 })
    );
    assert_eq!(
        told["samples"]["discarded"],
        serde_json::json!({ "out-of-range-values": 2 })
    );
    let text = String::from_utf8(estimate(&structure, &spoilt_record, &[]).stdout).unwrap();
    for part in [
        "missing samples: floor-3 50, floor-5 2",
        "discarded: out-of-range-values 2",
        "fit supported at the end (the data support the model); supported 100 % of the time",
    ] {
        assert!(text.contains(part), "{part} is not in\n{text}");
    }
}

#[test]
fn particles_agree_with_the_kalman_filter_for_few_states() {
    let folder = tempfile::tempdir().unwrap();
    let (structure, record) = (
        example("hysteretic-oscillator.toml"),
        folder.path().join("oscillator.csv"),
    );
    simulate(&structure, &record, "30");
    let level = |summary: &Value, name: &str| {
        let parameter = &summary["parameters"][name];
        (
            parameter["mean"].as_f64().unwrap(),
            parameter["std"].as_f64().unwrap(),
        )
    };
    let kalman = summary(&structure, &record, &[]);
    for seed in ["1", "2", "3"] {
        let options = ["--filter", "particle", "--particles", "500", "--seed", seed];
        let particle = summary(&structure, &record, &options);
        let misfit = particle["misfit"].as_f64().unwrap();
        assert!(
            (misfit - 1.0).abs() < 0.2 && particle["effective_share"].as_f64().unwrap() > 0.1,
            "misfit {misfit}"
        );
        for name in ["theta-1", "theta-2", "theta-4"] {
            let ((mean, std), (yardstick, its_std)) =
                (level(&kalman, name), level(&particle, name));
            println!(
                "seed {seed}: {name} {mean:.4} ± {std:.4}, particles {yardstick:.4} ± {its_std:.4}"
            );
            assert!(
                (mean - yardstick).abs() < 3.0 * std.hypot(its_std),
                "seed {seed}: {name} {mean} {yardstick}"
            );
        }
        if seed == "1" {
            assert_eq!(
                particle,
                summary(&structure, &record, &options),
                "the same seed gives the same numbers"
            );
        }
    }
}

#[test]
fn simulated_record_is_read_with_the_same_file() {
    let folder = tempfile::tempdir().unwrap();
    let mut tried = 0;
    for entry in std::fs::read_dir(example("")).unwrap() {
        let path = entry.unwrap().path();
        let text = std::fs::read_to_string(&path).unwrap_or_default();
        if !text.lines().any(|line| line == "[record]") {
            continue;
        }
        tried += 1;
        let record = folder.path().join("mapped.csv");
        simulate(&path, &record, "20");
        let mapped = summary(&path, &record, &[]);
        // Without the column mapping of the file, the record has the names of the channels and SI
        // units.
        let plain: String = text
            .lines()
            .filter(|line| !line.contains("column"))
            .map(|line| line.to_owned() + "\n")
            .collect();
        let structure = folder.path().join("plain.toml");
        std::fs::write(&structure, plain).unwrap();
        simulate(&structure, &record, "20");
        let plain = summary(&structure, &record, &[]);
        for (name, level) in mapped["parameters"].as_object().unwrap() {
            let (mapped, plain) = (
                level["mean"].as_f64().unwrap(),
                plain["parameters"][name]["mean"].as_f64().unwrap(),
            );
            assert!(
                (mapped - plain).abs() < 1e-9,
                "{}: {name} {mapped} {plain}",
                path.display()
            );
        }
    }
    assert!(tried >= 3, "{tried} examples with a record table");
}

#[test]
fn swapped_channels_give_a_warning() {
    let folder = tempfile::tempdir().unwrap();
    let (structure, record) = (example("demo.toml"), folder.path().join("demo.csv"));
    // long enough to learn the reference, and before the damage
    simulate(&structure, &record, "55");
    let sound = summary(&structure, &record, &[]);
    assert_eq!(sound["warnings"], serde_json::json!([]));
    let floors = &sound["noise"]["floors"];
    assert_eq!(
        (floors["stated_std"].as_f64(), floors["unit"].as_str()),
        (Some(0.005), Some("m/s2"))
    );
    assert!(
        (0.9..1.1).contains(&floors["ratio"].as_f64().unwrap()),
        "{floors}"
    );
    let text = std::fs::read_to_string(&record).unwrap();
    let swapped = text
        .replacen("floor-2", "floor-x", 1)
        .replacen("floor-5", "floor-2", 1)
        .replacen("floor-x", "floor-5", 1);
    std::fs::write(&record, swapped).unwrap();
    let told = summary(&structure, &record, &[]);
    println!(
        "misfit {}, noise {}",
        told["misfit"], told["noise"]["floors"]
    );
    let warning = told["warnings"][0].as_str().unwrap();
    assert!(
        warning.starts_with("noise of floors is ") && warning.contains("a swapped channel"),
        "{warning}"
    );
}

#[test]
fn record_that_ends_before_the_reference_is_known_gives_a_warning() {
    let folder = tempfile::tempdir().unwrap();
    let (structure, record) = (example("demo.toml"), folder.path().join("demo.csv"));
    simulate(&structure, &record, "40");
    let told = summary(&structure, &record, &[]);
    let storeys = "storey-1, storey-2, storey-3, storey-4, storey-5";
    let warning =
        format!("no decision on {storeys}: the reference was still being learnt at the end");
    assert_eq!(told["warnings"], serde_json::json!([warning]));
}

#[test]
fn the_summary_keeps_the_parameter_order_and_reports_the_classes() {
    let folder = tempfile::tempdir().unwrap();
    let text = std::fs::read_to_string(example("demo.toml")).unwrap();
    let text = text
        .replace("name = \"storey-1\"", "name = \"zero\"")
        .replace("at-s = 60", "at-s = 20")
        + "\n[classes]\nkind = \"self-calibrating\"\n";
    let (structure, record) = (
        folder.path().join("demo.toml"),
        folder.path().join("demo.csv"),
    );
    std::fs::write(&structure, text).unwrap();
    simulate(&structure, &record, "40");
    let output = estimate(&structure, &record, &["--json", "--verbose"]);
    let json = String::from_utf8(output.stdout).unwrap();
    let places: Vec<usize> = ["zero", "storey-2", "storey-5"]
        .map(|name| json.find(&format!("\"{name}\":")).unwrap())
        .to_vec();
    assert!(places.is_sorted(), "{json}");
    let told: Value = serde_json::from_str(&json).unwrap();
    let classes = &told["classes"];
    let sum: f64 = classes["classes"]
        .as_array()
        .unwrap()
        .iter()
        .map(|class| class["plausibility"].as_f64().unwrap())
        .sum();
    assert!((sum - 1.0).abs() < 1e-9, "{classes}");
    assert_eq!(
        classes["leads"][0],
        serde_json::json!({ "time_s": 0.0, "class": "baseline" })
    );
    let calibrations = classes["calibrations"].as_array().unwrap();
    let of_damage = calibrations
        .iter()
        .find(|by| by["class"] == "storey-2" && by["time_s"].as_f64() > Some(20.0))
        .unwrap();
    assert!(of_damage["change"].as_f64() < Some(-0.02), "{classes}");
    let log = String::from_utf8(output.stderr).unwrap();
    let line = log
        .lines()
        .find(|line| line.contains("class storey-2 recalibrated"))
        .unwrap();
    for part in ["subject=\"identify\"", "time_s=2"] {
        assert!(line.contains(part), "{part} is not in {line}");
    }
    let text = String::from_utf8(estimate(&structure, &record, &[]).stdout).unwrap();
    for part in [
        "leads; plausibilities: ",
        "calibrations, the latest first: ",
        "leads that lasted, the latest first: ",
    ] {
        assert!(text.contains(part), "{part} is not in\n{text}");
    }
}

#[test]
fn options_without_effect_are_rejected() {
    let folder = tempfile::tempdir().unwrap();
    let (structure, record) = (example("demo.toml"), folder.path().join("demo.csv"));
    simulate(&structure, &record, "2");
    let paths = [
        "estimate",
        structure.to_str().unwrap(),
        "--record",
        record.to_str().unwrap(),
    ];
    for (options, told) in [
        (
            vec!["--particles", "50"],
            "--particles requires --filter particle",
        ),
        (
            vec![
                "--filter",
                "particle",
                "--particles",
                "10",
                "--warm-up",
                "5",
            ],
            "--warm-up is 5 s, must be shorter than the record of 2 s",
        ),
    ] {
        let output = spandrel(&[&paths[..], &options].concat());
        let log = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{log}");
        assert!(log.contains(told), "{log}");
    }
    let text = folder.path().join("demo.txt");
    let output = spandrel(&[
        "simulate",
        structure.to_str().unwrap(),
        "--record",
        text.to_str().unwrap(),
    ]);
    assert_eq!(output.status.code(), Some(2));
    assert!(!text.exists() && String::from_utf8_lossy(&output.stderr).contains(".csv"));
}

#[test]
fn particles_of_a_large_model_come_with_a_warning() {
    let folder = tempfile::tempdir().unwrap();
    let (structure, record) = (example("demo.toml"), folder.path().join("demo.csv"));
    // The particles start once the noise level is trained.
    simulate(&structure, &record, "15");
    let output = estimate(
        &structure,
        &record,
        &["--filter", "particle", "--particles", "10"],
    );
    let log = String::from_utf8(output.stderr).unwrap();
    assert!(log.contains("16 states and parameters"), "{log}");
    let output = spandrel(&[
        "estimate",
        "demo.toml",
        "--record",
        "demo.csv",
        "--particles",
        "1",
    ]);
    assert_eq!(output.status.code(), Some(2));
}

#[test]
fn responses_and_noise_levels_are_written_without_parameters() {
    let folder = tempfile::tempdir().unwrap();
    let (structure, record) = (
        example("fifty-storeys.toml"),
        folder.path().join("building.csv"),
    );
    simulate(&structure, &record, "20");
    let table = folder.path().join("estimates.csv");
    let found = summary(&structure, &record, &["--output", table.to_str().unwrap()]);
    assert_eq!(found["parameters"], serde_json::json!({}));
    let text = std::fs::read_to_string(&table).unwrap();
    let mut lines = text.lines();
    let pairs = [
        "displacement-25",
        "velocity-25",
        "displacement-50",
        "velocity-50",
        "noise/ground",
        "noise/sensors",
    ];
    let header = pairs
        .map(|name| format!("{name}.mean,{name}.std"))
        .join(",");
    assert_eq!(lines.next(), Some(&*format!("time,{header}")));
    let last: Vec<f64> = lines
        .next_back()
        .unwrap()
        .split(',')
        .map(|cell| cell.parse().unwrap())
        .collect();
    assert_eq!((lines.count() + 1, last.len()), (2000, 13));
    // Yuen, Liang & Kuok (2013), table 2: errors of 4.1e-4, 1.2e-3, 5.5e-4 and 1.4e-3. The filter
    // reproduces them within a fifth.
    for (std, published) in [last[2], last[4], last[6], last[8]]
        .into_iter()
        .zip([4.070e-4, 1.222e-3, 5.521e-4, 1.360e-3])
    {
        assert!((std / published - 1.0).abs() < 0.2, "{std} {published}");
    }
    assert_eq!(
        (Some(last[9]), Some(last[11])),
        (
            found["noise"]["ground"]["mean"].as_f64(),
            found["noise"]["sensors"]["mean"].as_f64()
        )
    );
}

#[test]
fn a_structure_without_parameters_has_no_baseline() {
    let folder = tempfile::tempdir().unwrap();
    let (structure, record) = (
        example("sixty-storeys.toml"),
        folder.path().join("building.csv"),
    );
    simulate(&structure, &record, "1");
    let output = folder.path().join("baseline.json");
    let paths = [&structure, &record, &output].map(|path| path.to_str().unwrap());
    let told = spandrel(&[
        "baseline", paths[0], "--record", paths[1], "--output", paths[2],
    ]);
    assert_eq!(told.status.code(), Some(2));
    assert!(
        String::from_utf8_lossy(&told.stderr).contains("has no [[parameter]]"),
        "{told:?}"
    );
}

#[test]
fn data_that_contradict_the_model_give_no_baseline() {
    let folder = tempfile::tempdir().unwrap();
    let record = folder.path().join("building.csv");
    simulate(&example("demo.toml"), &record, "59");
    let file = std::fs::read_to_string(example("demo.toml")).unwrap();
    let swapped = file
        .replace("dof = \"floor-1\"", "dof = \"floor-?\"")
        .replace("dof = \"floor-5\"", "dof = \"floor-1\"")
        .replace("dof = \"floor-?\"", "dof = \"floor-5\"");
    let structure = folder.path().join("swapped.toml");
    std::fs::write(&structure, swapped).unwrap();
    let output = folder.path().join("baseline.json");
    let paths = [&structure, &record, &output].map(|path| path.to_str().unwrap());
    let told = spandrel(&[
        "baseline", paths[0], "--record", paths[1], "--output", paths[2],
    ]);
    assert_eq!(told.status.code(), Some(2), "{told:?}");
    let error = String::from_utf8_lossy(&told.stderr);
    assert!(
        error.contains("building.csv: the data contradict the model in 98 % of the frames"),
        "{error}"
    );
    assert!(!output.exists());
}

/// Returns a record with empty cells in these columns from 12 s on.
fn emptied(record: &str, columns: std::ops::RangeInclusive<usize>) -> String {
    let row = |line: &str| {
        let cells: Vec<&str> = line.split(',').collect();
        let is_late = cells[0].parse::<f64>().is_ok_and(|time_s| time_s >= 12.0);
        let cell = |(column, cell): (usize, &&str)| match is_late && columns.contains(&column) {
            true => String::new(),
            false => (*cell).to_owned(),
        };
        let cells: Vec<String> = cells.iter().enumerate().map(cell).collect();
        cells.join(",") + "\n"
    };
    record.lines().map(row).collect()
}

#[test]
fn a_baseline_leaves_out_recordings_that_show_nothing_and_names_them() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let demo = example("demo.toml");
    for (name, seed) in [("monday.csv", "1"), ("friday.csv", "3")] {
        let record = path(name);
        let simulate = ["simulate", demo.to_str().unwrap(), "--duration", "45"];
        let more = ["--seed", seed, "--record", record.to_str().unwrap()];
        assert!(spandrel(&[&simulate[..], &more].concat()).status.success());
    }
    let sound = std::fs::read_to_string(path("monday.csv")).unwrap();
    // The columns: time, ground, and five floors.
    std::fs::write(path("silent.csv"), emptied(&sound, 1..=1)).unwrap();
    std::fs::write(path("blind.csv"), emptied(&sound, 2..=6)).unwrap();
    std::fs::write(path("one-floor.csv"), emptied(&sound, 2..=5)).unwrap();
    let swapped = sound.replacen("floor-1", "floor-?", 1);
    let swapped = swapped.replacen("floor-5", "floor-1", 1);
    let swapped = swapped.replacen("floor-?", "floor-5", 1);
    std::fs::write(path("swapped.csv"), swapped).unwrap();
    let baseline = |records: &[&str]| {
        let output = path("baseline.json");
        let mut command = Command::new(env!("CARGO_BIN_EXE_spandrel"));
        command
            .arg("baseline")
            .arg(&demo)
            .arg("--output")
            .arg(output);
        for record in records {
            command.arg("--record").arg(path(record));
        }
        command.output().unwrap()
    };
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();

    let bad = ["silent.csv", "blind.csv", "swapped.csv"];
    let told = baseline(&bad);
    assert_eq!(told.status.code(), Some(2), "{told:?}");
    assert!(!path("baseline.json").exists());
    let error = text(&told.stderr);
    let none = "none of the 3 recordings is usable for a baseline";
    assert!(error.contains(none), "{error}");

    let all = [
        "monday.csv",
        "one-floor.csv",
        bad[0],
        bad[1],
        bad[2],
        "friday.csv",
    ];
    let told = baseline(&all);
    assert_eq!(told.status.code(), Some(0), "{told:?}");
    let told = text(&told.stdout);
    println!("{told}");
    assert!(
        told.contains("baseline of demo from 3 recordings"),
        "{told}"
    );
    let left_out: Vec<&str> = { told.lines() }
        .filter(|line| line.starts_with("left out: "))
        .collect();
    let expected = [
        "silent.csv: the measured excitation is missing, faulty or in doubt for ",
        "blind.csv: all sensors on the structure are missing, faulty or in doubt for ",
        "swapped.csv: the data contradict the model in ",
    ];
    assert_eq!(left_out.len(), expected.len(), "{told}");
    for (line, expected) in left_out.iter().zip(expected) {
        assert!(line.contains(expected), "{told}");
        assert!(error.contains(expected), "{error}");
    }
}

#[test]
fn a_baseline_leaves_out_an_uncertain_parameter_that_no_rule_watches() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    // Motion far below the noise teaches nothing.
    let demo = std::fs::read_to_string(example("demo.toml")).unwrap();
    let quiet = demo.replace("std = 0.1  ", "std = 0.002  ");
    assert_ne!(quiet, demo);
    let watched = quiet.replace("parameters = \"stiffness\"", "parameters = \"all\"");
    assert_ne!(watched, quiet);
    std::fs::write(path("quiet.toml"), quiet).unwrap();
    std::fs::write(path("watched.toml"), watched).unwrap();
    simulate(&path("quiet.toml"), &path("monday.csv"), "30");
    let (record, output) = (path("monday.csv"), path("baseline.json"));
    let baseline = |structure: &str| {
        spandrel(&[
            "baseline",
            path(structure).to_str().unwrap(),
            "--between-std",
            "0.01",
            "--record",
            record.to_str().unwrap(),
            "--output",
            output.to_str().unwrap(),
        ])
    };
    let told = baseline("watched.toml");
    assert_ne!(told.status.code(), Some(0), "{told:?}");
    let error = String::from_utf8_lossy(&told.stderr).into_owned();
    assert!(error.contains("parameter `damping`"), "{error}");
    assert!(!output.exists());

    let told = baseline("quiet.toml");
    assert_eq!(told.status.code(), Some(0), "{told:?}");
    let text = String::from_utf8_lossy(&told.stdout).into_owned();
    println!("{text}");
    let line = text.lines().find(|line| line.starts_with("left out: "));
    let line = line.unwrap_or_else(|| panic!("{text}"));
    for part in [
        "parameter damping",
        "no rule watches",
        "± 0.5000",
        "a std below 0.5",
    ] {
        assert!(line.contains(part), "{part}: {line}");
    }
    let file: Value = serde_json::from_slice(&std::fs::read(&output).unwrap()).unwrap();
    let parameters = file["parameters"].as_array().unwrap();
    let names: Vec<&str> = { parameters.iter() }
        .map(|parameter| parameter["parameter"].as_str().unwrap())
        .collect();
    assert_eq!(
        names,
        ["storey-1", "storey-2", "storey-3", "storey-4", "storey-5"]
    );
    for without in file["without_sensor"].as_array().unwrap() {
        assert_eq!(without["changes"].as_array().unwrap().len(), names.len());
    }
    // The file is usable: an interval for each parameter that it contains.
    let path = output.to_str().unwrap();
    let found = summary(
        &folder.path().join("quiet.toml"),
        &record,
        &["--baseline", path],
    );
    let interval = |name: &str| &found["parameters"][name]["for_this_structure"];
    assert!(interval("storey-5").is_object(), "{found}");
    assert!(interval("damping").is_null(), "{found}");
}

#[test]
fn particles_follow_a_linear_structure_without_parameters() {
    let folder = tempfile::tempdir().unwrap();
    let file = std::fs::read_to_string(example("sixty-storeys.toml")).unwrap();
    let two = file
        .replace("storeys = 60", "storeys = 2")
        .replace("floor-10\"", "floor-2\"");
    let nodes: Vec<&str> = two.split("\n[[node]]\n").collect();
    let rest = &two[two.find("\n[filter]").unwrap()..];
    let structure = folder.path().join("two.toml");
    std::fs::write(
        &structure,
        format!(
            "{}\n[[node]]\n{}\n[[node]]\n{}{rest}",
            nodes[0], nodes[1], nodes[2]
        ),
    )
    .unwrap();
    let record = folder.path().join("two.csv");
    simulate(&structure, &record, "10");
    let found = summary(
        &structure,
        &record,
        &["--filter", "particle", "--particles", "200"],
    );
    assert!(found["effective_share"].as_f64().unwrap() > 0.1, "{found}");
}
