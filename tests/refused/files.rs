//! Files and arguments that a command checks before it does anything.

use super::table::Table;
use crate::support::{Finished, Process, spandrel, two_storeys, write_stored_zip};
use std::io::Write;
use std::path::Path;
use std::process::Command;

/// Exit code of bad usage and bad input.
const BAD_INPUT: i32 = 2;

/// Returns a command that runs in a folder, so that messages contain the file names as given.
fn command(folder: &Path, subcommand: &str) -> Command {
    let mut command = spandrel(subcommand);
    command.current_dir(folder);
    command
}

fn finish(command: &mut Command) -> Finished {
    Process::start(command).wait()
}

fn parts(told: &[&str]) -> Vec<String> {
    told.iter().map(|part| (*part).to_owned()).collect()
}

/// Returns the text of the building with one part of it replaced.
fn building_with(old: &str, new: &str) -> String {
    let structure = two_storeys("");
    assert!(structure.contains(old), "the building has no {old}");
    structure.replacen(old, new, 1)
}

/// A mistake in a structure file: the old text, the new text, and what the error names.
type Mistake = (
    &'static str,
    &'static str,
    &'static str,
    &'static [&'static str],
);

const MISTAKES: [Mistake; 20] = [
    (
        "a key without a value",
        "storeys = 2",
        "storeys = ",
        &["syntax", "must be TOML"],
    ),
    (
        "a text instead of a number",
        "storeys = 2",
        "storeys = \"two\"",
        &["model.storeys", "\"two\"", "from 1 to 1000"],
    ),
    (
        "more storeys than allowed",
        "storeys = 2",
        "storeys = 2000000",
        &["model.storeys", "2000000", "1000"],
    ),
    (
        "a mass that is not a number",
        "mass-kg = 20_000",
        "mass-kg = nan",
        &["model.mass-kg", "nan", "finite"],
    ),
    (
        "a negative mass",
        "mass-kg = 20_000",
        "mass-kg = -20_000",
        &["model.mass-kg", "-20000", "above 0"],
    ),
    (
        "an unknown model",
        "\"shear-building\"",
        "\"pyramid\"",
        &["model.kind", "\"pyramid\"", "\"truss\""],
    ),
    (
        "an unknown key",
        "ratio = 0.02",
        "ratio = 0.02\nration = 1",
        &["damping.ration", "not a known key", "ratio"],
    ),
    (
        "a duplicate key",
        "storeys = 2",
        "storeys = 2\nstoreys = 3",
        &["syntax", "duplicate key"],
    ),
    (
        "a name with characters that key expressions forbid",
        "\"house\"",
        "\"House/1\"",
        &["structure.name", "\"House/1\"", "1 to 64"],
    ),
    (
        "a terminal escape in a name",
        "\"house\"",
        "\"ho\\u001b[31muse\"",
        &["structure.name", "\\u{1b}[31m", "1 to 64"],
    ),
    (
        "a name of 65 characters",
        "\"house\"",
        "\"aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa\"",
        &["structure.name", "1 to 64"],
    ),
    (
        "two parameters with the same name",
        "name = \"storey-2\"",
        "name = \"storey-1\" # again",
        &["parameter.name", "unique"],
    ),
    (
        "a sampling rate of 0",
        "sampling-rate-hz = 100",
        "sampling-rate-hz = 0",
        &["structure.sampling-rate-hz", "20000"],
    ),
    (
        "a sensor on a missing floor",
        "dof = \"floor-2\"",
        "dof = \"floor-9\"",
        &["dof", "floor-9", "floor-1"],
    ),
    (
        "a unit that is not SI",
        "unit = \"m/s\"\n",
        "unit = \"g\"\n",
        &["node.channel.unit", "\"g\"", "\"m/s\""],
    ),
    (
        "a sensor without noise",
        "noise-std = 0.001",
        "noise-std = 0",
        &["node.channel.noise-std", "is 0", "1e-30"],
    ),
    (
        "an excitation measured on a missing channel",
        "measured-on = \"ground\"",
        "measured-on = \"attic\"",
        &["measured-on", "attic"],
    ),
    (
        "a parameter of a missing storey",
        "[\"storey-2\"]",
        "[\"storey-7\"]",
        &["parameter.of", "storey-7"],
    ),
    (
        "a damping ratio above 1",
        "ratio = 0.02",
        "ratio = 2",
        &["damping.ratio", "2"],
    ),
    (
        "a negative lateness",
        "lateness-s = 3600",
        "lateness-s = -1",
        &["ingest.lateness-s", "-1", "from 0"],
    ),
];

