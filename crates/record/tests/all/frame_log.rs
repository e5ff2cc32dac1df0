//! Tests the frame log when its process is killed and when its disk is full.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use crate::skip::skip;
use spandrel_record::{FrameLog, FrameLogReader, LogLayout, LogSettings, LogSpan, LoggedFrames};

/// Environment variable with the log folder of the child process, set by the parent.
const FOLDER: &str = "FRAME_LOG_FOLDER";
const FRAMES_PER_APPEND: u64 = 5;

fn layout() -> LogLayout {
    let channels = (0..6).map(|channel| format!("channel-{channel}")).collect();
    LogLayout {
        structure: "tower".to_owned(),
        channels,
        nodes: vec!["roof".to_owned()],
        sampling_rate_hz: 100.0,
    }
}

fn frames(from: u64, count: u64) -> LoggedFrames {
    LoggedFrames {
        source: "ingest".to_owned(),
        epoch: 1,
        sequence: from,
        t0_ns: 0,
        sampling_rate_hz: 100.0,
        channels: 6,
        values: (from * 6..(from + count) * 6)
            .map(|value| value as f64)
            .collect(),
        ended: false,
        nodes: Vec::new(),
    }
}

/// Reads and checks all frames, and returns the number after the last one.
fn checked(reader: &FrameLogReader) -> u64 {
    let mut after = 0;
    while let Some(answer) = reader.read(1, after, 1000, usize::MAX).unwrap() {
        assert_eq!(answer, frames(after, answer.count()));
        after = answer.end();
    }
    after
}

fn settings() -> LogSettings {
    LogSettings {
        segment_bytes: 50_000,
        ..LogSettings::default()
    }
}

#[test]
#[ignore = "the child of a_killed_writer_loses_no_acknowledged_frame"]
fn writes_until_it_is_killed() {
    let folder = PathBuf::from(std::env::var_os(FOLDER).unwrap());
    let (mut log, opened) = FrameLog::open(&folder, layout(), settings()).unwrap();
    let mut next = opened.last.map_or(0, |last| last.end());
    loop {
        log.append(&[frames(next, FRAMES_PER_APPEND)]).unwrap();
        next += FRAMES_PER_APPEND;
        println!("there: {next}");
    }
}

#[test]
fn a_killed_writer_loses_no_acknowledged_frame() {
    let folder = tempfile::tempdir().unwrap();
    let mut next = 0;
    for life in 1..=20 {
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args([
                "--exact",
                "frame_log::writes_until_it_is_killed",
                "--ignored",
                "--nocapture",
            ])
            .env(FOLDER, folder.path())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(child.stdout.take().unwrap())
            .lines()
            .map(Result::unwrap);
        let mut told = lines
            .by_ref()
            .filter_map(|line| line.strip_prefix("there: ")?.parse::<u64>().ok());
        let mut last = told.by_ref().take(37 * life).last().unwrap();
        child.kill().unwrap();
        child.wait().unwrap();
        last = told.last().unwrap_or(last);
        assert!(last > next);
        let (log, opened) = FrameLog::open(folder.path(), layout(), settings()).unwrap();
        assert!(!opened.was_closed && opened.same_boot && opened.set_aside.is_empty());
        next = checked(&log.reader());
        assert!(
            next >= last,
            "life {life}: {last} frames were there, {next} are"
        );
        assert_eq!(opened.last.map(|last| last.end()), Some(next));
        assert_eq!(
            log.reader().spans(),
            [LogSpan {
                epoch: 1,
                from: 0,
                to: next,
                missing: 0
            }]
        );
    }
}

/// A separate file system in memory.
struct SmallDisk(PathBuf);

impl SmallDisk {
    /// Mounts a file system of the given size. Skips the test without permission.
    fn or_skip(folder: &Path, size: &str) -> Option<Self> {
        let options = format!("size={size}");
        let mounted = Command::new("mount")
            .args(["-t", "tmpfs", "-o", &options, "tmpfs"])
            .arg(folder)
            .output();
        if mounted.is_ok_and(|output| output.status.success()) {
            return Some(Self(folder.to_owned()));
        }
        skip("a small disk cannot be mounted here");
        None
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        // It disappears with the machine at the latest.
        let _ = Command::new("umount").arg("-l").arg(&self.0).status();
    }
}

