//! Error messages and exit codes of the command line for bad input: 2 for files and usage, 1 for
//! all other errors.

use crate::support::{
    Finished, Process, Record, Site, free_endpoint, spandrel, storeys, two_storeys,
};
use std::io::Write;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use tempfile::TempDir;

const BAD_INPUT: i32 = 2;
const FAILED: i32 = 1;

/// All subcommands.
const SUBCOMMANDS: [&str; 20] = [
    "demo",
    "run",
    "ingest",
    "identify",
    "fuse",
    "alert",
    "history",
    "notify",
    "dashboard",
    "simulate",
    "replay",
    "estimate",
    "baseline",
    "check",
    "judge",
    "info",
    "convert",
    "validate",
    "bench",
    "watch",
];

fn finish(command: &mut Command) -> Finished {
    Process::start(command).wait()
}

/// Writes a file into a folder that exists as long as the test.
fn write(folder: &TempDir, name: &str, text: &str) -> PathBuf {
    let path = folder.path().join(name);
    std::fs::File::create(&path)
        .unwrap()
        .write_all(text.as_bytes())
        .unwrap();
    path
}

/// Returns the number of the line that contains `part`, counted from 1.
fn line_of(text: &str, part: &str) -> usize {
    1 + text.lines().position(|line| line.contains(part)).unwrap()
}

/// Checks that `simulate` and `run` reject a structure file with the messages `told` at the line of
/// `part`.
#[track_caller]
fn assert_refused(structure: &str, part: &str, told: &[&str]) {
    let folder = tempfile::tempdir().unwrap();
    let path = write(&folder, "tower.toml", structure);
    let place = format!("{}:{}: ", path.display(), line_of(structure, part));
    let told: Vec<&str> = std::iter::once(place.as_str())
        .chain(told.iter().copied())
        .collect();
    let mut simulate = spandrel("simulate");
    finish(
        simulate
            .arg(&path)
            .arg("--record")
            .arg(folder.path().join("x.csv")),
    )
    .expect_code(BAD_INPUT)
    .expect_told(&told);
    let mut run = spandrel("run");
    finish(run.arg(&path).args(["--listen", "tcp/127.0.0.1:0"]))
        .expect_code(BAD_INPUT)
        .expect_told(&told);
}

/// Returns the two-storey building with one text replaced.
fn building_with(old: &str, new: &str) -> String {
    let structure = two_storeys("");
    assert!(structure.contains(old), "the building has no {old}");
    structure.replacen(old, new, 1)
}

#[test]
fn the_error_names_an_unknown_structure_key_with_line_and_hint() {
    let structure = building_with("mass-kg = 20_000", "mass-kg = 20_000\nmass-hg = 1");
    assert_refused(
        &structure,
        "mass-hg",
        &["model.mass-hg", "not a known key", "mass-kg"],
    );
}

#[test]
fn the_error_names_a_wrong_unit_and_the_right_one() {
    let structure = building_with("unit = \"m/s\"\n", "unit = \"g\"\n");
    assert_refused(
        &structure,
        "unit = \"g\"",
        &["node.channel.unit", "\"g\"", "m/s"],
    );
}

#[test]
fn negative_mass_is_refused() {
    let structure = building_with("mass-kg = 20_000", "mass-kg = -20_000");
    assert_refused(
        &structure,
        "-20_000",
        &["model.mass-kg", "-20000", "above 0"],
    );
}

#[test]
fn duplicate_names_are_refused() {
    let structure = building_with(
        "[[node]]\nname = \"floor-1\"",
        "[[node]]\nname = \"ground\" # again",
    );
    assert_refused(&structure, "# again", &["node.name", "ground"]);
}

