//! Memory of the demo, and of commands with huge input, on systems that report and limit it for a
//! process (Linux).
#![cfg(target_os = "linux")]

use crate::support::{HOUSE, storeys, write_stored_zip};
use std::io::Write as _;
use std::path::Path;
use std::process::{Command, Output, Stdio};
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

/// Runs a command that must refuse its input, and returns the reason. The limits are those of
/// [`limited`].
fn assert_refuses(folder: &Path, arguments: &[&str], most_mb: u32, most_s: u32) -> String {
    let ended = limited(folder, arguments, most_mb, most_s);
    let said = String::from_utf8(ended.stderr).unwrap();
    assert_eq!(ended.status.code(), Some(2), "{arguments:?}: {said}");
    // Reading a whole file can fail without an abort.
    assert!(!said.contains("out of memory"), "{arguments:?}: {said}");
    said
}

/// Runs a command. The system aborts it at this memory (MB), and kills it after this processor time
/// (s).
fn limited(folder: &Path, arguments: &[&str], most_mb: u32, most_s: u32) -> Output {
    let limits = format!(
        "ulimit -t {most_s}; ulimit -d {}; exec \"$0\" \"$@\"",
        1000 * most_mb
    );
    let mut command = Command::new("sh");
    command.args(["-c", &limits, env!("CARGO_BIN_EXE_spandrel")]);
    let ended = command.args(arguments).current_dir(folder).output();
    ended.unwrap()
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
    // Short rows, whose numbers take the most memory for their length.
    let part = "ground,roof\n".to_owned() + &"1,2\n".repeat(1_000_000);
    write_stored_zip(&at("many.zip"), part.as_bytes(), part.len() as u32, 20);
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
            let is_told = !record.ends_with(".zip") || said.contains("at most 24 MiB");
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
    for text in [storeys(1000, ""), storeys(190, ""), storeys(10, &many)] {
        std::fs::write(folder.path().join("tower.toml"), text).unwrap();
        assert_refuses(folder.path(), &["check", "tower.toml"], 500, 20);
    }
}

/// Returns a building of 1,000 storeys with this many parameters, and with sensors on the ground
/// and on this many floors.
fn tall(parameters: usize, floors: usize) -> String {
    let channel = |name: &str, rest: &str| {
        format!(
            "[[node]]\nname = \"{name}\"\n[[node.channel]]\nname = \"{name}\"\nunit = \"m/s2\"\n\
             noise-std = 0.005\n{rest}\n"
        )
    };
    let mut text = "[structure]\nname = \"tall\"\nsampling-rate-hz = 100\n\
                    [model]\nkind = \"shear-building\"\nstoreys = 1000\nmass-kg = 20_000\n\
                    first-frequency-hz = 0.1\n\
                    [damping]\nkind = \"rayleigh\"\nratio = 0.02\nmodes = [1, 2]\n\
                    [[excitation]]\nname = \"ground\"\nkind = \"ground\"\nstd = 0.1\n\
                    measured-on = \"ground\"\n"
        .to_owned();
    text += &channel("ground", "quantity = \"ground-acceleration\"");
    for part in 0..parameters {
        let storeys = part * 1000 / parameters..(part + 1) * 1000 / parameters;
        let storeys = storeys.map(|below| format!("\"storey-{}\"", below + 1));
        let storeys: Vec<String> = storeys.collect();
        text += &format!(
            "[[parameter]]\nname = \"part-{part}\"\nscales = \"stiffness\"\nof = [{}]\nstd = 0.2\n",
            storeys.join(", ")
        );
    }
    for number in 1..=floors {
        let floor = format!("floor-{}", number * 1000 / floors);
        let rest = format!(
            "quantity = \"absolute-acceleration\"\ndof = \"{floor}\"\nnoise-group = \"floors\"\n\
             adapt-noise = true"
        );
        text += &channel(&floor, &rest);
    }
    text
}

/// Regression: such checks took 43 s of processor time for many parameters, and 76 s for many
/// channels.
#[test]
fn a_check_that_takes_too_much_time_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    for (parameters, floors) in [(590, 2), (5, 399)] {
        std::fs::write(folder.path().join("tower.toml"), tall(parameters, floors)).unwrap();
        let said = assert_refuses(folder.path(), &["check", "tower.toml"], 500, 20);
        let is_told = said.contains("must take at most 240 MB and 28 s (20 s on two processors)");
        assert!(is_told && said.contains("leave out parameters"), "{said}");
    }
}

/// 40 s of processor time are 20 s on two processors.
#[test]
fn a_thousand_storeys_are_checked_within_20_seconds_and_500_mb() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("tower.toml"), tall(100, 19)).unwrap();
    let ended = limited(folder.path(), &["check", "tower.toml"], 500, 40);
    let said = String::from_utf8_lossy(&ended.stderr);
    assert!(ended.status.success(), "{:?}: {said}", ended.status);
    let found = String::from_utf8(ended.stdout).unwrap();
    assert!(found.contains("1000 degrees of freedom"), "{found}");
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
