//! `spandrel judge`: the example of the book, and series with mistakes.

use spandrel_validate::seasons;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// Length of the example.
const DAYS: u32 = 510;
/// Date of the loss of the example.
const LOSS_DATE: &str = "2025-10-24";
const SECONDS_PER_DAY: f64 = 86_400.0;

fn example(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../docs/examples/judge")
        .join(name)
}

fn judge(structure: &Path, series: &Path, options: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_spandrel"));
    command
        .arg("judge")
        .arg(structure)
        .arg("--series")
        .arg(series);
    command.args(options).output().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Runs `spandrel judge --example`.
fn write_example(path: &Path, options: &str) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_spandrel"));
    command.args(["judge", "--example"]).arg(path);
    command.args(options.split_whitespace()).output().unwrap()
}

/// The file also shows that the series of a seed does not change.
#[test]
fn the_example_series_is_that_of_the_command() {
    let path = example("footbridge.csv");
    let folder = tempfile::tempdir().unwrap();
    let written = folder.path().join("footbridge.csv");
    let output = write_example(&written, "--days 510 --loss 0.05 --loss-day 480");
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let told = format!("{}: 2040 epochs, 510 days, seed 1\n", written.display());
    assert_eq!(text(&output.stdout), told);
    let simulated = std::fs::read_to_string(written).unwrap();
    if std::env::var_os("UPDATE_DOCS").is_some() {
        std::fs::write(&path, &simulated).unwrap();
    }
    let found = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(
        found == simulated,
        "docs/examples/judge/footbridge.csv differs from the simulation; UPDATE_DOCS=1 rewrites it"
    );
}

#[test]
fn a_mistake_in_the_options_of_the_example_is_named_and_nothing_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("example.csv");
    for (options, told) in [
        ("--days 0", "0 is not in 1..=3653"),
        (
            "--days 10 --loss 0.05 --loss-day 10",
            "--loss-day: 10, must be below --days",
        ),
        (
            "--loss 0.05 --loss-day 400 --repair-day 400",
            "--repair-day: 400, must be above --loss-day and below --days",
        ),
        ("--loss 1.5 --loss-day 400", "must be above 0 and below 1"),
        ("--loss 0.05", "--loss-day <DAY>"),
        ("--loss-day 400", "--loss <SHARE>"),
        ("--series other.csv", "cannot be used with"),
    ] {
        let output = write_example(&path, options);
        let stderr = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{options}: {stderr}");
        assert!(stderr.contains(told), "{options}: {stderr}");
        assert!(!path.exists(), "{options}");
    }
    let mut command = Command::new(env!("CARGO_BIN_EXE_spandrel"));
    let output = command.args(["judge", "--seed", "2"]).output().unwrap();
    assert_eq!(output.status.code(), Some(2));
    assert!(text(&output.stderr).contains("--example <FILE>"));
}

#[test]
fn the_example_finds_its_loss_and_nothing_before() {
    let output = judge(
        &example("footbridge.toml"),
        &example("footbridge.csv"),
        &["--json"],
    );
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let stdout = text(&output.stdout);
    let lines: Vec<serde_json::Value> = stdout
        .lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect();
    let raised: Vec<_> = lines.iter().filter(|line| line["raised"] == true).collect();
    let losses: Vec<_> = raised
        .iter()
        .filter(|line| line["finding"]["kind"] != "stiffer")
        .collect();
    let [loss] = losses[..] else {
        panic!("one loss must be raised: {losses:?}");
    };
    assert_eq!(loss["quantity"], "first-bending");
    assert_eq!(loss["finding"]["kind"], "lasting-loss");
    let date = loss["date"].as_str().unwrap();
    assert!(date >= LOSS_DATE, "raised on {date}, lost on {LOSS_DATE}");
}

