//! Computers on which the commands of deploy/README.md run as printed. Each has its own network,
//! and its own `/etc`, `/usr/local/bin`, `/var/lib`, `/var/log` and `/run`.
//!
//! A block ` ```sh DEPLOYMENT/COMPUTER ` runs on that computer and must succeed. A block that ends
//! in ` runs ` is a command that runs until it is stopped. A block ` ```sh program ` runs first on
//! each computer.
//!
//! Some commands are replaced, because they need a real machine. `systemctl` starts the command of
//! a unit with its credentials, its folder and its readiness message, but without its sandbox.
//! `scp` copies between folders. The results of `cargo build` and `apt-get install` already exist.
//! The program is that of the tests, which is not static.

use super::{DEADLINE, Lab, Process, spandrel};
use std::collections::BTreeMap;
use std::fs::Permissions;
use std::os::unix::fs::{PermissionsExt as _, symlink};
use std::os::unix::net::UnixDatagram;
use std::path::{Path, PathBuf};
use std::process::Command;
use tempfile::TempDir;

/// Folders that each computer has for itself.
const PLACES: [&str; 5] = ["etc", "usr/local/bin", "var/lib", "var/log", "run"];
/// Script that mounts the folders of a computer and then runs the remaining arguments. The first
/// argument is the parent of the folders.
const ENTER: &str = "set -e; home=$1; shift; \
    for place in etc usr/local/bin var/lib var/log run; do mount \
    --bind \"$home/$place\" \"/$place\"; done; cd \"$home/source\"; exec \"$@\"";
/// Replacement of `sudo` for a user that is already root.
const SUDO: &str = "#!/bin/sh\nif [ \"$1\" = -u ]; then user=$2; shift 2; \
    exec setpriv --reuid \"$user\" --regid \"$user\" --init-groups -- \"$@\"; fi\nexec \"$@\"\n";
/// Search path for programs on a computer.
const PATH: &str = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin";
/// Commands whose results already exist.
const PROVIDED: [&str; 3] = ["cargo build ", "rustup ", "sudo apt-get "];

/// One block of commands.
#[derive(Debug, Clone)]
struct Block {
    line: usize,
    place: String,
    goes_on: bool,
    script: String,
}

/// A deployment of deploy/README.md on separate computers.
pub struct Computers {
    // In the order in which they must end.
    running: BTreeMap<(String, String), Process>,
    lab: Lab,
    folder: TempDir,
    deployment: &'static str,
    blocks: std::vec::IntoIter<Block>,
}

impl Computers {
    /// Creates the computers of a deployment with these addresses. Returns `None`, and prints a
    /// line, if the machine lacks the tools or the permission.
    pub fn or_skip(deployment: &'static str, computers: &[(&str, &str)]) -> Option<Self> {
        let lab = Lab::at_or_skip(computers, 1)?;
        let folder = tempfile::tempdir().unwrap();
        let all = blocks(&std::fs::read_to_string(root().join("deploy/README.md")).unwrap());
        let of_deployment = |block: &&Block| block.place.split('/').next() == Some(deployment);
        let blocks: Vec<Block> = all.iter().filter(of_deployment).cloned().collect();
        let program: Vec<&Block> = all
            .iter()
            .filter(|block| block.place == "program")
            .collect();
        assert!(
            !blocks.is_empty() && !program.is_empty(),
            "deploy/README.md has no commands of {deployment}"
        );
        let mut made = Self {
            running: BTreeMap::new(),
            lab,
            folder,
            deployment,
            blocks: blocks.into_iter(),
        };
        for (name, _) in computers {
            made.furnish(name);
            for block in &program {
                made.execute(name, block);
            }
        }
        Some(made)
    }

    /// Creates the folders of a computer from those of this machine and the files of this
    /// repository.
    fn furnish(&self, name: &str) {
        let home = self.home(name);
        for place in PLACES {
            std::fs::create_dir_all(home.join(place)).unwrap();
        }
        checked(
            Command::new("cp")
                .args(["-a", "/etc/."])
                .arg(home.join("etc")),
        );
        let source = home.join("source");
        let built = source.join("target/x86_64-unknown-linux-musl/release");
        std::fs::create_dir_all(&built).unwrap();
        for folder in ["deploy", "docs"] {
            symlink(root().join(folder), source.join(folder)).unwrap();
        }
        symlink(spandrel("").get_program(), built.join("spandrel")).unwrap();
        let sudo = home.join("usr/local/bin/sudo");
        std::fs::write(&sudo, SUDO).unwrap();
        std::fs::set_permissions(&sudo, Permissions::from_mode(0o755)).unwrap();
    }

