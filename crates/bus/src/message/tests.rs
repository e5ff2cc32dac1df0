use proptest::collection::vec;
use proptest::prelude::*;

use super::*;
use crate::name::Name;

fn header(sequence: u64) -> Header {
    Header {
        source: "roof".into(),
        epoch: 1,
        sequence,
        time_ns: 1_700_000_000_000_000_000,
    }
}

fn frames(sequence: u64, values: Vec<f64>) -> FrameBlock {
    FrameBlock {
        header: header(sequence),
        t0_ns: 0,
        sampling_rate_hz: 200.0,
        channels: 2,
        values,
        state: StreamState::Running,
    }
}

fn samples(sequence: u64, time_ns: i64, count: usize) -> SampleBlock {
    SampleBlock {
        header: Header {
            time_ns,
            ..header(sequence)
        },
        sampling_rate_hz: 120.0,
        pace: Pace::Live,
        channels: 2,
        samples: (0..2 * count).map(|v| v as f64).collect(),
        state: NodeState::Running,
        clock_quality: None,
    }
}

fn estimate() -> Estimate {
    Estimate {
        mean: vec![1.0, 0.9],
        covariance: vec![0.1, 0.0, 0.2],
        noise_mean: vec![0.5],
        noise_covariance: vec![0.01],
        innovations: vec![f64::NAN, 0.1],
        normalised_innovation_squared: 1.0,
        log_evidence: -3.0,
        used_channels: 1,
        flags: EstimateFlags::working(),
        excluded: Excluded::None,
        sustained_information: vec![100.0, 50.0],
    }
}

fn estimates(count: usize) -> EstimateBlock {
    EstimateBlock {
        header: header(7),
        term: 0,
        t0_ns: 0,
        sampling_rate_hz: 200.0,
        parameters: 2,
        noise_parameters: 1,
        channels: 2,
        estimates: vec![estimate(); count],
        state: StreamState::Ended,
    }
}

fn parameter() -> ParameterDisplay {
    ParameterDisplay {
        structure: Name::new("tower").unwrap(),
        parameter: Name::new("storey-2").unwrap(),
        time_ns: 5,
        mean: 0.9,
        std: 0.01,
        interval: CredibleInterval {
            level: 0.95,
            low: 0.88,
            high: 0.92,
        },
    }
}

#[test]
fn encoding_names_type_and_version() {
    assert_eq!(
        FrameBlock::encoding(),
        "application/postcard;spandrel.frames.v1"
    );
    assert_eq!(
        ParameterDisplay::encoding(),
        "application/json;spandrel.parameter.v2"
    );
}

#[test]
fn error_names_both_encodings_of_another_version() {
    let payload = frames(0, vec![1.0, 2.0]).encode().unwrap();
    let error =
        FrameBlock::decode("application/postcard;spandrel.frames.v2", &payload).unwrap_err();
    let text = error.to_string();
    assert!(text.contains("spandrel.frames.v1") && text.contains("spandrel.frames.v2"));
    assert_eq!(error.reason(), "encoding");
}

#[test]
fn another_type_is_refused() {
    let payload = frames(0, vec![1.0, 2.0]).encode().unwrap();
    assert!(matches!(
        EstimateBlock::decode(&FrameBlock::encoding(), &payload),
        Err(DecodeError::Encoding { .. })
    ));
}

#[test]
fn trailing_bytes_are_refused() {
    let mut payload = frames(0, vec![1.0, 2.0]).encode().unwrap();
    payload.push(0);
    assert!(matches!(
        FrameBlock::decode(&FrameBlock::encoding(), &payload),
        Err(DecodeError::Trailing { bytes: 1 })
    ));
}

#[test]
fn bytes_truncated_at_any_length_are_rejected() {
    let payload = estimates(2).encode().unwrap();
    for end in 0..payload.len() {
        let error = EstimateBlock::decode(&EstimateBlock::encoding(), &payload[..end]).unwrap_err();
        assert_eq!(error.reason(), "undecodable", "{end}");
    }
}

#[test]
fn large_payloads_are_refused_before_decoding() {
    let payload = vec![0; MAX_MESSAGE_BYTES + 1];
    assert!(matches!(
        FrameBlock::decode(&FrameBlock::encoding(), &payload),
        Err(DecodeError::TooLarge { .. })
    ));
}

#[test]
fn values_must_fill_whole_frames() {
    assert_eq!(
        frames(0, vec![1.0, 2.0, 3.0]).check(),
        Err(Malformed::Length {
            what: "values",
            found: 3,
            expected: 4
        })
    );
}

#[test]
fn missing_values_are_encoded_and_infinite_values_are_rejected() {
    let decoded = FrameBlock::decode(
        &FrameBlock::encoding(),
        &frames(0, vec![f64::NAN, 2.0]).encode().unwrap(),
    )
    .unwrap();
    assert!(decoded.values[0].is_nan());
    assert!(frames(0, vec![f64::INFINITY, 2.0]).encode().is_err());
}

