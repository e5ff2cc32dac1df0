//! The container image. Podman builds its last stage around the program of the tests, and runs it
//! with the printed options. Without podman, the copied files and the command are still tested.

use crate::history::get;
use crate::support::{Process, skip, spandrel};
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use tempfile::TempDir;

/// Folder of the configuration in the image.
const CONFIGURATION: &str = "/etc/spandrel/";
/// User and group in the image.
const USER: u32 = 65532;
/// Folders of the C library, which the program of the tests needs and that of the image does not.
const LIBRARIES: [&str; 2] = ["/lib", "/lib64"];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../..")
        .canonicalize()
        .unwrap()
}

fn containerfile() -> String {
    std::fs::read_to_string(root().join("deploy/Containerfile")).unwrap()
}

/// Returns the instructions of the file, each with its arguments.
fn instructions() -> Vec<(String, String)> {
    let text = containerfile();
    let lines = text
        .lines()
        .filter(|line| !line.trim().is_empty() && !line.starts_with('#'));
    lines
        .map(|line| line.split_once(' ').unwrap())
        .map(|(word, rest)| (word.to_owned(), rest.to_owned()))
        .collect()
}

fn all(word: &str) -> Vec<String> {
    instructions()
        .into_iter()
        .filter(|(found, _)| found == word)
        .map(|(_, rest)| rest)
        .collect()
}

/// Parses a JSON list of words.
fn words(text: &str) -> Vec<String> {
    serde_json::from_str(text).unwrap_or_else(|error| panic!("{text}: {error}"))
}

/// Returns the repository files that are copied into a folder of the image.
fn copied_to(folder: &str) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for copy in all("COPY").iter().filter(|copy| !copy.contains("--from=")) {
        let mut paths: Vec<&str> = copy.split_whitespace().collect();
        if paths.pop() == Some(folder) {
            found.extend(paths.into_iter().map(|path| root().join(path)));
        }
    }
    found
}

#[test]
fn the_image_copies_existing_files_and_runs_without_privileges() {
    let configuration = copied_to(CONFIGURATION);
    assert_eq!(configuration.len(), 2, "{configuration:?}");
    for path in configuration {
        assert!(
            path.is_file(),
            "{} is copied, but does not exist",
            path.display()
        );
    }
    assert_eq!(all("USER"), ["65532:65532"]);
    let stages = all("FROM");
    let [compiler, last] = &stages[..] else {
        panic!("{stages:?}");
    };
    assert_eq!(last, "scratch");
    let (_, digest) = compiler.split_once("@sha256:").expect("an image by digest");
    let digest = digest.split_whitespace().next().unwrap();
    assert!(
        digest.len() == 64 && digest.bytes().all(|byte| byte.is_ascii_hexdigit()),
        "{compiler}"
    );
    // The image has no C library, so the program must be static, for the processor of the image.
    let target = super::package::TARGET;
    let (_, system) = target.split_once('-').unwrap();
    let built = super::package::build_of_the_readme();
    let runs = all("RUN");
    for command in [format!("rustup target add {target}"), built] {
        let command = command.replace(target, &format!("$(uname -m)-{system}"));
        assert!(runs.contains(&command), "{command} is not in {runs:?}");
    }
    let program = format!("/release/spandrel {}", words(&all("ENTRYPOINT")[0])[0]);
    let copies = all("COPY");
    let copied = copies.iter().find(|copy| copy.ends_with(&program));
    let built = format!("/target/*-{system}/");
    assert!(
        copied.is_some_and(|copy| copy.contains(&built)),
        "{copies:?}"
    );
    // The image and the repository use the same compiler.
    let toolchain = std::fs::read_to_string(root().join("rust-toolchain.toml")).unwrap();
    let (_, version) = compiler.split_once("rust:").unwrap();
    let version = version.split('-').next().unwrap();
    assert!(
        toolchain.contains(&format!("channel = \"{version}")),
        "compiler {version}, {toolchain}"
    );
    // The ignore file must not exclude sources of the program.
    let ignored = std::fs::read_to_string(root().join(".containerignore")).unwrap();
    for needed in [
        ".cargo",
        "crates",
        "tests",
        "docs",
        "deploy",
        "Cargo.toml",
        "Cargo.lock",
        "rust-toolchain.toml",
        "clients",
    ] {
        assert!(
            root().join(needed).exists() && ignored.lines().all(|line| line != needed),
            "{needed} is left out"
        );
    }
}

