//! Tests of `--open`: the desktop receives the address of the page that is printed, once.
#![cfg(target_os = "linux")]
#![expect(clippy::disallowed_methods, reason = "a deadline needs a clock")]

use crate::support::{Process, spandrel};
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

/// Only ends a hang; no result depends on it.
const DEADLINE: Duration = Duration::from_secs(180);

/// A replacement for the desktop's opener.
///
/// It writes its arguments to a file and renames the file, so that the test never reads half of it.
const OPENER: &str = r#"#!/bin/sh
printf '%s\n' "$#" "$1" > "$OPENED.part" && mv "$OPENED.part" "$OPENED"
"#;

/// A replacement that writes one line for each page.
const COUNTER: &str = r#"#!/bin/sh
printf '%s\n' "$1" >> "$OPENED"
"#;

/// Returns the variable `PATH` with an opener in a folder.
fn with_opener(folder: &Path, opener: &str) -> String {
    let file = folder.join("xdg-open");
    std::fs::write(&file, opener).unwrap();
    std::fs::set_permissions(&file, std::fs::Permissions::from_mode(0o755)).unwrap();
    format!("{}:{}", folder.display(), std::env::var("PATH").unwrap())
}

/// Waits until a condition holds.
fn wait_until(what: &str, mut holds: impl FnMut() -> bool) {
    let start = Instant::now();
    while !holds() {
        assert!(start.elapsed() < DEADLINE, "waited in vain: {what}");
        std::thread::yield_now();
    }
}

/// Returns `true` if a process has ended children for which it does not wait.
fn has_zombies(parent: u32) -> bool {
    let processes = std::fs::read_dir("/proc").unwrap();
    let states = processes.filter_map(|entry| {
        let text = std::fs::read_to_string(entry.unwrap().path().join("stat")).ok()?;
        // The name in brackets may contain anything. The state and the parent follow it.
        let after = text.rsplit_once(") ")?.1.to_owned();
        Some(after)
    });
    let zombie = format!("Z {parent} ");
    { states }.any(|state| state.starts_with(&zombie))
}

/// Regression: each reload opened a further tab of the browser, and left a zombie process.
#[test]
fn reload_does_not_open_the_page_again() {
    let desktop = tempfile::tempdir().unwrap();
    let opened = desktop.path().join("opened");
    let services = Process::start(
        spandrel("run")
            .arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo.toml"))
            .args(["--open", "--http", "127.0.0.1:0"])
            .args(["--listen", "tcp/127.0.0.1:0"])
            .env("PATH", with_opener(desktop.path(), COUNTER))
            .env("OPENED", &opened),
    );
    let pages = |text: &str| {
        text.lines()
            .filter(|line| line.starts_with("page: "))
            .count()
    };
    let lines = || std::fs::read_to_string(&opened).map_or(0, |text| text.lines().count());
    services.wait_for_output("a page", |text| pages(text) == 1);
    wait_until("the page is opened", || lines() == 1);
    services.wait_for_log("ready structures=1");
    services.hang_up();
    services.wait_for_output("a page after the reload", |text| pages(text) == 2);
    wait_until("no zombie process", || !has_zombies(services.id()));
    services.stop().expect_code(0);
    assert_eq!(lines(), 1);
}

/// Regression: the former page sometimes still had the address, and the program ended.
#[test]
fn page_has_the_same_address_after_each_of_many_reloads() {
    let free = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let page = free.local_addr().unwrap().to_string();
    drop(free);
    let services = Process::start(
        spandrel("run")
            .arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo.toml"))
            .args(["--http", &page, "--listen", "tcp/127.0.0.1:0"]),
    );
    for times in 1..=12 {
        services.wait_for_output("a page", |text| text.matches("page: ").count() == times);
        services.hang_up();
    }
    services.stop().expect_code(0);
}

#[test]
fn demo_opens_the_page_at_the_address_it_prints() {
    let desktop = tempfile::tempdir().unwrap();
    let opened = desktop.path().join("opened");
    let demo = Command::new(env!("CARGO_BIN_EXE_spandrel"))
        .args(
            "demo --open --http 127.0.0.1:0 --listen tcp/127.0.0.1:0 --speed max --duration 5"
                .split(' '),
        )
        .env("PATH", with_opener(desktop.path(), OPENER))
        .env("OPENED", &opened)
        .env("XDG_STATE_HOME", desktop.path())
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&demo.stdout);
    assert!(
        demo.status.success(),
        "{said}{}",
        String::from_utf8_lossy(&demo.stderr)
    );
    let page = said
        .lines()
        .find_map(|line| line.strip_prefix("page: "))
        .unwrap_or_else(|| panic!("no page in {said}"));
    assert!(
        page.starts_with("http://127.0.0.1:") && !page.contains(":0/"),
        "{page}"
    );
    wait_until("the page is opened", || opened.exists());
    let asked = std::fs::read_to_string(&opened).unwrap();
    assert_eq!(asked, format!("1\n{page}\n"));
}