#[test]
fn rates_counts_and_numbers_out_of_range_are_refused() {
    let mut block = frames(0, vec![]);
    block.channels = 0;
    assert!(matches!(block.check(), Err(Malformed::Count { .. })));
    let mut block = frames(0, vec![]);
    block.sampling_rate_hz = f64::NAN;
    assert!(matches!(block.check(), Err(Malformed::Rate { .. })));
    let block = frames(u64::MAX, vec![1.0, 2.0]);
    assert!(matches!(
        block.check(),
        Err(Malformed::SequenceOverflow { .. })
    ));
    let mut block = frames(0, vec![]);
    block.header.source = "x".repeat(MAX_SOURCE_BYTES + 1);
    assert!(matches!(block.check(), Err(Malformed::Text { .. })));
}

#[test]
fn estimate_of_another_shape_is_refused() {
    let mut block = estimates(1);
    block.estimates[0].covariance.push(0.0);
    assert!(matches!(block.check(), Err(Malformed::Length { .. })));
    let mut block = estimates(1);
    block.estimates[0].mean[0] = f64::NAN;
    assert!(matches!(block.check(), Err(Malformed::NotFinite { .. })));
}

#[test]
fn variances_lie_on_the_diagonal() {
    let estimate = estimate();
    assert_eq!(estimate.variance(0), Some(0.1));
    assert_eq!(estimate.variance(1), Some(0.2));
    assert_eq!(estimate.variance(2), None);
}

#[test]
fn item_bytes_bound_the_encoded_size() {
    let (one, two) = (estimates(1), estimates(2));
    let grown = two.encode().unwrap().len() - one.encode().unwrap().len();
    assert!(grown <= one.item_bytes());
    let (one, two) = (frames(0, vec![0.0; 2]), frames(0, vec![0.0; 4]));
    let grown = two.encode().unwrap().len() - one.encode().unwrap().len();
    assert!(grown <= one.item_bytes());
}

#[test]
fn skipping_samples_advances_number_and_time() {
    let mut block = samples(10, 0, 4);
    block.skip(2);
    assert_eq!(block.header.sequence, 12);
    assert_eq!(block.header.time_ns, 16_666_667);
    assert_eq!(block.samples, [4.0, 5.0, 6.0, 7.0]);
}

#[test]
fn blocks_that_continue_are_appended() {
    let mut block = samples(0, 0, 2);
    assert!(block.append(&samples(2, 16_666_667, 1)));
    assert_eq!(block.count(), 3);
}

#[test]
fn blocks_after_a_gap_in_number_or_time_are_not_appended() {
    let mut block = samples(0, 0, 2);
    assert!(!block.append(&samples(3, 16_666_667, 1)));
    assert!(!block.append(&samples(2, 17_000_000, 1)));
    assert_eq!(block.count(), 2);
}

#[test]
fn truncation_removes_the_end_of_the_epoch() {
    let mut block = estimates(3);
    block.truncate(3);
    assert_eq!(block.state, StreamState::Ended);
    block.truncate(2);
    assert_eq!((block.count(), block.state), (2, StreamState::Running));
}

#[test]
fn json_messages_are_decoded_unchanged() {
    let message = parameter();
    let payload = message.encode().unwrap();
    let encoding = ParameterDisplay::encoding();
    assert_eq!(
        ParameterDisplay::decode(&encoding, &payload).unwrap(),
        message
    );
}

#[test]
fn json_without_a_schema_is_accepted() {
    let text = br#"{"structure":"tower","parameter":"storey-2","time_ns":1,"who":"ada"}"#;
    let message = Acknowledgement::decode("application/json", text).unwrap();
    assert_eq!(message.who, "ada");
    assert!(Acknowledgement::decode("application/json;spandrel.event.v1", text).is_err());
}

#[test]
fn json_with_an_invalid_name_or_deviation_is_rejected() {
    let text = br#"{"structure":"To wer","parameter":"storey-2","time_ns":1,"who":"ada"}"#;
    assert!(Acknowledgement::decode("application/json", text).is_err());
    let mut message = parameter();
    message.std = -0.1;
    assert!(message.encode().is_err());
}

