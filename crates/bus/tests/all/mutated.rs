//! Decoding of real messages of every type, damaged in many ways.
//!
//! Decoding must return an error or a valid message. It must never panic, or use more memory than
//! the message justifies.

use crate::decoders::{Decode, TYPES};
use proptest::prelude::*;
use spandrel_bus::{
    Acknowledgement, AlertMessage, Annotation, CaughtUp, ChannelState, ConditionDisplay,
    Description, EpochDisplay, Estimate, EstimateBlock, EstimateFlags, Event, FeedbackMessage,
    FitDisplay, FrameBlock, Header, HistoryLog, HistorySpan, JudgementCourse, JudgementDisplay,
    JudgementLog, LocalDensity, LocalMessage, LossDisplay, MAX_MESSAGE_BYTES, Maintenance,
    MaskedSpan, Message, ModeDisplay, ModelClassDisplay, MonitoringDisplay, MotionNumbers,
    NodeDisplay, NodeLineage, NoiseDisplay, OutlierDisplay, Pace, ParameterDisplay, Progress,
    ReportPage, SampleBlock, ScreenedChannel, SensorHealthDisplay, SpectrumDisplay, StateMessage,
    Status, StreamState, ToldMotion, ToldSamples, WaveformDisplay,
};

use std::path::Path;

/// Memory allowed in addition to the message. A list reserves at most 1 MiB in advance, and lists
/// are nested.
const RESERVED_BYTES: u64 = 4 << 20;
/// Memory allowed per byte of a message. A number in JSON occupies eight bytes, in a list that may
/// just have doubled.
const BYTES_PER_BYTE: u64 = 40;

fn header() -> Header {
    Header {
        source: "roof".into(),
        epoch: 3,
        sequence: 1_000,
        time_ns: 1_700_000_000_000_000_000,
    }
}

fn estimate() -> Estimate {
    Estimate {
        mean: vec![1.0, 0.9],
        covariance: vec![0.01, 0.001, 0.02],
        noise_mean: vec![0.5],
        noise_covariance: vec![0.01],
        innovations: vec![0.1, -0.2],
        normalised_innovation_squared: 1.2,
        log_evidence: -3.0,
        used_channels: 2,
        flags: EstimateFlags::working(),
        excluded: spandrel_bus::Excluded::None,
        sustained_information: vec![100.0, 50.0],
    }
}

fn motion(count: usize) -> MotionNumbers {
    MotionNumbers {
        mean: vec![0.1; count],
        variance: vec![0.01; count],
    }
}

/// Returns a real message of each type, with the decoder of the fuzz target.
fn messages() -> Vec<(&'static str, Vec<u8>, Decode)> {
    let messages = encoded().into_iter().zip(TYPES);
    let messages = messages.map(|((name, bytes), decode)| (name, bytes, *decode));
    messages.collect()
}

fn decoder(name: &str) -> Decode {
    let mut messages = messages().into_iter();
    messages.find(|message| message.0 == name).unwrap().2
}

