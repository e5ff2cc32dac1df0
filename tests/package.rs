//! The parts of the Debian package: files, configuration and units. `cargo deb` itself is not run,
//! because its build takes minutes. `dpkg-deb` packs the same parts with the program of the tests.

use crate::support::skip;
use std::collections::BTreeSet;
use std::fs::Permissions;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// The program in the list of files of the package.
const PROGRAM: &str = "target/release/spandrel";

fn crate_folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).to_owned()
}

fn read(path: &Path) -> String {
    std::fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// Returns the table `[package.metadata.deb]`.
fn package() -> toml::Value {
    let manifest: toml::Table = read(&crate_folder().join("Cargo.toml")).parse().unwrap();
    manifest["package"]["metadata"]["deb"].clone()
}

fn texts(value: &toml::Value) -> Vec<String> {
    let values = value.as_array().unwrap().iter();
    values
        .map(|text| text.as_str().unwrap().to_owned())
        .collect()
}

/// Returns the files of the package, each with its source, its folder and its mode.
fn files(package: &toml::Value) -> Vec<[String; 3]> {
    let assets = package["assets"].as_array().unwrap().iter();
    assets
        .map(|asset| <[String; 3]>::try_from(texts(asset)).unwrap())
        .collect()
}

/// Target of a static program.
pub const TARGET: &str = "x86_64-unknown-linux-musl";

/// Returns the commands of deploy/README.md that begin with some words.
fn commands(start: &str) -> Vec<String> {
    let text = read(&crate_folder().join("../../deploy/README.md"));
    let lines = text.lines().map(str::trim);
    let found = lines.filter(|line| line.starts_with(start));
    found.map(str::to_owned).collect()
}

/// Returns the command of deploy/README.md that builds the program.
pub fn build_of_the_readme() -> String {
    let [build] = &commands("cargo build ")[..] else {
        panic!("deploy/README.md does not build the program exactly once");
    };
    build.clone()
}

/// Regression test: the documented program required the C library of the machine that built it.
#[test]
fn the_documented_program_and_package_are_static() {
    let option = format!("--target {TARGET}");
    for command in [build_of_the_readme(), commands("cargo deb ").concat()] {
        assert!(command.contains(&option), "{command}");
    }
    let install = commands("sudo install -m 755 target/").concat();
    assert!(install.contains(&format!("target/{TARGET}/")), "{install}");
    assert_eq!(commands(&format!("rustup target add {TARGET}")).len(), 2);
}

#[test]
fn the_package_has_all_its_files_and_keeps_the_configuration_of_the_owner() {
    let package = package();
    let mut configuration = BTreeSet::new();
    let mut units = Vec::new();
    for [source, folder, _] in files(&package) {
        let path = crate_folder().join(source.trim_end_matches("**/*"));
        assert!(
            source == PROGRAM || path.exists(),
            "{source} does not exist"
        );
        let name = path.file_name().unwrap().to_str().unwrap();
        match folder.as_str() {
            "etc/spandrel/" => {
                configuration.insert(format!("/etc/spandrel/{name}"));
            }
            "usr/lib/systemd/system/" => units.push(path),
            _ => {}
        }
    }
    let kept: BTreeSet<String> = texts(&package["conf-files"]).into_iter().collect();
    assert_eq!(configuration, kept);

    let settings: toml::Table = read(&crate_folder().join("../../deploy/spandrel.toml"))
        .parse()
        .unwrap();
    for structure in texts(&settings["structures"]) {
        let path = format!("/etc/spandrel/{structure}");
        assert!(kept.contains(&path), "the package lacks {path}");
    }
    assert_eq!(units.len(), 3);
    for unit in units {
        // The package installs the program in another folder than the commands of the README.
        let starts = read(&unit);
        let starts: Vec<&str> = starts
            .lines()
            .filter_map(|line| line.strip_prefix("ExecStart="))
            .collect();
        let [start] = starts[..] else {
            panic!("{} has {} commands", unit.display(), starts.len());
        };
        assert!(start.starts_with("spandrel "), "{start}");
    }
}

/// Copies a file, or all files below a folder, into a folder.
fn copy(source: &Path, folder: &Path, mode: u32) {
    let name = source.file_name().unwrap();
    if source.is_dir() {
        for entry in std::fs::read_dir(source).unwrap() {
            let path = entry.unwrap().path();
            let inner = path.is_dir().then(|| path.file_name().unwrap());
            copy(&path, &folder.join(inner.unwrap_or_default()), mode);
        }
        return;
    }
    std::fs::create_dir_all(folder).unwrap();
    let target = folder.join(name);
    std::fs::copy(source, &target).unwrap();
    std::fs::set_permissions(&target, Permissions::from_mode(mode)).unwrap();
}

/// Runs a command that must succeed, and returns its output.
#[track_caller]
fn output_of(command: &mut Command) -> String {
    let output = command.stdin(Stdio::null()).output().unwrap();
    assert!(output.status.success(), "{command:?}: {output:?}");
    String::from_utf8(output.stdout).unwrap()
}

/// Installs the parts of the package in an empty root, and updates them.
#[test]
fn the_package_is_installed_updated_and_removed_and_keeps_a_changed_configuration() {
    if Command::new("dpkg-deb").arg("--version").output().is_err() {
        return skip("dpkg-deb is not installed");
    }
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let (tree, root, file) = (at("tree"), at("root"), at("spandrel.deb"));
    let package = package();
    for [source, folder, mode] in files(&package) {
        let path = match source.as_str() {
            PROGRAM => PathBuf::from(env!("CARGO_BIN_EXE_spandrel")),
            other => crate_folder().join(other.trim_end_matches("**/*")),
        };
        let mode = u32::from_str_radix(&mode, 8).unwrap();
        copy(&path, &tree.join(folder), mode);
    }
    let control = tree.join("DEBIAN");
    std::fs::create_dir(&control).unwrap();
    std::fs::set_permissions(&control, Permissions::from_mode(0o755)).unwrap(); // whatever the umask
    let kept = texts(&package["conf-files"]).join("\n") + "\n";
    std::fs::write(control.join("conffiles"), kept).unwrap();
    for part in ["info", "triggers", "updates"] {
        std::fs::create_dir_all(root.join("var/lib/dpkg").join(part)).unwrap();
    }
    std::fs::write(root.join("var/lib/dpkg/status"), "").unwrap();
    let path = std::env::var("PATH").unwrap() + ":/usr/sbin:/sbin"; // dpkg demands ldconfig
    let dpkg = |action: &str, what: &Path| {
        let mut command = Command::new("dpkg");
        command
            .arg(format!("--root={}", root.display()))
            .arg(format!("--log={}", at("dpkg.log").display()))
            .args(["--force-not-root", action])
            .arg(what);
        output_of(command.env("PATH", &path));
    };
    let (program, demo) = (
        root.join("usr/bin/spandrel"),
        root.join("etc/spandrel/demo.toml"),
    );
    let changed = || read(&demo) + "# changed by the owner\n";
    for version in ["0.1.0-1", "0.1.0-2"] {
        let maintainer = package["maintainer"].as_str().unwrap();
        let about = format!(
            "Package: spandrel\nVersion: {version}\nArchitecture: all\n\
             Maintainer: {maintainer}\nDescription: monitoring\n"
        );
        std::fs::write(control.join("control"), about).unwrap();
        let mut pack = Command::new("dpkg-deb");
        pack.args(["-Znone", "--root-owner-group", "--build"]);
        output_of(pack.arg(&tree).arg(&file));
        dpkg("--install", &file);
        if version == "0.1.0-1" {
            std::fs::write(&demo, changed()).unwrap();
        }
    }
    assert!(
        read(&demo).ends_with("# changed by the owner\n"),
        "the update has overwritten the configuration"
    );
    let checked = output_of(Command::new(&program).arg("check").arg(&demo));
    assert!(checked.starts_with("demo: "), "{checked}");
    dpkg("--remove", Path::new("spandrel"));
    assert!(!program.exists() && demo.exists(), "after its removal");
}
