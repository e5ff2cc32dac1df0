//! The file of the container image, tested without a container engine: the files it copies exist,
//! and its command works with them.

use crate::support::{Process, spandrel};
use std::path::{Path, PathBuf};

/// Folder of the configuration in the image.
const CONFIGURATION: &str = "/etc/spandrel/";

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
