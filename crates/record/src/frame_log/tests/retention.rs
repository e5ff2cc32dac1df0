//! Retention of segments.

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

#[test]
fn segments_with_too_old_frames_are_deleted() {
    let folder = tempfile::tempdir().unwrap();
    let settings = LogSettings {
        keep_s: 20,
        ..short_segments()
    };
    let mut log = open_with(folder.path(), settings);
    for from in (0..5000).step_by(100) {
        log.append(&[frames(1, from, 100)]).unwrap(); // a second each
    }
    let kept = log.reader().spans()[0];
    assert_eq!(
        (kept.from, kept.to),
        (2900, 5000),
        "20 s before the last frame, and the segment that has this time"
    );
    // The next frame is a day later. All earlier segments are too old, except the last one before
    // it.
    let later = LoggedFrames {
        t0_ns: T0_NS + 86_400_000_000_000,
        ..frames(2, 0, 1)
    };
    log.append(&[later]).unwrap();
    assert_eq!(
        log.reader()
            .spans()
            .iter()
            .map(|span| span.epoch)
            .collect::<Vec<_>>(),
        [1, 2]
    );
    let span = log.reader().spans()[0];
    assert_eq!((span.from, span.to), (4900, 5000));
}