pub fn structure_files(table: &mut Table) {
    table.section("Structure files (`spandrel check FILE`)");
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("tower.toml");
    let check = |name: &str| finish(command(folder.path(), "check").arg(name));
    for (given, old, new, told) in MISTAKES {
        let text = building_with(old, new);
        // The mistake is on the last line of the new text.
        let from = two_storeys("").find(old).unwrap();
        let line = text[..from].lines().count().max(1)
            + new.trim_end().matches('\n').count()
            + usize::from(text[..from].ends_with('\n'));
        std::fs::write(&file, text).unwrap();
        let told: Vec<String> = std::iter::once(format!("tower.toml:{line}"))
            .chain(parts(told))
            .collect();
        table.add_ended(given, (BAD_INPUT, &told), &check("tower.toml"));
    }
    std::fs::write(&file, "").unwrap();
    table.add_ended(
        "an empty file",
        (BAD_INPUT, &parts(&["tower.toml:1", "structure", "missing"])),
        &check("tower.toml"),
    );
    std::fs::write(&file, b"\xff\xfe[\0s\0").unwrap();
    table.add_ended(
        "a file in UTF-16",
        (BAD_INPUT, &parts(&["tower.toml:1", "UTF-16", "UTF-8"])),
        &check("tower.toml"),
    );
    std::fs::write(&file, b"# tower\n# caf\xe9\n").unwrap();
    table.add_ended(
        "a file in Latin-1",
        (BAD_INPUT, &parts(&["tower.toml:2", "byte 0xe9", "UTF-8"])),
        &check("tower.toml"),
    );
    table.add_ended(
        "a missing file",
        (BAD_INPUT, &parts(&["nowhere.toml", "No such file"])),
        &check("nowhere.toml"),
    );
    table.add_ended(
        "a folder",
        (BAD_INPUT, &parts(&["folder", "regular file"])),
        &check("."),
    );
    table.add_ended(
        "an endless device",
        (BAD_INPUT, &parts(&["/dev/zero", "regular file"])),
        &check("/dev/zero"),
    );
    make_pipe(&folder.path().join("pipe.toml"));
    table.add_ended(
        "a pipe without a writer",
        (BAD_INPUT, &parts(&["pipe.toml", "regular file"])),
        &check("pipe.toml"),
    );
    let matrices = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/matrices.toml");
    let text = std::fs::read_to_string(matrices).unwrap();
    make_pipe(&folder.path().join("pipe.mtx"));
    let named = text.split('"').find(|part| part.ends_with(".mtx"));
    std::fs::write(&file, text.replace(named.unwrap(), "pipe.mtx")).unwrap();
    table.add_ended(
        "a matrix that is a pipe without a writer",
        (
            BAD_INPUT,
            &parts(&["tower.toml:", "pipe.mtx", "pipe", "Matrix Market"]),
        ),
        &check("tower.toml"),
    );
}

/// Creates a named pipe. Opening it waits for a writer.
pub fn make_pipe(path: &Path) {
    let made = Command::new("mkfifo").arg(path).status().unwrap();
    assert!(made.success(), "mkfifo {}", path.display());
}

