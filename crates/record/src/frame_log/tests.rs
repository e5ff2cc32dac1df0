//! Tests of the frame log through its public interface. Each file covers one subject.

mod crash;
mod layout;
mod memory;
mod model;
mod recording;
mod retention;
mod sharing;
mod spread;

use std::path::{Path, PathBuf};

use super::*;

/// Number of channels of the test frames.
const CHANNELS: u16 = 3;
const T0_NS: i64 = 1_700_000_000_000_000_000;

fn layout() -> LogLayout {
    LogLayout {
        structure: "tower".to_owned(),
        channels: ["roof-x", "roof-y", "base"].map(str::to_owned).to_vec(),
        nodes: ["roof", "base"].map(str::to_owned).to_vec(),
        sampling_rate_hz: 100.0,
    }
}

/// Returns frames whose values encode epoch, frame and channel.
fn frames(epoch: u64, from: u64, count: u64) -> LoggedFrames {
    let value =
        |frame: u64, channel: u16| epoch as f64 * 1e9 + frame as f64 + f64::from(channel) / 8.0;
    LoggedFrames {
        source: "ingest".to_owned(),
        epoch,
        sequence: from,
        t0_ns: T0_NS,
        sampling_rate_hz: 100.0,
        channels: CHANNELS,
        values: (from..from + count)
            .flat_map(|frame| (0..CHANNELS).map(move |channel| value(frame, channel)))
            .collect(),
        ended: false,
        nodes: vec![
            NodePosition {
                epoch: 7,
                sequence: from + count,
                ended: false,
            },
            NodePosition {
                epoch: 8,
                sequence: 2 * (from + count),
                ended: false,
            },
        ],
    }
}

/// Returns a folder in memory if possible, because these tests open and repair thousands of logs.
fn quick_folder() -> tempfile::TempDir {
    tempfile::tempdir_in("/dev/shm")
        .or_else(|_| tempfile::tempdir())
        .unwrap()
}

fn ended(frames: LoggedFrames) -> LoggedFrames {
    LoggedFrames {
        ended: true,
        ..frames
    }
}

fn open(folder: &Path) -> (FrameLog, OpenedLog) {
    FrameLog::open(folder, layout(), LogSettings::default()).unwrap()
}

fn open_with(folder: &Path, settings: LogSettings) -> FrameLog {
    FrameLog::open(folder, layout(), settings).unwrap().0
}

/// Opens a log whose first segment is as long as the later ones.
fn open_with_full_first_segment(folder: &Path, settings: LogSettings) -> FrameLog {
    let mut log = open_with(folder, settings);
    log.limits = Limits::new(&settings);
    log
}

/// Returns settings with one append per segment.
fn short_segments() -> LogSettings {
    LogSettings {
        segment_bytes: 1,
        ..LogSettings::default()
    }
}

fn segments(folder: &Path) -> Vec<PathBuf> {
    let files = std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path());
    let mut files: Vec<PathBuf> = files
        .filter(|path| path.extension().is_some_and(|end| end == "mcap"))
        .collect();
    files.sort_unstable();
    files
}

/// Returns all frames of an epoch as numbers and values, read in parts of at most `limit` frames.
fn all_frames(reader: &FrameLogReader, epoch: u64, limit: u64) -> Vec<(u64, Vec<u64>)> {
    let mut found = Vec::new();
    let mut after = 0;
    while let Some(answer) = reader.read(epoch, after, limit, usize::MAX).unwrap() {
        assert!(answer.sequence >= after && answer.count() <= limit);
        let rows = answer.values.chunks_exact(usize::from(answer.channels));
        found.extend((answer.sequence..).zip(rows.map(bits)));
        after = answer.end();
        if answer.ended {
            break;
        }
    }
    found
}

fn bits(values: &[f64]) -> Vec<u64> {
    values.iter().map(|value| value.to_bits()).collect()
}

/// Returns number and values of all frames in `blocks`.
fn rows_of(blocks: &[LoggedFrames]) -> Vec<(u64, Vec<u64>)> {
    let rows = |block: &LoggedFrames| {
        let rows: Vec<Vec<u64>> = block
            .values
            .chunks_exact(usize::from(block.channels))
            .map(bits)
            .collect();
        (block.sequence..).zip(rows).collect::<Vec<_>>()
    };
    blocks.iter().flat_map(rows).collect()
}

