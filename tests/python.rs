//! The Python package and its example against running services.
//!
//! The tests need Python 3 with the packages of `clients/python/tests/requirements.txt`, as
//! `python3` or as the program in `PYTHON`. Otherwise they print that they were skipped, or fail if
//! `REQUIRE_ALL_TESTS` is set.

use crate::support::{Lab, Process, Secured, Site, skip, two_storeys, within};
use spandrel_bus::{
    Acknowledgement, AlertMessage, CaughtUp, ConditionDisplay, EpochDisplay, Event, FitDisplay,
    HistorySpan, JudgementDisplay, LossDisplay, Message, ModeDisplay, ModelClassDisplay,
    MonitoringDisplay, NodeDisplay, NoiseDisplay, OutlierDisplay, ParameterDisplay, Progress,
    SampleBlock, SensorHealthDisplay, SpectrumDisplay, Status, WaveformDisplay,
};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

const DAMAGED: &str = "[[alert]]\nparameters = \"all\"\nreference.design-std = 1e-9\nloss = 0.05\n\
                       credibility = 0.99\nsustain-s = 5\n\
                       [[simulation.damage]]\nparameter = \"storey-2\"\nat-s = 20\nloss = 0.15\n";

/// Returns the folder of the package.
fn package() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../clients/python")
}

