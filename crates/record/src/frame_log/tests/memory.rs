//! Memory that a log uses per written chunk. Each structure has one open log.

use super::*;

/// Live blocks of 50 ms, one chunk each, for three minutes.
const CHUNKS: u64 = 3600;

fn append_live(log: &mut FrameLog) {
    for chunk in 0..CHUNKS {
        log.append(&[frames(1, 5 * chunk, 5)]).unwrap();
    }
}

/// The index must not stay in memory. With 300 bytes per chunk in an MCAP writer and 56 in the
/// reader, each structure would need more than a megabyte.
#[test]
fn open_segment_keeps_little_memory_per_chunk() {
    let folder = tempfile::tempdir().unwrap();
    let mut log = open_with_full_first_segment(folder.path(), LogSettings::default());
    let held = allocation_counter::measure(|| append_live(&mut log));
    assert!(
        held.bytes_current < 20 * CHUNKS as i64,
        "{} bytes of {CHUNKS} chunks",
        held.bytes_current
    );
    let reader = log.reader();
    assert_eq!(
        reader.read(1, 9_001, 4, usize::MAX).unwrap().unwrap(),
        frames(1, 9_001, 4)
    );
    let mut log = Some(log);
    let ending = allocation_counter::measure(|| log.take().unwrap().close().unwrap());
    assert!(
        ending.bytes_max < 400 << 10,
        "{} bytes to end it",
        ending.bytes_max
    );
    assert_eq!(
        all_frames(&reader, 1, 4096),
        rows_of(&[frames(1, 0, 5 * CHUNKS)])
    );
}

#[test]
fn index_in_the_file_matches_its_chunks() {
    let folder = tempfile::tempdir().unwrap();
    let mut log = open_with_full_first_segment(folder.path(), LogSettings::default());
    append_live(&mut log);
    log.append(&[
        frames(1, 5 * CHUNKS, 5),
        frames(1, 5 * CHUNKS + 5, 5),
        ended(frames(1, 5 * CHUNKS + 10, 1)),
    ])
    .unwrap();
    log.close().unwrap();
    let bytes = std::fs::read(segments(folder.path()).remove(0)).unwrap();
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let stats = summary.stats.clone().unwrap();
    assert_eq!(
        (stats.message_count, u64::from(stats.chunk_count)),
        (CHUNKS + 3, CHUNKS + 1)
    );
    let first_ns = frames(1, 0, 1).time_ns() as u64;
    let last_ns = frames(1, 5 * CHUNKS + 10, 1).time_ns() as u64;
    assert_eq!(
        (stats.message_start_time, stats.message_end_time),
        (first_ns, last_ns)
    );
    assert_eq!((summary.schemas.len(), summary.channels.len()), (1, 1));
    let mut places = Vec::new();
    for index in &summary.chunk_indexes {
        for (channel, entries) in summary.read_message_indexes(&bytes, index).unwrap() {
            assert_eq!(channel.topic, "frames");
            for entry in entries {
                let message = summary.seek_message(&bytes, index, &entry).unwrap();
                places.push((message.sequence, message.log_time == entry.log_time));
            }
        }
    }
    assert_eq!(
        places,
        (0..CHUNKS as u32 + 3)
            .map(|number| (number, true))
            .collect::<Vec<_>>()
    );
    // The checksum covers the whole summary, and the footer up to the checksum.
    let footer = bytes.len() - mcap::MAGIC.len() - 4;
    let start_at = footer - 16;
    let start = u64::from_le_bytes(bytes[start_at..start_at + 8].try_into().unwrap()) as usize;
    let stated = u32::from_le_bytes(bytes[footer..footer + 4].try_into().unwrap());
    assert_eq!(crc32fast::hash(&bytes[start..footer]), stated);
}
