//! The parts of the Debian package: files, configuration and units. `cargo deb` itself is not run.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

fn crate_folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).to_owned()
}

fn read(path: &Path) -> String {
    std::fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
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
    let manifest: toml::Table = read(&crate_folder().join("Cargo.toml")).parse().unwrap();
    let package = &manifest["package"]["metadata"]["deb"];
    let texts = |value: &toml::Value| -> Vec<String> {
        let values = value.as_array().unwrap().iter();
        values
            .map(|text| text.as_str().unwrap().to_owned())
            .collect()
    };
    let mut configuration = BTreeSet::new();
    let mut units = Vec::new();
    for asset in package["assets"].as_array().unwrap() {
        let [source, folder, _] = &texts(asset)[..] else {
            panic!("{asset} is not a source, a folder and a mode");
        };
        let path = crate_folder().join(source.trim_end_matches("**/*"));
        let is_built = source == "target/release/spandrel";
        assert!(is_built || path.exists(), "{source} does not exist");
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
