//! A site with a router whose parties need certificates, created by the built binary as its users
//! would.

use super::{Process, spandrel};
use spandrel_bus::{Bus, BusConfig, Mode, TlsConfig};
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::Command;
use tempfile::TempDir;

/// The certificates of a site, and the endpoint of its router.
pub struct Secured {
    folder: TempDir,
    endpoint: String,
    structure_file: PathBuf,
}

impl Secured {
    /// Creates an authority, a router, a certificate for each of these parties, and one for each
    /// node of the structure.
    pub fn new(structure_file: &Path, parties: &[&str]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let endpoint = format!("quic/{}", listener.local_addr().unwrap());
        let site = Self {
            folder,
            endpoint,
            structure_file: structure_file.to_owned(),
        };
        site.tool(&["create"], &[]);
        site.tool(
            &["issue"],
            &[
                "router",
                "main",
                "--host",
                "127.0.0.1",
                "--host",
                "localhost",
            ],
        );
        for party in parties {
            let (role, name) = party.split_once('.').unwrap();
            site.tool(&["issue"], &[role, name]);
        }
        site.tool(&["nodes"], &[structure_file.to_str().unwrap()]);
        let listen = site.endpoint.clone();
        site.tool(
            &["router"],
            &[structure_file.to_str().unwrap(), "--listen", &listen],
        );
        site
    }

    /// Runs `spandrel site` on its folder.
    pub fn tool(&self, before: &[&str], after: &[&str]) -> String {
        let mut command = spandrel("site");
        command.args(before).arg(self.folder()).args(after);
        Process::start(&mut command).wait().expect_code(0).stdout
    }

    pub fn folder(&self) -> PathBuf {
        self.folder.path().join("site")
    }

    pub fn endpoint(&self) -> &str {
        &self.endpoint
    }

    /// Returns the path of the router file.
    pub fn router_file(&self) -> PathBuf {
        self.folder().join("router.json5")
    }

    /// Starts the router, and waits until it accepts connections.
    pub fn router(&self) -> Process {
        let process = Process::start(spandrel("router").arg(self.router_file()).arg("-v"));
        process.wait_for_log("ready");
        process
    }

    /// Returns the path of a party's certificate.
    pub fn certificate(&self, party: &str) -> PathBuf {
        self.folder().join(format!("{party}.pem"))
    }

    /// Returns the bus configuration of a party.
    pub fn config(&self, party: &str) -> BusConfig {
        BusConfig {
            mode: Mode::Client,
            connect: vec![self.endpoint.clone()],
            connect_timeout_s: Some(super::DEADLINE.as_secs_f64()),
            tls: Some(TlsConfig::beside(self.certificate(party))),
            ..BusConfig::default()
        }
    }

    /// Opens a session of a party.
    pub async fn join(&self, party: &str) -> Bus {
        Bus::open(&self.config(party))
            .await
            .unwrap_or_else(|error| panic!("{party}: {error}"))
    }

    /// Returns a command of a party that connects to the router.
    pub fn connecting(&self, party: &str, subcommand: &str) -> Command {
        let mut command = spandrel(subcommand);
        command
            .arg(&self.structure_file)
            .args(["-v", "--connect", &self.endpoint]);
        command.arg("--certificate").arg(self.certificate(party));
        command
    }
}
