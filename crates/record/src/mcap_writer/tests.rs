use super::*;
use crate::{ReadOptions, RecordedFile};

const RATE_HZ: f64 = 200.0;

fn channels() -> Vec<McapChannel> {
    let channel = |name: &str| McapChannel {
        name: name.to_owned(),
        unit: "m/s2".to_owned(),
        description: String::new(),
        sampling_rate_hz: Some(RATE_HZ),
        origin: TimeOrigin::Epoch,
    };
    vec![channel("roof"), channel("base")]
}

fn sample(place: usize, step: i64) -> f64 {
    (step as f64 * 0.1 + place as f64).sin()
}

/// Writes samples of two channels, and returns the file. If `is_killed`, the file has no proper
/// end.
fn written(steps: i64, is_killed: bool) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("out.mcap");
    let mut writer = McapWriter::create(&path, &channels()).unwrap();
    for step in 0..steps {
        for place in 0..2 {
            writer
                .write(place, step * 5_000_000, sample(place, step))
                .unwrap();
        }
    }
    match is_killed {
        // Like after `kill -9`, nothing is dropped or flushed.
        true => std::mem::forget(writer),
        false => drop(writer.finish().unwrap()),
    }
    std::fs::read(&path).unwrap()
}

fn read(bytes: &[u8]) -> Result<RecordedFile, RecordError> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("cut.mcap");
    std::fs::write(&path, bytes).unwrap();
    RecordedFile::read(&path, &ReadOptions::default())
}

#[test]
fn killed_writer_loses_only_its_last_chunk() {
    // 5000 steps of two channels: two chunks of 4096 messages are complete, and 1808 messages are
    // lost.
    let file = read(&written(5000, true)).unwrap();
    for (place, channel) in file.channels().iter().enumerate() {
        let samples: Vec<f64> = channel.samples().collect();
        assert_eq!(samples.len(), 4096);
        assert!(
            samples
                .iter()
                .enumerate()
                .all(|(step, value)| *value == sample(place, step as i64))
        );
    }
    assert_eq!(
        file.remarks(),
        ["the file is truncated: only its complete chunks are read"]
    );
}

#[test]
fn file_cut_anywhere_is_read_up_to_its_last_whole_chunk() {
    let whole = written(10_000, false);
    let mut lengths = Vec::new();
    // Cut at every byte of the beginning and the end, and at many bytes in between.
    let places = (0..600)
        .chain((600..whole.len() - 600).step_by(499))
        .chain(whole.len() - 600..whole.len());
    for end in places {
        match crate::formats::mcap::read(&whole[..end]) {
            Ok((channels, _)) => {
                for (place, channel) in channels.iter().enumerate() {
                    let samples: Vec<f64> = channel.samples().collect();
                    assert!(
                        samples
                            .iter()
                            .enumerate()
                            .all(|(step, value)| *value == sample(place, step as i64))
                    );
                    lengths.push(samples.len());
                }
            }
            Err(fault) => assert!(lengths.is_empty(), "cut at {end}: {fault}"),
        }
    }
    lengths.dedup();
    assert_eq!(
        lengths,
        [2048, 4096, 6144, 8192, 10_000],
        "samples of a channel by chunk"
    );
}

#[test]
fn error_names_the_position_of_damage_within_a_chunk() {
    let mut bytes = written(3000, false);
    let chunk = &mcap::Summary::read(&bytes).unwrap().unwrap().chunk_indexes[0];
    let middle = chunk.chunk_start_offset + chunk.chunk_length / 2;
    bytes[middle as usize] ^= 0x40;
    let told = read(&bytes).unwrap_err().to_string();
    assert!(
        told.contains("MCAP: byte ") && told.contains("must be complete and undamaged"),
        "{told}"
    );
}

#[test]
fn damaged_byte_anywhere_is_an_error_or_no_change_but_no_panic() {
    let bytes = written(40, false);
    for place in 0..bytes.len() {
        for damage in [0x01, 0x80, 0xff] {
            let mut damaged = bytes.clone();
            damaged[place] ^= damage;
            let _ = crate::formats::mcap::read(&damaged);
        }
    }
}

#[test]
fn messages_are_json_with_a_schema_that_names_the_value_a_number() {
    let bytes = written(3, false);
    let messages: Vec<_> = mcap::MessageStream::new(&bytes)
        .unwrap()
        .map(Result::unwrap)
        .collect();
    assert_eq!(messages.len(), 6);
    let first = &messages[0];
    assert_eq!(
        (
            first.channel.topic.as_str(),
            first.channel.message_encoding.as_str()
        ),
        ("roof", "json")
    );
    let message: serde_json::Value = serde_json::from_slice(&first.data).unwrap();
    assert_eq!(message, serde_json::json!({ "value": sample(0, 0) }));
    let schema = first.channel.schema.as_ref().unwrap();
    assert_eq!(schema.encoding, "jsonschema");
    let schema: serde_json::Value = serde_json::from_slice(&schema.data).unwrap();
    assert_eq!(
        (&schema["type"], &schema["properties"]["value"]["type"]),
        (&"object".into(), &"number".into())
    );
}

#[test]
fn infinite_values_and_times_before_1970_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let mut writer = McapWriter::create(&folder.path().join("out.mcap"), &channels()).unwrap();
    assert!(matches!(
        writer.write(0, -1, 1.0),
        Err(RecordError::NotWritable { .. })
    ));
    assert!(matches!(
        writer.write(0, 0, f64::INFINITY),
        Err(RecordError::NotWritable { .. })
    ));
    assert!(matches!(
        writer.write(2, 0, 1.0),
        Err(RecordError::NotWritable { .. })
    ));
    writer.write(0, 0, f64::NAN).unwrap(); // a missing sample is not a message
    writer.finish().unwrap();
}
