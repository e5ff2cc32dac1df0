//! Exclusive access to the folder of a log.

use super::*;

#[test]
fn log_can_be_opened_only_once() {
    let folder = tempfile::tempdir().unwrap();
    let (log, _) = open(folder.path());
    let error = FrameLog::open(folder.path(), layout(), LogSettings::default())
        .err()
        .unwrap();
    assert!(
        matches!(&error, RecordError::LogInUse { folder: named } if named == folder.path()),
        "{error}"
    );
    drop(log);
    open(folder.path());
}

#[test]
fn readers_see_whole_frames_while_the_log_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let settings = LogSettings {
        segment_bytes: 20_000,
        ..LogSettings::default()
    };
    let mut log = open_with(folder.path(), settings);
    let total = 4000;
    std::thread::scope(|scope| {
        for limit in [1, 7, 1000] {
            let reader = log.reader();
            scope.spawn(move || {
                let mut after = 0;
                while after < total {
                    let Some(answer) = reader.read(1, after, limit, usize::MAX).unwrap() else {
                        std::thread::yield_now();
                        continue;
                    };
                    let nodes = answer.nodes.clone();
                    assert_eq!(
                        answer,
                        LoggedFrames {
                            nodes,
                            ..frames(1, after, answer.count())
                        }
                    );
                    after = answer.end();
                }
            });
        }
        let syncer = log.syncer();
        scope.spawn(move || (0..50).for_each(|_| syncer.sync().unwrap()));
        for from in (0..total).step_by(5) {
            log.append(&[frames(1, from, 5)]).unwrap();
        }
    });
    log.syncer().sync().unwrap();
}

#[test]
fn reader_survives_the_deletion_of_its_segment() {
    let folder = tempfile::tempdir().unwrap();
    let settings = LogSettings {
        keep_bytes: 30_000,
        ..short_segments()
    };
    let mut log = open_with(folder.path(), settings);
    let total = 3000;
    std::thread::scope(|scope| {
        let reader = log.reader();
        scope.spawn(move || {
            let mut after = 0;
            while after < total {
                let Some(answer) = reader.read(1, after, 50, usize::MAX).unwrap() else {
                    continue;
                };
                let nodes = answer.nodes.clone();
                assert_eq!(
                    answer,
                    LoggedFrames {
                        nodes,
                        ..frames(1, answer.sequence, answer.count())
                    }
                );
                after = answer.end();
            }
        });
        for from in (0..total).step_by(5) {
            log.append(&[frames(1, from, 5)]).unwrap();
        }
    });
}
