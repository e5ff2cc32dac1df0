//! The JSON form of sample blocks, which a script publishes.

use proptest::collection::vec;
use proptest::prelude::*;
use spandrel_bus::{
    CaughtUp, DecodeError, FrameBlock, Header, MAX_CHANNELS, Message, NodeState, Pace, SampleBlock,
    StreamState,
};
use std::error::Error as _;

const JSON: &str = "application/json";

fn block() -> SampleBlock {
    SampleBlock {
        header: Header {
            source: "roof".into(),
            epoch: 3,
            sequence: 40,
            time_ns: 1_700_000_000_000_000_000,
        },
        sampling_rate_hz: 100.0,
        pace: Pace::Live,
        channels: 2,
        samples: vec![0.5, -1.0, 2.0, 1e-3],
        state: NodeState::Running,
        clock_quality: None,
    }
}

/// Returns an object with the required fields of [`block`], and with `fields` after them.
fn with(fields: &str) -> String {
    format!(
        r#"{{"source":"roof","epoch":3,"sequence":40,"time_ns":1700000000000000000,
            "sampling_rate_hz":100,{fields}}}"#
    )
}

fn decode(text: &str) -> Result<SampleBlock, DecodeError> {
    SampleBlock::decode(JSON, text.as_bytes())
}

#[track_caller]
fn assert_refused(text: &str, reason: &str, named: &str) {
    let error = decode(text).unwrap_err();
    let told = format!("{error}: {:?}", error.source().map(ToString::to_string));
    assert_eq!(error.reason(), reason, "{text}\n  {told}");
    assert!(told.contains(named), "{text}\n  {told}\n  lacks {named}");
}