/// Returns these messages in the order of the fuzz target.
fn encoded() -> Vec<(&'static str, Vec<u8>)> {
    fn binary<M: Message>(message: &M) -> (&'static str, Vec<u8>) {
        (M::TYPE, message.encode().unwrap())
    }
    fn text<M: Message>(text: &str) -> (&'static str, Vec<u8>) {
        let message = M::decode("application/json", text.as_bytes())
            .unwrap_or_else(|error| panic!("{error:?}: {text}"));
        (M::TYPE, message.encode().unwrap())
    }
    let samples = SampleBlock {
        header: header(),
        sampling_rate_hz: 100.0,
        pace: Pace::Live,
        channels: 2,
        samples: (0..20).map(f64::from).collect(),
        state: StreamState::Running,
        clock_quality: None,
    };
    let frames = FrameBlock {
        header: header(),
        t0_ns: 0,
        sampling_rate_hz: 100.0,
        channels: 3,
        values: (0..30).map(f64::from).collect(),
        state: StreamState::Running,
    };
    let estimates = EstimateBlock {
        header: header(),
        term: 0,
        t0_ns: 0,
        sampling_rate_hz: 100.0,
        parameters: 2,
        noise_parameters: 1,
        channels: 2,
        estimates: vec![estimate(); 3],
        state: StreamState::Running,
    };
    let local = LocalMessage {
        header: header(),
        pace: Pace::Live,
        density: Some(LocalDensity {
            mean: vec![1.0, 0.9],
            covariance: vec![0.01, 0.001, 0.02],
            lineage: Some(NodeLineage {
                own: 4,
                answers: vec![1, 2, 3],
            }),
            motion: Some(ToldMotion::Samples(ToldSamples::new(
                &[0.1, f64::NAN, -3.2, 700.0],
                &[-5, 2],
            ))),
        }),
        restarts: 1,
        samples: 250,
        screening: vec![
            ScreenedChannel {
                state: ChannelState::Screening,
                rejected: 3,
                screened: 1000,
                recent_share: 0.01,
                scale: 1e-3,
                masked: Some(MaskedSpan {
                    from_ns: 1,
                    to_ns: 3,
                    samples: 3
                }),
            };
            2
        ],
        state: StreamState::Running,
    };
    let feedback = FeedbackMessage {
        header: header(),
        node_epoch: 2,
        answers: 5,
        nodes: 3,
        mean: vec![1.0, 0.9],
        covariance: vec![0.01, 0.001, 0.02],
        motion: Some(motion(4)),
        responses: vec![None, Some(ToldMotion::Numbers(motion(2))), None],
    };
    let alert = "{\"structure\":\"demo\",\"parameter\":\"storey-2\",\"time_ns\":5,\"state\":\"raised\",\"since_ns\":4,\
                 \"rule_loss\":0.05,\"rule_credibility\":0.99,\"credibility\":1.0,\"loss\":0.1,\
                 \"loss_interval\":{\"level\":0.95,\"low\":0.09,\"high\":0.11},\"mean\":0.9,\"std\":0.003,\"reference\":1.0,\
                 \"reference_std\":0.0,\"acknowledged_by\":null,\"why\":\"it has lost 10 %\"}";
    let seen = "{\"structure\":\"demo\",\"parameter\":\"storey-2\",\"time_ns\":5,\"who\":\"Grace\",\"note\":\"seen\"}";
    let event = "{\"structure\":\"demo\",\"time_ns\":5,\"kind\":\"restart\",\"subject\":\"demo\",\"what\":\"filter restarted\",\
                 \"why\":\"diverged\"}";
    vec![
        binary(&samples),
        binary(&frames),
        binary(&estimates),
        binary(&local),
        binary(&feedback),
        binary(&Progress {
            header: header(),
            done: 7,
            kept: 5,
        }),
        binary(&CaughtUp {
            header: header(),
            state: StreamState::Ended,
        }),
        text::<AlertMessage>(alert),
        text::<Acknowledgement>(seen),
        text::<Event>(event),
        text::<ParameterDisplay>(
            "{\"structure\":\"demo\",\"parameter\":\"storey-2\",\"time_ns\":5,\"mean\":1.0,\"std\":0.2,\
             \"interval\":{\"level\":0.95,\"low\":0.6,\"high\":1.4}}",
        ),
        text::<NoiseDisplay>(
            "{\"structure\":\"demo\",\"name\":\"ground\",\"time_ns\":5,\"mean\":1.0,\"std\":0.2}",
        ),
        text::<OutlierDisplay>(
            "{\"structure\":\"demo\",\"channel\":\"roof\",\"time_ns\":5,\"state\":\"screening\",\"flagged\":1,\"rejected\":2,\
             \"screened\":30,\"recent_share\":0.1,\"scale\":0.5,\"masked\":{\"from_ns\":1,\"to_ns\":2,\"samples\":3}}",
        ),
        text::<SensorHealthDisplay>(
            "{\"structure\":\"demo\",\"node\":\"roof\",\"time_ns\":5,\"channels\":[{\"channel\":\"roof-x\",\"state\":\"faulty\",\
             \"probability\":0.999,\"fault\":\"gain\",\"gain\":0.7,\"delay_s\":0.001,\"coherence\":0.98}]}",
        ),
        text::<ConditionDisplay>(
            "{\"structure\":\"demo\",\"name\":\"deck-temperature\",\"time_ns\":5,\"value\":-3.5,\"unit\":\"degC\",\
             \"interval_s\":600.0,\"instrument\":\"Pt100 in the deck\"}",
        ),
        text::<ModelClassDisplay>(
            "{\"structure\":\"demo\",\"time_ns\":5,\"classes\":[{\"class\":\"baseline\",\"plausibility\":0.8},\
             {\"class\":\"soft\",\"plausibility\":0.2}],\"leading\":\"baseline\",\"believed\":\"baseline\",\"calibrations\":1,\
             \"calibration\":{\"time_ns\":4,\"class\":\"soft\",\"change\":-0.05}}",
        ),
        text::<NodeDisplay>(
            "{\"structure\":\"demo\",\"node\":\"roof\",\"time_ns\":5,\"state\":\"used\",\"distance\":4.0,\"distance_limit\":3.0,\
             \"weight\":0.5625,\"excluded_since_ns\":null,\"excluded_share\":0.0,\"messages\":10,\"bytes_received\":1000,\"bytes_sent\":500,\
             \"refused\":{\"flood\":1},\"restarts\":0}",
        ),
        text::<Status>(
            "{\"structure\":\"demo\",\"service\":\"ingest\",\"id\":\"ingest\",\"time_ns\":5,\"lag_s\":0.1,\"done\":12,\
             \"drops\":{\"lost-items\":1,\"fetched-items\":2},\"restarts\":0,\"version\":\"0.1.0\"}",
        ),
        text::<Description>(
            "{\"structure\":\"demo\",\"text\":\"[structure]\\nname = \\\"demo\\\"\\n\"}",
        ),
        text::<HistorySpan>(
            "{\"structure\":\"demo\",\"kind\":\"parameter\",\"name\":\"storey-2\",\"resolution_s\":60,\"kept_from_s\":1.0,\
             \"rows\":{\"time_s\":[1.0,2.0],\"count\":[1,2],\"mean\":[1.0,1.0],\"std\":[0.1,0.1],\"spread\":[0.0,0.1],\
             \"least\":[0.9,0.9],\"largest\":[1.1,1.1],\"low\":[0.8,0.8],\"high\":[1.2,1.2],\
             \"probability_of_loss\":[0.0,0.1]}}",
        ),
        text::<HistoryLog>(&format!(
            "{{\"structure\":\"demo\",\"alerts\":[{alert}],\"acknowledgements\":[{seen}],\"events\":[{event}]}}"
        )),
        binary(&StateMessage {
            header: header(),
            term: 3,
            checkpoint: (0..200).collect(),
        }),
        text::<FitDisplay>(
            "{\"structure\":\"demo\",\"time_ns\":5,\"verdict\":\"doubtful\",\"reasons\":[\"excess-noise\"],\"follows_jump\":false,\
             \"channels\":[{\"channel\":\"roof\",\"largest_autocorrelation\":0.35,\"explained_share\":0.8,\
             \"excitation_correlation\":-0.1,\"noise_ratio\":1.2}]}",
        ),
        text::<LossDisplay>(
            "{\"structure\":\"demo\",\"parameter\":\"storey-2\",\"time_ns\":5,\"loss\":0.04,\
             \"interval\":{\"level\":0.95,\"low\":0.01,\"high\":0.07},\"probability_of_loss\":0.4,\"rule_loss\":0.05,\
             \"rule_credibility\":0.95,\"reference\":1.0,\"reference_std\":0.01}",
        ),
        text::<MonitoringDisplay>(
            "{\"structure\":\"demo\",\"time_ns\":7,\"measured_ns\":5,\"state\":\"degraded\",\"since_ns\":6,\
             \"reasons\":[\"33 % of the samples of roof are used\"],\
             \"parameters\":[{\"parameter\":\"storey-2\",\"state\":\"watching\",\"why\":null,\"sustained_std\":0.01}],\
             \"channels\":[{\"channel\":\"roof\",\"state\":\"degraded\",\"used_share\":0.33}]}",
        ),
        ("samples-json", serde_json::to_vec(&samples).unwrap()),
        (
            "caught-up-json",
            br#"{"source":"roof","epoch":3,"sequence":44,"state":"ended"}"#.to_vec(),
        ),
        text::<Maintenance>(
            "{\"structure\":\"demo\",\"parameter\":\"storey-2\",\"time_ns\":5,\"until_ns\":3600000000005,\
             \"who\":\"ada\",\"reason\":\"new bearings\"}",
        ),
        text::<JudgementDisplay>(
            "{\"structure\":\"demo\",\"quantity\":\"storey-2\",\"time_ns\":9,\"day_ns\":0,\"epoch_ns\":8,\"epochs\":96,\"measured\":true,\
             \"state\":\"judged\",\"change\":{\"kind\":\"lasting-loss\",\"found_ns\":0,\"since_ns\":0,\"loss\":0.05,\
             \"interval\":{\"level\":0.95,\"low\":0.04,\"high\":0.06}},\"sentence\":\"storey-2 \
             has lost 5 % of stiffness.\",\
             \"expectation\":{\"measured\":0.95,\"expected\":1.0,\"interval\":{\"level\":0.95,\"low\":0.98,\"high\":1.02},\
             \"residual\":-3.0,\"ln_evidence\":9.0,\"ln_threshold\":8.2,\"cusum_share\":1.1},\
             \"false_alarms_per_year\":0.1}",
        ),
        text::<JudgementCourse>(
            "{\"structure\":\"demo\",\"quantity\":\"storey-2\",\"kind\":\"stiffness\",\
             \"conditions\":[{\"name\":\"deck\",\"unit\":\"degC\"}],\"false_alarms_per_year\":0.1,\"loss\":0.02,\
             \"commissioning_days\":365,\"reference\":{\"from_ns\":0,\"to_ns\":9,\"coverage\":0.95,\"scatter\":0.001,\
             \"knows_frost\":true,\"promised_per_year\":0.1,\"achieved_per_year\":0.05,\
             \"delays\":[{\"loss\":0.05,\"median_days\":6,\"found_in_a_month\":0.99}]},\"kept_from_ns\":0,\"annotations\":[],\
             \"rows\":[{\"day_ns\":0,\"state\":\"judged\",\"change\":null,\"sentence\":\"storey-2 \
             shows no lasting change.\",\
             \"epochs\":96,\"measured\":0.95,\"conditions\":[14.74],\"expectation\":{\"measured\":0.95,\"expected\":1.0,\
             \"interval\":{\"level\":0.95,\"low\":0.9,\"high\":1.1},\"residual\":-1.0,\"ln_evidence\":1.0,\
             \"ln_threshold\":8.2,\"cusum_share\":0.1}},{\"day_ns\":86400000000000,\"state\":\"no-statement\",\
             \"change\":null,\"sentence\":\"\",\"epochs\":0,\"measured\":null,\"conditions\":[],\"expectation\":null}]}",
        ),
        text::<Annotation>(
            "{\"structure\":\"demo\",\"quantity\":\"storey-2\",\"time_ns\":9,\"from_ns\":5,\"to_ns\":8,\"kind\":\"repair\",\
             \"effect\":\"new-reference\",\"who\":\"ada\",\"text\":\"new bearings\"}",
        ),
        text::<ModeDisplay>(
            "{\"structure\":\"demo\",\"mode\":\"bending-1\",\"time_ns\":600000000000,\"epoch_s\":600.0,\"epochs\":1,\
             \"state\":\"paired\",\"partner\":\"torsion-1\",\"estimate\":{\"frequency_hz\":3.9,\"frequency_std_hz\":0.004,\
             \"damping\":0.01,\"damping_std\":0.001,\"shape\":[{\"channel\":\"span-1\",\"value\":[1.0,0.0],\"std\":0.0}],\
             \"amplitude\":0.02},\"presence\":1.0,\"machine\":false,\"declared_hz\":3.9}",
        ),
        text::<WaveformDisplay>(
            "{\"structure\":\"demo\",\"node\":\"roof\",\"time_ns\":5,\"frames\":100,\"bucket_s\":0.5,\"channels\":[\
             {\"channel\":\"roof-x\",\"missing\":50,\"level\":{\"mean\":0.25,\"rms\":0.5,\"last\":-0.125},\
             \"extremes\":[[-1.5,0.75],null]}]}",
        ),
        text::<SpectrumDisplay>(
            "{\"structure\":\"demo\",\"node\":\"roof\",\"time_ns\":5,\"window_s\":20.48,\"frequencies_hz\":[0.5,1.0],\
             \"channels\":[{\"channel\":\"roof-x\",\"windows\":5,\"density\":[1e-6,0.0]}]}",
        ),
        text::<ReportPage>(
            "{\"structure\":\"demo\",\"report\":\"2022-12-20t10-34-01z\",\"html\":\"<p>strong</p>\",\
             \"json\":\"{}\"}",
        ),
        text::<EpochDisplay>(
            "{\"structure\":\"demo\",\"quantity\":\"storey-2\",\"time_ns\":450000000000,\"epoch_s\":900.0,\
             \"ln_mean\":-0.05,\"ln_std\":0.002,\"amplitude\":-2.5,\"conditions\":[\
             {\"name\":\"deck\",\"unit\":\"degC\",\"value\":14.74},{\"name\":\"rms\",\"unit\":\"log10\",\"value\":-2.5}],\
             \"measured\":true}",
        ),
        text::<JudgementLog>(
            "{\"structure\":\"demo\",\"changes\":[{\"quantity\":\"storey-2\",\"state\":\"acknowledged\",\"time_ns\":9,\
             \"change\":{\"kind\":\"lasting-loss\",\"found_ns\":5,\"since_ns\":0,\"loss\":0.05,\
             \"interval\":{\"level\":0.95,\"low\":0.04,\"high\":0.06}},\
             \"seen\":{\"who\":\"ada\",\"text\":\"crack\",\"time_ns\":9},\
             \"sentence\":\"storey-2 has lost 5 % of stiffness.\"}]}",
        ),
    ]
}

