use spandrel_bus::{Block, InstrumentState, SampleBlock, TimeGrid};
use spandrel_record::ReadOptions;

use super::*;
use crate::calibration::Calibration;
use crate::core_input::{Link, Recorded};
use crate::gap::GapReport;
use crate::lines::LineFormat;
use crate::source_plan::{
    ConditionPlan, DropFolder, NodePlan, SourceKind, SourcePlan, StructurePlan,
};

/// 100 Hz.
const STEP: i64 = 10_000_000;
const SECOND: i64 = 1_000_000_000;
/// A time in 2026, ns.
const T0: i64 = 1_790_000_000 * SECOND;

/// Returns a feed of a datacast with channels `EHZ` and `ENZ` of one node. 100 counts are 1 m/s².
fn feed() -> Feed {
    let channel = |label: &str, position: usize| ChannelPlan {
        label: label.to_owned(),
        node: 0,
        position,
        channel: format!("roof-{position}"),
        calibration: Calibration::new(100.0, 0.0, 1.0),
        unit: "m/s2",
    };
    let config = FeedConfig {
        structures: vec![StructurePlan {
            name: "house".to_owned(),
            file: "house.toml".into(),
        }],
        nodes: vec![NodePlan {
            structure: 0,
            name: "roof".to_owned(),
            channels: 2,
            rate_hz: 100.0,
        }],
        sources: vec![SourcePlan {
            name: "shake".to_owned(),
            kind: SourceKind::Udp {
                listen: "127.0.0.1:0".to_owned(),
                format: LineFormat::RaspberryShake,
            },
            stamps: Stamps::Source { jitter_s: 0.0 },
            wait_s: 1.0,
            channels: vec![channel("EHZ", 0), channel("ENZ", 1)],
            conditions: vec![ConditionPlan {
                label: "LKI".to_owned(),
                structure: 0,
                name: "air".to_owned(),
                unit: "degC",
                range: Some((-40.0, 60.0)),
                interval_s: None,
                calibration: Calibration::new(10.0, 0.0, 1.0),
            }],
        }],
        remarks: Vec::new(),
    };
    Feed::new(config, 7)
}

/// The moment `elapsed_ns` after the start.
fn at(elapsed_ns: i64) -> Moment {
    Moment {
        wall_ns: T0 + elapsed_ns,
        elapsed_ns,
    }
}

/// Returns the packet number `number` of a channel, whose values are the numbers of its samples.
fn packet(label: &str, number: i64) -> Packet {
    Packet {
        label: label.to_owned(),
        start_ns: Some(T0 + number * 25 * STEP),
        rate_hz: None,
        values: (number * 25..number * 25 + 25)
            .map(|sample| 100.0 * sample as f64)
            .collect(),
        clock_quality: None,
    }
}

/// Sends packets as they are measured.
fn send(feed: &mut Feed, packets: &[Packet], at: Moment) -> Vec<Output> {
    let mut out = Vec::new();
    let packets = packets.to_vec();
    feed.handle(FeedInput::Packets { source: 0, packets }, at, &mut out);
    out
}

fn blocks(out: &[Output]) -> Vec<&SampleBlock> {
    out.iter()
        .filter_map(|output| match output {
            Output::Block { block, .. } => Some(block),
            _ => None,
        })
        .collect()
}

fn lost(out: &[Output]) -> Vec<&GapReport> {
    out.iter()
        .filter_map(|output| match output {
            Output::Lost(lost) => Some(lost),
            _ => None,
        })
        .collect()
}

#[test]
fn packets_become_numbered_blocks_in_si_units() {
    let mut feed = feed();
    let mut out = Vec::new();
    for number in 0..4 {
        out.extend(send(&mut feed, &[packet("EHZ", number)], at(number)));
        out.extend(send(&mut feed, &[packet("ENZ", number)], at(number)));
    }
    let (mut sequence, mut values) = (0, Vec::new());
    for block in blocks(&out) {
        assert_eq!((block.header.epoch, block.header.sequence), (7, sequence));
        assert_eq!(block.header.time_ns, T0 + sequence as i64 * STEP);
        sequence = block.end();
        values.extend(block.iter().map(<[f64]>::to_vec));
    }
    let expected: Vec<Vec<f64>> = (0..100).map(|sample| vec![f64::from(sample); 2]).collect();
    assert_eq!(values, expected);
    assert!(feed.drops(0).is_empty());
}