#[test]
fn the_command_of_the_image_starts_with_its_files_and_stops_in_order() {
    let folder = tempfile::tempdir().unwrap();
    for path in copied_to(CONFIGURATION) {
        std::fs::copy(&path, folder.path().join(path.file_name().unwrap())).unwrap();
    }
    let state = folder.path().join("state");
    std::fs::create_dir(&state).unwrap();
    assert_eq!(words(&all("ENTRYPOINT")[0]), ["/usr/local/bin/spandrel"]);
    assert_eq!(all("STOPSIGNAL"), ["SIGTERM"]);
    // Regression: without a folder for the temporary files of SQLite, the history lost values.
    assert_eq!(
        all("ENV"),
        ["STATE_DIRECTORY", "TMPDIR"].map(|name| format!("{name}={}", all("VOLUME")[0]))
    );
    let here =
        |word: &String| word.replace(CONFIGURATION, &format!("{}/", folder.path().display()));
    let arguments: Vec<String> = words(&all("CMD")[0]).iter().map(here).collect();
    let mut command = spandrel(&arguments[0]);
    command.args(&arguments[1..]).env("STATE_DIRECTORY", &state);
    // Other programs on this machine may use the default ports.
    command
        .env("SPANDREL_BUS__LISTEN", "tcp/127.0.0.1:0")
        .env("SPANDREL_DASHBOARD__LISTEN", "127.0.0.1:0");
    let services = Process::start(&mut command);
    services.wait_for_log("ready structures=1");
    services.stop().expect_code(0);
    assert!(
        state.join("history.sqlite").is_file(),
        "what is kept lies in the volume"
    );
}

/// Podman with a storage of its own, which ends with it.
struct Podman(TempDir);

impl Podman {
    /// Skips the test if podman is missing or lacks the rights of root.
    fn or_skip() -> Option<Self> {
        let mut asked = Command::new("podman");
        asked.args(["info", "--format={{.Host.Security.Rootless}}"]);
        let Ok(said) = asked.output() else {
            skip("podman is not installed (apt-get install podman runc)");
            return None;
        };
        if said.stdout != b"false\n" {
            skip("podman cannot create files of another user without the rights of root");
            return None;
        }
        Some(Self(tempfile::tempdir().unwrap()))
    }

    fn command(&self, subcommand: &str) -> Command {
        let mut command = Command::new("podman");
        for (option, folder) in [("--root", "root"), ("--runroot", "run")] {
            command.arg(option).arg(self.0.path().join(folder));
        }
        // This driver mounts nothing, so that an image can be built without rights to mount.
        command.args(["--storage-driver", "vfs", subcommand]);
        command
    }

    /// Returns what a subcommand that must succeed prints.
    #[track_caller]
    fn said(&self, subcommand: &str, arguments: &[&str]) -> String {
        let output = self.command(subcommand).args(arguments).output().unwrap();
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(
            output.status.success(),
            "podman {subcommand} {arguments:?}\n{errors}"
        );
        String::from_utf8(output.stdout).unwrap().trim().to_owned()
    }

    /// Builds the last stage of the file. A folder replaces the stage that compiles.
    fn build(&self) {
        let stage = self.0.path().join("build");
        let release = stage.join("source/target/of-the-tests-unknown-linux-musl/release");
        std::fs::create_dir_all(&release).unwrap();
        std::fs::copy(env!("CARGO_BIN_EXE_spandrel"), release.join("spandrel")).unwrap();
        let runs = all("RUN");
        let state = runs.iter().find(|run| run.starts_with("install "));
        let state = state
            .unwrap()
            .replace("/image", &format!("{}/image", stage.display()));
        let made = Command::new("sh").args(["-c", &state]).status().unwrap();
        assert!(made.success(), "{state}");

        let file = self.0.path().join("Containerfile");
        let text = containerfile();
        let (_, last) = text.rsplit_once("\nFROM ").unwrap();
        std::fs::write(&file, format!("FROM {last}")).unwrap();
        let arguments = [
            "--layers=false",
            "--tag=spandrel",
            &format!("--build-context=build={}", stage.display()),
            &format!("--file={}", file.display()),
            &root().display().to_string(),
        ];
        self.said("build", &arguments);
    }

    /// Runs another program in the image, to learn whether this machine permits containers.
    ///
    /// The trial has only those printed options that need a right of the machine. A machine cannot
    /// refuse the others, so a container that fails with them fails the test.
    fn try_container(&self) -> Result<(), String> {
        let mut trial = self.command("run");
        trial.args(options_of_test());
        trial.args(["--rm", "--network=host", "--memory=1g"]);
        trial.args(["--volume=/bin:/bin:ro", "--entrypoint=/bin/true"]);
        let trial = trial.arg("spandrel").output().unwrap();
        if trial.status.success() {
            return Ok(());
        }
        let why = String::from_utf8_lossy(&trial.stderr).into_owned();
        let refusals = ["operation not permitted", "permission denied", "cgroup"];
        let message = why.to_lowercase();
        assert!(
            refusals.iter().any(|refusal| message.contains(refusal)),
            "{why}"
        );
        Err(why)
    }
}

