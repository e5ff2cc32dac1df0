//! Memory of the demo, and of commands with huge input, on systems that report and limit it for a
//! process (Linux).
#![cfg(target_os = "linux")]

use crate::support::{HOUSE, storeys, write_stored_zip};
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

/// Runs a command that must refuse its input, and returns the reason. The system aborts it at this
/// memory (MB), and kills it after this processor time (s).
fn assert_refuses(folder: &Path, arguments: &[&str], most_mb: u32, most_s: u32) -> String {
    let limits = format!(
        "ulimit -t {most_s}; ulimit -d {}; exec \"$0\" \"$@\"",
        1000 * most_mb
    );
    let mut command = Command::new("sh");
    command.args(["-c", &limits, env!("CARGO_BIN_EXE_spandrel")]);
    let ended = command.args(arguments).current_dir(folder).output();
    let ended = ended.unwrap();
    let said = String::from_utf8(ended.stderr).unwrap();
    assert_eq!(ended.status.code(), Some(2), "{arguments:?}: {said}");
    // Reading a whole file can fail without an abort.
    assert!(!said.contains("out of memory"), "{arguments:?}: {said}");
    said
}

/// Regression: these recordings took up to 4.1 GB or 31 s. The zip archives took up to 2.5 GB.
#[test]
fn huge_recordings_are_refused_within_two_seconds_and_200_mb() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let names = "ground,roof\n";
    let some = names.to_owned() + &"0.5,1.5\n".repeat(10_000);
    for (name, start) in [
        ("sparse.csv", some.as_str()),
        ("line.csv", "ground,roof\n0.5,"),
    ] {
        let mut file = std::fs::File::create(at(name)).unwrap();
        file.write_all(start.as_bytes()).unwrap();
        file.set_len(3 << 30).unwrap();
    }
    let columns: Vec<String> = (0..100_000).map(|number| format!("c{number}")).collect();
    std::fs::write(at("wide.csv"), columns.join(",") + "\n").unwrap();
    std::fs::write(at("sound.csv"), some).unwrap();
    // Long rows, because `estimate` identifies each row up to the limit.
    let long = "0".repeat(500);
    let rows = format!("0.5{long},1.5{long}\n").repeat(1 << 14);
    let rows = gzip(folder.path(), rows.as_bytes());
    let names = gzip(folder.path(), names.as_bytes());
    std::fs::write(at("rows.csv.gz"), [names, rows.repeat(64)].concat()).unwrap();
    let zeros = gzip(folder.path(), &vec![0; 16 << 20]);
    std::fs::write(at("zeros.csv.gz"), zeros.repeat(64)).unwrap();
    // 72 MiB of rows, because the rest of a file of 800 MB must not be read.
    let stored = "ground,roof\n".to_owned() + &"0.500000,1.500000\n".repeat(4 << 20);
    write_stored_zip(&at("huge.zip"), stored.as_bytes(), 800_000_000, 1);
    let part = &stored.as_bytes()[..12 + 18 * 233_000];
    write_stored_zip(&at("many.zip"), part, part.len() as u32, 20);
    let house = format!("{HOUSE}[record]\ntime-column = \"\"\n");
    std::fs::write(at("house.toml"), house).unwrap();
    let records = [
        "sparse.csv",
        "line.csv",
        "wide.csv",
        "rows.csv.gz",
        "zeros.csv.gz",
        "huge.zip",
        "many.zip",
        "/dev/zero",
    ];
    for record in records {
        for command in [
            &["info", record][..],
            &["convert", record, "out.csv", "--rate", "100"],
            &["estimate", "house.toml", "--record", record],
            &["check", "house.toml", "--record", record],
        ] {
            let said = assert_refuses(folder.path(), command, 200, 2);
            let unpacked = record.trim_end_matches(".gz");
            assert!(said.contains(unpacked), "{command:?}: {said}");
            let is_told = !record.ends_with(".zip") || said.contains("at most 64 MiB");
            assert!(is_told, "{command:?}: {said}");
        }
    }
    let convert = "convert sound.csv out.csv --rate 100 --resample 1e12";
    let convert: Vec<&str> = convert.split(' ').collect();
    assert_refuses(folder.path(), &convert, 200, 2);
}

/// Returns content as gzip data, with the largest ratio.
fn gzip(folder: &Path, content: &[u8]) -> Vec<u8> {
    let path = folder.join("unpacked");
    std::fs::write(&path, content).unwrap();
    let packed = Command::new("gzip").arg("-9nc").arg(path).output();
    packed.unwrap().stdout
}

/// Regression: a matrix without end took 3.4 GB.
#[test]
fn a_matrix_without_end_is_refused_within_two_seconds_and_200_mb() {
    let folder = tempfile::tempdir().unwrap();
    let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples");
    let text = std::fs::read_to_string(examples.join("matrices.toml")).unwrap();
    std::fs::create_dir(folder.path().join("matrices")).unwrap();
    for name in ["k-lower.mtx", "k-middle.mtx", "k-upper.mtx"] {
        let name = Path::new("matrices").join(name);
        std::fs::copy(examples.join(&name), folder.path().join(&name)).unwrap();
    }
    let huge = std::fs::File::create(folder.path().join("huge.mtx")).unwrap();
    huge.set_len(3 << 30).unwrap();
    for (matrix, reason) in [
        ("/dev/zero", "is a folder, a pipe, a device or a socket"),
        ("huge.mtx", "at most 67108864 are allowed"),
    ] {
        let text = text.replace("matrices/mass.mtx", matrix);
        std::fs::write(folder.path().join("tower.toml"), text).unwrap();
        let said = assert_refuses(folder.path(), &["check", "tower.toml"], 200, 2);
        let is_named = said.contains(&format!("model.mass: {matrix}"));
        assert!(is_named && said.contains(reason), "{said}");
    }
}

/// Regression: a check of 10,000 nodes took over 25 s and 1.6 GB, and one of 1,000 storeys with as
/// many parameters and sensors 3.7 GB. One of 1,000 storeys with 400 parameters took 59 s.
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
    for text in [storeys(1000, ""), storeys(190, ""), storeys(10, &many)] {
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
