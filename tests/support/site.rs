//! The environment of one test: folder, root, endpoint and structure.

use super::{Estimated, Process, Record, spandrel, within};
use spandrel_bus::{Bus, BusConfig, Keys, Service};
use spandrel_record::{FrameLog, LogLayout, LogSettings};
use spandrel_structure::Structure;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicU32, Ordering};
use tempfile::TempDir;

/// Number of sites of this process so far. Each site has its own root.
static SITES: AtomicU32 = AtomicU32::new(0);

/// Environment that one test has for itself.
pub struct Site {
    folder: TempDir,
    root: String,
    endpoint: String,
    structure_file: PathBuf,
    structure: Structure,
}

impl Site {
    /// Creates a site with a structure file of the documentation.
    pub fn of(structure_file: &Path) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let number = SITES.fetch_add(1, Ordering::Relaxed);
        let root = format!("test-{}-{number}", std::process::id());
        let structure = Structure::read(structure_file).unwrap_or_else(|error| panic!("{error}"));
        Self {
            folder,
            root,
            endpoint: free_endpoint(),
            structure_file: structure_file.to_owned(),
            structure,
        }
    }

    /// Creates a site with a structure file of this text.
    pub fn with(structure: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let structure_file = folder.path().join("structure.toml");
        std::fs::write(&structure_file, structure).unwrap();
        Self {
            folder,
            ..Self::of(&structure_file)
        }
    }

    /// Returns this structure with the root and endpoint of another site.
    pub fn at(self, other: &Self) -> Self {
        Self {
            root: other.root.clone(),
            endpoint: other.endpoint.clone(),
            ..self
        }
    }

    /// Returns this structure with a given root, because files on disk contain the root.
    pub fn rooted(self, root: &str) -> Self {
        Self {
            root: root.to_owned(),
            ..self
        }
    }

    pub fn folder(&self) -> &Path {
        self.folder.path()
    }

    pub fn structure_file(&self) -> &Path {
        &self.structure_file
    }

    pub fn structure(&self) -> &Structure {
        &self.structure
    }

    pub fn endpoint(&self) -> &str {
        &self.endpoint
    }

    pub fn keys(&self) -> Keys {
        Keys::parse(&self.root, self.structure.name()).unwrap()
    }

    /// Simulates this structure to a record.
    pub fn simulate(&self, seconds: f64) -> Record {
        let path = self.folder().join("record.csv");
        let mut command = spandrel("simulate");
        command.arg(&self.structure_file).arg("--record").arg(&path);
        Process::start(command.args(["--duration", &seconds.to_string()]))
            .wait()
            .expect_code(0);
        Record::read(&path)
    }

    /// Identifies a record offline.
    pub fn estimate(&self, record: &Record) -> Estimated {
        let output = record.path().with_extension("estimates.csv");
        let mut command = spandrel("estimate");
        command
            .arg(&self.structure_file)
            .arg("--record")
            .arg(record.path())
            .arg("--output")
            .arg(&output);
        let finished = Process::start(command.arg("--json")).wait().expect_code(0);
        let responses: Vec<&str> = self
            .structure
            .estimated_responses()
            .iter()
            .map(|response| response.name())
            .collect();
        Estimated::read(
            &output,
            &responses,
            serde_json::from_str(&finished.stdout).unwrap(),
        )
    }

    /// Opens the recording of the structure in a state folder whose services have ended.
    pub fn recording_in(&self, state: &Path) -> FrameLog {
        let folder = state.join(&self.root).join(self.structure.name());
        self.frame_log(&folder.join("recording"))
    }

    /// Opens a folder of recorded frames of the structure.
    pub fn frame_log(&self, folder: &Path) -> FrameLog {
        let layout = LogLayout {
            structure: self.structure.name().to_owned(),
            channels: self
                .structure
                .channels()
                .map(|channel| channel.name().to_owned())
                .collect(),
            nodes: self
                .structure
                .nodes()
                .iter()
                .map(|node| node.name().to_owned())
                .collect(),
            sampling_rate_hz: self.structure.sampling_rate_hz(),
        };
        let (log, _) = FrameLog::open(folder, layout, LogSettings::default()).unwrap();
        log
    }

    /// Returns a service command of this site that others can connect to.
    pub fn listening(&self, subcommand: &str) -> Command {
        let mut command = spandrel(subcommand);
        command.arg(&self.structure_file).args([
            "-v",
            "--root",
            &self.root,
            "--listen",
            &self.endpoint,
        ]);
        command
    }

    /// Returns a service command of this site that connects to the listening process.
    pub fn connecting(&self, subcommand: &str) -> Command {
        let mut command = spandrel(subcommand);
        command.arg(&self.structure_file).args([
            "-v",
            "--root",
            &self.root,
            "--connect",
            &self.endpoint,
        ]);
        command
    }

    /// Starts all services in one process, and waits until it accepts connections.
    pub fn run(&self) -> Process {
        let process = Process::start(&mut self.listening("run"));
        process.wait_for_log("ready structures=1");
        process
    }

    /// Starts a replay in a separate process.
    pub fn replay(&self, record: &Record, speed: &str) -> Process {
        let mut command = spandrel("replay");
        command
            .arg(record.path())
            .arg("--structure")
            .arg(&self.structure_file)
            .args(["--speed", speed, "-v"]);
        Process::start(command.args(["--root", &self.root, "--connect", &self.endpoint]))
    }

    /// Starts a view that prints lines.
    pub fn watch(&self) -> Process {
        let mut command = spandrel("watch");
        Process::start(command.args(["--root", &self.root, "--connect", &self.endpoint]))
    }

    /// Opens a session of the test itself, connected to the listening process.
    pub async fn join(&self) -> Bus {
        let config = BusConfig {
            root: self.root.clone(),
            connect: vec![self.endpoint.clone()],
            connect_timeout_s: Some(super::DEADLINE.as_secs_f64()),
            ..BusConfig::default()
        };
        Bus::open(&config).await.unwrap()
    }

    /// Opens a session of the test itself, to which processes connect.
    pub async fn host(&self) -> Bus {
        let config = BusConfig {
            root: self.root.clone(),
            listen: vec![self.endpoint.clone()],
            ..BusConfig::default()
        };
        Bus::open(&config).await.unwrap()
    }

    /// Waits for the liveliness tokens of all services.
    pub async fn wait_for_services(&self, bus: &Bus) {
        for service in [Service::Ingest, Service::Identify, Service::Alert] {
            let mut tokens = bus.watch_live(self.keys().all_live(service)).await.unwrap();
            within(&format!("token of {}", service.as_str()), tokens.some()).await;
        }
    }
}

/// Returns a free endpoint.
pub fn free_endpoint() -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    format!("tcp/{}", listener.local_addr().unwrap())
}