#[test]
fn blocks_have_the_lowest_stated_quality_of_the_clock() {
    let mut feed = feed();
    let mut number = 0;
    let mut quality = |stated: [Option<u8>; 2]| {
        let mut out = Vec::new();
        for (label, clock_quality) in ["EHZ", "ENZ"].into_iter().zip(stated) {
            let packet = Packet {
                clock_quality,
                ..packet(label, number)
            };
            out.extend(send(&mut feed, &[packet], at(number)));
        }
        number += 1;
        blocks(&out).last().unwrap().clock_quality
    };
    // Programs that do not know the quality write 0.
    assert_eq!(quality([None, Some(0)]), None);
    assert_eq!(quality([Some(90), Some(70)]), Some(70));
    assert_eq!(quality([Some(90), Some(0)]), Some(0));
    assert_eq!(quality([Some(90), None]), Some(90));
}

#[test]
fn lost_packet_is_counted_and_reported_to_the_sample() {
    let mut feed = feed();
    send(&mut feed, &[packet("EHZ", 0), packet("ENZ", 0)], at(0));
    send(&mut feed, &[packet("EHZ", 1)], at(SECOND));
    send(&mut feed, &[packet("EHZ", 2), packet("ENZ", 2)], at(SECOND));
    let mut out = Vec::new();
    feed.handle(FeedInput::Tick, at(SECOND), &mut out);
    let expected = GapReport {
        node: 0,
        channel: "roof-1".to_owned(),
        samples: 25,
        from_ns: T0 + 25 * STEP,
        to_ns: T0 + 50 * STEP,
        because: LostBecause::NotDelivered,
    };
    assert_eq!(lost(&out), [&expected]);
    assert_eq!(
        feed.drops(0),
        [("undelivered-samples".to_owned(), 25)].into()
    );
}

#[test]
fn losses_that_repeat_are_added_to_one_report() {
    let mut feed = feed();
    let mut out = Vec::new();
    // Every third packet of one channel is lost, for 20 s.
    for number in 0..80 {
        let now = at(number * SECOND / 4);
        out.extend(send(&mut feed, &[packet("EHZ", number)], now));
        if number % 3 != 1 {
            out.extend(send(&mut feed, &[packet("ENZ", number)], now));
        }
        feed.handle(FeedInput::Tick, now, &mut out);
    }
    feed.handle(FeedInput::Stop, at(20 * SECOND), &mut out);
    let reports = lost(&out);
    assert!(reports.len() <= 4, "{reports:?}");
    let samples: u64 = reports.iter().map(|report| report.samples).sum();
    assert_eq!(samples, 26 * 25);
}

#[test]
fn samples_lost_while_the_feed_was_stopped_are_reported_per_channel() {
    let mut feed = feed();
    let recorded = Recorded {
        frames: TimeGrid::new(T0 - 100 * STEP, 100.0).unwrap(),
        next: 60, // the last frame is 41 steps before the first sample
    };
    let mut out = Vec::new();
    feed.handle(
        FeedInput::Recorded {
            structure: 0,
            recorded,
        },
        at(0),
        &mut out,
    );
    out.extend(send(
        &mut feed,
        &[packet("EHZ", 0), packet("ENZ", 0)],
        at(0),
    ));
    feed.handle(FeedInput::Tick, at(0), &mut out);
    let found: Vec<(u64, LostBecause)> = lost(&out)
        .iter()
        .map(|report| (report.samples, report.because))
        .collect();
    assert_eq!(found, [(40, LostBecause::FeedStopped); 2]);
}

#[test]
fn repeated_packets_are_dropped_and_counted() {
    let mut feed = feed();
    for number in [0, 1, 1, 0, 2] {
        for label in ["EHZ", "ENZ"] {
            send(&mut feed, &[packet(label, number)], at(number * SECOND / 4));
        }
    }
    assert_eq!(feed.published(0).1, 75);
    assert_eq!(feed.drops(0), [("repeated-samples".to_owned(), 100)].into());
}

#[test]
fn clock_that_goes_back_begins_an_epoch_without_losing_samples() {
    let mut feed = feed();
    let mut out = Vec::new();
    let mut now = 0;
    // A minute forwards by mistake, then back.
    for number in (240..260).chain(0..40) {
        now += SECOND / 4;
        for label in ["EHZ", "ENZ"] {
            out.extend(send(&mut feed, &[packet(label, number)], at(now)));
        }
    }
    feed.handle(FeedInput::Stop, at(now), &mut out);
    let set_back: Vec<&Output> = out
        .iter()
        .filter(|output| matches!(output, Output::SetBack { .. }))
        .collect();
    assert_eq!(set_back.len(), 1);
    let of_new_epoch: Vec<f64> = blocks(&out)
        .iter()
        .filter(|block| block.header.epoch == 8)
        .flat_map(|block| block.samples.iter().copied())
        .collect();
    let expected: Vec<f64> = (0..1000)
        .flat_map(|sample| [f64::from(sample); 2])
        .collect();
    assert_eq!(of_new_epoch, expected);
}