#[test]
fn the_course_has_a_row_per_quantity_and_day_with_the_numbers_of_the_judgements() {
    let folder = tempfile::tempdir().unwrap();
    let days = folder.path().join("days.csv");
    let output = judge(
        &example("footbridge.toml"),
        &example("footbridge.csv"),
        &["--json", "--course", days.to_str().unwrap()],
    );
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let course = std::fs::read_to_string(&days).unwrap();
    let mut rows = course.lines();
    let head: Vec<&str> = rows.next().unwrap().split(',').collect();
    let column = |name: &str| head.iter().position(|head| *head == name).unwrap();
    let rows: Vec<Vec<&str>> = rows.map(|row| row.split(',').collect()).collect();
    assert_eq!(rows.len(), 2 * DAYS as usize);
    let quantities: Vec<&str> = rows.iter().map(|row| row[column("quantity")]).collect();
    assert!(
        quantities[..DAYS as usize]
            .iter()
            .all(|of| *of == "first-bending")
    );
    let stdout = text(&output.stdout);
    let lines = stdout
        .lines()
        .map(|line| serde_json::from_str::<serde_json::Value>(line).unwrap());
    let mut expected = 0;
    for line in lines {
        let is_it = |row: &&Vec<&str>| {
            row[column("date")] == line["date"] && row[column("quantity")] == line["quantity"]
        };
        let row = rows.iter().find(is_it).unwrap();
        assert_eq!(row[column("state")], line["state"]);
        let number = |name: &str| row[column(name)].parse::<f64>().ok();
        assert_eq!(number("measured"), line["means"]["value"].as_f64());
        assert_eq!(number("expected"), line["expectation"]["expected"].as_f64());
        // The means of conditions have single precision.
        let single = |value: Option<f64>| value.map(|value| value as f32);
        assert_eq!(
            single(number("condition/deck")),
            single(line["means"]["conditions"][0].as_f64())
        );
        assert_eq!(number("loss"), line["finding"]["loss"].as_f64());
        expected += i32::from(number("expected").is_some());
    }
    assert!(expected > 200, "{expected}");
}

#[test]
fn the_report_states_promise_achievement_and_what_would_be_missed() {
    let output = judge(
        &example("footbridge.toml"),
        &example("footbridge.csv"),
        &["--report"],
    );
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let stdout = text(&output.stdout);
    for part in [
        "budget: 0.1 false alarms per year for 2 quantities",
        "alarms: 1 in 144 days judged, 1 of them in the last year; false alarms promised for these \
         days: 0.039",
        "false alarms per year: 0.050 promised",
        "loss of 5 %: found after",
        "loss of 1 %: mostly missed",
    ] {
        assert!(stdout.contains(part), "{part}\n{stdout}");
    }
    let output = judge(
        &example("footbridge.toml"),
        &example("footbridge.csv"),
        &["--report", "--json"],
    );
    let stdout = text(&output.stdout);
    let last: serde_json::Value = serde_json::from_str(stdout.lines().last().unwrap()).unwrap();
    assert_eq!(last["budget"]["alarms"], 1);
    assert_eq!(last["budget"]["judged_days"], 144);
}

/// A mistake in the example, and a part of its message.
struct Mistake {
    structure: (&'static str, &'static str),
    series: (&'static str, &'static str),
    said: &'static [&'static str],
}

const NONE: (&str, &str) = ("", "");

#[test]
fn a_mistake_in_a_series_is_named_with_its_place_and_exit_code_2() {
    let series = "time,f1_hz,f2_hz,deck_celsius\n2025-01-01T00:00:00Z,2.3,3.9,4.0\n\
                  2025-01-01T06:00:00Z,2.3,3.9,4.5\n2025-01-01T12:00:00Z,2.3,3.9,5.0\n";
    let structure = std::fs::read_to_string(example("footbridge.toml")).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let (toml, csv) = (
        folder.path().join("bridge.toml"),
        folder.path().join("bridge.csv"),
    );
    let mistakes = [
        Mistake {
            structure: NONE,
            series: ("T12:00", "T03:00"),
            said: &[
                "bridge.csv:4: column `time`: time 2025-01-01T03:00:00Z is not later than",
                "1 of 3 rows are not in the order of time",
            ],
        },
        Mistake {
            structure: NONE,
            series: ("2025-01-01T06:00", "2026-01-01T06:00"),
            said: &[
                "bridge.csv:3: column `time`: time 2026-01-01T06:00:00Z is far ahead of both \
                 neighbours",
            ],
        },
        Mistake {
            structure: NONE,
            series: ("2025-01-01T00:00:00Z", "100000000000"),
            said: &[
                "bridge.csv:2: time is `100000000000`, must be seconds, ISO 8601, DD.MM.YYYY HH:MM",
            ],
        },
        Mistake {
            structure: NONE,
            series: ("5.0", "278.2"),
            said: &["bridge.csv:4:", "deck_celsius", "278.2", "check the unit"],
        },
        Mistake {
            structure: NONE,
            series: ("2.3,3.9,5.0", "-2.3,3.9,5.0"),
            said: &["bridge.csv:4:", "f1_hz", "is -2.3, must be above 0"],
        },
        Mistake {
            structure: NONE,
            series: ("f1_hz,f2_hz", "tower_f1,tower_f2"),
            said: &["bridge.csv:1: has no column `f1_hz`, `f2_hz`", "tower_f1"],
        },
        Mistake {
            structure: ("loss = 0.02", "losss = 0.02"),
            series: NONE,
            said: &["bridge.toml:10: judge.losss: is not a known key"],
        },
    ];
    for mistake in mistakes {
        let changed = |text: &str, (from, to): (&str, &str)| {
            assert!(text.contains(from), "{from}");
            if from.is_empty() {
                text.to_owned()
            } else {
                text.replace(from, to)
            }
        };
        std::fs::write(&toml, changed(&structure, mistake.structure)).unwrap();
        std::fs::write(&csv, changed(series, mistake.series)).unwrap();
        let output = judge(&toml, &csv, &[]);
        let stderr = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{stderr}");
        for part in mistake.said {
            assert!(stderr.contains(part), "{part}\n{stderr}");
        }
    }
}

