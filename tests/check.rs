//! Tests of the built binary with `spandrel check`: exit codes and output streams.

use crate::support::{Process, Site, five_storeys, spandrel, two_storeys};
use std::path::PathBuf;
use std::process::{Command, Output};

fn check(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_spandrel"))
        .arg("check")
        .args(arguments)
        .output()
        .unwrap()
}

fn example(name: &str) -> String {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR"))
        .join("../../docs/examples")
        .join(name);
    path.to_str().unwrap().to_owned()
}

fn text(bytes: &[u8]) -> &str {
    std::str::from_utf8(bytes).unwrap()
}

#[test]
fn examples_are_checked_with_exit_code_0_and_nothing_on_standard_error() {
    for name in [
        "demo.toml",
        "output-only.toml",
        "noisy.toml",
        "matrices.toml",
        "fifty-storeys.toml",
    ] {
        let output = check(&[&example(name)]);
        assert_eq!(
            output.status.code(),
            Some(0),
            "{name}: {}",
            text(&output.stderr)
        );
        assert_eq!(text(&output.stderr), "", "{name}");
        assert!(
            text(&output.stdout).contains("natural modes as designed"),
            "{name}: {}",
            text(&output.stdout)
        );
    }
}

/// Regression: the description was printed as it is in the file, so a terminal obeyed it.
#[test]
fn terminal_escapes_in_a_description_are_printed_as_text() {
    let described = "name = \"house\"\ndescription = \"tall\\u001b[2J\\u0007\"";
    let file = two_storeys("").replacen("name = \"house\"", described, 1);
    let site = Site::with(&file);
    let output = check(&[site.structure_file().to_str().unwrap()]);
    let page = text(&output.stdout);
    assert!(page.starts_with("house: tall\\u{1b}[2J\\u{7}\n"), "{page}");
    assert!(!page.contains(['\u{1b}', '\u{7}']), "{page:?}");
}

#[test]
fn a_structure_without_parameters_reports_only_motion_and_levels() {
    for (name, adapted) in [
        ("fifty-storeys.toml", "yes"),
        ("fifty-storeys-wind.toml", "yes"),
        ("sixty-storeys.toml", "no"),
    ] {
        let output = check(&[&example(name)]);
        let page = text(&output.stdout);
        assert!(
            page.contains("no parameters: the filter follows the motion"),
            "{name}: {page}"
        );
        assert!(
            page.contains(&format!("  {adapted}  ")) && !page.contains("warning: "),
            "{name}: {page}"
        );
    }
}

#[test]
fn warnings_are_not_failures() {
    let output = check(&[&example("output-only.toml")]);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let page = text(&output.stdout);
    assert!(
        page.contains("\nwarning: storey-1 depends on the level and the spectrum of ground"),
        "{page}"
    );
}

#[test]
fn json_is_one_object_for_the_requested_length() {
    let output = check(&[&example("demo.toml"), "--after", "120", "--json"]);
    let json: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(
        (&json["structure"], &json["after_s"]),
        (&"demo".into(), &120.0.into())
    );
}

#[test]
fn a_bad_file_ends_with_2_and_shows_line_and_key() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bad.toml");
    let file = std::fs::read_to_string(example("demo.toml")).unwrap();
    std::fs::write(&path, file.replace("half-life-s = 10", "half-live-s = 10")).unwrap();
    let line = file
        .lines()
        .position(|line| line.starts_with("half-life-s"))
        .unwrap()
        + 1;
    let output = check(&[path.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(2));
    let message = text(&output.stderr);
    assert!(
        message.contains(&format!("bad.toml:{line}: filter.half-live-s")),
        "{message}"
    );
    assert!(
        message.contains("did you mean \"half-life-s\"?"),
        "{message}"
    );
    assert_eq!(text(&output.stdout), "");
}

#[test]
fn a_missing_file_and_a_bad_length_end_with_2() {
    let missing = check(&["no-such-file.toml"]);
    assert_eq!(missing.status.code(), Some(2));
    assert!(
        text(&missing.stderr).contains("no-such-file.toml"),
        "{}",
        text(&missing.stderr)
    );
    assert_eq!(
        check(&[&example("demo.toml"), "--after", "-1"])
            .status
            .code(),
        Some(2)
    );
}

#[test]
fn live_sensors_are_checked_like_those_of_a_record() {
    let site = Site::of(&five_storeys());
    let services = site.run();
    let mut record = site.simulate(120.0);
    let rows = record.len();
    record
        .change("floor-3", 0..rows, |_, value| -value)
        .save_as("inverted.csv");
    let mut offline = spandrel("check");
    offline.arg(site.structure_file()).arg("--json");
    offline.arg("--record").arg(record.path());
    let offline = Process::start(&mut offline).wait().expect_code(0).stdout;
    let mut live = site.connecting("check");
    let live = Process::start(live.args(["--json", "--live", "120"]));
    live.wait_for_log("waiting for frames");
    site.replay(&record, "max").wait().expect_code(0);
    assert_eq!(live.wait().expect_code(0).stdout, offline);
    assert!(offline.contains("opposite sign"), "{offline}");
    services.stop().expect_code(0);
}