fn python() -> Option<String> {
    let program = std::env::var("PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let has_packages = Command::new(&program)
        .args(["-c", "import matplotlib, mypy, numpy, pytest, zenoh"])
        .output();
    if has_packages.is_ok_and(|output| output.status.success()) {
        return Some(program);
    }
    skip("python3 with the packages of clients/python/tests/requirements.txt is not installed");
    None
}

/// Runs the tests of the package in a file or folder.
fn pytest(mut command: Command, tests: &str) {
    command
        .args(["-m", "pytest", "-q", "--color=no", "-p", "no:cacheprovider"])
        .arg(tests)
        .current_dir(package())
        .env("PROGRAM", env!("CARGO_BIN_EXE_spandrel"));
    let output = command.output().unwrap();
    let said = text(&output);
    println!("{said}");
    let may_skip = std::env::var_os("REQUIRE_ALL_TESTS").is_none();
    assert!(may_skip || !said.contains(" skipped"), "{said}");
}

#[test]
fn the_tests_of_the_package_pass() {
    let Some(python) = python() else { return };
    pytest(Command::new(python), "tests");
}

/// Runs in its own network, because the pages state the default endpoint.
#[test]
fn the_python_code_of_the_pages_runs_as_printed() {
    let Some(python) = python() else { return };
    let Some(lab) = Lab::or_skip(&["desk"], 4) else {
        return;
    };
    let mut command = lab.inside("desk");
    command.arg(python);
    pytest(command, "tests/pages/test_pages.py");
}

#[test]
fn the_package_supports_the_versions_of_the_services() {
    let Some(python) = python() else { return };
    let script = "import spandrel\n\
                  from spandrel import alerts, messages, past, postcard\n\
                  for kind in spandrel.MESSAGES: print(messages.encoding_of(kind))\n\
                  print(alerts.ENCODING, past.ENCODING, postcard.SAMPLES_ENCODING)\n\
                  print(postcard.CAUGHT_UP_ENCODING, postcard.PROGRESS_ENCODING)\n";
    let mut command = Command::new(python);
    command
        .args(["-c", script])
        .env("PYTHONPATH", package().join("src"));
    let said = text(&command.output().unwrap());
    let mut found: Vec<&str> = said.split_whitespace().collect();
    let mut expected = [
        ParameterDisplay::encoding(),
        LossDisplay::encoding(),
        NoiseDisplay::encoding(),
        OutlierDisplay::encoding(),
        SensorHealthDisplay::encoding(),
        WaveformDisplay::encoding(),
        SpectrumDisplay::encoding(),
        ConditionDisplay::encoding(),
        EpochDisplay::encoding(),
        JudgementDisplay::encoding(),
        ModeDisplay::encoding(),
        ModelClassDisplay::encoding(),
        FitDisplay::encoding(),
        MonitoringDisplay::encoding(),
        NodeDisplay::encoding(),
        Event::encoding(),
        AlertMessage::encoding(),
        Status::encoding(),
        Acknowledgement::encoding(),
        HistorySpan::encoding(),
        SampleBlock::encoding(),
        CaughtUp::encoding(),
        Progress::encoding(),
    ];
    found.sort_unstable();
    expected.sort_unstable();
    assert_eq!(found, expected);
}

#[test]
fn the_package_has_the_units_of_the_services() {
    let Some(python) = python() else { return };
    let script = "import spandrel; print('\\n'.join(spandrel.CONDITION_UNITS))";
    let mut command = Command::new(python);
    command
        .args(["-c", script])
        .env("PYTHONPATH", package().join("src"));
    let said = text(&command.output().unwrap());
    let expected: Vec<&str> = ConditionDisplay::units().collect();
    assert_eq!(said.lines().collect::<Vec<_>>(), expected);
}

fn client(python: &str, site: &Site, arguments: &[&str]) -> Command {
    let mut command = Command::new(python);
    command
        .arg(package().join("watch.py"))
        .env("PYTHONPATH", package().join("src"));
    let root = site.keys().root().to_string();
    command
        .args(["house", "--root", &root, "--connect", site.endpoint()])
        .args(arguments);
    command
}

#[tokio::test(flavor = "multi_thread")]
async fn script_with_a_certificate_has_the_rights_of_a_viewer() {
    let Some(python) = python() else { return };
    let folder = tempfile::tempdir().unwrap();
    let structure = folder.path().join("house.toml");
    std::fs::write(&structure, two_storeys(DAMAGED)).unwrap();
    let site = Secured::new(&structure, &["server.main", "gateway.house", "viewer.ada"]);
    let _router = site.router();
    let server = Process::start(
        site.connecting("server.main", "run")
            .args(["--http", "none"]),
    );
    server.wait_for_log("ready structures=1");
    let mut client = Command::new(python);
    client.env("PYTHONPATH", package().join("src"));
    client.arg(package().join("watch.py")).args([
        "house",
        "--seconds",
        "20",
        "--connect",
        site.endpoint(),
        "--certificate",
    ]);
    let listening = Process::start(client.arg(site.certificate("viewer.ada")));
    listening.wait_for_output("that it listens", |said| said.contains("listening below"));
    let mut simulate = site.connecting("gateway.house", "simulate");
    Process::start(simulate.args(["--speed", "max", "--duration", "60"]))
        .wait()
        .expect_code(0);
    listening.wait_for_output("alert of storey-2", |said| {
        said.contains("ALERT storey-2 raised")
    });
    server.stop().expect_code(0);
}

fn text(output: &Output) -> String {
    assert!(
        output.status.success(),
        "{}{}",
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    );
    String::from_utf8_lossy(&output.stdout).into_owned()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_script_receives_alerts_and_plots_the_past() {
    let Some(python) = python() else { return };
    let site = Site::with(&two_storeys(DAMAGED));
    let services = Process::start(site.listening("run").args(["--http", "none"]));
    services.wait_for_log("ready structures=1");
    let bus = site.join().await;
    site.wait_for_services(&bus).await;
    let record = site.simulate(60.0);
    let listening = Process::start(&mut client(&python, &site, &["--seconds", "20"]));
    listening.wait_for_output("that it listens", |said| said.contains("listening below"));
    site.replay(&record, "max").wait().expect_code(0);
    listening.wait_for_output("alert of storey-2", |said| {
        said.contains("ALERT storey-2 raised: storey-2 has lost") && said.contains("storey-1 1.0")
    });
    let picture = site.folder().join("storey-2.png");
    let mut past = client(
        &python,
        &site,
        &["--history", "storey-2", "--plot", picture.to_str().unwrap()],
    );
    // Recent values reach the history within seconds.
    let said = within("a past with the damage in it", async {
        loop {
            let said = text(&tokio::task::block_in_place(|| past.output().unwrap()));
            if said.contains("last 0.8") {
                return said;
            }
        }
    })
    .await;
    assert!(
        said.contains("rows of storey-2, resolution as displayed"),
        "{said}"
    );
    assert!(std::fs::read(&picture).unwrap().starts_with(b"\x89PNG"));
    bus.close().await.unwrap();
    services.stop().expect_code(0);
}
