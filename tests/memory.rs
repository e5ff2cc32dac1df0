//! Memory of the demo, and of commands with huge input, on systems that report and limit it for a
//! process (Linux).
#![cfg(target_os = "linux")]

use crate::support::storeys;
use std::io::Write as _;
use std::path::Path;
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

/// Runs a command that must refuse its input. The system aborts it at this memory (MB), and kills it
/// after this processor time (s).
fn assert_refuses(folder: &Path, arguments: &[&str], most_mb: u32, most_s: u32) {
    let limits = format!(
        "ulimit -t {most_s}; ulimit -d {}; exec \"$0\" \"$@\"",
        1000 * most_mb
    );
    let mut command = Command::new("sh");
    command.args(["-c", &limits, env!("CARGO_BIN_EXE_spandrel")]);
    let ended = command.args(arguments).current_dir(folder).output();
    let ended = ended.unwrap();
    let said = String::from_utf8_lossy(&ended.stderr);
    assert_eq!(ended.status.code(), Some(2), "{arguments:?}: {said}");
}

/// Regression: these recordings took up to 4.1 GB or 31 s.
#[test]
fn huge_recordings_are_refused_within_two_seconds_and_200_mb() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let rows = "0.5,1.5\n".repeat(1 << 21);
    for (name, start) in [("sparse.csv", &rows[..80_000]), ("line.csv", "0.5,")] {
        let mut file = std::fs::File::create(at(name)).unwrap();
        file.write_all(start.as_bytes()).unwrap();
        file.set_len(3 << 30).unwrap();
    }
    let columns: Vec<String> = (0..100_000).map(|number| format!("c{number}")).collect();
    std::fs::write(at("wide.csv"), columns.join(",") + "\n").unwrap();
    std::fs::write(at("sound.csv"), &rows[..80_000]).unwrap();
    std::fs::write(at("rows"), rows).unwrap();
    let packed = Command::new("gzip").arg("-9nc").arg(at("rows")).output();
    std::fs::write(at("rows.csv.gz"), packed.unwrap().stdout.repeat(64)).unwrap();
    let records = [
        "sparse.csv",
        "line.csv",
        "wide.csv",
        "rows.csv.gz",
        "/dev/zero",
    ];
    for record in records {
        assert_refuses(folder.path(), &["info", record], 200, 2);
    }
    let convert = "convert sound.csv out.csv --rate 100 --resample 1e12";
    let convert: Vec<&str> = convert.split(' ').collect();
    assert_refuses(folder.path(), &convert, 200, 2);
}

/// Regression: a check of 10,000 nodes took over 25 s and 1.6 GB, and one of 1,000 storeys with as
/// many parameters and sensors 3.7 GB.
#[test]
fn a_check_that_takes_too_much_memory_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let node = |number: u32| {
        format!(
            "[[node]]\nname = \"n{number}\"\n[[node.channel]]\nname = \"n{number}\"\n\
             quantity = \"velocity\"\ndof = \"floor-1\"\nunit = \"m/s\"\nnoise-std = 0.001\n"
        )
    };
    let many: String = (0..10_000).map(node).collect();
    for text in [storeys(1000, ""), storeys(240, ""), storeys(10, &many)] {
        std::fs::write(folder.path().join("tower.toml"), text).unwrap();
        assert_refuses(folder.path(), &["check", "tower.toml"], 500, 20);
    }
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
