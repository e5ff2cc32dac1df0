//! A PostgreSQL server for tests.

#[path = "../../../../../tests/support/skip.rs"]
#[expect(dead_code, reason = "other programs use the rest of it")]
mod skip;

use skip::skip;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

pub(super) struct Server {
    folder: tempfile::TempDir,
    programs: PathBuf,
}

impl Server {
    /// Starts a server. Skips the test if none is installed, or panics if all tests are required.
    pub(super) fn start_or_skip() -> Option<Self> {
        let Some(programs) = programs() else {
            skip("no PostgreSQL server is installed (initdb, pg_ctl)");
            return None;
        };
        let folder = tempfile::tempdir().unwrap();
        // PostgreSQL does not run as root. It then runs as its own user, which needs access to the
        // folder.
        if is_root() {
            run(Command::new("chown").arg("postgres").arg(folder.path()));
        }
        let mut server = Self { folder, programs };
        run(server
            .command("initdb")
            .args(["--auth=trust", "--no-sync", "--username=spandrel", "-D"])
            .arg(server.data()));
        server.start();
        Some(server)
    }

    fn data(&self) -> PathBuf {
        self.folder.path().join("data")
    }

    fn command(&self, program: &str) -> Command {
        let program = self.programs.join(program);
        if !is_root() {
            return Command::new(program);
        }
        let mut command = Command::new("runuser");
        command.args(["-u", "postgres", "--"]).arg(program);
        command
    }

    pub(super) fn start(&mut self) {
        let options = format!(
            "-k {} -c listen_addresses= -c fsync=off",
            self.folder.path().display()
        );
        let log = self.data().join("log");
        run(self
            .command("pg_ctl")
            .arg("-w")
            .arg("-D")
            .arg(self.data())
            .arg("-l")
            .arg(log)
            .arg("-o")
            .arg(options)
            .arg("start"));
    }

    pub(super) fn stop(&mut self) {
        run(self
            .command("pg_ctl")
            .args(["-w", "-m", "immediate", "-D"])
            .arg(self.data())
            .arg("stop"));
    }

    pub(super) fn url(&self) -> String {
        let socket = self.folder.path().display().to_string().replace('/', "%2F");
        format!("postgres://spandrel@{socket}/postgres")
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let mut stop = self.command("pg_ctl");
        stop.args(["-m", "immediate", "-D"])
            .arg(self.data())
            .arg("stop")
            .stdout(Stdio::null())
            .stderr(Stdio::null());
        // Stopping fails if the server has already stopped.
        let _ = stop.status();
    }
}

fn run(command: &mut Command) {
    let output = command.current_dir("/").output().unwrap();
    assert!(
        output.status.success(),
        "{command:?}: {}",
        String::from_utf8_lossy(&output.stderr)
    );
}

fn is_root() -> bool {
    let id = Command::new("id").arg("-u").output();
    id.is_ok_and(|output| output.stdout.trim_ascii() == b"0")
}

/// Finds the folder of the server programs, on the path or in Debian's location.
fn programs() -> Option<PathBuf> {
    let on_path =
        std::env::var_os("PATH").map(|path| std::env::split_paths(&path).collect::<Vec<_>>());
    let versions = std::fs::read_dir("/usr/lib/postgresql")
        .into_iter()
        .flatten()
        .flatten();
    let debian = versions.map(|version| version.path().join("bin"));
    let has_all = |folder: &Path| {
        ["initdb", "pg_ctl"]
            .iter()
            .all(|program| folder.join(program).is_file())
    };
    on_path
        .into_iter()
        .flatten()
        .chain(debian)
        .find(|folder| has_all(folder))
}