/// Mistakes in a configuration file, and what the error names.
const MISCONFIGURED: [(&str, &str, &[&str]); 21] = [
    (
        "an unknown key",
        "thread = 3\n",
        &["spandrel.toml", "`thread`", "`threads`"],
    ),
    (
        "a key without a value",
        "structures = \n",
        &["spandrel.toml", "line 1"],
    ),
    (
        "a number below the minimum",
        "threads = 0\n",
        &["spandrel.toml", "threads", "nonzero"],
    ),
    (
        "a number instead of a list",
        "[bus]\nlisten = 7\n",
        &["spandrel.toml", "bus.listen", "sequence"],
    ),
    (
        "an unknown mode of the bus",
        "[bus]\nmode = \"boss\"\n",
        &["bus.mode", "boss", "peer, client or router"],
    ),
    (
        "a root with characters that key expressions forbid",
        "[bus]\nroot = \"a/b\"\n",
        &["bus.root", "a/b", "a-z, 0-9 and -"],
    ),
    (
        "a negative connection timeout",
        "[bus]\nconnect_timeout_s = -1\n",
        &["bus.connect_timeout_s", "-1", "at least 0 s"],
    ),
    (
        "an invalid endpoint",
        "[bus]\nconnect = [\"nonsense\"]\n",
        &["connect", "nonsense", "<protocol>/<address>"],
    ),
    (
        "plain TCP that other machines can reach",
        "[bus]\nlisten = [\"tcp/0.0.0.0:0\"]\n",
        &["tcp/0.0.0.0:0", "quic/"],
    ),
    (
        "TLS over TCP",
        "[bus]\nlisten = [\"tls/127.0.0.1:0\"]\n",
        &["tls/127.0.0.1:0", "quic/"],
    ),
    (
        "a checkpoint interval of zero",
        "[state]\ncheckpoint-s = 0\n",
        &["state.checkpoint-s", "0.01 and 3600 s"],
    ),
    (
        "a negative flush interval",
        "[state.recording]\nsync-s = -1\n",
        &["state.recording.sync-s", "-1"],
    ),
    (
        "a negative size",
        "[state.recording]\nkeep-bytes = -1\n",
        &["state.recording.keep-bytes", "-1"],
    ),
    (
        "an unknown database",
        "[history]\ndatabase = \"mysql://x\"\n",
        &["history.database", "mysql://x", "postgres://"],
    ),
    (
        "an invalid address",
        "[[notify.webhook]]\nurl = \"ftp://x\"\n",
        &["notify.webhook[0].url", "ftp://", "https://"],
    ),
    (
        "an unknown variable in a template",
        "[[notify.email]]\nserver = \"mail\"\nfrom = \"a@b.example\"\nto = [\"c@d.example\"]\n\
         subject = \"{{ strucure }}\"\n",
        &["notify.email[0].subject", "`strucure`", "structure"],
    ),
    (
        "quiet hours in an unknown time zone",
        "[[notify.webhook]]\nurl = \"http://x/\"\n\
         quiet = [{ from = \"22:00\", to = \"06:00\", zone = \"Mars/Base\" }]\n",
        &[
            "notify.webhook[0].quiet[0].zone",
            "Mars/Base",
            "Europe/Zurich",
        ],
    ),
    (
        "an infinite delay of notices",
        "[notify]\nblind-after-s = inf\n",
        &["notify.blind-after-s", "inf", "30 days"],
    ),
    (
        "a page that other machines can reach",
        "[dashboard]\nlisten = \"0.0.0.0:0\"\n",
        &["0.0.0.0:0", "dashboard.tokens"],
    ),
    (
        "a missing token file",
        "[dashboard]\ntokens = \"none.json\"\n",
        &["none.json", "No such file"],
    ),
    (
        "a token file without tokens",
        "[dashboard]\ntokens = \"nobody.json\"\n",
        &["nobody.json", "no token"],
    ),
];

