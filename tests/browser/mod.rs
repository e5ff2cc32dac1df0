//! Tests of the page in a real browser.
//!
//! The damage of the demo is visible, the alert can be acknowledged, a lost connection is restored,
//! and the page fits a phone. Each module tests one subject. The functions here start the program
//! and the browser for all of them. The tests save screenshots in `target/screenshots`.

mod chromium;
mod compare;
mod conditions;
mod damage;
mod language;
mod lasting;
mod layout;
mod map;
mod mistakes;
mod model;
mod nodes;
mod overview;
mod report;
mod resources;
mod samples;
mod subscriber;
mod tokens;
mod trouble;
mod undated;
mod waveforms;
mod workspace;

use crate::support::skip;
use chromium::Browser;
use std::fmt::Write as _;
use std::io::{BufRead, BufReader};
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

/// Number of storeys and parameters of the tall building.
const STOREYS: usize = 40;

/// A program that is killed when its test ends.
struct Program {
    child: Child,
    page: String,
}

impl Program {
    /// Starts a subcommand and reads the address of its page.
    fn start(arguments: &[&str]) -> Self {
        let mut command = Command::new(env!("CARGO_BIN_EXE_spandrel"));
        let mut child = command
            .args(arguments)
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
        let line = lines
            .next()
            .expect("a line that says where the page is")
            .unwrap();
        // Reads the output to its end, so that the program never blocks on it.
        std::thread::spawn(move || lines.for_each(drop));
        let page = line
            .strip_prefix("page: ")
            .unwrap_or_else(|| panic!("no address of a page: {line}"))
            .to_owned();
        Self { child, page }
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        // The process may have ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn free_address() -> String {
    TcpListener::bind("127.0.0.1:0")
        .unwrap()
        .local_addr()
        .unwrap()
        .to_string()
}

/// Starts the browser. Without Chromium it returns `None` with a message, or fails if all tests are
/// required.
async fn browser() -> Option<Browser> {
    let Some(program) = chromium::installed() else {
        skip("Chromium is not installed (apt-get install chromium)");
        return None;
    };
    let screenshots: PathBuf = Path::new(env!("CARGO_TARGET_TMPDIR")).join("../screenshots");
    Some(Browser::start(&program, screenshots).await)
}

/// Runs a subcommand to its end.
fn tool(arguments: &[&str]) {
    let ended = Command::new(env!("CARGO_BIN_EXE_spandrel"))
        .args(arguments)
        .output()
        .unwrap();
    assert!(
        ended.status.success(),
        "{arguments:?}: {}",
        String::from_utf8_lossy(&ended.stderr)
    );
}

/// Runs the services of a structure with their page and without persistent state. Returns the
/// program and its endpoint.
fn run_in(folder: &Path, structure: &str) -> (Program, String) {
    let configuration = folder.join("spandrel.toml");
    std::fs::write(
        &configuration,
        "[history]\ndatabase = \"none\"\n[state]\nfolder = \"none\"\n",
    )
    .unwrap();
    let (configuration, endpoint) = (
        configuration.to_str().unwrap(),
        format!("tcp/{}", free_address()),
    );
    let run = [
        "run",
        structure,
        "--config",
        configuration,
        "--http",
        "127.0.0.1:0",
        "--listen",
        &endpoint,
    ];
    (Program::start(&run), endpoint)
}

/// Starts a demo that keeps running, without its output.
fn demo(arguments: &[&str]) -> Program {
    let endpoint = format!("tcp/{}", free_address());
    let settings = [
        "--stay",
        "--speed",
        "10",
        "--http",
        "127.0.0.1:0",
        "--listen",
        &endpoint,
    ];
    Program::start(&[&["demo"], arguments, &settings].concat())
}

/// Returns the path of an example of the docs.
fn example(name: &str) -> String {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../docs/examples")
        .join(name)
        .to_str()
        .unwrap()
        .to_owned()
}

/// Returns a structure file of forty storeys with a parameter and a sensor each.
fn tall_building() -> String {
    let mut text = String::from(
        "[structure]\nname = \"tall\"\ndescription = \"forty storeys\"\nsampling-rate-hz = 25\n\
         display-rate-hz = 10\n[model]\nkind = \"shear-building\"\nstoreys = 40\nmass-kg = 20_000\n\
         first-frequency-hz = 0.3\n[damping]\nkind = \"rayleigh\"\nratio = 0.02\nmodes = [1, 2]\n\
         [[excitation]]\nname = \"ground\"\nkind = \"ground\"\nstd = 0.1\n\
         measured-on = \"ground\"\n\
         [[node]]\nname = \"ground\"\n[[node.channel]]\nname = \"ground\"\n\
         quantity = \"ground-acceleration\"\nunit = \"m/s2\"\nnoise-std = 0.005\n\
         [[alert]]\nparameters = \"stiffness\"\nloss = 0.05\ncredibility = 0.99\nsustain-s = 5\n\
         reference = { learn-s = 10 }\n",
    );
    for storey in 1..=STOREYS {
        write!(
            text,
            "[[parameter]]\nname = \"storey-{storey}\"\nscales = \"stiffness\"\n\
             of = [\"storey-{storey}\"]\n\
             std = 0.05\n[[node]]\nname = \"node-{storey}\"\n[[node.channel]]\n\
             name = \"acceleration-{storey}\"\nquantity = \"absolute-acceleration\"\n\
             dof = \"floor-{storey}\"\nunit = \"m/s2\"\nnoise-std = 0.005\n"
        )
        .unwrap();
    }
    text
}