/// Regression test: numbers of hours were read as seconds, so a year was an hour of 1970.
#[test]
fn numbers_of_hours_are_not_read_as_seconds() {
    let folder = tempfile::tempdir().unwrap();
    let csv = folder.path().join("hours.csv");
    let series = "time,f1_hz,f2_hz,deck_celsius\n0,2.3,3.9,4.0\n1,2.3,3.9,4.5\n2,2.3,3.9,5.0\n";
    std::fs::write(&csv, series).unwrap();
    let output = judge(&example("footbridge.toml"), &csv, &[]);
    let stderr = text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{stderr}");
    for part in [
        "hours.csv:3: column `time`",
        "the row is 1 s after the previous one",
        "as seconds since 1970, or in ISO 8601, such as 2025-01-01T06:00:00Z",
    ] {
        assert!(stderr.contains(part), "{part}\n{stderr}");
    }
    // The same hours in seconds are a record without dates.
    std::fs::write(
        &csv,
        series.replace("\n1,", "\n3600,").replace("\n2,", "\n7200,"),
    )
    .unwrap();
    let output = judge(&example("footbridge.toml"), &csv, &[]);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
}

/// Returns the lines of the example with other times, and what `judge` prints.
fn judge_with_times(name: &str, time: impl Fn(i64) -> String) -> (String, String) {
    let folder = tempfile::tempdir().unwrap();
    let csv = folder.path().join(name);
    let series = std::fs::read_to_string(example("footbridge.csv")).unwrap();
    let mut changed = String::new();
    for line in series.lines() {
        let (at, rest) = line.split_once(',').unwrap();
        match at.parse::<i64>() {
            Ok(second) => changed += &format!("{},{rest}\n", time(second)),
            Err(_) => changed += &format!("{line}\n"),
        }
    }
    std::fs::write(&csv, changed).unwrap();
    let output = judge(&example("footbridge.toml"), &csv, &["--json"]);
    let stderr = text(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{stderr}");
    (text(&output.stdout), stderr)
}

#[test]
fn the_times_of_spreadsheets_and_loggers_give_the_same_judgements() {
    let form = |pattern: &'static str| {
        move |second: i64| {
            let at = jiff::Timestamp::from_second(second).unwrap();
            at.strftime(pattern).to_string()
        }
    };
    let (expected, _) = judge_with_times("iso.csv", form("%Y-%m-%dT%H:%M:%SZ"));
    for pattern in ["%d.%m.%Y %H:%M", "%d.%m.%Y %H:%M:%S", "%Y/%m/%d %H:%M"] {
        let (found, stderr) = judge_with_times("dates.csv", form(pattern));
        assert!(found == expected, "{pattern}: {stderr}");
    }
    for zeros in ["", "000", "000000", "000000000"] {
        let (found, stderr) = judge_with_times("numbers.csv", |second| format!("{second}{zeros}"));
        assert!(found == expected, "{zeros}: {stderr}");
    }
}