pub fn configurations(table: &mut Table) {
    table.section("Configuration files and variables (`spandrel run`)");
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("house.toml"), two_storeys("")).unwrap();
    std::fs::write(folder.path().join("nobody.json"), "[]").unwrap();
    for (given, text, told) in MISCONFIGURED {
        std::fs::write(folder.path().join("spandrel.toml"), text).unwrap();
        let mut run = command(folder.path(), "run");
        run.args(["house.toml", "--config", "spandrel.toml"]);
        if !text.contains("[bus]") {
            run.args(["--listen", "tcp/127.0.0.1:0"]); // the default port may be in use
        }
        let given = format!("{given}: `{}`", text.trim_end().replace('\n', " "));
        table.add_ended(&given, (BAD_INPUT, &parts(told)), &finish(&mut run));
    }
    std::fs::write(folder.path().join("spandrel.toml"), b"\xfe\xff\0[\0b").unwrap();
    let mut run = command(folder.path(), "run");
    run.args(["house.toml", "--config", "spandrel.toml"]);
    let told = parts(&["spandrel.toml:1", "UTF-16 (big-endian)", "UTF-8"]);
    table.add_ended("a file in UTF-16", (BAD_INPUT, &told), &finish(&mut run));
    let large = std::fs::File::create(folder.path().join("large.toml")).unwrap();
    large.set_len(2 << 20).unwrap();
    make_pipe(&folder.path().join("pipe.toml"));
    for (given, option, file, told) in [
        ("a missing file", "--config", "nowhere.toml", "No such file"),
        (
            "a pipe without a writer",
            "--config",
            "pipe.toml",
            "regular file",
        ),
        ("an endless device", "--config", "/dev/zero", "regular file"),
        ("a file of 2 MiB", "--config", "large.toml", "1048576"),
        (
            "a Zenoh file that is a pipe",
            "--zenoh-config",
            "pipe.toml",
            "regular file",
        ),
        (
            "a Zenoh file that is a device",
            "--zenoh-config",
            "/dev/zero",
            "regular file",
        ),
    ] {
        let mut run = command(folder.path(), "run");
        run.args(["house.toml", option, file]);
        table.add_ended(given, (BAD_INPUT, &parts(&[file, told])), &finish(&mut run));
    }
    let xml = "[[feed.source]]\nname = \"shake\"\nkind = \"udp\"\naddress = \"127.0.0.1:0\"\n\
               format = \"raspberry-shake\"\n[[feed.source.channel]]\nsource = \"ENE\"\n\
               channel = \"roof\"\nstationxml = ";
    for (given, key) in [
        ("a baseline", "[baselines]\nhouse = "),
        ("a StationXML file", xml),
    ] {
        for (kind, file) in [("pipe", "pipe.toml"), ("device", "/dev/zero")] {
            let text = format!("{key}\"{file}\"\n");
            std::fs::write(folder.path().join("spandrel.toml"), text).unwrap();
            let mut run = command(folder.path(), "run");
            run.args(["house.toml", "--config", "spandrel.toml"]);
            run.args(["--listen", "tcp/127.0.0.1:0"]);
            table.add_ended(
                &format!("{given} that is a {kind}"),
                (BAD_INPUT, &parts(&[file, "regular file"])),
                &finish(&mut run),
            );
        }
    }
    for (variable, value, told) in [
        (
            "SPANDREL_THREADS",
            "many",
            &["SPANDREL_", "many", "threads"][..],
        ),
        ("SPANDREL_BUS__ROOTS", "a", &["SPANDREL_", "roots"][..]),
    ] {
        let mut run = command(folder.path(), "run");
        run.args(["house.toml", "--listen", "tcp/127.0.0.1:0"]);
        let finished = finish(run.env(variable, value));
        table.add_ended(
            &format!("`{variable}={value}`"),
            (BAD_INPUT, &parts(told)),
            &finished,
        );
    }
}

/// Bad arguments, and what the error names.
const MISUSED: [(&[&str], &[&str]); 11] = [
    (&["fly"], &["fly"]),
    (&["run"], &["no structure"]),
    (&["run", "--fly"], &["--fly"]),
    (
        &["run", "house.toml", "again.toml"],
        &["house.toml", "again.toml", "`house`"],
    ),
    (
        &["run", "house.toml", "--root", "a/b"],
        &["bus.root", "a/b"],
    ),
    (
        &["simulate", "sensors.toml", "--record", "rec.csv"],
        &[
            "sensors.toml:13",
            "model.kind",
            "\"modal\"",
            "needs a model",
        ],
    ),
    (
        &["alert", "sensors.toml"],
        &["nothing for alert", "no model"],
    ),
    (&["simulate", "house.toml", "--duration", "-1"], &["-1"]),
    (
        &["simulate", "house.toml", "--record", "house.toml"],
        &["house.toml", "would be overwritten"],
    ),
    (
        &[
            "replay",
            "rec.csv",
            "--structure",
            "house.toml",
            "--speed",
            "fast",
        ],
        &["--speed", "fast"],
    ),
    (
        &[
            "token",
            "Ada Lovelace",
            "--role",
            "viewer",
            "--file",
            "tokens.json",
        ],
        &["Ada Lovelace", "a-z"],
    ),
];

