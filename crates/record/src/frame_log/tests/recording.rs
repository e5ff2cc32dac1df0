//! Reads a segment, and a folder of segments, as a recording.

use super::*;
use crate::{
    ChannelColumn, ColumnMapping, OffsetRemoval, ReadOptions, RecordReader, RecordedFile, Recording,
};

/// Writes epochs 1 and 2, each with a gap, in several segments.
fn written(folder: &Path) -> Vec<LoggedFrames> {
    let later = |block: LoggedFrames| LoggedFrames {
        t0_ns: T0_NS + 60_000_000_000,
        ..block
    };
    let mut missing = frames(1, 5, 3);
    missing.values[4] = f64::NAN;
    let blocks = vec![
        frames(1, 0, 5),
        missing,
        ended(frames(1, 10, 2)),
        later(frames(2, 0, 4)),
    ];
    let mut log = open_with(folder, short_segments());
    for block in &blocks {
        log.append(std::slice::from_ref(block)).unwrap();
    }
    log.close().unwrap();
    blocks
}

fn samples(recording: &RecordedFile, channel: usize) -> Vec<(i64, u64)> {
    let samples = recording.channels()[channel].timed_samples();
    samples
        .map(|(time_ns, value)| (time_ns, value.to_bits()))
        .collect()
}

fn expected(blocks: &[LoggedFrames], channel: usize) -> Vec<(i64, u64)> {
    let samples = |block: &LoggedFrames| {
        let start_ns = block.t0_ns;
        let rows = rows_of(std::slice::from_ref(block)).into_iter();
        rows.map(move |(number, row)| (start_ns + number as i64 * 10_000_000, row[channel]))
            .collect::<Vec<_>>()
    };
    blocks.iter().flat_map(samples).collect()
}

#[test]
fn a_folder_of_segments_is_one_recording_with_the_channels_of_the_layout() {
    let folder = tempfile::tempdir().unwrap();
    let blocks = written(folder.path());
    assert_eq!(segments(folder.path()).len(), 4);
    let recording = RecordedFile::read(folder.path(), &ReadOptions::default()).unwrap();
    let names: Vec<&str> = recording
        .channels()
        .iter()
        .map(|channel| channel.name())
        .collect();
    assert_eq!(names, ["roof-x", "roof-y", "base"]);
    for (place, channel) in recording.channels().iter().enumerate() {
        assert_eq!(channel.sampling_rate_hz(), Some(100.0));
        assert_eq!(samples(&recording, place), expected(&blocks, place));
    }
    assert!(recording.remarks().is_empty(), "{:?}", recording.remarks());
}

#[test]
fn rows_of_a_folder_are_the_frames() {
    let folder = tempfile::tempdir().unwrap();
    let blocks = written(folder.path());
    let columns = ["base", "roof-x"].map(ChannelColumn::new).to_vec();
    let mut recording = Recording::open(
        folder.path(),
        &ColumnMapping::new(columns),
        OffsetRemoval::Keep,
    )
    .unwrap();
    assert_eq!(recording.check_sampling_rate(100.0).unwrap(), 100.0);
    let expected = expected(&blocks, 2).into_iter().zip(expected(&blocks, 0));
    for ((time_ns, base), (_, roof)) in expected {
        let row = recording.next_row().unwrap().unwrap();
        assert_eq!((row.time_ns, bits(row.values)), (time_ns, vec![base, roof]));
    }
    assert!(recording.next_row().unwrap().is_none());
}

#[test]
fn open_segment_can_be_read_as_a_recording() {
    let folder = tempfile::tempdir().unwrap();
    let (mut log, _) = open(folder.path());
    log.append(&[frames(1, 0, 5)]).unwrap();
    let recording =
        RecordedFile::read(&segments(folder.path())[0], &ReadOptions::default()).unwrap();
    assert_eq!(samples(&recording, 2), expected(&[frames(1, 0, 5)], 2));
    assert_eq!(
        recording.remarks(),
        ["the file is truncated: only its complete chunks are read"]
    );
    drop(log);
    open(folder.path());
    let recording =
        RecordedFile::read(&segments(folder.path())[0], &ReadOptions::default()).unwrap();
    assert_eq!(samples(&recording, 2), expected(&[frames(1, 0, 5)], 2));
    assert!(recording.remarks().is_empty(), "mended");
}

#[test]
fn first_frame_of_overlapping_epochs_is_kept_with_a_remark() {
    let folder = tempfile::tempdir().unwrap();
    let mut log = open_with(folder.path(), short_segments());
    let blocks = [
        frames(1, 0, 5),
        LoggedFrames {
            t0_ns: T0_NS + 2_000_000,
            ..frames(2, 0, 7)
        },
    ];
    blocks
        .iter()
        .for_each(|block| log.append(std::slice::from_ref(block)).unwrap());
    log.close().unwrap();
    std::fs::write(folder.path().join("notes.txt"), "of the site").unwrap();
    let recording = RecordedFile::read(folder.path(), &ReadOptions::default()).unwrap();
    let values: Vec<u64> = samples(&recording, 0)
        .into_iter()
        .map(|(_, bits)| bits)
        .collect();
    let kept = [frames(1, 0, 5), frames(2, 5, 2)];
    assert_eq!(
        values,
        rows_of(&kept)
            .into_iter()
            .map(|(_, row)| row[0])
            .collect::<Vec<_>>()
    );
    assert_eq!(
        recording.remarks(),
        [
            "skipped, not segments of the frame log: notes.txt",
            "5 frames have the time of another frame and are skipped",
        ]
    );
}

#[test]
fn segments_of_other_channels_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    written(folder.path());
    let elsewhere = tempfile::tempdir().unwrap();
    let other = LogLayout {
        channels: ["a", "b", "c"].map(str::to_owned).to_vec(),
        ..layout()
    };
    let (mut log, _) = FrameLog::open(elsewhere.path(), other, LogSettings::default()).unwrap();
    log.append(&[frames(9, 0, 1)]).unwrap();
    log.close().unwrap();
    let path = segments(elsewhere.path()).remove(0);
    std::fs::copy(&path, folder.path().join(path.file_name().unwrap())).unwrap();
    let error = RecordedFile::read(folder.path(), &ReadOptions::default())
        .unwrap_err()
        .to_string();
    let expected =
        "channels of the frames is a, b, c at 100 Hz, must be roof-x, roof-y, base at 100 Hz";
    assert!(error.ends_with(expected), "{error}");
}
