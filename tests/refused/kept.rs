//! Checkpoints and recordings on disk: unreadable files are set aside under another name, and the
//! services start from the rest.

use super::table::{Table, code};
use crate::support::{Process, Site, two_storeys};
use spandrel_checkpoint::{Checkpoints, Identity, Position};
use std::path::{Path, PathBuf};

/// Rules, so that an alert service with checkpoints runs.
const RULES: &str = "[[alert]]\nparameters = \"all\"\nreference.design-std = 1e-9\nloss = 0.5\n";

/// Returns the files in a folder whose names begin with `beginning`, in the order of their names.
fn files(folder: &Path, beginning: &str) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path());
    let begins = |path: &PathBuf| {
        path.file_name()
            .unwrap()
            .to_str()
            .unwrap()
            .starts_with(beginning)
    };
    let mut files: Vec<PathBuf> = entries.filter(begins).collect();
    files.sort();
    files
}

fn identity(version: u16, of: &str) -> Identity {
    Identity {
        kind: "identify",
        version,
        of: of.to_owned(),
        basis: "another structure file".to_owned(),
    }
}

/// Returns the line of a log that names this file, from `field` on.
fn told_of(log: &str, file: &str, field: &str) -> String {
    let line = log
        .lines()
        .find(|line| line.contains(file))
        .unwrap_or("nothing");
    line.split_once(field)
        .map_or(line, |(_, told)| told)
        .to_owned()
}

pub async fn all(table: &mut Table) {
    let site = Site::with(&two_storeys(RULES));
    let record = site.simulate(4.0);
    let state = site.folder().join("state");
    let run = || {
        let mut command = site.listening("run");
        let process = Process::start(
            command
                .args(["--http", "none"])
                .env("XDG_STATE_HOME", &state),
        );
        process.wait_for_log("ready structures=1");
        process
    };
    let services = run();
    site.replay(&record, "max").wait().expect_code(0);
    services.stop().expect_code(0);
    let of_structure = state
        .join("spandrel")
        .join(site.keys().root().as_str())
        .join("house");

    table.section("Checkpoints on disk (`spandrel run`)");
    let checkpoints = of_structure.join("checkpoints");
    let sound = std::fs::read(files(&checkpoints, "identify-").last().unwrap()).unwrap();
    let mut turned = sound.clone();
    turned[sound.len() / 2] ^= 1;
    // `identify` starts with the oldest readable checkpoint, so these come before the sound one.
    let place = |sequence| Position { epoch: 0, sequence };
    let path =
        |sequence: u64| checkpoints.join(format!("identify-{:020}-{sequence:020}.checkpoint", 0));
    // The state before the first frame is older, and remains until alert has saved a decision.
    if path(0).exists() {
        std::fs::remove_file(path(0)).unwrap();
    }
    std::fs::write(path(1), "what somebody else has put here").unwrap();
    std::fs::write(path(2), turned).unwrap();
    std::fs::write(path(3), &sound[..sound.len() / 2]).unwrap();
    let save = |identity, sequence| {
        Checkpoints::open(&checkpoints, identity)
            .unwrap()
            .save(place(sequence), &7_u64)
            .unwrap()
    };
    save(identity(9_999, "house"), 4);
    save(identity(1, "tower"), 5);
    let alert = Identity {
        kind: "alert",
        ..identity(9_999, "house")
    };
    let last = Position {
        epoch: 1 << 62,
        sequence: 1,
    };
    Checkpoints::open(&checkpoints, alert)
        .unwrap()
        .save(last, &7_u64)
        .unwrap();

    let recording = of_structure.join("recording");
    let newest = files(&recording, "frames-").pop().unwrap();
    let whole = std::fs::read(&newest).unwrap();
    std::fs::write(&newest, &whole[..whole.len() - 100]).unwrap();
    let foreign = recording.join(format!("frames-{:020}-{:020}.mcap", last.epoch, 0));
    std::fs::write(&foreign, vec![0xa5; 4096]).unwrap();

    let services = run();
    let log = services.log();
    for (sequence, given, told) in [
        (
            1,
            "a file that is not a checkpoint",
            "it is not a Spandrel checkpoint",
        ),
        (2, "a flipped bit", "it is damaged"),
        (3, "cut off", "it is damaged"),
        (
            4,
            "of a newer version",
            "it has layout version 9999, this program reads version",
        ),
        (
            5,
            "of another structure",
            "it belongs to identify of tower, expected identify of house",
        ),
    ] {
        let file = path(sequence);
        let observed = told_of(&log, file.file_name().unwrap().to_str().unwrap(), "why=");
        let is_aside = !file.exists() && file.with_extension("checkpoint.refused").is_file();
        let expected = format!(
            "set aside as `….checkpoint.refused`, with the reason {}; the valid one is used",
            code(told)
        );
        table.add(
            given,
            &expected,
            &observed,
            is_aside && observed.contains(told) && log.contains("resumed from its checkpoint"),
        );
    }
    let name = format!("alert-{:020}-{:020}.checkpoint", last.epoch, last.sequence);
    let observed = told_of(&log, &name, "why=");
    let is_aside = checkpoints.join(format!("{name}.refused")).is_file();
    let told = "it has layout version 9999";
    table.add(
        "of alert, of a newer version",
        &format!("as above, with the reason {}", code(told)),
        &observed,
        is_aside && observed.contains(told),
    );

    table.section("Recordings on disk (`spandrel run`)");
    let aside = files(&recording, "frames-")
        .into_iter()
        .any(|path| path.to_str().unwrap().ends_with(".unreadable"));
    let observed = told_of(&log, "file set aside", "ingest::recorder: ")
        .split(" structure=")
        .next()
        .unwrap()
        .to_owned();
    table.add(
        "a file that is not a segment",
        "set aside as `….unreadable`",
        &observed,
        aside && !foreign.exists(),
    );
    let torn = "the recording ended in an incomplete record";
    let observed = told_of(&log, torn, "ingest::recorder: ")
        .split(" structure=")
        .next()
        .unwrap()
        .to_owned();
    table.add(
        "the end of a segment cut off",
        &format!("{}; complete records are kept", code(torn)),
        &observed,
        observed.contains(torn),
    );
    services.stop().expect_code(0);

    // Another sensor layout under the same name: its samples must not be mixed with the recording.
    let other = two_storeys(RULES).replace("name = \"roof-velocity\"", "name = \"roof-speed\"");
    std::fs::write(site.structure_file(), other).unwrap();
    let mut command = site.listening("run");
    let finished = Process::start(
        command
            .args(["--http", "none"])
            .env("XDG_STATE_HOME", &state),
    )
    .wait();
    let told = ["recording", "channels", "roof-velocity", "roof-speed"].map(str::to_owned);
    let stderr = finished
        .stderr
        .replace(&*state.to_string_lossy(), "STATE")
        .replace(site.keys().root().as_str(), "ROOT");
    table.add_ended(
        "a recording with other channels",
        (2, &told),
        &crate::support::Finished { stderr, ..finished },
    );
}