#[test]
fn parameter_without_effect_is_refused() {
    let structure =
        two_storeys("[[parameter]]\nname = \"alpha\"\nscales = \"damping-alpha\" # none\n");
    let structure = structure.replace("ratio = 0.02", "beta-s = 0.01");
    let line = "[[parameter]]\nname = \"alpha\"".lines().next().unwrap();
    let last = structure.lines().count()
        - structure
            .lines()
            .rev()
            .position(|text| text == line)
            .unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = write(&folder, "tower.toml", &structure);
    let place = format!("{}:{last}: ", path.display());
    let mut command = spandrel("simulate");
    command
        .arg(&path)
        .arg("--record")
        .arg(folder.path().join("x.csv"));
    finish(&mut command).expect_code(BAD_INPUT).expect_told(&[
        &place,
        "parameter.scales",
        "no effect",
    ]);
}

#[test]
fn all_mistakes_of_a_structure_are_reported_at_once() {
    let structure = two_storeys("")
        .replace("storeys = 2", "storeys = 0")
        .replace("ratio = 0.02", "ratio = 2");
    let ratio = format!(":{}: damping.ratio", line_of(&structure, "ratio = 2"));
    assert_refused(&structure, "storeys = 0", &["model.storeys", &ratio]);
}

/// Returns a structure of two degrees of freedom from matrices. `stiffness` are the entries of its
/// second substructure.
fn matrices(folder: &TempDir, mass: &str, stiffness: &str) -> String {
    let matrix =
        |entries: &str| format!("%%MatrixMarket matrix array real general\n2 2\n{entries}\n");
    write(folder, "m.mtx", &matrix(mass));
    write(folder, "k1.mtx", &matrix("2e6\n-1e6\n-1e6\n1e6"));
    write(folder, "k2.mtx", &matrix(stiffness));
    let model = "kind = \"matrices\"\nmass = \"m.mtx\"\n\
                 substructures = { storey-1 = \"k1.mtx\", storey-2 = \"k2.mtx\" }\n\
                 degrees-of-freedom = [\"floor-1\", \"floor-2\"]\n";
    building_with(
        "kind = \"shear-building\"\nstoreys = 2\nmass-kg = 20_000\nfirst-frequency-hz = 2.0\n",
        model,
    )
}

/// Checks that `simulate` rejects a structure of matrices with the messages `told` at the line of
/// `part`.
#[track_caller]
fn assert_matrices_refused(mass: &str, stiffness: &str, part: &str, told: &[&str]) {
    let folder = tempfile::tempdir().unwrap();
    let structure = matrices(&folder, mass, stiffness);
    let path = write(&folder, "tower.toml", &structure);
    let place = format!("{}:{}: ", path.display(), line_of(&structure, part));
    let told: Vec<&str> = std::iter::once(place.as_str())
        .chain(told.iter().copied())
        .collect();
    let mut command = spandrel("simulate");
    command
        .arg(&path)
        .arg("--record")
        .arg(folder.path().join("x.csv"));
    finish(&mut command)
        .expect_code(BAD_INPUT)
        .expect_told(&told);
}

#[test]
fn indefinite_stiffness_matrix_is_refused() {
    let told = ["model.substructures.storey-2", "semidefinite"];
    assert_matrices_refused(
        "1e4\n0\n0\n1e4",
        "1e6\n2e6\n2e6\n1e6",
        "substructures",
        &told,
    );
}

#[test]
fn mass_matrix_without_mass_is_refused() {
    let told = ["model.mass", "-10000", "positive definite"];
    assert_matrices_refused("1e4\n0\n0\n-1e4", "1e6\n0\n0\n0", "mass = \"m.mtx\"", &told);
}

#[test]
fn the_error_names_a_missing_matrix_file() {
    let folder = tempfile::tempdir().unwrap();
    let structure = matrices(&folder, "1e4\n0\n0\n1e4", "0\n0\n0\n1e6").replace("k2.mtx", "k3.mtx");
    let path = write(&folder, "tower.toml", &structure);
    let place = format!(
        "{}:{}: ",
        path.display(),
        line_of(&structure, "substructures")
    );
    let mut command = spandrel("simulate");
    command
        .arg(&path)
        .arg("--record")
        .arg(folder.path().join("x.csv"));
    finish(&mut command).expect_code(BAD_INPUT).expect_told(&[
        &place,
        "model.substructures.storey-2",
        "k3.mtx",
    ]);
}