#[test]
fn rows_that_are_not_in_the_order_of_time_are_left_out_with_a_warning() {
    let folder = tempfile::tempdir().unwrap();
    let csv = folder.path().join("rows.csv");
    let series = std::fs::read_to_string(example("footbridge.csv")).unwrap();
    let lines: Vec<&str> = series.lines().collect();
    let sound = judge(
        &example("footbridge.toml"),
        &example("footbridge.csv"),
        &["--json"],
    );
    let run = |lines: &[String]| {
        std::fs::write(&csv, lines.join("\n") + "\n").unwrap();
        let output = judge(&example("footbridge.toml"), &csv, &["--json"]);
        let stderr = text(&output.stderr);
        assert_eq!(output.status.code(), Some(0), "{stderr}");
        assert!(output.stdout == sound.stdout, "{stderr}");
        stderr
    };
    // Line 801 of the file is repeated, and a row of 2032 follows line 1000.
    let mut disturbed: Vec<String> = lines.iter().map(|line| (*line).to_owned()).collect();
    let (_, values) = lines[1000].split_once(',').unwrap();
    disturbed.insert(1000, format!("1956528000,{values}"));
    disturbed.insert(801, lines[800].to_owned());
    let stderr = run(&disturbed);
    assert!(
        stderr.contains("rows.csv line=802 reason=time "),
        "{stderr}"
    );
    assert!(stderr.contains("is not later than"), "{stderr}");
    assert!(stderr.contains("left_out=2 rows=2042"), "{stderr}");
    assert!(!stderr.contains("daylight saving"), "{stderr}");
    // Local times without a zone repeat an hour.
    let local = disturbed.iter().map(|line| {
        let (at, rest) = line.split_once(',').unwrap();
        match at.parse().map(jiff::Timestamp::from_second) {
            Ok(at) => format!("{},{rest}", at.unwrap().strftime("%d.%m.%Y %H:%M")),
            Err(_) => line.clone(),
        }
    });
    let stderr = run(&local.collect::<Vec<_>>());
    assert!(stderr.contains("when daylight saving ends"), "{stderr}");
}

#[test]
fn words_for_missing_values_are_those_of_an_empty_field() {
    let folder = tempfile::tempdir().unwrap();
    let csv = folder.path().join("missing.csv");
    let series = std::fs::read_to_string(example("footbridge.csv")).unwrap();
    let with = |word: &str| {
        let lines = series.lines().enumerate().map(|(index, line)| {
            let fields: Vec<&str> = line.split(',').collect();
            match index % 10 {
                3 => format!("{},{word},{},{}\n", fields[0], fields[2], fields[3]),
                _ => format!("{line}\n"),
            }
        });
        std::fs::write(&csv, lines.collect::<String>()).unwrap();
        let output = judge(&example("footbridge.toml"), &csv, &["--json"]);
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        output.stdout
    };
    let empty = with("");
    for word in ["NA", "N/A", "#N/A", "nan", "-", "NaN", "n/a"] {
        assert!(with(word) == empty, "{word}");
    }
}

/// A note that is not about this series must not clear its loss.
#[test]
fn a_note_about_something_else_or_another_time_is_named_with_its_line() {
    let folder = tempfile::tempdir().unwrap();
    let notes = folder.path().join("notes.jsonl");
    let note = "{\"structure\": \"footbridge\", \"quantity\": \"first-bending\", \"time_ns\": \
                1762300800000000000, \"from_ns\": 1762300800000000000, \"kind\": \"repair\", \
                \"effect\": \"new-reference\", \"who\": \"ada\", \"text\": \"new bearings\"}";
    let run = |from: &str, to: &str| {
        std::fs::write(&notes, format!("\n{}\n", note.replace(from, to))).unwrap();
        let options = ["--annotations", notes.to_str().unwrap()];
        let output = judge(
            &example("footbridge.toml"),
            &example("footbridge.csv"),
            &options,
        );
        let stderr = text(&output.stderr);
        assert_eq!(output.status.code(), Some(0), "{stderr}");
        (text(&output.stdout), stderr)
    };
    let (stdout, stderr) = run("ada", "ada");
    assert!(!stderr.contains("notes.jsonl"), "{stderr}");
    assert!(stdout.contains("first-bending is being learnt"), "{stdout}");
    for (from, to, told) in [
        (
            "footbridge",
            "footbrige",
            "notes.jsonl line=2 reason=structure is `footbrige`, must be `footbridge`",
        ),
        (
            "first-bending",
            "first-bendng",
            "notes.jsonl line=2 reason=quantity is `first-bendng`, must be one of: \
             `first-bending`, `first-torsion`",
        ),
        (
            "1762300800000000000",
            "1762300800",
            "notes.jsonl line=2 begins=1970-01-01T00:00:01Z",
        ),
    ] {
        let (stdout, stderr) = run(from, to);
        assert!(stderr.contains(told), "{told}\n{stderr}");
        assert!(
            !stdout.contains("first-bending is being learnt"),
            "{stdout}"
        );
    }
}

