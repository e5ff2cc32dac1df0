//! The parts of the Debian package: files, configuration and units. `cargo deb` itself is not run.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

fn crate_folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).to_owned()
}

fn read(path: &Path) -> String {
    std::fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
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