/// Regression: files that are dropped into a folder in another order began a new run.
#[test]
fn older_files_of_a_folder_are_dropped_and_begin_no_epoch() {
    let mut config = feed().config().clone();
    config.sources[0].kind = SourceKind::Folder(DropFolder {
        path: "records".into(),
        memory: "records.json".into(),
        options: ReadOptions::default(),
    });
    let mut feed = Feed::new(config, 7);
    let (mut out, mut now) = (Vec::new(), 0);
    for number in (240..260).chain(0..40).chain(260..280) {
        now += SECOND / 4;
        for label in ["EHZ", "ENZ"] {
            out.extend(send(&mut feed, &[packet(label, number)], at(now)));
        }
    }
    feed.handle(FeedInput::Stop, at(now), &mut out);
    assert!(blocks(&out).iter().all(|block| block.header.epoch == 7));
    let published: u64 = blocks(&out).iter().map(|block| block.count()).sum();
    assert_eq!(published, 1000);
    let expected = BTreeMap::from([("older-samples".to_owned(), 2000)]);
    assert_eq!(feed.drops(0), expected);
}

#[test]
fn wrong_rate_stops_the_channel_and_names_both_rates() {
    let mut feed = feed();
    let mut out = Vec::new();
    for number in 0..60 {
        // 50 Hz: the packets come twice as far apart.
        let slow = Packet {
            start_ns: Some(T0 + number * 50 * STEP),
            ..packet("EHZ", number)
        };
        let now = at(number * SECOND / 2);
        feed.handle(
            FeedInput::Link {
                source: 0,
                link: Link::Open,
            },
            now,
            &mut out,
        );
        out.extend(send(&mut feed, &[slow], now));
    }
    let status = feed.status(0).unwrap();
    assert_eq!(status.state, InstrumentState::Failed);
    let expected = "EHZ: sampling rate is 50.0000 Hz, must be 100 Hz, the rate of its node in the \
                    structure file";
    assert_eq!(status.last_error.as_deref(), Some(expected));
}

#[test]
fn unmapped_channel_is_seen_and_disturbs_nothing() {
    let mut feed = feed();
    send(&mut feed, &[packet("EHE", 0), packet("EHZ", 0)], at(0));
    let (_, unmapped) = feed.seen(0).unwrap();
    assert_eq!(*unmapped, [("EHE".to_owned(), 25)].into());
    assert_eq!(feed.status(0).unwrap().errors, 0);
}

#[test]
fn late_channel_is_reported_and_the_other_is_published() {
    let mut feed = feed();
    let mut out = send(&mut feed, &[packet("EHZ", 0)], at(0));
    feed.handle(FeedInput::Tick, at(SECOND), &mut out);
    assert_eq!(
        blocks(&out).iter().map(|block| block.count()).sum::<u64>(),
        25
    );
    out.clear();
    out.extend(send(&mut feed, &[packet("ENZ", 0)], at(SECOND)));
    feed.handle(FeedInput::Tick, at(SECOND), &mut out);
    let late = lost(&out);
    assert_eq!((late[0].samples, late[0].because), (25, LostBecause::Late));
}

#[test]
fn conditions_beside_channels_are_returned_once_and_wrong_ones_are_errors() {
    let (mut feed, mut out) = (feed(), Vec::new());
    let temperature = |time_ns: i64, tenths: f64| Packet {
        label: "LKI".to_owned(),
        start_ns: Some(time_ns),
        rate_hz: None,
        values: vec![tenths],
        clock_quality: None,
    };
    let stored = FeedInput::Stored {
        source: 0,
        condition: 0,
        newest_ns: T0 - SECOND,
    };
    feed.handle(stored, at(0), &mut out);
    let packets = vec![
        temperature(T0 - SECOND, 200.0),
        temperature(T0, 215.0),
        temperature(T0, 215.0),
        temperature(T0 + 1, 9990.0),
    ];
    let input = FeedInput::Packets { source: 0, packets };
    feed.handle(input, at(0), &mut out);
    let values: Vec<&Output> = out
        .iter()
        .filter(|output| matches!(output, Output::Condition { .. }))
        .collect();
    let expected = Output::Condition {
        source: 0,
        condition: 0,
        time_ns: T0,
        value: 21.5,
    };
    assert_eq!(values, [&expected]);
    let status = feed.status(0).unwrap();
    assert_eq!((status.samples, status.errors), (1, 1));
    assert_eq!(feed.drops(0)["repeated-conditions"], 2);
    assert!(feed.seen(0).unwrap().1.is_empty(), "it is mapped");
}