#[test]
fn frames_are_read_back_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    let (mut log, _) = open(folder.path());
    let payload_of_nan = f64::from_bits(0xfff8_dead_beef_0001);
    let written = LoggedFrames {
        source: "ingest-östlich".to_owned(),
        epoch: u64::MAX,
        sequence: 1 << 40,
        t0_ns: i64::MIN,
        sampling_rate_hz: 119.88,
        channels: CHANNELS,
        values: vec![
            payload_of_nan,
            -0.0,
            f64::MIN_POSITIVE / 3.0,
            f64::INFINITY,
            f64::NAN,
            1.0 / 3.0,
        ],
        ended: true,
        nodes: vec![
            NodePosition {
                epoch: u64::MAX,
                sequence: 0,
                ended: false,
            },
            NodePosition {
                epoch: 0,
                sequence: u64::MAX,
                ended: false,
            },
        ],
    };
    log.append(std::slice::from_ref(&written)).unwrap();
    let expected = (
        bits(&written.values),
        LoggedFrames {
            values: Vec::new(),
            ..written
        },
    );
    let taken = |found: LoggedFrames| {
        (
            bits(&found.values),
            LoggedFrames {
                values: Vec::new(),
                ..found
            },
        )
    };
    let found = log
        .reader()
        .read(u64::MAX, 0, u64::MAX, usize::MAX)
        .unwrap()
        .unwrap();
    assert_eq!(taken(found), expected);
    log.close().unwrap();
    let (log, opened) = open(folder.path());
    assert_eq!(taken(opened.last.unwrap()), expected);
    let found = log
        .reader()
        .read(u64::MAX, 0, u64::MAX, usize::MAX)
        .unwrap()
        .unwrap();
    assert_eq!(taken(found), expected);
}

#[test]
fn a_log_without_frames_is_empty() {
    let folder = tempfile::tempdir().unwrap();
    let deep = folder.path().join("a/b");
    let (log, opened) = open(&deep);
    let empty = OpenedLog {
        last: None,
        was_closed: true,
        same_boot: true,
        is_complete: None,
        torn_bytes: 0,
        set_aside: Vec::new(),
    };
    assert_eq!(opened, empty);
    assert_eq!(
        (log.reader().spans(), log.reader().next_epoch(None)),
        (Vec::new(), None)
    );
    assert_eq!(log.reader().read(0, 0, 10, 1000).unwrap(), None);
    log.close().unwrap();
    assert_eq!(
        open(&deep).1,
        OpenedLog {
            is_complete: Some(true),
            ..empty
        }
    );
}

#[test]
fn replies_are_joined_up_to_limit_and_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let (mut log, _) = open(folder.path());
    for from in (0..50).step_by(5) {
        log.append(&[frames(1, from, 5)]).unwrap();
    }
    let reader = log.reader();
    let count = |after, limit, bytes| {
        reader
            .read(1, after, limit, bytes)
            .unwrap()
            .map(|found| found.count())
    };
    assert_eq!(count(0, 100, usize::MAX), Some(50));
    assert_eq!(count(3, 12, usize::MAX), Some(12));
    assert_eq!(count(0, 100, 24 * 7 + 23), Some(7));
    assert_eq!(
        (count(0, 0, usize::MAX), count(0, 100, 0)),
        (Some(1), Some(1)),
        "at least one frame"
    );
    assert_eq!(
        (count(49, 100, 1000), count(50, 100, 1000)),
        (Some(1), None)
    );
    let answer = reader.read(1, 3, 12, usize::MAX).unwrap().unwrap();
    assert_eq!(
        answer,
        frames(1, 3, 12),
        "twelve frames end with a block: node positions are known"
    );
    let answer = reader.read(1, 3, 11, usize::MAX).unwrap().unwrap();
    assert_eq!(
        answer,
        LoggedFrames {
            nodes: Vec::new(),
            ..frames(1, 3, 11)
        },
        "within a block they are not"
    );
}

