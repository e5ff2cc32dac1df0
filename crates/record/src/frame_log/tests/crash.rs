//! State of the log after a crash, on a full disk and on a damaged disk.

use super::*;

/// Writes some appends without closing the log. Returns the bytes of its segment, the end of each
/// append, and the file name.
fn torn_log(appends: &[Vec<LoggedFrames>]) -> (Vec<u8>, Vec<usize>, String) {
    let folder = tempfile::tempdir().unwrap();
    let (mut log, _) = open(folder.path());
    let mut ends = Vec::new();
    for blocks in appends {
        log.append(blocks).unwrap();
        ends.push(
            std::fs::metadata(&segments(folder.path())[0])
                .unwrap()
                .len() as usize,
        );
    }
    drop(log);
    let path = segments(folder.path()).remove(0);
    (
        std::fs::read(&path).unwrap(),
        ends,
        path.file_name().unwrap().to_str().unwrap().to_owned(),
    )
}

fn appends() -> Vec<Vec<LoggedFrames>> {
    vec![
        vec![frames(1, 0, 2)],
        vec![frames(1, 2, 1), ended(frames(1, 3, 2))],
        vec![frames(2, 0, 3)],
        vec![frames(2, 3, 1)],
    ]
}

fn rows_of_epoch(appends: &[Vec<LoggedFrames>], epoch: u64) -> Vec<(u64, Vec<u64>)> {
    let blocks: Vec<LoggedFrames> = appends
        .concat()
        .into_iter()
        .filter(|block| block.epoch == epoch)
        .collect();
    rows_of(&blocks)
}

#[test]
fn log_truncated_at_any_byte_is_a_prefix_and_accepts_appends() {
    let appends = appends();
    let (bytes, ends, name) = torn_log(&appends);
    for cut in 0..=bytes.len() {
        let folder = quick_folder();
        let path = folder.path().join(&name);
        std::fs::write(&path, &bytes[..cut]).unwrap();
        let (mut log, opened) = open(folder.path());
        // An append is complete even without the message index, which follows its chunk.
        let index_bytes = |append: usize| 15 + 16 * appends[append].len();
        let whole = (0..ends.len())
            .filter(|append| ends[*append] - index_bytes(*append) <= cut)
            .count();
        let reader = log.reader();
        for epoch in 1..3 {
            assert_eq!(
                all_frames(&reader, epoch, 100),
                rows_of_epoch(&appends[..whole], epoch),
                "cut at {cut}"
            );
        }
        assert_eq!(
            opened.last.as_ref(),
            appends[..whole].concat().last(),
            "cut at {cut}"
        );
        assert!(!opened.was_closed, "cut at {cut}");
        if whole > 0 {
            let is_index_whole = ends[whole - 1] <= cut;
            let kept = ends[whole - 1]
                - if is_index_whole {
                    0
                } else {
                    index_bytes(whole - 1)
                };
            assert_eq!(opened.torn_bytes, (cut - kept) as u64, "cut at {cut}");
            assert!(
                mcap::MessageStream::new(&std::fs::read(&path).unwrap())
                    .unwrap()
                    .all(|message| message.is_ok())
            );
        } else {
            let aside: u64 = opened
                .set_aside
                .iter()
                .map(|path| std::fs::metadata(path).unwrap().len())
                .sum();
            assert_eq!(
                opened.torn_bytes + aside,
                cut as u64,
                "nothing disappears unseen"
            );
        }
        log.append(&[frames(3, 0, 2)]).unwrap();
        assert_eq!(all_frames(&reader, 3, 100), rows_of(&[frames(3, 0, 2)]));
        log.close().unwrap();
        let (log, opened) = open(folder.path());
        assert_eq!(
            (opened.was_closed, opened.torn_bytes, opened.last),
            (true, 0, Some(frames(3, 0, 2)))
        );
        assert_eq!(
            all_frames(&log.reader(), 1, 100),
            rows_of_epoch(&appends[..whole], 1)
        );
    }
}

#[test]
fn damaged_byte_loses_at_most_its_own_append() {
    let appends = appends();
    let (bytes, ends, name) = torn_log(&appends);
    for place in 0..bytes.len() {
        let folder = quick_folder();
        let mut damaged = bytes.clone();
        damaged[place] ^= 1 << (place % 8);
        std::fs::write(folder.path().join(&name), &damaged).unwrap();
        let (log, _) = open(folder.path());
        let hit = ends.iter().filter(|end| **end <= place).count();
        for epoch in 1..3 {
            let found = all_frames(&log.reader(), epoch, 100);
            let with = rows_of_epoch(&appends, epoch);
            let mut others = appends.clone();
            others.remove(hit);
            let without = rows_of_epoch(&others, epoch);
            assert!(found == with || found == without, "byte {place}: {found:?}");
        }
    }
}