#[test]
fn a_full_disk_rejects_appends_and_the_log_continues_when_there_is_space() {
    let folder = tempfile::tempdir().unwrap();
    let Some(_disk) = SmallDisk::or_skip(folder.path(), "256k") else {
        return;
    };
    let ballast = folder.path().join("ballast");
    std::fs::write(&ballast, vec![0; 100_000]).unwrap();
    let log_folder = folder.path().join("log");
    let (mut log, _) = FrameLog::open(&log_folder, layout(), LogSettings::default()).unwrap();
    let mut next = 0;
    while log.append(&[frames(next, FRAMES_PER_APPEND)]).is_ok() {
        next += FRAMES_PER_APPEND;
        assert!(next < 10_000, "the disk is full before");
    }
    for _ in 0..10 {
        let error = log
            .append(&[frames(next, FRAMES_PER_APPEND)])
            .unwrap_err()
            .to_string();
        assert!(error.ends_with("cannot be written"), "{error}");
    }
    assert_eq!(
        checked(&log.reader()),
        next,
        "all that were accepted, and no more"
    );
    std::fs::remove_file(&ballast).unwrap();
    for _ in 0..20 {
        log.append(&[frames(next, FRAMES_PER_APPEND)]).unwrap();
        next += FRAMES_PER_APPEND;
    }
    log.syncer().sync().unwrap();
    assert_eq!(checked(&log.reader()), next);
    drop(log);
    let (log, opened) = FrameLog::open(&log_folder, layout(), LogSettings::default()).unwrap();
    assert_eq!((opened.torn_bytes, opened.set_aside.len()), (0, 0));
    assert_eq!(
        log.reader().spans(),
        [LogSpan {
            epoch: 1,
            from: 0,
            to: next,
            missing: 0
        }]
    );
    assert_eq!(checked(&log.reader()), next);
}

#[test]
#[ignore = "measures; run it alone, with --nocapture"]
#[expect(clippy::disallowed_methods, reason = "this test measures time")]
fn duration_of_an_append_and_a_read() {
    let folder = tempfile::tempdir().unwrap();
    let (mut log, _) = FrameLog::open(folder.path(), layout(), LogSettings::default()).unwrap();
    let appends = 60_000;
    let mut times = Vec::new();
    for append in 0..appends {
        let block = [frames(append * FRAMES_PER_APPEND, FRAMES_PER_APPEND)];
        let start = std::time::Instant::now();
        log.append(&block).unwrap();
        times.push(start.elapsed());
    }
    let reader = log.reader();
    times.sort_unstable();
    println!(
        "append: median {:?}, 99 % {:?}, longest {:?}",
        times[times.len() / 2],
        times[times.len() * 99 / 100],
        times[times.len() - 1]
    );
    let bytes = || -> u64 {
        let files = std::fs::read_dir(folder.path()).unwrap();
        files
            .map(|file| file.unwrap().metadata().unwrap().len())
            .sum()
    };
    let values = appends * FRAMES_PER_APPEND * 6 * 8;
    println!(
        "bytes of an append over its values: {:.1}",
        (bytes() - values) as f64 / appends as f64
    );
    let timed = |what: &str, limit: u64, reader: &FrameLogReader| {
        let start = std::time::Instant::now();
        let mut after = 7;
        let mut reads = 0;
        while reads < 1000 {
            let answer = reader.read(1, after, limit, 1 << 20).unwrap().unwrap();
            after = (after + answer.count() * 13) % (appends * FRAMES_PER_APPEND - limit);
            reads += 1;
        }
        println!("{what} of {limit} frames: {:?}", start.elapsed() / reads);
    };
    timed("read", 5, &reader);
    timed("read", 1000, &reader);
    let start = std::time::Instant::now();
    log.syncer().sync().unwrap();
    println!("sync: {:?}", start.elapsed());
    let start = std::time::Instant::now();
    log.close().unwrap();
    println!(
        "close: {:?}, bytes of an append over its values: {:.1}",
        start.elapsed(),
        (bytes() - values) as f64 / appends as f64
    );
    let start = std::time::Instant::now();
    let (log, _) = FrameLog::open(folder.path(), layout(), LogSettings::default()).unwrap();
    println!("open with {} bytes: {:?}", bytes(), start.elapsed());
    timed("read of an older segment", 1000, &log.reader());
}
