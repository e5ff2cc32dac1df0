//! Test of the demo's memory use, on systems that report it for a process (Linux).
#![cfg(target_os = "linux")]

use std::process::{Command, Stdio};
use std::time::Duration;

/// Maximum resident size (MB).
const MOST_MB: f64 = 100.0;

/// Returns the peak resident size of a process so far (MB), or `None` once it has ended.
fn peak_mb(process: u32) -> Option<f64> {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).ok()?;
    let line = status.lines().find(|line| line.starts_with("VmHWM:"))?;
    let kilobytes: f64 = line.split_whitespace().nth(1)?.parse().ok()?;
    Some(kilobytes / 1024.0)
}

#[test]
fn ten_minutes_of_the_demo_at_full_speed_stay_below_a_hundred_megabytes() {
    let arguments = [
        "--speed",
        "max",
        "--duration",
        "600",
        "--headless",
        "--json",
        "--listen",
        "tcp/127.0.0.1:0",
    ];
    let mut demo = Command::new(env!("CARGO_BIN_EXE_spandrel"));
    let mut child = demo
        .arg("demo")
        .args(arguments)
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    let (mut peak, mut looks) = (0.0_f64, 0);
    let code = loop {
        if let Some(mb) = peak_mb(child.id()) {
            peak = peak.max(mb);
            looks += 1;
        }
        if let Some(status) = child.try_wait().unwrap() {
            break status.code();
        }
        std::thread::sleep(Duration::from_millis(5));
    };
    println!("largest resident size {peak:.0} MB, in {looks} looks");
    assert_eq!(code, Some(0));
    assert!(
        looks > 3 && peak > 1.0,
        "the process was not seen at work: {looks} looks, {peak} MB"
    );
    assert!(peak < MOST_MB, "{peak} MB");
}
