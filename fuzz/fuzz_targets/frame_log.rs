//! Reads segments of a frame log. The log keeps intact data, removes or sets aside the rest, and continues.

#![no_main]

use libfuzzer_sys::fuzz_target;
use spandrel_record::{FrameLog, FrameLogReader, LogLayout, LogSettings, LoggedFrames};
use std::path::PathBuf;
use std::sync::LazyLock;

/// A folder of this process, in memory where the system has such a folder.
static FOLDER: LazyLock<PathBuf> = LazyLock::new(|| {
    let shared = PathBuf::from("/dev/shm");
    let folder = if shared.is_dir() { shared } else { std::env::temp_dir() };
    folder.join(format!("spandrel-fuzz-log-{}", std::process::id()))
});

/// That of the seeds.
fn layout() -> LogLayout {
    let names = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect();
    LogLayout {
        structure: "house".to_owned(),
        channels: names(&["ground", "floor-1", "roof", "roof-velocity"]),
        nodes: names(&["ground", "floor-1", "roof"]),
        sampling_rate_hz: 100.0,
    }
}

fn frames(epoch: u64) -> LoggedFrames {
    LoggedFrames {
        source: "ingest".to_owned(),
        epoch,
        sequence: 0,
        t0_ns: 0,
        sampling_rate_hz: 100.0,
        channels: 4,
        values: vec![0.5; 40],
        ended: false,
        nodes: Vec::new(),
    }
}

/// All frames of an epoch, in order and each once.
fn read(reader: &FrameLogReader, epoch: u64) -> u64 {
    let (mut after, mut count) = (0, 0);
    while let Ok(Some(answer)) = reader.read(epoch, after, 1000, 1 << 20) {
        assert!(answer.epoch == epoch && answer.sequence >= after);
        count += answer.count();
        if answer.end() <= after {
            break;
        }
        after = answer.end();
    }
    count
}

fuzz_target!(|bytes: &[u8]| {
    let folder = &*FOLDER;
    let _ = std::fs::remove_dir_all(folder); // the first time it is not there
    std::fs::create_dir_all(folder).expect("the folder of temporary files can be written");
    std::fs::write(folder.join(format!("frames-{:020}-{:020}.mcap", 1, 0)), bytes).expect("a file can be written");
    let (mut log, opened) = match FrameLog::open(folder, layout(), LogSettings::default()) {
        Ok(opened) => opened,
        Err(error) => return assert!(!error.to_string().is_empty()),
    };
    let epoch = opened.last.as_ref().map_or(1, |last| last.epoch);
    let before = read(&log.reader(), epoch);
    if epoch == u64::MAX {
        return;
    }
    log.append(&[frames(epoch + 1)]).expect("the log goes on");
    log.close().expect("the log can be closed");
    let (log, opened) = FrameLog::open(folder, layout(), LogSettings::default()).expect("a log that was closed opens");
    assert!(opened.was_closed && opened.torn_bytes == 0 && opened.set_aside.is_empty());
    assert_eq!(opened.last.map(|last| (last.epoch, last.end())), Some((epoch + 1, 10)));
    assert_eq!(read(&log.reader(), epoch), before);
    assert_eq!(read(&log.reader(), epoch + 1), 10);
});
