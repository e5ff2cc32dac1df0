//! Computers on which the commands of deploy/README.md run as they are printed: each has a network of its own, and folders of its
//! own in place of `/etc`, `/usr/local/bin`, `/var/lib`, `/var/log` and `/run`.
//!
//! A block ` ```sh DEPLOYMENT/COMPUTER ` runs on that computer and must succeed; one that ends in ` runs ` is a command that goes
//! on until it is stopped; ` ```sh program ` runs on each computer first. What only the machine itself can do is done in its
//! place: `systemctl` starts what a unit says, with its credentials, its folder and its word that it is ready, without its sandbox; `scp`
//! copies; what `cargo build` and `apt-get install` would bring is there.

use super::{DEADLINE, Lab, Process, spandrel};
use std::collections::BTreeMap;
use std::fs::Permissions;
use std::os::unix::fs::{PermissionsExt as _, symlink};
use std::os::unix::net::UnixDatagram;
use std::path::{Path, PathBuf};
use std::process::Command;
use tempfile::TempDir;

/// What each computer has to itself.
const PLACES: [&str; 5] = ["etc", "usr/local/bin", "var/lib", "var/log", "run"];
/// Enters the folders of a computer, then runs what follows. The first argument is where they are.
const ENTER: &str = "set -e; home=$1; shift; \
    for place in etc usr/local/bin var/lib var/log run; do mount --bind \"$home/$place\" \"/$place\"; done; \
    cd \"$home/source\"; exec \"$@\"";
/// `sudo` for who is root already.
const SUDO: &str = "#!/bin/sh\nif [ \"$1\" = -u ]; then user=$2; shift 2; \
    exec setpriv --reuid \"$user\" --regid \"$user\" --init-groups -- \"$@\"; fi\nexec \"$@\"\n";
/// Where programs are looked for on a computer.
const PATH: &str = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin";
/// What is there without being installed.
const PROVIDED: [&str; 2] = ["cargo build ", "sudo apt-get "];

/// One block of commands.
#[derive(Debug, Clone)]
struct Block {
    line: usize,
    place: String,
    goes_on: bool,
    script: String,
}

/// A deployment of deploy/README.md on computers of its own.
pub struct Computers {
    // in the order in which they have to end
    running: BTreeMap<(String, String), Process>,
    lab: Lab,
    folder: TempDir,
    deployment: &'static str,
    blocks: std::vec::IntoIter<Block>,
}

impl Computers {
    /// The computers of a deployment with their addresses; none, and a line that says so, where the machine lacks the means or the right.
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

    /// Makes the folders of a computer: those of this machine, and what it has of this repository.
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
        std::fs::create_dir_all(source.join("target/release")).unwrap();
        for folder in ["deploy", "docs"] {
            symlink(root().join(folder), source.join(folder)).unwrap();
        }
        symlink(
            spandrel("").get_program(),
            source.join("target/release/spandrel"),
        )
        .unwrap();
        let sudo = home.join("usr/local/bin/sudo");
        std::fs::write(&sudo, SUDO).unwrap();
        std::fs::set_permissions(&sudo, Permissions::from_mode(0o755)).unwrap();
    }

    fn home(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// A file of a computer, as this machine has it.
    pub fn file(&self, computer: &str, path: &str) -> PathBuf {
        self.home(computer).join(path.trim_start_matches('/'))
    }

    /// A command on a computer, with the environment that systemd and a shell have in common.
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

    /// What a line of a shell says on a computer; it must succeed.
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

    /// Runs the next block, which must be one of this computer; returns what it says.
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

    /// Whether all blocks have run.
    pub fn is_through(&self) -> bool {
        self.blocks.len() == 0
    }

    /// What goes on on a computer: a unit, or the first word behind `spandrel` that is no flag.
    #[track_caller]
    pub fn process(&self, computer: &str, name: &str) -> &Process {
        let found = self.running.get(&(computer.to_owned(), name.to_owned()));
        found.unwrap_or_else(|| panic!("no {name} on {computer}, but {:?}", self.running.keys()))
    }

    /// Takes a process out, to stop it.
    #[track_caller]
    pub fn take(&mut self, computer: &str, name: &str) -> Process {
        let found = self.running.remove(&(computer.to_owned(), name.to_owned()));
        found.unwrap_or_else(|| panic!("no {name} on {computer}, but {:?}", self.running.keys()))
    }

    /// Starts a program that goes on.
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

    /// Copies files of one computer into the repository of another, as `scp FILE… ADDRESS:spandrel/`.
    fn copy(&self, computer: &str, files: &[&str], target: &str) {
        let (address, folder) = target.split_once(':').unwrap();
        assert_eq!(folder, "spandrel/", "{target}: the repository is there");
        let name = self.lab.name_at(address);
        let target = self.home(name).join("source");
        self.said(
            computer,
            &format!("cp {} {}/", files.join(" "), target.display()),
        );
    }

    /// Starts a unit, again if it runs, and waits until it says that it is ready.
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
        let _ = std::fs::remove_file(&word); // of an earlier life
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

    /// Makes what the package of Debian makes when it is installed, and starts it.
    pub fn install_postgresql(&mut self, computer: &str, version: &str) {
        let _ = std::fs::remove_dir_all(self.file(computer, "etc/postgresql")); // that of this machine, if it has one
        let folders = "install -d -o postgres -g postgres /run/postgresql /var/lib/postgresql /var/log/postgresql";
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

/// The newest PostgreSQL of this machine that is packaged as Debian does it.
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

/// The `[Service]` of a unit with what is laid over it.
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

/// The blocks of a page that name where they run.
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

/// The parts of a block: a line that is done in place of the machine, or lines for a shell.
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