#[test]
fn reply_stops_at_a_gap_and_the_next_reply_starts_after_it() {
    let folder = tempfile::tempdir().unwrap();
    let (mut log, _) = open(folder.path());
    log.append(&[frames(1, 10, 5), frames(1, 20, 5)]).unwrap();
    log.append(&[frames(1, 40, 5)]).unwrap();
    let reader = log.reader();
    let span = |after| {
        reader
            .read(1, after, 100, 10_000)
            .unwrap()
            .map(|found| (found.sequence, found.end()))
    };
    assert_eq!(span(0), Some((10, 15)));
    assert_eq!((span(15), span(22)), (Some((20, 25)), Some((22, 25))));
    assert_eq!((span(25), span(45)), (Some((40, 45)), None));
    assert_eq!(
        reader.spans(),
        [LogSpan {
            epoch: 1,
            from: 10,
            to: 45,
            missing: 20
        }]
    );
}

#[test]
fn reader_with_all_frames_of_an_epoch_receives_its_end() {
    let folder = tempfile::tempdir().unwrap();
    let (mut log, _) = open(folder.path());
    log.append(&[frames(1, 0, 5)]).unwrap();
    log.append(&[ended(frames(1, 5, 0)), frames(2, 0, 5)])
        .unwrap();
    log.append(&[ended(frames(2, 5, 5))]).unwrap();
    let reader = log.reader();
    let read = |epoch, after, limit| {
        let found = reader.read(epoch, after, limit, 10_000).unwrap();
        found.map(|found| (found.sequence, found.count(), found.ended))
    };
    assert_eq!(read(1, 0, 100), Some((0, 5, true)));
    assert_eq!(read(1, 0, 5), Some((0, 5, false)));
    assert_eq!(
        (read(1, 5, 100), read(1, 6, 100)),
        (Some((5, 0, true)), None)
    );
    assert_eq!(
        (read(2, 0, 10), read(2, 0, 9)),
        (Some((0, 10, true)), Some((0, 9, false)))
    );
    assert_eq!(
        (read(2, 10, 1), read(2, 11, 1)),
        (Some((10, 0, true)), None)
    );
    assert_eq!((read(0, 0, 1), read(3, 0, 1)), (None, None));
    assert_eq!(
        [None, Some(0), Some(1), Some(2)].map(|epoch| reader.next_epoch(epoch)),
        [Some(1), Some(1), Some(2), None]
    );
}

#[test]
fn append_skips_frames_already_in_the_log() {
    let folder = tempfile::tempdir().unwrap();
    let (mut log, _) = open(folder.path());
    let other = |from, count: usize| LoggedFrames {
        values: vec![-1.0; 3 * count],
        ..frames(1, from, count as u64)
    };
    log.append(&[frames(1, 0, 5), other(3, 4)]).unwrap();
    log.append(&[other(0, 7)]).unwrap();
    log.append(&[ended(frames(1, 5, 2))]).unwrap();
    log.append(&[ended(frames(1, 0, 7)), ended(frames(1, 7, 0))])
        .unwrap();
    drop(log);
    let (mut log, opened) = open(folder.path());
    assert_eq!(
        opened.last.as_ref().map(|last| (last.end(), last.ended)),
        Some((7, true))
    );
    log.append(&[ended(frames(1, 0, 7))]).unwrap();
    assert_eq!(
        all_frames(&log.reader(), 1, 4),
        rows_of(&[frames(1, 0, 5), other(5, 2)])
    );
    assert_eq!(
        segments(folder.path()).len(),
        1,
        "what is there already makes no segment"
    );
}