#[test]
fn exchanged_channels_of_a_record_are_named_with_a_baseline_only() {
    let text = std::fs::read_to_string(five_storeys()).unwrap();
    let (sound, _) = text.split_once("[[simulation.damage]]").unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let start = |command: &mut Command| Process::start(command).wait();
    std::fs::write(path("house.toml"), sound).unwrap();
    for seed in ["1", "2", "3", "4"] {
        let mut simulate = spandrel("simulate");
        simulate
            .arg(path("house.toml"))
            .args(["--duration", "120", "--seed", seed]);
        start(
            simulate
                .arg("--record")
                .arg(path(seed).with_extension("csv")),
        )
        .expect_code(0);
    }
    let mut baseline = spandrel("baseline");
    baseline
        .arg(path("house.toml"))
        .arg("--output")
        .arg(path("baseline.json"));
    for record in ["1.csv", "2.csv", "3.csv"] {
        baseline.arg("--record").arg(path(record));
    }
    start(&mut baseline).expect_code(0);
    let record = std::fs::read_to_string(path("4.csv")).unwrap();
    let (header, rows) = record.split_once('\n').unwrap();
    let header = header.replace("floor-1", "x").replace("floor-5", "floor-1");
    let exchanged = format!("{}\n{rows}", header.replace('x', "floor-5"));
    std::fs::write(path("exchanged.csv"), exchanged).unwrap();
    let checked = |record: &str, with: &[&str]| {
        let mut check = spandrel("check");
        check
            .current_dir(folder.path())
            .args(["house.toml", "--record", record])
            .args(with);
        start(&mut check)
    };
    let with = ["--baseline", "baseline.json"];
    let page = checked("exchanged.csv", &[]).expect_code(0).stdout;
    assert!(!page.contains("exchanged"), "{page}");
    let page = checked("4.csv", &with).expect_code(0).stdout;
    assert_eq!(page.matches(" sound ").count(), 6, "{page}");
    let page = checked("exchanged.csv", &with).expect_code(0).stdout;
    for floor in ["floor-1", "floor-5"] {
        assert!(
            page.contains(&format!("{floor} is exchanged with another one")),
            "{page}"
        );
    }

    let learnt = std::fs::read_to_string(path("baseline.json")).unwrap();
    let mut learnt: serde_json::Value = serde_json::from_str(&learnt).unwrap();
    learnt["sensors"].as_array_mut().unwrap().remove(0);
    std::fs::write(path("baseline.json"), learnt.to_string()).unwrap();
    let warning = checked("4.csv", &with).expect_code(0).stderr;
    let expected = "contains no reference for the sensors ground";
    assert!(warning.contains(expected), "{warning}");
    learnt["structure"] = "tower".into();
    std::fs::write(path("baseline.json"), learnt.to_string()).unwrap();
    let message = checked("4.csv", &with).expect_code(2).stderr;
    assert!(
        message.contains("tower") && message.contains("baseline.json"),
        "{message}"
    );
}

/// Frames with fewer channels than the file states would be read beyond their end.
#[test]
fn a_live_check_with_another_file_names_the_difference() {
    let site = Site::with(&two_storeys(""));
    let services = site.run();
    let text = std::fs::read_to_string(five_storeys()).unwrap();
    let other = site.folder().join("other.toml");
    std::fs::write(&other, text.replace("\"demo\"", "\"house\"")).unwrap();
    let mut live = spandrel("check");
    live.arg(&other).args(["-v", "--live", "10"]);
    live.args(["--root", site.keys().root().as_str()]);
    let live = Process::start(live.args(["--connect", site.endpoint()]));
    live.wait_for_log("waiting for frames");
    let record = site.simulate(4.0);
    site.replay(&record, "max").wait().expect_code(0);
    let message = live.wait().expect_code(2).stderr;
    let expected = "the frames of house have 4 channels at 100 Hz, the structure file states 6";
    assert!(message.contains(expected), "{message}");
    services.stop().expect_code(0);
}

#[test]
fn a_live_check_without_sensors_says_what_to_look_at() {
    let site = Site::of(&five_storeys());
    let services = site.run();
    let mut live = site.connecting("check");
    let finished = Process::start(live.args(["--live", "60"])).wait();
    let message = finished.expect_code(1).stderr;
    let expected = "no frames of demo for 10 s, after 0 s of data";
    assert!(message.contains(expected), "{message}");
    services.stop().expect_code(0);
}