#[test]
fn omitted_fields_have_the_documented_defaults() {
    assert_eq!(
        decode(&with(r#""samples":[[0.5,-1],[2,1e-3]]"#)).unwrap(),
        block()
    );
}

#[test]
fn every_field_can_be_stated() {
    let text =
        with(r#""pace":"replayed","channels":2,"samples":[[0.5,-1],[2,0.001]],"state":"ended""#);
    let expected = SampleBlock {
        pace: Pace::Replayed,
        state: StreamState::Ended,
        ..block()
    };
    assert_eq!(decode(&text).unwrap(), expected);
}

/// The block of the page, as printed.
#[test]
fn the_example_of_the_page_is_accepted() {
    let page = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/topics.md");
    let page = std::fs::read_to_string(page).unwrap();
    let (_, example) = page.split_once("```json samples\n").unwrap();
    let (example, _) = example.split_once("\n```").unwrap();
    let found = decode(example).unwrap();
    assert_eq!(found.header.time_ns, 1_790_000_000_500_000_000);
    assert_eq!((found.channels, found.iter().len()), (2, 2));
    assert!(found.samples[2].is_nan());
    assert_eq!(found.samples[3], -0.002);
}

#[test]
fn a_plain_list_contains_one_channel_unless_channels_is_stated() {
    let one = decode(&with(r#""samples":[0.5,-1,2,1e-3]"#)).unwrap();
    assert_eq!((one.channels, one.iter().len()), (1, 4));
    let two = decode(&with(r#""channels":2,"samples":[0.5,-1,2,1e-3]"#)).unwrap();
    assert_eq!(two, block());
}

#[test]
fn the_encoding_may_name_the_version() {
    let text = with(r#""samples":[[0.5,-1],[2,1e-3]]"#);
    let found = SampleBlock::decode("application/json;spandrel.samples.v1", text.as_bytes());
    assert_eq!(found.unwrap(), block());
}

#[test]
fn null_is_a_missing_sample() {
    for samples in ["[null,1,null]", "[[null],[1],[null]]"] {
        let found = decode(&with(&format!(r#""samples":{samples}"#))).unwrap();
        let missing: Vec<bool> = found.samples.iter().map(|value| value.is_nan()).collect();
        assert_eq!(missing, [true, false, true], "{samples}");
    }
}

#[test]
fn end_of_a_stream_requires_only_the_number_of_channels() {
    let end = decode(&with(r#""channels":2,"samples":[],"state":"ended""#)).unwrap();
    assert_eq!((end.channels, end.state), (2, StreamState::Ended));
    let refused = with(r#""samples":[],"state":"ended""#);
    assert_refused(&refused, "undecodable", "channels is missing");
}

#[test]
fn an_unsupported_version_or_type_is_refused_with_both_supported_encodings() {
    let text = with(r#""samples":[1]"#);
    for found in [
        "application/json;spandrel.samples.v2",
        "application/json;spandrel.frames.v1",
        "text/json",
    ] {
        let error = SampleBlock::decode(found, text.as_bytes()).unwrap_err();
        let told = error.to_string();
        for part in [
            found,
            "application/postcard;spandrel.samples.v1",
            "application/json;spandrel.samples.v1",
        ] {
            assert!(told.contains(part), "{told}");
        }
        assert_eq!(error.reason(), "encoding");
    }
}

#[test]
fn frames_are_not_accepted_as_json() {
    assert!(matches!(
        FrameBlock::decode(JSON, b"{}"),
        Err(DecodeError::Encoding { .. })
    ));
}

#[test]
fn error_names_the_defect_of_malformed_samples() {
    let refused = [
        (
            r#""samples":[[1,2],[3]]"#,
            "item 1 of samples is a row of 1 values, must be a row of 2",
        ),
        (
            r#""samples":[1,[2]]"#,
            "item 1 of samples is a row of 1 values, must be a number",
        ),
        (
            r#""samples":[[1],2]"#,
            "item 1 of samples is a number, must be a row of 1 values",
        ),
        (r#""samples":[[]]"#, "empty row"),
        (r#""samples":[[[1]]]"#, "expected f64"),
        (
            r#""samples":["1"]"#,
            "expected a number, null for a missing sample",
        ),
        (
            r#""samples":[true]"#,
            "expected a number, null for a missing sample",
        ),
        (r#""samples":{"roof":[1]}"#, "expected a list of samples"),
        (r#""samples":[NaN]"#, "expected value at line"),
        (r#""samples":[1e999]"#, "number out of range"),
        (
            r#""channels":1,"samples":[[1,2]]"#,
            "channels is 1, must be 2",
        ),
        (r#""samples":[1],"chanels":1"#, "unknown field `chanels`"),
        (
            r#""samples":[1],"pace":"fast""#,
            "expected `live` or `replayed`",
        ),
        (
            r#""samples":[1],"state":"over""#,
            "expected `running` or `ended`",
        ),
        (r#""state":"running""#, "missing field `samples`"),
        (
            r#""samples":[1],"samples":[2]"#,
            "duplicate field `samples`",
        ),
    ];
    for (fields, named) in refused {
        assert_refused(&with(fields), "undecodable", named);
    }
    for field in ["source", "epoch", "sequence", "time_ns", "sampling_rate_hz"] {
        let text = with(r#""samples":[1]"#).replace(&format!("\"{field}\""), "\"pace\"");
        let text = text.replacen(r#""pace":"roof""#, r#""pace":"live""#, 1);
        assert_eq!(decode(&text).unwrap_err().reason(), "undecodable", "{text}");
    }
}

#[test]
fn counts_are_checked_as_in_the_binary_form() {
    let wide = vec!["0"; MAX_CHANNELS + 1].join(",");
    for (fields, named) in [
        (
            r#""channels":3,"samples":[1,2]"#.to_owned(),
            "samples has 2 values, must have 3",
        ),
        (r#""channels":0,"samples":[1]"#.to_owned(), "channels is 0"),
        (format!(r#""samples":[[{wide}]]"#), "channels is 4097"),
    ] {
        assert_refused(&with(&fields), "malformed", named);
    }
    let slow =
        with(r#""samples":[1]"#).replace("\"sampling_rate_hz\":100", "\"sampling_rate_hz\":0");
    assert_refused(&slow, "malformed", "sampling rate is 0 Hz");
    let late =
        with(r#""samples":[1]"#).replace("\"sequence\":40", "\"sequence\":18446744073709551615");
    assert_refused(&late, "malformed", "exceeds the largest sequence number");
}

#[test]
fn an_infinite_sample_is_not_written_as_a_missing_one() {
    let mut block = block();
    block.samples[1] = f64::INFINITY;
    let error = serde_json::to_string(&block).unwrap_err().to_string();
    assert!(error.contains("inf"), "{error}");
}

#[test]
fn caught_up_reply_may_be_json() {
    let text = r#"{"source":"roof","epoch":3,"sequence":44}"#;
    let at = CaughtUp {
        header: Header {
            sequence: 44,
            time_ns: 0,
            ..block().header
        },
        state: StreamState::Running,
    };
    let encoding = "application/json;spandrel.caught-up.v1";
    assert_eq!(CaughtUp::decode(encoding, text.as_bytes()).unwrap(), at);
    let written = serde_json::to_vec(&at).unwrap();
    assert_eq!(CaughtUp::decode(encoding, &written).unwrap(), at);
}

/// Returns a value of a field: usually the valid one, sometimes none or another one.
fn field(valid: &'static str) -> impl Strategy<Value = Option<&'static str>> {
    const OTHERS: [&str; 12] = [
        "null",
        "-1",
        "0",
        "1",
        "1e300",
        "18446744073709551615",
        "[]",
        "[[]]",
        "[1,2,3]",
        "[1,[2]]",
        "\"live\"",
        "{}",
    ];
    prop_oneof![
        8 => Just(Some(valid)),
        1 => Just(None),
        2 => proptest::sample::select(&OTHERS[..]).prop_map(Some),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 1000, ..ProptestConfig::default() })]

    #[test]
    fn samples_survive_json_bit_for_bit(
        epoch: u64,
        sequence in 0u64..1 << 60,
        time_ns: i64,
        sampling_rate_hz in 1e-3..1e6_f64,
        replayed: bool,
        ended: bool,
        channels in 1u16..5,
        values in vec(prop_oneof![
            9 => any::<f64>().prop_filter("finite", |value| value.is_finite()),
            1 => Just(f64::NAN),
        ], 0..40),
    ) {
        let channel_count = usize::from(channels);
        let rows = values.len() / channel_count;
        let block = SampleBlock {
            header: Header { source: "roof".into(), epoch, sequence, time_ns },
            sampling_rate_hz,
            pace: if replayed { Pace::Replayed } else { Pace::Live },
            channels,
            samples: values[..rows * channel_count].to_vec(),
            state: if ended { StreamState::Ended } else { StreamState::Running },
            clock_quality: None,
        };
        let text = serde_json::to_vec(&block).unwrap();
        let found = SampleBlock::decode("application/json;spandrel.samples.v1", &text).unwrap();
        let bits = |block: &SampleBlock| block.samples.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
        prop_assert_eq!(bits(&found), bits(&block));
        prop_assert_eq!(found.sampling_rate_hz.to_bits(), sampling_rate_hz.to_bits());
        prop_assert_eq!(&found.header, &block.header);
        prop_assert_eq!((found.pace, found.channels, found.state), (block.pace, channels, block.state));
        // The binary form of the same block is unaffected.
        let binary = SampleBlock::decode(&SampleBlock::encoding(), &block.encode().unwrap()).unwrap();
        prop_assert_eq!(bits(&binary), bits(&block));
    }

    #[test]
    fn arbitrary_fields_give_an_error_or_valid_samples(
        values in (
            field("\"roof\""), field("3"), field("40"), field("5"), field("100"),
            field("\"live\""), field("2"), field("[[1,null],[3,4]]"), field("\"ended\""),
        ),
    ) {
        let (source, epoch, sequence, time_ns, rate, pace, channels, samples, state) = values;
        let fields: Vec<String> = [
            ("source", source), ("epoch", epoch), ("sequence", sequence), ("time_ns", time_ns),
            ("sampling_rate_hz", rate), ("pace", pace), ("channels", channels),
            ("samples", samples), ("state", state),
        ]
        .into_iter()
        .filter_map(|(name, value)| Some(format!("\"{name}\":{}", value?)))
        .collect();
        if let Ok(block) = decode(&format!("{{{}}}", fields.join(","))) {
            prop_assert!(block.check().is_ok(), "{block:?}");
        }
    }
}
