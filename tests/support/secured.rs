//! A site whose parties show certificates to a router: made by the built binary, as its users make it.

use super::{Process, spandrel};
use spandrel_bus::{Bus, BusConfig, Mode, TlsConfig};
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::Command;
use tempfile::TempDir;

/// The certificates of a site, and where its router listens.
pub struct Secured {
    folder: TempDir,
    endpoint: String,
    structure_file: PathBuf,
}

impl Secured {
    /// An authority, a router, a certificate for each of these, and a certificate for each node of the structure.
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

    /// Where the router file is.
    pub fn router_file(&self) -> PathBuf {
        self.folder().join("router.json5")
    }

    /// Starts the router, and waits until it can be connected to.
    pub fn router(&self) -> Process {
        let process = Process::start(spandrel("router").arg(self.router_file()).arg("-v"));
        process.wait_for_log("ready");
        process
    }

    /// The certificate of a party.
    pub fn certificate(&self, party: &str) -> PathBuf {
        self.folder().join(format!("{party}.pem"))
    }

    /// How a party joins the bus.
    pub fn config(&self, party: &str) -> BusConfig {
        BusConfig {
            mode: Mode::Client,
            connect: vec![self.endpoint.clone()],
            connect_timeout_s: Some(super::DEADLINE.as_secs_f64()),
            tls: Some(TlsConfig::beside(self.certificate(party))),
            ..BusConfig::default()
        }
    }

    /// A session of a party.
    pub async fn join(&self, party: &str) -> Bus {
        Bus::open(&self.config(party))
            .await
            .unwrap_or_else(|error| panic!("{party}: {error}"))
    }

    /// A command of a party that connects to the router.
    pub fn connecting(&self, party: &str, subcommand: &str) -> Command {
        let mut command = spandrel(subcommand);
        command
            .arg(&self.structure_file)
            .args(["-v", "--connect", &self.endpoint]);
        command.arg("--certificate").arg(self.certificate(party));
        command
    }
}