/// A way to damage a message.
#[derive(Clone, Debug)]
enum Damage {
    Flip {
        at: usize,
        bit: u8,
    },
    Set {
        at: usize,
        to: u8,
    },
    Cut {
        at: usize,
        length: usize,
    },
    Repeat {
        at: usize,
        length: usize,
        times: usize,
    },
    Insert {
        at: usize,
        bytes: Vec<u8>,
    },
    /// A varint that claims the maximum number of items.
    Claim {
        at: usize,
    },
    End {
        at: usize,
    },
}

fn damage() -> impl Strategy<Value = Damage> {
    let at = || 0usize..2048;
    prop_oneof![
        (at(), 0u8..8).prop_map(|(at, bit)| Damage::Flip { at, bit }),
        (at(), any::<u8>()).prop_map(|(at, to)| Damage::Set { at, to }),
        (at(), 1usize..64).prop_map(|(at, length)| Damage::Cut { at, length }),
        (at(), 1usize..64, 1usize..200).prop_map(|(at, length, times)| Damage::Repeat {
            at,
            length,
            times
        }),
        (at(), proptest::collection::vec(any::<u8>(), 1..16))
            .prop_map(|(at, bytes)| Damage::Insert { at, bytes }),
        at().prop_map(|at| Damage::Claim { at }),
        at().prop_map(|at| Damage::End { at }),
    ]
}