impl Drop for Podman {
    fn drop(&mut self) {
        // Containers and volumes hold locks of the machine. A test that failed has left them.
        for rest in [
            &["rm", "--all", "--force", "--volumes", "--time", "0"][..],
            &["volume", "rm", "--all", "--force"],
        ] {
            let _ = self.command(rest[0]).args(&rest[1..]).output();
        }
    }
}

/// Returns owner, group and mode of a file.
fn rights(path: &Path) -> (u32, u32, u32) {
    let found =
        std::fs::metadata(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    (found.uid(), found.gid(), found.mode() & 0o7777)
}

/// Returns the options of the command `podman run` in deploy/README.md, and those of a test.
fn options_of_run() -> Vec<String> {
    let readme = std::fs::read_to_string(root().join("deploy/README.md")).unwrap();
    let (_, command) = readme.split_once("\npodman run --detach ").unwrap();
    let (command, _) = command.split_once("\n```").unwrap();
    // The image has a configuration too.
    let command = command.replace("--volume /etc/spandrel:/etc/spandrel:ro ", "");
    let words = command.split_whitespace().filter(|word| *word != "\\");
    let mut options: Vec<String> = words.map(str::to_owned).collect();
    assert_eq!(options.pop().as_deref(), Some("spandrel"), "{command}");
    // Only the volume is left for writing.
    options.push("--read-only-tmpfs=false".to_owned());
    options.extend(options_of_test());
    options
}

/// Returns the options that only a test needs.
fn options_of_test() -> Vec<String> {
    let mut options = [
        // Podman's defaults may be above the limits of this machine.
        "--ulimit=nofile=1024:1024",
        "--ulimit=nproc=4096:4096",
        // Other programs on this machine may use the default ports.
        "--env=SPANDREL_BUS__LISTEN=tcp/127.0.0.1:0",
        "--env=SPANDREL_DASHBOARD__LISTEN=127.0.0.1:0",
    ]
    .map(str::to_owned)
    .to_vec();
    let libraries = LIBRARIES
        .into_iter()
        .filter(|folder| Path::new(folder).exists());
    options.extend(libraries.map(|folder| format!("--volume={folder}:{folder}:ro")));
    options
}

#[test]
fn the_built_image_runs_as_printed_and_writes_only_to_its_volume() {
    let Some(podman) = Podman::or_skip() else {
        return;
    };
    podman.build();
    let image = PathBuf::from(podman.said("image", &["mount", "spandrel"]));
    let entries = std::fs::read_dir(&image).unwrap();
    let mut folders: Vec<_> = entries.map(|entry| entry.unwrap().file_name()).collect();
    folders.sort();
    assert_eq!(folders, ["etc", "usr", "var"]);
    assert_eq!(rights(&image.join("usr/local/bin/spandrel")), (0, 0, 0o755));
    assert_eq!(rights(&image.join("var/lib")), (0, 0, 0o755));
    assert_eq!(rights(&image.join("var/lib/spandrel")), (USER, USER, 0o700));
    for path in copied_to(CONFIGURATION) {
        let copy = image.join("etc/spandrel").join(path.file_name().unwrap());
        assert_eq!(std::fs::read(&copy).unwrap(), std::fs::read(&path).unwrap());
    }

    let options = options_of_run();
    if let Err(why) = podman.try_container() {
        println!("the image is not run, because this machine permits no container: {why}");
        return;
    }
    let container = Process::start(podman.command("run").args(&options).arg("spandrel"));
    container.wait_for_log("ready structures=1");
    container.wait_for_output("address of the page", |said| said.contains("page: http://"));
    let said = container.output();
    let (_, page) = said.split_once("page: http://").unwrap();
    let address = page.split('/').next().unwrap();
    assert_eq!(get(address, "/health/live")["live"], true);
    let process = podman.said(
        "container",
        &["inspect", "--format={{.State.Pid}}", "spandrel"],
    );
    let (user, group, _) = rights(&Path::new("/proc").join(process));
    assert_eq!((user, group), (USER, USER));

    podman.said("stop", &["spandrel"]);
    container.wait().expect_code(0);
    let inspected = ["inspect", "--format={{.Mountpoint}}", "spandrel-state"];
    let state = PathBuf::from(podman.said("volume", &inspected));
    assert_eq!(rights(&state), (USER, USER, 0o700));
    assert!(state.join("history.sqlite").is_file());
}