proptest! {
    #[test]
    fn frames_are_decoded_bit_for_bit(
        sequence in 0u64..1 << 60,
        epoch: u64,
        t0_ns: i64,
        values in vec(prop_oneof![any::<f64>().prop_filter("finite", |v| v.is_finite()), Just(f64::NAN)], 0..40),
    ) {
        let mut block = frames(sequence, values);
        block.values.truncate(block.values.len() / 2 * 2);
        block.header.epoch = epoch;
        block.t0_ns = t0_ns;
        let back = FrameBlock::decode(&FrameBlock::encoding(), &block.encode().unwrap()).unwrap();
        let bits = |b: &FrameBlock| b.values.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
        prop_assert_eq!(bits(&back), bits(&block));
        prop_assert_eq!(back.header, block.header);
    }

    #[test]
    fn arbitrary_bytes_give_an_error_or_a_valid_message(bytes in vec(any::<u8>(), 0..300)) {
        fn total<M: Message>(bytes: &[u8]) -> Result<(), TestCaseError> {
            if let Ok(message) = M::decode(&M::encoding(), bytes) {
                prop_assert!(message.check().is_ok());
            }
            Ok(())
        }
        total::<SampleBlock>(&bytes)?;
        if let Ok(block) = SampleBlock::decode("application/json", &bytes) {
            prop_assert!(block.check().is_ok());
        }
        total::<FrameBlock>(&bytes)?;
        total::<EstimateBlock>(&bytes)?;
        total::<Progress>(&bytes)?;
        total::<CaughtUp>(&bytes)?;
        total::<ParameterDisplay>(&bytes)?;
        total::<NoiseDisplay>(&bytes)?;
        total::<OutlierDisplay>(&bytes)?;
        total::<SensorHealthDisplay>(&bytes)?;
        total::<WaveformDisplay>(&bytes)?;
        total::<SpectrumDisplay>(&bytes)?;
        total::<ModelClassDisplay>(&bytes)?;
        total::<FitDisplay>(&bytes)?;
        total::<Event>(&bytes)?;
        total::<AlertMessage>(&bytes)?;
        total::<Acknowledgement>(&bytes)?;
        total::<Status>(&bytes)?;
    }

    #[test]
    fn damaged_messages_never_panic(at in 0usize..200, byte: u8) {
        let mut payload = estimates(2).encode().unwrap();
        let at = at % payload.len();
        payload[at] = byte;
        if let Ok(mut block) = EstimateBlock::decode(&EstimateBlock::encoding(), &payload) {
            block.skip(1);
            let _ = block.append(&estimates(1));
        }
    }

    #[test]
    fn skipped_and_appended_blocks_hold_the_same_items(split in 0u64..10, count in 1u64..10) {
        let split = split.min(count);
        let whole = frames(5, (0..2 * count).map(|v| v as f64).collect());
        let (mut front, mut back) = (whole.clone(), whole.clone());
        front.truncate(split);
        back.skip(split);
        prop_assert!(front.append(&back));
        prop_assert_eq!(front.values, whole.values);
    }
}

#[test]
fn shared_samples_are_decoded_bit_for_bit_from_two_bytes_each() {
    let exponents = [-9, 3];
    let (small, large) = (2f64.powi(-9), 8.0);
    let samples: Vec<f64> = (0..50)
        .flat_map(|i| [small * f64::from(i * 100 - 2500), large * f64::from(30 * i)])
        .collect();
    let told = ToldSamples::new(&samples, &exponents);
    assert_eq!(told.samples(), samples);
    let bytes = postcard::to_allocvec(&told).unwrap().len();
    assert!(bytes <= 2 * samples.len() + 6, "{bytes} bytes");

    let odd = [
        f64::NAN,
        0.0,
        f64::INFINITY,
        -0.4 * large,
        small,
        -8.0 * 2f64.powi(31),
        -small,
        8.0 * (2f64.powi(31) - 2.0),
    ];
    let expected = [
        f64::NAN,
        0.0,
        f64::NAN,
        0.0,
        small,
        f64::NAN,
        -small,
        8.0 * (2f64.powi(31) - 2.0),
    ];
    for (found, expected) in ToldSamples::new(&odd, &exponents)
        .samples()
        .into_iter()
        .zip(expected)
    {
        assert!(
            found == expected || (found.is_nan() && expected.is_nan()),
            "{found}, not {expected}"
        );
    }
}

#[test]
fn invalid_shared_samples_are_rejected() {
    let local = |told: ToldSamples| LocalMessage {
        header: header(1),
        pace: Pace::Live,
        density: Some(LocalDensity {
            mean: vec![1.0],
            covariance: vec![0.1],
            lineage: None,
            motion: Some(ToldMotion::Samples(told)),
        }),
        restarts: 0,
        samples: 0,
        screening: Vec::new(),
        state: NodeState::Running,
    };
    assert!(local(ToldSamples::new(&[1.0; 4], &[0, 0])).check().is_ok());
    for (samples, exponents, what) in [
        (3, vec![0, 0], "sent samples"),
        (1, vec![], "channels of sent samples"),
        (1, vec![1001], "exponent of a unit"),
    ] {
        let error = local(ToldSamples::new(&vec![1.0; samples], &exponents))
            .check()
            .unwrap_err()
            .to_string();
        assert!(error.contains(what), "{error}");
    }
}

#[test]
fn quality_of_the_clock_travels_beside_the_payload_of_samples() {
    let plain = samples(0, 5, 3);
    let stated = SampleBlock {
        clock_quality: Some(87),
        ..plain.clone()
    };
    // Readers of former versions read the same payload.
    assert_eq!(stated.encode().unwrap(), plain.encode().unwrap());
    assert_eq!(plain.attachment(), None);
    assert_eq!(stated.attachment().as_deref(), Some("clock-quality=87"));
    let read = |attachment: &str| {
        let mut block = plain.clone();
        block.attach(attachment);
        block.clock_quality
    };
    assert_eq!(read("clock-quality=87"), Some(87));
    for wrong in [
        "clock-quality=101",
        "clock-quality=-1",
        "clock-quality",
        "",
        "87",
    ] {
        assert_eq!(read(wrong), None, "{wrong:?}");
    }
}