#[test]
fn damage_to_an_open_log_is_a_gap() {
    let folder = tempfile::tempdir().unwrap();
    let (mut log, _) = open(folder.path());
    for from in 0..10 {
        log.append(&[frames(1, from, 1)]).unwrap();
    }
    let path = segments(folder.path()).remove(0);
    let mut bytes = std::fs::read(&path).unwrap();
    let value = frames(1, 4, 1).values[0].to_le_bytes();
    let place = bytes.windows(8).position(|window| window == value).unwrap();
    bytes[place] ^= 1;
    std::fs::write(&path, bytes).unwrap();
    let reader = log.reader();
    assert_eq!(
        reader.read(1, 0, 100, 10_000).unwrap().unwrap(),
        frames(1, 0, 4)
    );
    assert_eq!(
        reader.read(1, 4, 100, 10_000).unwrap().unwrap(),
        frames(1, 5, 5)
    );
}

#[test]
fn unclosed_log_keeps_all_frames_and_receives_a_footer() {
    let folder = tempfile::tempdir().unwrap();
    let (mut log, _) = open(folder.path());
    log.append(&[frames(1, 0, 5)]).unwrap();
    drop(log);
    let (log, opened) = open(folder.path());
    assert_eq!(
        (opened.last, opened.was_closed, opened.torn_bytes),
        (Some(frames(1, 0, 5)), false, 0)
    );
    assert!(opened.same_boot);
    log.close().unwrap();
    let bytes = std::fs::read(&segments(folder.path())[0]).unwrap();
    assert!(
        mcap::Summary::read(&bytes).unwrap().is_none(),
        "a footer without summary"
    );
    let (_, opened) = open(folder.path());
    assert!(!opened.was_closed, "mended is not closed");
}

#[test]
fn completeness_of_a_log_is_stored_for_the_next_run() {
    let folder = tempfile::tempdir().unwrap();
    for (noted, found) in [
        (None, None),
        (Some(false), Some(false)),
        (Some(true), Some(true)),
        (Some(false), Some(false)),
    ] {
        let (mut log, _) = open(folder.path());
        if let Some(noted) = noted {
            log.note_complete(noted).unwrap();
        }
        drop(log);
        let (log, opened) = open(folder.path());
        assert_eq!(opened.is_complete, found);
        drop(log);
    }
}

/// A full segment ends properly, and a power failure may lose the next one. Such a log counts as
/// not closed.
#[test]
fn log_without_its_newest_segment_counts_as_not_closed() {
    let folder = tempfile::tempdir().unwrap();
    let settings = LogSettings {
        segment_bytes: 1,
        ..LogSettings::default()
    };
    let (mut log, _) = FrameLog::open(folder.path(), layout(), settings).unwrap();
    log.append(&[frames(1, 0, 5)]).unwrap();
    log.append(&[frames(1, 5, 5)]).unwrap();
    let newest = log.segment.as_ref().unwrap().path().to_owned();
    drop(log);
    std::fs::remove_file(newest).unwrap();
    let (log, opened) = open(folder.path());
    assert_eq!(
        (opened.was_closed, opened.torn_bytes, opened.last),
        (false, 0, Some(frames(1, 0, 5)))
    );
    log.close().unwrap();
    assert!(open(folder.path()).1.was_closed);
}

#[test]
fn segment_of_another_boot_is_detected() {
    let folder = tempfile::tempdir().unwrap();
    let (mut log, _) = open(folder.path());
    log.stated.boot_id = "another".to_owned();
    log.append(&[frames(1, 0, 5)]).unwrap();
    drop(log);
    assert!(!open(folder.path()).1.same_boot);
}

#[test]
fn unreadable_segment_without_frames_is_set_aside() {
    let folder = tempfile::tempdir().unwrap();
    let (mut log, _) = open(folder.path());
    log.append(&[frames(1, 0, 5)]).unwrap();
    log.close().unwrap();
    let name = |sequence: u64| {
        folder
            .path()
            .join(SegmentName { epoch: 1, sequence }.file_name())
    };
    std::fs::write(name(5), vec![0; 5000]).unwrap();
    std::fs::write(name(6), []).unwrap();
    let (mut log, opened) = open(folder.path());
    let aside = folder.path().join(format!(
        "{}.unreadable",
        name(5).file_name().unwrap().to_str().unwrap()
    ));
    assert_eq!(
        (opened.set_aside, opened.last),
        (vec![aside.clone()], Some(frames(1, 0, 5)))
    );
    assert_eq!(std::fs::read(aside).unwrap(), vec![0; 5000]);
    assert!(!name(6).exists());
    // A later unreadable file must not prevent appends, either.
    std::fs::write(name(5), vec![0; 6000]).unwrap();
    log.append(&[frames(1, 5, 5)]).unwrap();
    assert_eq!(
        all_frames(&log.reader(), 1, 100),
        rows_of(&[frames(1, 0, 10)])
    );
    let aside = folder.path().join(format!(
        "{}.2.unreadable",
        name(5).file_name().unwrap().to_str().unwrap()
    ));
    assert_eq!(std::fs::read(aside).unwrap(), vec![0; 6000]);
}