pub fn arguments(table: &mut Table) {
    table.section("Arguments");
    let folder = tempfile::tempdir().unwrap();
    for name in ["house.toml", "again.toml"] {
        std::fs::write(folder.path().join(name), two_storeys("")).unwrap();
    }
    let sensors = include_str!("../../docs/examples/modes/sensors-only.toml");
    std::fs::write(folder.path().join("sensors.toml"), sensors).unwrap();
    for (arguments, told) in MISUSED {
        let finished = finish(command(folder.path(), arguments[0]).args(&arguments[1..]));
        table.add_ended(
            &format!("`spandrel {}`", arguments.join(" ")),
            (BAD_INPUT, &parts(told)),
            &finished,
        );
    }
}

/// Returns a text with one line changed, counted from 1.
fn with_line(text: &str, number: usize, change: impl Fn(&str) -> String) -> String {
    let lines = (1..).zip(text.lines()).map(|(at, line)| {
        if at == number {
            change(line)
        } else {
            line.to_owned()
        }
    });
    lines.map(|line| line + "\n").collect()
}

pub fn records(table: &mut Table) {
    table.section("Recordings (`spandrel estimate`; formats other than tables: `spandrel info`)");
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("house.toml"), two_storeys("")).unwrap();
    finish(command(folder.path(), "simulate").args([
        "house.toml",
        "--record",
        "sound.csv",
        "--duration",
        "2",
    ]))
    .expect_code(0);
    let sound = std::fs::read_to_string(folder.path().join("sound.csv")).unwrap();
    let last_field =
        |line: &str, with: &str| format!("{},{with}", line.rsplit_once(',').unwrap().0);
    let reversed = || {
        let rows: Vec<&str> = sound.lines().skip(1).collect();
        let rows: Vec<&str> = sound
            .lines()
            .take(1)
            .chain(rows.into_iter().rev())
            .collect();
        rows.join("\n") + "\n"
    };
    let every_second =
        |(at, line): (usize, &str)| (at == 0 || at % 2 == 1).then(|| format!("{line}\n"));
    let tables: [(&str, String, &[&str]); 10] = [
        (
            "a missing column",
            sound.replacen(",roof,", ",tower,", 1),
            &["rec.csv:1", "`roof`", "`tower`"],
        ),
        (
            "a duplicate column",
            sound.replacen(",roof,", ",ground,", 1),
            &["rec.csv:1", "`ground`", "once"],
        ),
        (
            "a row with an extra field",
            with_line(&sound, 42, |line| format!("{line},1")),
            &["rec.csv:42", "6 fields", "5"],
        ),
        (
            "a field that is not a number",
            with_line(&sound, 8, |line| last_field(line, "much")),
            &["rec.csv:8", "`much`"],
        ),
        (
            "an infinite value",
            with_line(&sound, 8, |line| last_field(line, "inf")),
            &["rec.csv:8", "`inf`", "finite"],
        ),
        (
            "a number above the range of a double",
            with_line(&sound, 8, |line| last_field(line, "1e999")),
            &["rec.csv:8", "1e999"],
        ),
        (
            "rows in reverse order",
            reversed(),
            &["rec.csv:3", "must increase"],
        ),
        (
            "another sampling rate",
            sound.lines().enumerate().filter_map(every_second).collect(),
            &["50.0000 Hz", "100 Hz"],
        ),
        (
            "a header without rows",
            sound
                .lines()
                .take(1)
                .map(|line| format!("{line}\n"))
                .collect(),
            &["rec.csv", "0 rows", "2"],
        ),
        (
            "an empty file",
            String::new(),
            &["rec.csv", "unknown format", "miniSEED"],
        ),
    ];
    for (given, text, told) in tables {
        std::fs::write(folder.path().join("rec.csv"), text).unwrap();
        let finished =
            finish(command(folder.path(), "estimate").args(["house.toml", "--record", "rec.csv"]));
        table.add_ended(given, (BAD_INPUT, &parts(told)), &finished);
    }
    let wide: Vec<u8> = sound.encode_utf16().flat_map(u16::to_le_bytes).collect();
    std::fs::write(folder.path().join("utf-16.csv"), wide).unwrap();
    let finished =
        finish(command(folder.path(), "estimate").args(["house.toml", "--record", "utf-16.csv"]));
    let told = parts(&["utf-16.csv", "UTF-16 (little-endian)", "UTF-8"]);
    table.add_ended("a table in UTF-16", (BAD_INPUT, &told), &finished);
    huge_records(table, folder.path());
    for (given, name, bytes, told) in damaged_formats(folder.path()) {
        std::fs::write(folder.path().join(&name), bytes).unwrap();
        let finished = finish(command(folder.path(), "info").arg(&name));
        let told: Vec<String> = std::iter::once(name).chain(parts(told)).collect();
        table.add_ended(given, (BAD_INPUT, &told), &finished);
    }
}

