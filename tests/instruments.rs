//! The tutorial of the instruments, as a new user follows it: the commands of the page, and a
//! program that sends the datacast of a Raspberry Shake.

use crate::support::page::{here, root};
use crate::support::{Lab, Process};
use std::path::Path;
use std::process::Command;

const PAGE: &str = include_str!("../docs/instruments.md");

/// Returns the commands of the tutorial.
fn commands() -> Vec<&'static str> {
    let tutorial = PAGE
        .split("## ")
        .find(|part| part.starts_with("A Raspberry Shake in ten"));
    let lines = tutorial.unwrap().lines().map(str::trim);
    lines.filter(|line| line.starts_with("spandrel ")).collect()
}

/// Returns a line with `#` instead of each number.
fn without_numbers(line: &str) -> String {
    let is_number = |word: &str| word.parse::<f64>().is_ok();
    let words = line
        .split(' ')
        .map(|word| match is_number(word.trim_end_matches(',')) {
            true => "#",
            false => word,
        });
    words.collect::<Vec<_>>().join(" ")
}

/// Prepares a command of the page, which runs in `folder`.
fn prepared(mut command: Command, folder: &Path, line: &str) -> Command {
    let program = Path::new(env!("CARGO_BIN_EXE_spandrel"));
    let path = std::env::var("PATH").unwrap();
    let programs = format!("{}:{path}", program.parent().unwrap().display());
    command.args(["sh", "-c", &format!("exec {line}")]);
    command
        .current_dir(folder)
        .env("PATH", programs)
        .env("XDG_STATE_HOME", folder);
    command
}

/// Returns the estimates of the stiffness with their standard deviations that `watch` has printed.
fn estimates(said: &str) -> Vec<(f64, f64)> {
    let estimate = |line: &str| {
        let rest = line.split_once("house stiffness ")?.1;
        let mut words = rest.split(' ');
        let mean = words.next()?.parse().ok()?;
        let std = words.nth(1)?.parse().ok()?;
        Some((mean, std))
    };
    said.lines().filter_map(estimate).collect()
}

/// Runs in its own network, because the page states the ports.
#[test]
fn the_datacast_of_a_shake_is_watched_as_the_page_says() {
    let Some(lab) = Lab::or_skip(&["desk"], 1) else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let examples = root().join("docs/examples/instruments");
    for name in ["raspberry-shake.toml", "raspberry-shake-feed.toml"] {
        std::fs::copy(examples.join(name), folder.join(name)).unwrap();
    }
    let simulate = "spandrel simulate raspberry-shake.toml --duration 120 --record shake.csv";
    let simulated = prepared(here(), folder, simulate).output().unwrap();
    assert!(simulated.status.success(), "{simulated:?}");
    let mut shake = lab.inside("desk");
    let program = root().join("tests/support/datacast.py");
    shake
        .arg("python3")
        .arg(program)
        .arg(folder.join("shake.csv"));
    let _shake = Process::start(&mut shake);

    let commands = commands();
    let [check, run, watch] = commands[..] else {
        panic!("{commands:?}");
    };
    let inside = |line: &str| prepared(lab.inside("desk"), folder, line);
    let checked = inside(check).output().unwrap();
    assert!(checked.status.success(), "{checked:?}");
    let said = String::from_utf8(checked.stdout).unwrap();
    let shown = PAGE.lines().map(str::trim_end);
    let shown = shown.skip_while(|line| !line.starts_with("   shake (udp"));
    let shown = shown.take_while(|line| !line.ends_with("```"));
    let shown: Vec<String> = shown.map(|line| without_numbers(&line[3..])).collect();
    let found: Vec<String> = said.lines().map(without_numbers).collect();
    assert_eq!(found, shown, "{said}");

    let services = Process::start(&mut inside(run));
    services.wait_for_log("ready structures=1");
    let watching = Process::start(&mut inside(watch));
    watching.wait_for_output("an estimate of the stiffness near 1", |said| {
        let mut found = estimates(said).into_iter();
        found.any(|(mean, std)| std < 0.03 && (mean - 1.0).abs() < 3.0 * std)
    });
    watching.stop().expect_code(0);
    services.stop().expect_code(0);
}