#[test]
fn every_command_that_reads_a_structure_names_a_missing_file() {
    let record = Path::new("record.csv");
    for (subcommand, more) in [
        ("run", vec![]),
        ("ingest", vec![]),
        ("identify", vec![]),
        ("alert", vec![]),
        ("check", vec![]),
        ("simulate", vec!["--record", "x.csv"]),
        ("estimate", vec!["--record", "x.csv"]),
        ("baseline", vec!["--record", "x.csv", "--output", "x.json"]),
    ] {
        finish(spandrel(subcommand).arg("nowhere.toml").args(more))
            .expect_code(BAD_INPUT)
            .expect_told(&["nowhere.toml"]);
    }
    let mut replay = spandrel("replay");
    finish(replay.arg(record).args(["--structure", "nowhere.toml"]))
        .expect_code(BAD_INPUT)
        .expect_told(&["nowhere.toml"]);
}

/// Checks that `estimate` and `replay` reject a record with the messages `told`.
#[track_caller]
fn assert_record_refused(site: &Site, record: &Path, told: &[&str]) {
    let mut estimate = spandrel("estimate");
    estimate
        .arg(site.structure_file())
        .arg("--record")
        .arg(record);
    finish(&mut estimate)
        .expect_code(BAD_INPUT)
        .expect_told(told);
    let mut replay = spandrel("replay");
    replay
        .arg(record)
        .arg("--structure")
        .arg(site.structure_file())
        .args(["--connect", &free_endpoint()]);
    finish(&mut replay).expect_code(BAD_INPUT).expect_told(told);
}