pub fn baselines_and_annotations(table: &mut Table) {
    table.section("Baselines and annotations (`estimate --baseline`, `judge --annotations`)");
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("house.toml"), two_storeys("")).unwrap();
    let simulate = "house.toml --record sound.csv --duration 2";
    finish(command(folder.path(), "simulate").args(simulate.split(' '))).expect_code(0);
    make_pipe(&folder.path().join("pipe.json"));
    let large = std::fs::File::create(folder.path().join("large.json")).unwrap();
    large.set_len(65 << 20).unwrap();
    let judged = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/judge");
    for (given, file, told) in [
        ("a pipe without a writer", "pipe.json", "regular file"),
        ("an endless device", "/dev/zero", "regular file"),
        ("a file of 65 MiB", "large.json", "67108864"),
    ] {
        let told = parts(&[file, told]);
        let mut estimate = command(folder.path(), "estimate");
        estimate.args(["house.toml", "--record", "sound.csv", "--baseline", file]);
        let given_here = format!("as a baseline: {given}");
        table.add_ended(&given_here, (BAD_INPUT, &told), &finish(&mut estimate));
        let mut judge = command(folder.path(), "judge");
        judge.arg(judged.join("footbridge.toml")).arg("--series");
        judge.arg(judged.join("footbridge.csv"));
        judge.args(["--annotations", file]);
        let given_here = format!("as annotations: {given}");
        table.add_ended(&given_here, (BAD_INPUT, &told), &finish(&mut judge));
    }
}

/// Adds recordings that are huge, or have no end.
fn huge_records(table: &mut Table, folder: &Path) {
    let estimate = |record: &str| {
        let mut estimate = command(folder, "estimate");
        finish(estimate.args(["house.toml", "--record", record]))
    };
    let info = |record: &str| finish(command(folder, "info").arg(record));
    make_pipe(&folder.join("pipe.csv"));
    for (given, record) in [
        ("a pipe without a writer", "pipe.csv"),
        ("an endless device", "/dev/zero"),
    ] {
        let told = parts(&[record, "pipe, a device", "regular file"]);
        table.add_ended(given, (BAD_INPUT, &told), &estimate(record));
    }
    let sparse = std::fs::File::create(folder.join("sparse.csv")).unwrap();
    let rows = "0.5,1.5\n".repeat(10_000);
    (&sparse).write_all(rows.as_bytes()).unwrap();
    sparse.set_len(3 << 30).unwrap();
    let told = parts(&["sparse.csv:10001", "no end within 1048576 bytes"]);
    table.add_ended("a row of 3 GiB", (BAD_INPUT, &told), &info("sparse.csv"));
    let columns: Vec<String> = (0..100_000).map(|number| format!("c{number}")).collect();
    std::fs::write(folder.join("wide.csv"), columns.join(",") + "\n").unwrap();
    let told = parts(&["wide.csv:1", "100000 columns", "10000"]);
    table.add_ended("100,000 columns", (BAD_INPUT, &told), &info("wide.csv"));
    let zeros = folder.join("zeros");
    std::fs::write(&zeros, "0.5,1.5\n".repeat(1 << 21)).unwrap();
    let member = Command::new("gzip")
        .arg("-9nc")
        .arg(&zeros)
        .output()
        .unwrap();
    std::fs::write(folder.join("bomb.csv.gz"), member.stdout.repeat(64)).unwrap();
    let told = parts(&[
        "bomb.csv.gz",
        "decompressed",
        "100 times the compressed size",
    ]);
    table.add_ended(
        "1 GiB of equal rows in 1 MB of gzip",
        (BAD_INPUT, &told),
        &info("bomb.csv.gz"),
    );
    // The format is recognised by the first 64 KiB.
    let rows = "ground,roof\n".to_owned() + &"0.5,1.5\n".repeat(10_000);
    write_stored_zip(&folder.join("stored.zip"), rows.as_bytes(), 800_000_000, 1);
    let told = parts(&["stored.zip", "decompressed", "24 MiB", "extract"]);
    table.add_ended(
        "a zip archive of 800 MB, without compression",
        (BAD_INPUT, &told),
        &info("stored.zip"),
    );
    let mut convert = command(folder, "convert");
    let finished = finish(convert.args(["sound.csv", "out.csv", "--resample", "1e12"]));
    let told = parts(&["sound.csv", "1000000000000 Hz", "10000 times"]);
    table.add_ended("a conversion to 1e12 Hz", (BAD_INPUT, &told), &finished);
}