    fn home(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Returns the path on this machine of a computer's file.
    pub fn file(&self, computer: &str, path: &str) -> PathBuf {
        self.home(computer).join(path.trim_start_matches('/'))
    }

    /// Returns a command on a computer, with the environment that systemd and a shell have in
    /// common.
    pub fn inside(&self, computer: &str, program: &str) -> Command {
        let home = self.home(computer);
        let mut command = self.lab.inside(computer);
        command
            .args(["unshare", "--mount", "sh", "-c", ENTER, "sh"])
            .arg(&home)
            .arg(program);
        command
            .env_clear()
            .env("PATH", PATH)
            .env("HOME", &home)
            .env("LC_ALL", "C.UTF-8");
        command
    }

    /// Runs a shell script on a computer and returns its output. The script must succeed.
    pub fn said(&self, computer: &str, script: &str) -> String {
        let output = self
            .inside(computer, "bash")
            .args(["-e", "-o", "pipefail", "-c", script])
            .output()
            .unwrap();
        let (said, told) = (
            String::from_utf8_lossy(&output.stdout),
            String::from_utf8_lossy(&output.stderr),
        );
        assert!(
            output.status.success(),
            "on {computer}: {script}\n{}\n{said}{told}",
            output.status
        );
        said.into_owned()
    }

    /// Runs the next block, which must belong to this computer, and returns its output.
    #[track_caller]
    pub fn follow(&mut self, computer: &str) -> String {
        let block = self
            .blocks
            .next()
            .unwrap_or_else(|| panic!("the page has no block more for {computer}"));
        assert_eq!(
            block.place,
            format!("{}/{computer}", self.deployment),
            "deploy/README.md:{}",
            block.line
        );
        self.execute(computer, &block)
    }

    /// Returns `true` if all blocks have run.
    pub fn is_through(&self) -> bool {
        self.blocks.len() == 0
    }

    /// Returns a running process of a computer by the name of its unit, or by the first word after
    /// `spandrel` that is not a flag.
    #[track_caller]
    pub fn process(&self, computer: &str, name: &str) -> &Process {
        let found = self.running.get(&(computer.to_owned(), name.to_owned()));
        found.unwrap_or_else(|| panic!("no {name} on {computer}, but {:?}", self.running.keys()))
    }

    /// Removes and returns a process, so that the caller can stop it.
    #[track_caller]
    pub fn take(&mut self, computer: &str, name: &str) -> Process {
        let found = self.running.remove(&(computer.to_owned(), name.to_owned()));
        found.unwrap_or_else(|| panic!("no {name} on {computer}, but {:?}", self.running.keys()))
    }

    /// Starts a program that keeps running.
    pub fn start(&mut self, computer: &str, name: &str, command: &mut Command) -> &Process {
        let process = Process::start(command);
        self.running
            .entry((computer.to_owned(), name.to_owned()))
            .insert_entry(process)
            .into_mut()
    }

    fn execute(&mut self, computer: &str, block: &Block) -> String {
        println!(
            "deploy/README.md:{} on {computer}:\n{}",
            block.line, block.script
        );
        let mut said = String::new();
        for part in parts(&block.script) {
            let words: Vec<&str> = part.split_whitespace().collect();
            match words.as_slice() {
                _ if PROVIDED.iter().any(|provided| part.starts_with(provided)) => {}
                ["sudo", "systemctl", "daemon-reload"] => {}
                ["sudo", "systemctl", "enable", "--now", units @ ..]
                | ["sudo", "systemctl", "restart", units @ ..] => {
                    units
                        .iter()
                        .for_each(|unit| self.start_unit(computer, unit));
                }
                ["scp", files @ .., target] => self.copy(computer, files, target),
                [_, rest @ ..] if block.goes_on => {
                    let name = rest.iter().find(|word| !word.starts_with('-')).unwrap();
                    let mut shell = self.inside(computer, "bash");
                    self.start(computer, name, shell.args(["-c", &format!("exec {part}")]));
                }
                _ => said += &self.said(computer, &part),
            }
        }
        said
    }

    /// Copies files of one computer into the repository of another, as
    /// `scp FILE… ADDRESS:spandrel/` does.
    fn copy(&self, computer: &str, files: &[&str], target: &str) {
        let (address, folder) = target.split_once(':').unwrap();
        assert_eq!(folder, "spandrel/", "{target}: the repository is installed");
        let name = self.lab.name_at(address);
        let target = self.home(name).join("source");
        self.said(
            computer,
            &format!("cp {} {}/", files.join(" "), target.display()),
        );
    }

    /// Starts or restarts a unit, and waits until it reports that it is ready.
    fn start_unit(&mut self, computer: &str, name: &str) {
        if let Some(running) = self.running.remove(&(computer.to_owned(), name.to_owned())) {
            running.stop();
        }
        match name {
            "postgresql" => self.start_postgresql(computer),
            _ => self.start_service(computer, name),
        }
    }

    fn start_service(&mut self, computer: &str, name: &str) {
        let unit = Unit::read(&self.file(computer, "etc/systemd/system"), name);
        let given = format!("/run/credentials/{name}.service");
        let mut variables = vec![("CREDENTIALS_DIRECTORY".to_owned(), given.clone())];
        for credential in unit.all("LoadCredential") {
            let (id, source) = credential.split_once(':').unwrap();
            std::fs::create_dir_all(self.file(computer, &given)).unwrap();
            let copied = std::fs::copy(
                self.file(computer, source),
                self.file(computer, &given).join(id),
            );
            copied.unwrap_or_else(|error| {
                panic!("{name} on {computer}: credential {credential}: {error}")
            });
        }
        for folder in unit.all("StateDirectory") {
            let folder = format!("/var/lib/{folder}");
            std::fs::create_dir_all(self.file(computer, &folder)).unwrap();
            variables.push(("STATE_DIRECTORY".to_owned(), folder));
        }
        for pair in unit
            .all("Environment")
            .iter()
            .flat_map(|line| line.split_whitespace())
        {
            let (variable, value) = pair.split_once('=').unwrap();
            variables.push((variable.to_owned(), value.to_owned()));
        }
        let socket = format!("/run/notify-{name}");
        let word = self.file(computer, &socket);
        let _ = std::fs::remove_file(&word); // of an earlier run
        let word = UnixDatagram::bind(word).unwrap();
        let is_told = unit.all("Type") == ["notify"];
        if is_told {
            variables.push(("NOTIFY_SOCKET".to_owned(), socket));
        }
        let [line] = &unit.all("ExecStart")[..] else {
            panic!("{name}: one ExecStart")
        };
        let mut words = line.split_whitespace();
        let mut command = self.inside(computer, words.next().unwrap());
        command.args(words).envs(variables);
        let process = self.start(computer, name, &mut command);
        match is_told {
            true => wait_for_ready(&word, process),
            false => process.wait_for_log("ready"),
        }
    }

    /// Creates what the Debian package creates on installation, and starts it.
    pub fn install_postgresql(&mut self, computer: &str, version: &str) {
        // The folder of this machine, if it exists.
        let _ = std::fs::remove_dir_all(self.file(computer, "etc/postgresql"));
        let folders = "install -d -o postgres -g postgres /run/postgresql /var/lib/postgresql \
                       /var/log/postgresql";
        self.said(computer, folders);
        self.said(
            computer,
            &format!("pg_createcluster {version} main -- --no-sync"),
        );
        self.start_postgresql(computer);
    }

    fn start_postgresql(&mut self, computer: &str) {
        let configuration = self
            .said(computer, "echo /etc/postgresql/*/main")
            .trim()
            .to_owned();
        let version = configuration.split('/').nth(3).unwrap();
        let mut command = self.inside(computer, "setpriv");
        command.args([
            "--reuid",
            "postgres",
            "--regid",
            "postgres",
            "--init-groups",
            "--",
        ]);
        command.arg(format!("/usr/lib/postgresql/{version}/bin/postgres"));
        command
            .arg("-D")
            .arg(format!("/var/lib/postgresql/{version}/main"));
        command
            .arg("-c")
            .arg(format!("config_file={configuration}/postgresql.conf"));
        let process = self.start(computer, "postgresql", &mut command);
        process.wait_for_log("ready to accept connections");
    }
}

/// Returns the newest PostgreSQL version of this machine with Debian's packaging.
pub fn packaged_postgresql() -> Option<String> {
    let versions = std::fs::read_dir("/usr/lib/postgresql").ok()?.flatten();
    let usable = versions.filter(|version| version.path().join("bin/postgres").is_file());
    let mut names: Vec<String> = usable
        .filter_map(|version| version.file_name().into_string().ok())
        .collect();
    names.sort();
    names
        .pop()
        .filter(|_| Path::new("/usr/bin/pg_createcluster").is_file())
}

fn wait_for_ready(socket: &UnixDatagram, process: &Process) {
    socket.set_read_timeout(Some(DEADLINE)).unwrap();
    let mut buffer = [0; 4096];
    loop {
        let received = socket.recv(&mut buffer);
        let length =
            received.unwrap_or_else(|error| panic!("not ready: {error}\n{}", process.log()));
        if buffer[..length]
            .split(|byte| *byte == b'\n')
            .any(|line| line == b"READY=1")
        {
            return;
        }
    }
}

/// The `[Service]` section of a unit with its overrides.
struct Unit(Vec<(String, String)>);

impl Unit {
    fn read(folder: &Path, name: &str) -> Self {
        let (template, instance) = name
            .split_once('@')
            .map_or((name.to_owned(), ""), |(template, instance)| {
                (format!("{template}@"), instance)
            });
        let mut files = vec![folder.join(format!("{template}.service"))];
        for of in [&template, name] {
            let laid_over = std::fs::read_dir(folder.join(format!("{of}.service.d")))
                .into_iter()
                .flatten();
            let mut laid_over: Vec<PathBuf> =
                laid_over.map(|entry| entry.unwrap().path()).collect();
            laid_over.sort();
            files.extend(
                laid_over
                    .into_iter()
                    .filter(|path| !files.contains(path))
                    .collect::<Vec<_>>(),
            );
        }
        let mut settings = Vec::new();
        for file in files {
            let text = std::fs::read_to_string(&file)
                .unwrap_or_else(|error| panic!("{}: {error}", file.display()));
            let lines = text.lines().filter(|line| !line.starts_with('#'));
            let service = lines
                .skip_while(|line| *line != "[Service]")
                .skip(1)
                .take_while(|line| !line.starts_with('['));
            for (key, value) in service.filter_map(|line| line.split_once('=')) {
                let value = value
                    .replace("%d", &format!("/run/credentials/{name}.service"))
                    .replace("%i", instance);
                assert!(
                    !value.contains('%') || value.contains("%%"),
                    "{}: {value}",
                    file.display()
                );
                settings.push((key.to_owned(), value));
            }
        }
        Self(settings)
    }

