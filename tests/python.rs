//! The Python client against running services: its output for the present and the past.
//!
//! The test needs Python 3 with the package `eclipse-zenoh` (and `matplotlib` for the plot) as
//! `python3` or as the program in `PYTHON`. Otherwise it prints that it was skipped, or fails if
//! `REQUIRE_ALL_TESTS` is set.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that fails panics"
)]

mod support;

use std::path::Path;
use std::process::{Command, Output};
use support::{Process, Secured, Site, skip, two_storeys, within};

const DAMAGED: &str = "[[alert]]\nparameters = \"all\"\nreference.design-std = 1e-9\nloss = 0.05\ncredibility = 0.99\nsustain-s = 5\n\
                       [[simulation.damage]]\nparameter = \"storey-2\"\nat-s = 20\nloss = 0.15\n";

fn python() -> Option<String> {
    let program = std::env::var("PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let has_packages = Command::new(&program)
        .args(["-c", "import zenoh, matplotlib"])
        .output();
    if has_packages.is_ok_and(|output| output.status.success()) {
        return Some(program);
    }
    skip("python3 with the packages of clients/python/requirements.txt is not installed");
    None
}

fn client(python: &str, site: &Site, arguments: &[&str]) -> Command {
    let mut command = Command::new(python);
    command.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("../../clients/python/watch.py"));
    let root = site.keys().root().to_string();
    command
        .args(["house", "--root", &root, "--connect", site.endpoint()])
        .args(arguments);
    command
}

#[tokio::test(flavor = "multi_thread")]
async fn a_script_with_a_certificate_receives_what_a_viewer_may() {
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
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../clients/python/watch.py");
    let mut client = Command::new(python);
    client.arg(script).args([
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
        "{}",
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