impl Damage {
    fn apply(&self, message: &mut Vec<u8>) {
        if message.is_empty() {
            return;
        }
        let place = |at: usize| at % message.len();
        match *self {
            Self::Flip { at, bit } => {
                let at = place(at);
                message[at] ^= 1 << bit;
            }
            Self::Set { at, to } => {
                let at = place(at);
                message[at] = to;
            }
            Self::Cut { at, length } => {
                let at = place(at);
                message.drain(at..(at + length).min(message.len()));
            }
            Self::Repeat { at, length, times } => {
                let at = place(at);
                let end = (at + length).min(message.len());
                let part = message[at..end].repeat(times);
                message.splice(end..end, part);
            }
            Self::Insert { at, ref bytes } => {
                let at = place(at);
                message.splice(at..at, bytes.iter().copied());
            }
            Self::Claim { at } => {
                let at = place(at);
                let claim = [0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0x01];
                message.splice(at..=at, claim);
            }
            Self::End { at } => message.truncate(place(at)),
        }
    }
}

/// Decodes bytes and checks the memory used.
#[track_caller]
fn check(name: &str, bytes: &[u8], decode: Decode) {
    let taken = allocation_counter::measure(|| {
        let _ = decode(bytes); // a rejection is allowed
    });
    let allowed = RESERVED_BYTES + BYTES_PER_BYTE * bytes.len() as u64;
    assert!(
        taken.bytes_max <= allowed,
        "{name}: {} bytes took {} in memory",
        bytes.len(),
        taken.bytes_max
    );
}