/// Creates a site with a record whose text is changed.
fn record_with(change: impl FnOnce(String) -> String) -> (Site, Record, String) {
    let site = Site::with(&two_storeys(""));
    let record = site.simulate(5.0);
    let text = change(std::fs::read_to_string(record.path()).unwrap());
    std::fs::write(record.path(), &text).unwrap();
    let name = record.path().display().to_string();
    (site, record, name)
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

#[test]
fn the_error_lists_missing_and_present_columns_of_a_record() {
    let (site, record, name) = record_with(|text| text.replacen(",roof,", ",tower,", 1));
    assert_record_refused(
        &site,
        record.path(),
        &[&format!("{name}:1: "), "`roof`", "`tower`"],
    );
}

#[test]
fn the_error_names_the_line_of_a_ragged_row() {
    let (site, record, name) =
        record_with(|text| with_line(&text, 42, |line| line.to_owned() + ",1"));
    assert_record_refused(
        &site,
        record.path(),
        &[&format!("{name}:42: "), "6 fields", "5"],
    );
}

#[test]
fn the_error_names_line_and_column_of_a_field_that_is_not_a_number() {
    let much = |line: &str| format!("{},much", line.rsplit_once(',').unwrap().0);
    let (site, record, name) = record_with(|text| with_line(&text, 8, much));
    assert_record_refused(
        &site,
        record.path(),
        &[&format!("{name}:8: "), "`roof-velocity`", "`much`"],
    );
}

#[test]
fn the_error_names_both_rates_of_a_record_with_a_wrong_rate() {
    let (site, mut record, _) = record_with(|text| text);
    for row in 1..record.len() {
        record.delay_from(row, 0.01);
    }
    record.save_as("slow.csv");
    assert_record_refused(&site, record.path(), &["slow.csv", "50.0000 Hz", "100 Hz"]);
}

#[test]
fn the_error_lists_the_known_formats_of_records() {
    let (site, record, _) = record_with(|text| text);
    let path = record.path().with_extension("xyz");
    std::fs::write(&path, [0, 1, 2, 3]).unwrap();
    assert_record_refused(
        &site,
        &path,
        &["record.xyz", "unknown format", "CSV", "miniSEED"],
    );
}

#[test]
fn the_error_names_a_missing_record() {
    let (site, record, _) = record_with(|text| text);
    assert_record_refused(
        &site,
        &record.path().with_file_name("nowhere.csv"),
        &["nowhere.csv"],
    );
}

// The commands check only the first 1000 rows before they publish data.
#[test]
fn mistake_far_down_a_record_is_bad_input_on_both_routes() {
    let site = Site::with(&two_storeys(""));
    let record = site.simulate(15.0);
    let text = std::fs::read_to_string(record.path()).unwrap();
    std::fs::write(
        record.path(),
        with_line(&text, 1401, |line| line.to_owned() + ",1"),
    )
    .unwrap();
    let place = format!("{}:1401: ", record.path().display());
    let mut estimate = spandrel("estimate");
    estimate
        .arg(site.structure_file())
        .arg("--record")
        .arg(record.path());
    finish(&mut estimate)
        .expect_code(BAD_INPUT)
        .expect_told(&[&place]);
    let _services = site.run();
    site.replay(&record, "max")
        .wait()
        .expect_code(BAD_INPUT)
        .expect_told(&[&place]);
}

#[test]
fn the_error_names_file_and_key_of_a_wrong_setting() {
    let folder = tempfile::tempdir().unwrap();
    for (text, key) in [
        ("thread = 3\n", "thread"),
        ("threads = 0\n", "threads"),
        ("[bus]\nlisten = 7\n", "bus.listen"),
        ("[bus]\nroots = \"a\"\n", "roots"),
        ("structures = \n", "spandrel.toml"),
    ] {
        let path = write(&folder, "spandrel.toml", text);
        finish(spandrel("run").arg("--config").arg(path))
            .expect_code(BAD_INPUT)
            .expect_told(&["spandrel.toml", key]);
    }
}

#[test]
fn the_error_names_a_missing_configuration() {
    let mut command = spandrel("run");
    finish(command.args(["--config", "nowhere.toml"]))
        .expect_code(BAD_INPUT)
        .expect_told(&["nowhere.toml"]);
}

#[test]
fn the_error_names_a_wrong_variable() {
    let site = Site::with(&two_storeys(""));
    for (variable, value, told) in [
        ("SPANDREL_THREADS", "many", "threads"),
        ("SPANDREL_BUS__MODE", "boss", "mode"),
        ("SPANDREL_BUS__ROOTS", "a", "roots"),
    ] {
        let mut command = spandrel("run");
        let finished =
            finish(command.arg(site.structure_file()).env(variable, value)).expect_code(BAD_INPUT);
        finished.expect_told(&[told, "SPANDREL_"]);
    }
}

#[test]
fn root_that_is_not_a_name_is_rejected() {
    let site = Site::with(&two_storeys(""));
    let mut command = spandrel("run");
    let finished =
        finish(command.arg(site.structure_file()).args(["--root", "a/b"])).expect_code(BAD_INPUT);
    finished.expect_told(&["\"a/b\"", "'/'"]);
}

/// Regression test: addresses that are none ended the program with 1, as if a retry could help.
#[test]
fn addresses_that_are_none_are_bad_usage() {
    let site = Site::with(&two_storeys(""));
    let free = ["--listen", "tcp/127.0.0.1:0"];
    for (option, address) in [
        ("--http", "8080"),
        ("--http", "127.0.0.1:99999"),
        ("--listen", "tcp/127.0.0.1"),
        ("--listen", "tcp/127.0.0.1:99999"),
        ("--connect", "tcp/127.0.0.1"),
    ] {
        let mut command = spandrel("run");
        command.arg(site.structure_file()).args(free);
        finish(command.args([option, address]))
            .expect_code(BAD_INPUT)
            .expect_told(&[address, "such as"]);
    }
}

#[test]
fn baseline_of_another_structure_is_named_once() {
    let rule = "[[alert]]\nparameters = \"all\"\nloss = 0.1\nreference = { learn-s = 5 }\n";
    let site = Site::with(&two_storeys(rule));
    let record = site.simulate(25.0);
    let baseline = site.folder().join("house.baseline.json");
    let mut command = spandrel("baseline");
    command
        .arg(site.structure_file())
        .arg("--record")
        .arg(record.path());
    finish(command.args(["--skip", "0", "--output"]).arg(&baseline)).expect_code(0);
    let text = std::fs::read_to_string(&baseline).unwrap();
    std::fs::write(&baseline, text.replace("\"house\"", "\"barn\"")).unwrap();
    let mut command = spandrel("estimate");
    command
        .arg(site.structure_file())
        .arg("--record")
        .arg(record.path());
    let finished = finish(command.arg("--baseline").arg(&baseline)).expect_code(BAD_INPUT);
    let finished = finished.expect_told(&["house.baseline.json", "`barn`", "`house`"]);
    assert!(!finished.stderr.contains("lacks"), "{}", finished.stderr);
}

#[test]
fn client_without_an_endpoint_is_bad_usage() {
    let site = Site::with(&two_storeys(""));
    let mut command = spandrel("run");
    command.env("SPANDREL_BUS__MODE", "client");
    finish(command.arg(site.structure_file()))
        .expect_code(BAD_INPUT)
        .expect_told(&["--connect", "--listen", "--certificate"]);
}

#[test]
fn no_structure_at_all_is_bad_usage() {
    finish(&mut spandrel("run"))
        .expect_code(BAD_INPUT)
        .expect_told(&["no structure"]);
}

#[test]
fn two_structures_of_one_name_are_refused_by_file() {
    let folder = tempfile::tempdir().unwrap();
    let paths = ["one.toml", "two.toml"].map(|name| write(&folder, name, &two_storeys("")));
    let finished = finish(spandrel("run").args(paths)).expect_code(BAD_INPUT);
    finished.expect_told(&["one.toml", "two.toml", "`house`"]);
}

#[test]
fn files_that_cannot_be_read_or_written_are_bad_input() {
    let site = Site::with(&two_storeys(""));
    let record = site.simulate(25.0);
    let nowhere = site.folder().join("nowhere").join("file");
    let with = |subcommand: &str, arguments: &[&str]| {
        let mut command = spandrel(subcommand);
        command.arg(site.structure_file()).args(arguments);
        finish(&mut command)
            .expect_code(BAD_INPUT)
            .expect_told(&["file"])
    };
    let (nowhere, record) = (nowhere.to_str().unwrap(), record.path().to_str().unwrap());
    with("estimate", &["--record", record, "--baseline", nowhere]);
    with("estimate", &["--record", record, "--output", nowhere]);
    with(
        "baseline",
        &["--record", record, "--skip", "0.5", "--output", nowhere],
    );
    with("simulate", &["--duration", "1", "--record", nowhere]);
    let told = with("run", &["--zenoh-config", nowhere]);
    assert!(
        !told.stderr.contains(".rs:"),
        "the message names a source file: {}",
        told.stderr
    );
    let folder = tempfile::tempdir().unwrap();
    let wrong = write(&folder, "file.json5", "{ mode: 7 }");
    with("run", &["--zenoh-config", wrong.to_str().unwrap()]);
    let wrong = write(&folder, "file.json", "{}");
    with(
        "estimate",
        &["--record", record, "--baseline", wrong.to_str().unwrap()],
    );
}

#[test]
fn the_error_explains_an_unusable_baseline() {
    let site = Site::with(&two_storeys(
        "[[alert]]\nparameters = \"all\"\nreference.design-std = 1e-9\nloss = 0.1\n",
    ));
    let record = site.simulate(20.0);
    let baseline = site.folder().join("house.baseline.json");
    let mut learn = spandrel("baseline");
    learn
        .arg(site.structure_file())
        .arg("--record")
        .arg(record.path())
        .arg("--output")
        .arg(&baseline);
    learn.args(["--between-std", "0"]);
    finish(&mut learn).expect_code(0);
    let estimate = |structure: &Path, baseline: &Path| {
        let mut command = spandrel("estimate");
        finish(
            command
                .arg(structure)
                .arg("--record")
                .arg(record.path())
                .arg("--baseline")
                .arg(baseline),
        )
        .expect_code(0)
    };
    estimate(site.structure_file(), &baseline)
        .expect_told(&["house.baseline.json: not used", "learn-s"]);
    // A rule that learns, with a baseline of the building from before its storeys were renamed.
    let learning =
        two_storeys("[[alert]]\nparameters = \"all\"\nloss = 0.1\nreference = { learn-s = 5 }\n");
    let folder = tempfile::tempdir().unwrap();
    let structure = write(&folder, "house.toml", &learning);
    let text = std::fs::read_to_string(&baseline)
        .unwrap()
        .replace("storey-2", "storey-two");
    let renamed = write(&folder, "house.baseline.json", &text);
    estimate(&structure, &renamed).expect_told(&[
        "unknown parameters of house: storey-two, must be among storey-1, storey-2",
        "lacks storey-2",
    ]);
    // A configuration with a baseline for a structure that it does not name.
    let text = format!(
        "structures = [{:?}]\n[baselines]\ntower = {:?}\n",
        site.structure_file().display().to_string(),
        baseline.display().to_string()
    );
    let configuration = write(&folder, "spandrel.toml", &text);
    finish(spandrel("run").arg("--config").arg(configuration))
        .expect_code(BAD_INPUT)
        .expect_told(&[
            "baseline of unknown structure `tower`",
            "must be one of: house",
        ]);
}

#[test]
fn the_error_names_a_port_in_use_and_suggests_a_remedy() {
    let site = Site::with(&two_storeys(""));
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let endpoint = format!("tcp/{}", taken.local_addr().unwrap());
    for subcommand in ["run", "ingest"] {
        let mut command = spandrel(subcommand);
        let finished = finish(
            command
                .arg(site.structure_file())
                .args(["--listen", &endpoint]),
        )
        .expect_code(FAILED);
        finished.expect_told(&[&endpoint, "cannot listen", "bus.listen"]);
    }
}

#[test]
fn an_endpoint_without_reply_ends_the_program() {
    let site = Site::with(&two_storeys(""));
    let endpoint = free_endpoint();
    let mut command = spandrel("identify");
    let finished = finish(
        command
            .arg(site.structure_file())
            .args(["--connect", &endpoint]),
    )
    .expect_code(FAILED);
    finished.expect_told(&[&endpoint, "no reply from"]);
}

#[test]
fn bad_usage_ends_with_2() {
    for arguments in [
        vec!["fly"],
        vec!["run", "--fly"],
        vec!["simulate"],
        vec!["simulate", "a.toml", "--duration", "-1"],
        vec![
            "replay",
            "a.csv",
            "--structure",
            "a.toml",
            "--speed",
            "fast",
        ],
        vec!["estimate", "a.toml"],
        vec!["completions", "cmd"],
    ] {
        let mut command = spandrel(arguments[0]);
        let finished = finish(command.args(&arguments[1..])).expect_code(BAD_INPUT);
        finished.expect_told(&["error:"]);
    }
}

#[test]
fn reader_of_the_result_may_close_the_pipe() {
    let site = Site::with(&two_storeys(""));
    let record = site.simulate(5.0);
    let mut estimate = spandrel("estimate");
    estimate
        .arg(site.structure_file())
        .arg("--record")
        .arg(record.path())
        .arg("--json");
    let mut completions = spandrel("completions");
    completions.arg("bash");
    for command in [&mut estimate, &mut completions] {
        let mut child = command
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        drop(child.stdout.take()); // like `| head -0`
        let output = child.wait_with_output().unwrap();
        let told = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(
            !told.contains("panicked"),
            "{command:?} with a closed pipe panicked:\n{told}"
        );
        assert_eq!(
            output.status.code(),
            Some(0),
            "{command:?} with a closed pipe:\n{told}"
        );
    }
}

#[test]
fn reader_of_the_errors_may_close_the_pipe() {
    Process::start_with_closed_log(spandrel("check").arg("nowhere.toml"))
        .wait()
        .expect_code(BAD_INPUT);
}

#[test]
fn help_of_every_subcommand_shows_an_example() {
    for subcommand in SUBCOMMANDS.into_iter().chain(["completions"]) {
        let finished = finish(spandrel(subcommand).arg("--help")).expect_code(0);
        let example = format!("spandrel {subcommand}");
        let has_example =
            finished.stdout.contains("Example") && finished.stdout.matches(&example).count() >= 2;
        assert!(
            has_example,
            "expected an example of {example}, found:\n{}",
            finished.stdout
        );
    }
}

#[test]
fn completions_are_scripts_that_their_shell_can_read() {
    let script = finish(spandrel("completions").arg("bash"))
        .expect_code(0)
        .stdout;
    for subcommand in SUBCOMMANDS {
        assert!(
            script.contains(subcommand),
            "no {subcommand} in the completions"
        );
    }
    let mut bash = Command::new("bash")
        .arg("-n")
        .stdin(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    bash.stdin
        .take()
        .unwrap()
        .write_all(script.as_bytes())
        .unwrap();
    let output = bash.wait_with_output().unwrap();
    assert!(
        output.status.success(),
        "bash -n: {}",
        String::from_utf8_lossy(&output.stderr)
    );
}

#[test]
fn a_result_that_cannot_be_written_names_its_file() {
    let (site, record, _) = record_with(|text| text);
    let mut command = spandrel("estimate");
    command
        .arg(site.structure_file())
        .arg("--record")
        .arg(record.path());
    let finished = finish(command.args(["--output", "/nowhere/estimates.csv"]));
    assert!(
        finished.code.is_some_and(|code| code != 0),
        "exit code {:?}",
        finished.code
    );
    finished.expect_told(&["/nowhere/estimates.csv"]);
}

#[test]
fn output_that_is_an_input_is_rejected_and_stays_unchanged() {
    let folder = tempfile::tempdir().unwrap();
    let text = two_storeys("");
    let structure = write(&folder, "house.toml", &text);
    let record = folder.path().join("record.csv");
    finish(
        spandrel("simulate")
            .arg(&structure)
            .arg("--record")
            .arg(&record)
            .args(["--duration", "2"]),
    )
    .expect_code(0);
    let before = std::fs::read(&record).unwrap();
    let refused = [
        finish(
            spandrel("simulate")
                .arg(&structure)
                .arg("--record")
                .arg(&structure),
        ),
        finish(
            spandrel("estimate")
                .arg(&structure)
                .arg("--record")
                .arg(&record)
                .arg("--output")
                .arg(&record),
        ),
        finish(
            spandrel("baseline")
                .arg(&structure)
                .arg("--record")
                .arg(&record)
                .arg("--output")
                .arg(&record),
        ),
    ];
    for finished in refused {
        let finished = finished.expect_code(2);
        assert!(
            finished.stderr.contains("would be overwritten"),
            "{}",
            finished.stderr
        );
    }
    assert_eq!(std::fs::read_to_string(&structure).unwrap(), text);
    assert_eq!(std::fs::read(&record).unwrap(), before);
}

// The rejected standby itself must report the size, instead of staying `joining` for ever while
// only the leader warns.
#[test]
fn the_error_names_the_size_of_a_structure_too_large_for_a_standby() {
    let site = Site::with(&storeys(400, ""));
    finish(site.listening("identify").arg("--standby"))
        .expect_code(BAD_INPUT)
        .expect_told(&[
            "structure house cannot have a standby",
            "must have at most 8388608",
            "--standby",
        ]);
}
