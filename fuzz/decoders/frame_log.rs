//! Segments of a frame log. The log keeps intact data, removes or sets aside the rest, and
//! continues.

use spandrel_record::{FrameLog, FrameLogReader, LogLayout, LogSettings, LoggedFrames};
use std::path::Path;

/// Returns the layout of the seeds.
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

/// Reads all frames of an epoch, which must be in order and come once. Returns their number.
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

/// Opens one input as the segment of a log in `folder`, and extends the log. Returns the reason if
/// the log cannot be opened, or if none of its frames is kept.
pub fn decode(folder: &Path, bytes: &[u8]) -> Result<(), String> {
    let folder = &folder.join("log");
    let _ = std::fs::remove_dir_all(folder); // does not exist at first
    std::fs::create_dir(folder).expect("the folder can be written");
    let segment = folder.join(format!("frames-{:020}-{:020}.mcap", 1, 0));
    std::fs::write(segment, bytes).expect("the folder can be written");
    let open = || FrameLog::open(folder, layout(), LogSettings::default());
    let (mut log, opened) = open().map_err(|error| error.to_string())?;
    let epoch = opened.last.as_ref().map_or(1, |last| last.epoch);
    let before = read(&log.reader(), epoch);
    if epoch == u64::MAX {
        return Ok(());
    }
    log.append(&[frames(epoch + 1)]).expect("the log continues");
    log.close().expect("the log can be closed");
    let (log, opened) = open().expect("a closed log opens");
    assert!(opened.was_closed && opened.torn_bytes == 0 && opened.set_aside.is_empty());
    let last = opened.last.map(|last| (last.epoch, last.end()));
    assert_eq!(last, Some((epoch + 1, 10)));
    assert_eq!(read(&log.reader(), epoch), before);
    assert_eq!(read(&log.reader(), epoch + 1), 10);
    match before {
        0 => Err("no frame is kept".to_owned()),
        _ => Ok(()),
    }
}
