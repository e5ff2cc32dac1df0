//! Test of `--open`: the desktop receives the address of the page that is printed.
#![cfg(target_os = "linux")]
#![expect(clippy::disallowed_methods, reason = "a deadline needs a clock")]

use std::os::unix::fs::PermissionsExt as _;
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

#[test]
fn demo_opens_the_page_at_the_address_it_prints() {
    let desktop = tempfile::tempdir().unwrap();
    let (opener, opened) = (
        desktop.path().join("xdg-open"),
        desktop.path().join("opened"),
    );
    std::fs::write(&opener, OPENER).unwrap();
    std::fs::set_permissions(&opener, std::fs::Permissions::from_mode(0o755)).unwrap();
    let path = format!(
        "{}:{}",
        desktop.path().display(),
        std::env::var("PATH").unwrap()
    );
    let demo = Command::new(env!("CARGO_BIN_EXE_spandrel"))
        .args(
            "demo --open --http 127.0.0.1:0 --listen tcp/127.0.0.1:0 --speed max --duration 5"
                .split(' '),
        )
        .env("PATH", path)
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
    let start = Instant::now();
    let asked = loop {
        match std::fs::read_to_string(&opened) {
            Ok(asked) => break asked,
            Err(error) => assert!(start.elapsed() < DEADLINE, "nothing was opened: {error}"),
        }
        std::thread::yield_now();
    };
    assert_eq!(asked, format!("1\n{page}\n"));
}