#[test]
fn the_samples_cover_every_type_and_decode() {
    assert_eq!(encoded().len(), TYPES.len());
    for (name, bytes, decode) in messages() {
        check(name, &bytes, decode);
        assert_eq!(decode(&bytes), Ok(()), "{name}");
    }
}

/// The fuzzer starts from these messages, each preceded by the number of its type. `UPDATE_DOCS=1`
/// writes them.
#[test]
fn the_fuzzer_starts_from_real_messages() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/seeds/messages");
    for (number, (name, bytes, _)) in messages().into_iter().enumerate() {
        let path = folder.join(name);
        let seed = [&[number as u8], &bytes[..]].concat();
        if std::env::var_os("UPDATE_DOCS").is_some() {
            std::fs::create_dir_all(&folder).unwrap();
            std::fs::write(&path, &seed).unwrap();
        }
        let kept = std::fs::read(&path).unwrap_or_default();
        assert!(
            kept == seed,
            "fuzz/seeds/messages/{name} is another message; UPDATE_DOCS=1 rewrites it"
        );
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 2000, ..ProptestConfig::default() })]

    #[test]
    fn damaged_messages_give_an_error_or_a_valid_message(
        which in 0..TYPES.len(),
        damages in proptest::collection::vec(damage(), 1..5),
    ) {
        let (name, mut bytes, decode) = messages().swap_remove(which);
        damages.iter().for_each(|damage| damage.apply(&mut bytes));
        check(name, &bytes, decode);
    }

    #[test]
    fn messages_of_another_type_give_an_error_or_a_valid_message(from in 0..TYPES.len(), to in 0..TYPES.len()) {
        let messages = messages();
        let (name, _, decode) = messages[to];
        check(name, &messages[from].1, decode);
    }
}