    fn all(&self, key: &str) -> Vec<&str> {
        self.0
            .iter()
            .filter(|(found, _)| found == key)
            .map(|(_, value)| value.as_str())
            .collect()
    }
}

/// Returns the blocks of a page that name their computer.
fn blocks(page: &str) -> Vec<Block> {
    let mut blocks = Vec::new();
    let mut lines = page.lines().enumerate();
    while let Some((number, line)) = lines.next() {
        let Some(mut words) = line.strip_prefix("```sh ").map(str::split_whitespace) else {
            continue;
        };
        let (place, goes_on) = (
            words.next().unwrap_or_default().to_owned(),
            words.next() == Some("runs"),
        );
        let script: Vec<&str> = lines
            .by_ref()
            .map(|(_, line)| line)
            .take_while(|line| *line != "```")
            .collect();
        blocks.push(Block {
            line: number + 1,
            place,
            goes_on,
            script: script.join("\n"),
        });
    }
    blocks
}

/// Splits a block into parts: a line that is run in a replaced form, or lines for a shell.
fn parts(script: &str) -> Vec<String> {
    let is_ours = |line: &str| {
        ["sudo systemctl ", "scp "]
            .iter()
            .chain(&PROVIDED)
            .any(|beginning| line.starts_with(beginning))
    };
    let mut parts: Vec<String> = Vec::new();
    let mut is_joined = false;
    for line in script.lines() {
        match parts.last_mut().filter(|_| is_joined && !is_ours(line)) {
            Some(part) => *part = format!("{part}\n{line}"),
            None => parts.push(line.to_owned()),
        }
        is_joined = !is_ours(line);
    }
    parts
}

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../..")
        .canonicalize()
        .unwrap()
}

fn checked(command: &mut Command) {
    let output = command.output().unwrap();
    assert!(
        output.status.success(),
        "{command:?}: {}",
        String::from_utf8_lossy(&output.stderr)
    );
}
