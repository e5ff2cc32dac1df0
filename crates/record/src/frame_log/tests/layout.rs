//! The layout of a folder, and its segments as seen by other MCAP readers.

use super::*;

#[test]
fn error_names_the_difference_to_the_layout_of_a_folder() {
    let folder = tempfile::tempdir().unwrap();
    let (mut log, _) = open(folder.path());
    log.append(&[frames(1, 0, 5)]).unwrap();
    log.close().unwrap();
    let others = [
        (
            LogLayout {
                structure: "bridge".to_owned(),
                ..layout()
            },
            "structure is `tower`, must be `bridge`",
        ),
        (
            LogLayout {
                channels: vec!["roof-x, roof-y, base".to_owned()],
                ..layout()
            },
            "channels is `[\"roof-x\", \"roof-y\", \"base\"]`, must be `[\"roof-x, roof-y, \
             base\"]`",
        ),
        (
            LogLayout {
                nodes: Vec::new(),
                ..layout()
            },
            "nodes is `[\"roof\", \"base\"]`, must be `[]`",
        ),
        (
            LogLayout {
                sampling_rate_hz: 200.0,
                ..layout()
            },
            "sampling rate is `100 Hz`, must be `200 Hz`",
        ),
    ];
    for (other, expected) in others {
        let error = FrameLog::open(folder.path(), other, LogSettings::default())
            .err()
            .unwrap()
            .to_string();
        let place = folder.path().display();
        let expected = format!(
            "{place}: the frame log has another layout: {expected}; move the folder, or choose \
             another one"
        );
        assert_eq!(error, expected);
    }
    assert!(open(folder.path()).1.was_closed, "nobody has touched it");
}

#[test]
fn a_closed_segment_is_mcap_with_index_and_schema() {
    let folder = tempfile::tempdir().unwrap();
    let (mut log, _) = open(folder.path());
    let blocks = [frames(3, 10, 5), frames(3, 15, 5)];
    log.append(&blocks[..1]).unwrap();
    log.append(&blocks[1..]).unwrap();
    log.close().unwrap();
    let path = segments(folder.path()).remove(0);
    assert_eq!(
        path.file_name().unwrap(),
        "frames-00000000000000000003-00000000000000000010.mcap"
    );
    let bytes = std::fs::read(&path).unwrap();
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    assert_eq!(summary.chunk_indexes.len(), 2);
    assert_eq!(
        summary.stats.as_ref().map(|stats| stats.message_count),
        Some(2)
    );
    let channel = summary.channels.values().next().unwrap();
    assert_eq!(
        (channel.topic.as_str(), channel.message_encoding.as_str()),
        ("frames", "spandrel.frames.v1")
    );
    assert_eq!(channel.schema.as_ref().unwrap().name, "spandrel.frames");
    assert_eq!(
        channel.metadata["channels"],
        r#"["roof-x","roof-y","base"]"#
    );
    let times: Vec<u64> = mcap::MessageStream::new(&bytes)
        .unwrap()
        .map(|message| message.unwrap().log_time)
        .collect();
    assert_eq!(
        times,
        [T0_NS as u64 + 100_000_000, T0_NS as u64 + 150_000_000]
    );
}

#[test]
fn message_matches_its_schema() {
    let folder = tempfile::tempdir().unwrap();
    let (mut log, _) = open(folder.path());
    let block = LoggedFrames {
        t0_ns: -1,
        nodes: vec![
            NodePosition {
                epoch: 5,
                sequence: 6,
                ended: false
            };
            2
        ],
        ..frames(3, 0, 1)
    };
    log.append(&[ended(block)]).unwrap();
    log.close().unwrap();
    let bytes = std::fs::read(&segments(folder.path())[0]).unwrap();
    let message = mcap::MessageStream::new(&bytes)
        .unwrap()
        .next()
        .unwrap()
        .unwrap();
    let mut expected = Vec::new();
    expected.extend([3, 0, 0, 0, 0, 0, 0, 0]); // epoch
    expected.extend([0; 8]); // first frame
    expected.extend([0xff; 8]); // time of frame 0: -1
    expected.extend([0, 0, 0, 0, 0, 0, 0x59, 0x40]); // 100 Hz
    // Frames, channels, nodes, bytes of the source, end mark.
    expected.extend([1, 0, 0, 0, 3, 0, 2, 0, 6, 0, 1, 0]);
    expected.extend(b"ingest");
    // Epoch, next sample, not ended.
    let node = [[5, 0, 0, 0, 0, 0, 0, 0], [6, 0, 0, 0, 0, 0, 0, 0], [0; 8]];
    expected.extend(node.concat().repeat(2));
    expected.extend(
        [3e9_f64, 3e9 + 0.125, 3e9 + 0.25]
            .map(f64::to_le_bytes)
            .concat(),
    );
    assert_eq!(message.data.as_ref(), expected);
    assert_eq!(message.log_time, 0, "before 1970");
}

#[test]
fn segment_of_another_encoding_is_rejected_and_unchanged() {
    let folder = tempfile::tempdir().unwrap();
    let (mut log, _) = open(folder.path());
    log.append(&[frames(1, 0, 5)]).unwrap();
    log.close().unwrap();
    let path = segments(folder.path()).remove(0);
    let mut writer = mcap::WriteOptions::new()
        .compression(None)
        .create(std::io::Cursor::new(Vec::new()))
        .unwrap();
    let metadata = std::collections::BTreeMap::new();
    let channel = writer
        .add_channel(0, "frames", "spandrel.frames.v2", &metadata)
        .unwrap();
    let header = mcap::records::MessageHeader {
        channel_id: channel,
        sequence: 0,
        log_time: 0,
        publish_time: 0,
    };
    writer.write_to_known_channel(&header, &[0; 4000]).unwrap();
    writer.finish().unwrap();
    let other = writer.into_inner().into_inner();
    std::fs::write(&path, &other).unwrap();
    let error = FrameLog::open(folder.path(), layout(), LogSettings::default())
        .err()
        .unwrap()
        .to_string();
    assert!(
        error.contains(
            "encoding of the frames is `spandrel.frames.v2`, must be `spandrel.frames.v1`"
        ),
        "{error}"
    );
    assert_eq!(std::fs::read(&path).unwrap(), other);
}