#[test]
fn a_claimed_length_reserves_no_memory() {
    for (name, bytes, decode) in messages() {
        for at in 0..bytes.len() {
            let mut claiming = bytes.clone();
            Damage::Claim { at }.apply(&mut claiming);
            check(name, &claiming, decode);
        }
    }
}

#[test]
fn largest_message_needs_no_more_memory_than_its_content() {
    // As many minimal items as possible: zeros decode as absent options, empty lists and small
    // numbers.
    for (name, bytes, decode) in messages() {
        for fill in [0_u8, 1, b'0', b'[', b' '] {
            let mut large = bytes.clone();
            large.resize(MAX_MESSAGE_BYTES, fill);
            check(name, &large, decode);
        }
    }
    // The shortest samples in JSON. Each takes two bytes here and eight in memory.
    for (begin, each) in [("[0", ",0"), ("[[0]", ",[0]"), ("[[null]", ",[null]")] {
        let start = format!(
            "{{\"source\":\"roof\",\"epoch\":3,\"sequence\":0,\"time_ns\":0,\"sampling_rate_hz\":100,\
             \"channels\":1,\"samples\":{begin}"
        );
        let count = (MAX_MESSAGE_BYTES - start.len() - 2) / each.len();
        let text = [start.as_str(), &each.repeat(count), "]}"].concat();
        check("samples-json", text.as_bytes(), decoder("samples-json"));
    }
    // A single list of absent responses. Each takes one byte here and tens of bytes in memory.
    let feedback = FeedbackMessage {
        header: header(),
        node_epoch: 0,
        answers: 0,
        nodes: 0,
        mean: vec![1.0],
        covariance: vec![1.0],
        motion: None,
        responses: vec![None; 4096],
    };
    let mut bytes = feedback.encode().unwrap();
    bytes.truncate(bytes.len() - 4096 - 2);
    bytes.extend([0x80, 0x80, 0x80, 0x04]); // claims 8,388,608 items
    bytes.resize(MAX_MESSAGE_BYTES, 0);
    let taken = allocation_counter::measure(|| {
        let _ = decoder("feedback")(&bytes); // a rejection is allowed
    });
    assert!(
        taken.bytes_max < 1 << 20,
        "8 MiB of absent responses took {} bytes",
        taken.bytes_max
    );
}