#[test]
fn invalid_frames_are_rejected_without_a_trace_in_the_log() {
    let folder = tempfile::tempdir().unwrap();
    let (mut log, _) = open(folder.path());
    log.append(&[frames(5, 0, 5), ended(frames(5, 5, 5))])
        .unwrap();
    let refused = [
        (
            LoggedFrames {
                channels: 2,
                ..frames(6, 0, 2)
            },
            "number of channels is 2, must be 3",
        ),
        (
            LoggedFrames {
                values: vec![0.0; 4],
                ..frames(6, 0, 2)
            },
            "number of values is 4, must be a multiple of 3",
        ),
        (
            LoggedFrames {
                nodes: vec![NodePosition {
                    epoch: 0,
                    sequence: 0,
                    ended: false,
                }],
                ..frames(6, 0, 2)
            },
            "number of nodes is 1, must be 0 or 2",
        ),
        (
            LoggedFrames {
                sampling_rate_hz: 0.0,
                ..frames(6, 0, 2)
            },
            "sampling rate is 0 Hz, must be positive",
        ),
        (
            LoggedFrames {
                sequence: u64::MAX - 1,
                ..frames(6, 0, 2)
            },
            "number of the first frame is",
        ),
        (
            LoggedFrames {
                source: "s".repeat(65_536),
                ..frames(6, 0, 2)
            },
            "length of the source is 65536",
        ),
        (
            frames(4, 0, 2),
            "epoch is 4, must be at least 5, the epoch of the last frames",
        ),
        (
            frames(5, 9, 2),
            "number of the last frame is 10, must be below 10, where epoch 5 ended",
        ),
    ];
    for (block, expected) in refused {
        // The block follows a valid one if the order permits that.
        let blocks = if block.epoch == 6 {
            vec![frames(6, 0, 5), block]
        } else {
            vec![block]
        };
        let told = log.append(&blocks).unwrap_err().to_string();
        assert!(
            told.starts_with(&format!("frames of `tower` cannot be logged: {expected}")),
            "{told}"
        );
        assert_eq!(
            log.reader().spans(),
            [LogSpan {
                epoch: 5,
                from: 0,
                to: 10,
                missing: 0
            }],
            "{expected}"
        );
    }
    log.append(&[frames(6, 0, 5)]).unwrap();
    assert_eq!(log.reader().next_epoch(Some(5)), Some(6));
}

#[test]
fn new_segment_starts_after_the_limit_of_bytes_or_time() {
    let folder = tempfile::tempdir().unwrap();
    let settings = LogSettings {
        segment_s: 10,
        ..LogSettings::default()
    };
    let mut log = open_with_full_first_segment(folder.path(), settings);
    for from in (0..5000).step_by(100) {
        log.append(&[frames(1, from, 100)]).unwrap(); // a second each
    }
    assert_eq!(segments(folder.path()).len(), 5);
    assert_eq!(
        all_frames(&log.reader(), 1, 170),
        rows_of(&[frames(1, 0, 5000)])
    );
    drop(log);
    let mut log = open_with_full_first_segment(
        folder.path(),
        LogSettings {
            segment_bytes: 20_000,
            ..LogSettings::default()
        },
    );
    for from in (5000..9000).step_by(100) {
        log.append(&[frames(1, from, 100)]).unwrap(); // 2400 bytes of values each
    }
    assert_eq!(segments(folder.path()).len(), 5 + 5);
    assert_eq!(
        all_frames(&log.reader(), 1, 1_000_000),
        rows_of(&[frames(1, 0, 9000)])
    );
}

#[test]
fn many_segments_are_read_from_any_sequence_number() {
    let folder = tempfile::tempdir().unwrap();
    let mut log = open_with(folder.path(), short_segments());
    for from in 0..300 {
        log.append(&[frames(1 + from / 100, from % 100, 1)])
            .unwrap();
    }
    assert_eq!(segments(folder.path()).len(), 300);
    drop(log);
    let (log, _) = open(folder.path());
    let reader = log.reader();
    for epoch in 1..4 {
        assert_eq!(
            all_frames(&reader, epoch, 17),
            rows_of(&[frames(epoch, 0, 100)])
        );
        for after in [0, 1, 50, 99] {
            let found = reader
                .read(epoch, after, 1000, usize::MAX)
                .unwrap()
                .unwrap();
            assert_eq!(found, frames(epoch, after, 100 - after));
        }
        assert_eq!(reader.read(epoch, 100, 1000, usize::MAX).unwrap(), None);
    }
    let whole = |epoch| LogSpan {
        epoch,
        from: 0,
        to: 100,
        missing: 0,
    };
    assert_eq!(reader.spans(), [whole(1), whole(2), whole(3)]);
}

#[test]
fn frame_times_follow_from_the_rate() {
    let of = |rate_hz, number| frame_time_ns(-5, rate_hz, number);
    assert_eq!(
        (of(120.0, 1), of(120.0, 2)),
        (-5 + 8_333_333, -5 + 16_666_667)
    );
    assert_eq!(
        of(120.0, 120_000_000_000 * 3),
        -5 + 3_000_000_000_000_000_000
    );
    assert_eq!(
        of(1e9 / 7e6, 1_000),
        -5 + 7_000_000_000,
        "a rate without whole microhertz"
    );
    assert_eq!(
        (of(1e-3, u64::MAX), of(f64::MIN_POSITIVE, 1)),
        (i64::MAX - 5, i64::MAX - 5)
    );
}
