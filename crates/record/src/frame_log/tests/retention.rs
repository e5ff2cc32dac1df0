//! Retention of segments.

use std::fs::File;
use std::time::Duration;

use super::*;

fn bytes_of(folder: &Path) -> u64 {
    segments(folder)
        .iter()
        .map(|path| std::fs::metadata(path).unwrap().len())
        .sum()
}

#[test]
fn oldest_segments_are_deleted_above_the_limit_of_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let settings = LogSettings {
        keep_bytes: 40_000,
        ..short_segments()
    };
    let mut log = open_with(folder.path(), settings);
    for from in (0..5000).step_by(100) {
        log.append(&[frames(1, from, 100)]).unwrap();
        assert!(bytes_of(folder.path()) <= 40_000);
    }
    let kept = log.reader().spans()[0];
    assert!(
        kept.from > 3500 && kept.to == 5000 && kept.missing == 0,
        "{kept:?}"
    );
    let oldest = log.reader().read(1, 0, 1, 10_000).unwrap().unwrap();
    assert_eq!(
        oldest.sequence, kept.from,
        "the oldest kept, and its number tells"
    );
    drop(log);
    open_with(
        folder.path(),
        LogSettings {
            keep_bytes: 20_000,
            ..settings
        },
    );
    assert!(bytes_of(folder.path()) <= 20_000, "also when it is opened");
}

#[test]
fn the_newest_segment_is_never_deleted() {
    let folder = tempfile::tempdir().unwrap();
    let nothing = LogSettings {
        keep_bytes: 0,
        keep_s: 0,
        ..short_segments()
    };
    let mut log = open_with(folder.path(), nothing);
    for from in 0..5 {
        log.append(&[frames(1, from, 1)]).unwrap();
        assert_eq!(
            all_frames(&log.reader(), 1, 10),
            rows_of(&[frames(1, from, 1)])
        );
    }
    drop(log);
    let log = open_with(folder.path(), nothing);
    assert_eq!(
        all_frames(&log.reader(), 1, 10),
        rows_of(&[frames(1, 4, 1)])
    );
}

/// Sets back the time at which every segment was written.
fn age(folder: &Path, by: Duration) {
    for path in segments(folder) {
        let file = File::options().write(true).open(path).unwrap();
        let written = file.metadata().unwrap().modified().unwrap();
        file.set_modified(written - by).unwrap();
    }
}

fn of_twenty_seconds() -> LogSettings {
    LogSettings {
        keep_s: 20,
        ..short_segments()
    }
}

fn kept(log: &FrameLog) -> Vec<(u64, u64, u64)> {
    let spans = log.reader().spans();
    spans
        .iter()
        .map(|span| (span.epoch, span.from, span.to))
        .collect()
}

#[test]
fn segments_with_too_old_frames_are_deleted() {
    let folder = tempfile::tempdir().unwrap();
    let mut log = open_with(folder.path(), of_twenty_seconds());
    for from in (0..5000).step_by(100) {
        log.append(&[frames(1, from, 100)]).unwrap(); // a second each
        age(folder.path(), Duration::from_secs(1));
    }
    assert_eq!(
        kept(&log),
        [(1, 2900, 5000)],
        "20 s before the last frame, and the segment that has this time"
    );
    // The next frame is a day later. All earlier segments are too old, except the last one before
    // it.
    age(folder.path(), Duration::from_secs(86_400));
    let later = LoggedFrames {
        t0_ns: T0_NS + 86_400_000_000_000,
        ..frames(2, 0, 1)
    };
    log.append(&[later]).unwrap();
    assert_eq!(kept(&log), [(1, 4900, 5000), (2, 0, 1)]);
}

// The clocks of all sensors were 400 days ahead for ten seconds, and everything before was deleted.
#[test]
fn clock_of_the_sensors_deletes_nothing() {
    const DAY_NS: i64 = 86_400_000_000_000;
    let folder = tempfile::tempdir().unwrap();
    let mut log = open_with(folder.path(), of_twenty_seconds());
    let mut append = |epoch: u64, days: i64, seconds: u64| {
        for from in (0..100 * seconds).step_by(100) {
            let t0_ns = T0_NS + days * DAY_NS;
            log.append(&[LoggedFrames {
                t0_ns,
                ..frames(epoch, from, 100)
            }])
            .unwrap();
            age(folder.path(), Duration::from_secs(1));
        }
        kept(&log)
    };
    assert_eq!(append(1, 0, 15), [(1, 0, 1500)]);
    assert_eq!(append(2, 400, 3), [(1, 0, 1500), (2, 0, 300)]);
    // The wrong times do not prevent that the segments are deleted in turn.
    let expected = [(3, 2900, 5000)];
    assert_eq!(append(3, 0, 50), expected);
}

#[test]
fn clock_of_the_machine_deletes_nothing_that_the_frames_contradict() {
    let folder = tempfile::tempdir().unwrap();
    let mut log = open_with(folder.path(), of_twenty_seconds());
    for from in (0..1000).step_by(100) {
        log.append(&[frames(1, from, 100)]).unwrap();
        age(folder.path(), Duration::from_secs(400 * 86_400));
    }
    assert_eq!(kept(&log), [(1, 0, 1000)]);
}