#[test]
fn a_series_without_its_thermometer_gives_no_alarm() {
    let folder = tempfile::tempdir().unwrap();
    let csv = folder.path().join("blind.csv");
    let series = std::fs::read_to_string(example("footbridge.csv")).unwrap();
    let blind = series.lines().map(|line| match line.rsplit_once(',') {
        Some((measured, "deck_celsius")) => format!("{measured},deck_celsius\n"),
        Some((measured, _)) => format!("{measured},\n"),
        None => panic!("{line}"),
    });
    std::fs::write(&csv, blind.collect::<String>()).unwrap();
    let output = judge(&example("footbridge.toml"), &csv, &[]);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let stdout = text(&output.stdout);
    assert!(stdout.contains("0 days judged"), "{stdout}");
    assert!(stdout.contains("deck was not measured"), "{stdout}");
    assert!(!stdout.contains("lasting-loss"), "{stdout}");
}

#[test]
fn a_series_without_a_temperature_needs_a_commissioning_of_a_year() {
    let folder = tempfile::tempdir().unwrap();
    let toml = folder.path().join("blind.toml");
    let quantity = "[[judge.quantity]]\nname = \"first\"\nis = \"frequency\"\ncolumn = \"f1_hz\"\n";
    let structure = |days: u32| {
        format!("[structure]\nname = \"blind\"\n[judge]\ncommissioning-days = {days}\n{quantity}")
    };
    for days in [120, 365] {
        std::fs::write(&toml, structure(days)).unwrap();
        let output = judge(&toml, &example("footbridge.csv"), &[]);
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        let stdout = text(&output.stdout);
        let needs_a_year = stdout.contains(
            "the commissioning spans 120 days, must span at least 330, because no temperature is \
             measured; the commissioning was extended by",
        );
        assert_eq!(needs_a_year, days == 120, "{days} days: {stdout}");
    }
}

#[test]
fn the_check_of_a_file_for_judgement_alone_names_its_quantities_and_conditions() {
    let output = Command::new(env!("CARGO_BIN_EXE_spandrel"))
        .arg("check")
        .arg(example("footbridge.toml"))
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let stdout = text(&output.stdout);
    for part in [
        "no model, for judgement only",
        "quantities: first-bending, first-torsion",
        "conditions: deck",
    ] {
        assert!(stdout.contains(part), "{part}\n{stdout}");
    }
}

#[test]
fn a_year_of_ten_quantities_is_judged() {
    let folder = tempfile::tempdir().unwrap();
    let (toml, csv) = (
        folder.path().join("ten.toml"),
        folder.path().join("ten.csv"),
    );
    let mut structure =
        "[structure]\nname = \"ten\"\n[judge]\ncommissioning-days = 120\n".to_owned();
    structure += "[[judge.condition]]\nname = \"deck\"\nunit = \"degC\"\n";
    let mut header = "time,deck".to_owned();
    for mode in 1..=10 {
        structure += &format!("[[judge.quantity]]\nname = \"mode-{mode}\"\nis = \"frequency\"\n");
        header += &format!(",mode-{mode}");
    }
    let mut series = header + "\n";
    let bridges: Vec<_> = (1..=5).map(|seed| seasons(seed, 365, None)).collect();
    for (index, first) in bridges[0].iter().enumerate() {
        series += &format!("{:.0},{:.3}", SECONDS_PER_DAY * first.day, first.deck);
        for value in bridges.iter().flat_map(|rows| rows[index].frequencies) {
            series += &value.map_or(",".to_owned(), |hertz| format!(",{hertz:.5}"));
        }
        series.push('\n');
    }
    std::fs::write(&toml, structure).unwrap();
    std::fs::write(&csv, series).unwrap();
    let output = judge(&toml, &csv, &["--json"]);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let stdout = text(&output.stdout);
    assert_eq!(stdout.lines().count(), 10 * 365);
    // The other bridges have other weather than the thermometer.
    let at_the_thermometer = |line: &&str| {
        line.contains("\"quantity\":\"mode-1\"") || line.contains("\"quantity\":\"mode-2\"")
    };
    let mut judged = 0;
    for line in stdout.lines().filter(at_the_thermometer) {
        judged += 1;
        for found in ["\"lasting-loss\"", "\"learned-away\""] {
            assert!(!line.contains(found), "{line}");
        }
    }
    assert_eq!(judged, 2 * 365);
}