/// Returns a damaged recording of each non-tabular format: description, name, bytes, and what the
/// error names.
fn damaged_formats(folder: &Path) -> Vec<(&'static str, String, Vec<u8>, &'static [&'static str])> {
    let seed = |name: &str| {
        let seeds = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/seeds/recording");
        std::fs::read(seeds.join(name)).unwrap()
    };
    let cut = |mut bytes: Vec<u8>, share: usize| {
        bytes.truncate(bytes.len() * share / 100);
        bytes
    };
    let filled = |head: &[u8], with: u8, length: usize| {
        let mut bytes = head.to_vec();
        bytes.resize(length, with);
        bytes
    };
    let packed = Command::new("gzip")
        .arg("-c")
        .arg(folder.join("sound.csv"))
        .output()
        .unwrap()
        .stdout;
    let mut matlab = filled(b"MATLAB 5.0 MAT-file", b' ', 124);
    matlab.extend([0, 1, b'I', b'M', 14, 0, 0, 0, 0xff, 0xff, 0xff, 0x7f]);
    let at2 = String::from_utf8(seed("motion.at2")).unwrap();
    let mut turned = seed("table.mcap");
    let middle = turned.len() / 3;
    turned[middle] ^= 1;
    let random = (0..4096_u32)
        .map(|at| (at.wrapping_mul(2_654_435_761) >> 24) as u8)
        .collect();
    vec![
        (
            "gzip, cut off",
            "cut.csv.gz".into(),
            cut(packed, 50),
            &["gzip", "incomplete"],
        ),
        (
            "a zip archive, cut off",
            "cut.zip".into(),
            cut(seed("table.zip"), 60),
            &["zip archive", "whole"],
        ),
        (
            "MCAP with a flipped bit",
            "turned.mcap".into(),
            turned,
            &["MCAP"],
        ),
        (
            "MATLAB, an array longer than the file",
            "long.mat".into(),
            matlab,
            &["byte 136", "2147483647"],
        ),
        (
            "miniSEED without a valid year",
            "none.mseed".into(),
            filled(b"000001D BRDG 00HNZXX", 0xff, 48),
            &["byte 20", "1900 to 2100"],
        ),
        (
            "a universal file without its header",
            "none.uff".into(),
            b"    -1\n    58\nno header\n    -1\n".to_vec(),
            &["byte 31", "line 3 of 11"],
        ),
        (
            "PEER AT2 with fewer values than stated",
            "few.at2".into(),
            at2.replacen("NPTS=   10", "NPTS=  910", 1).into_bytes(),
            &["line 6", "10 to the end", "910"],
        ),
        (
            "TDMS, a segment longer than the file",
            "long.tdms".into(),
            filled(b"TDSm\x0e\0\0\0\x69\x12\0\0", 0xa5, 60),
            &["byte 12", "32"],
        ),
        (
            "COSMOS with fewer lines of text than stated",
            "head.v1".into(),
            b"Corrected acceleration (Format v01.20 with 13 text lines)\nx\n".to_vec(),
            &["line 2", "lines of text"],
        ),
        (
            "CSMIP without data",
            "head.v2".into(),
            b"CORRECTED ACCELEROGRAM\nx\n".to_vec(),
            &["blocks of data is 0", "1"],
        ),
        (
            "SMC without its header",
            "head.smc".into(),
            b"2 CORRECTED ACCELEROGRAM\n*\nx\n".to_vec(),
            &["line 3", "eleven"],
        ),
        (
            "random bytes",
            "random.bin".into(),
            random,
            &["unknown format", "miniSEED"],
        ),
    ]
}