/// Sends the packets of both channels as they are measured, at the time of their last sample.
fn send_both(feed: &mut Feed, numbers: std::ops::Range<i64>) -> Vec<Output> {
    let mut out = Vec::new();
    for number in numbers {
        let arrived = at((number + 1) * 25 * STEP);
        let both = ["EHZ", "ENZ"].map(|label| packet(label, number));
        out.extend(send(feed, &both, arrived));
    }
    out
}

fn errors(out: &[Output]) -> Vec<&str> {
    out.iter()
        .filter_map(|output| match output {
            Output::Error { why, .. } => Some(why.as_str()),
            _ => None,
        })
        .collect()
}

// The samples of the next 2 s were late, and 31,500,000,000 samples counted as lost.
#[test]
fn single_packet_from_the_future_is_dropped_and_costs_no_other_sample() {
    let mut feed = feed();
    send_both(&mut feed, 0..4);
    let mut stray = packet("EHZ", 4);
    stray.start_ns = Some(T0 + 315_000_000 * SECOND);
    let mut out = send(&mut feed, &[stray, packet("ENZ", 4)], at(5 * 25 * STEP));
    out.extend(send_both(&mut feed, 5..9));
    let why = "roof-0: the time of a packet is 314999998.750 s after that of the next one; its 25 \
               samples are dropped";
    assert_eq!(errors(&out), [why]);
    let missing = [("stray-samples", 25), ("undelivered-samples", 25)];
    let counts = missing.map(|(reason, count)| (reason.to_owned(), count));
    assert_eq!(feed.drops(0), counts.into());
    feed.handle(FeedInput::Stop, at(9 * 25 * STEP), &mut out);
    let last = blocks(&out).last().copied().unwrap();
    assert_eq!((last.header.epoch, last.end()), (7, 225));
}

#[test]
fn packet_ahead_is_used_if_the_next_one_follows_it_or_does_not_arrive() {
    for has_next in [true, false] {
        let mut feed = feed();
        send_both(&mut feed, 0..4);
        // A file continues after a gap of ten seconds, without any delay.
        let (mut out, at_end) = (Vec::new(), at(100 * STEP));
        for number in 44..44 + 1 + i64::from(has_next) {
            let both = ["EHZ", "ENZ"].map(|label| packet(label, number));
            out.extend(send(&mut feed, &both, at_end));
        }
        let before = blocks(&out).iter().map(|block| block.count()).sum::<u64>();
        assert_eq!(before, if has_next { 50 } else { 0 });
        feed.handle(FeedInput::Tick, at(100 * STEP + 11 * SECOND), &mut out);
        let counts = [("undelivered-samples".to_owned(), 2000)];
        assert_eq!(feed.drops(0), counts.into(), "{has_next}");
        assert_eq!(errors(&out), [""; 0]);
        let first = blocks(&out)[0].header.time_ns;
        assert_eq!(first, T0 + 44 * 25 * STEP);
    }
}

// Short recordings of events that are dropped into a folder together.
#[test]
fn packets_with_gaps_between_them_are_all_used() {
    let mut feed = feed();
    let mut out = Vec::new();
    for number in [0, 40, 80, 160] {
        let both = ["EHZ", "ENZ"].map(|label| packet(label, number));
        out.extend(send(&mut feed, &both, at(number)));
    }
    feed.handle(FeedInput::Stop, at(SECOND), &mut out);
    let starts: Vec<i64> = blocks(&out).iter().map(|one| one.header.time_ns).collect();
    let expected = [0, 40, 80, 160].map(|number| T0 + number * 25 * STEP);
    assert_eq!(starts, expected);
    assert_eq!(feed.drops(0).get("stray-samples"), None);
}

#[test]
fn infinite_sample_is_an_error_and_counts_as_missing() {
    let mut feed = feed();
    let mut both = ["EHZ", "ENZ"].map(|label| packet(label, 0));
    both[1].values[3] = f64::INFINITY;
    let out = send(&mut feed, &both, at(25 * STEP));
    let why = "ENZ: a sample is infinite, must be a finite number; it counts as missing";
    assert_eq!(errors(&out), [why]);
    let rows: Vec<&[f64]> = blocks(&out)[0].iter().collect();
    assert!(rows[3][0] == 3.0 && rows[3][1].is_nan() && rows[4] == [4.0, 4.0]);
}
