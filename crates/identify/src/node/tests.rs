use super::*;
use spandrel_bus::{ChannelState, MaskedSpan};
use std::path::Path;

const FILE: &str = include_str!("../../../../docs/examples/forty-storey-building.toml");

/// Returns a worker of the fourth node at 25 Hz, without motion in its messages.
fn worker() -> NodeIdentification {
    worker_with("")
}

/// Returns the same worker with another line in the table `[fusion]`.
fn worker_with(line: &str) -> NodeIdentification {
    let mut text = FILE.to_owned();
    for (line, other) in [
        ("sampling-rate-hz = 250", "sampling-rate-hz = 25"),
        ("motion = \"samples\"", "motion = \"none\""),
        ("samples-per-period = 50", line),
    ] {
        assert_eq!(text.matches(line).count(), 1, "{line}");
        text = text.replace(line, other);
    }
    let structure = Structure::parse(&text, Path::new("building.toml")).unwrap();
    NodeIdentification::new(&structure, 3, 5).unwrap()
}

/// Returns samples `from` to before `to` of a slow oscillation that starts at time 0.
fn samples(from: u64, to: u64, pace: Pace) -> SampleBlock {
    let value = |number: u64| {
        [
            0.001 * (number as f64 * 0.06).sin(),
            -0.01 * (number as f64 * 0.06).sin(),
        ]
    };
    SampleBlock {
        header: Header {
            source: "floor-4".into(),
            epoch: 1,
            sequence: from,
            time_ns: (from * 40_000_000) as i64,
        },
        sampling_rate_hz: 25.0,
        pace,
        channels: 2,
        samples: (from..to).flat_map(value).collect(),
        state: StreamState::Running,
        clock_quality: None,
    }
}

/// Returns a position of the samples, which have epoch 1.
fn at(sequence: u64) -> Position {
    Position { epoch: 1, sequence }
}

fn run(
    worker: &mut NodeIdentification,
    inputs: impl IntoIterator<Item = NodeInput>,
) -> Vec<LocalMessage> {
    let mut outputs = Vec::new();
    inputs
        .into_iter()
        .for_each(|input| worker.handle(input, &mut outputs));
    let local = outputs.into_iter().filter_map(|output| match output {
        NodeOutput::Local(message) => Some(message),
        NodeOutput::Event(_) | NodeOutput::Frames(_) => None,
    });
    local.collect()
}

fn answer(message: &LocalMessage) -> NodeInput {
    let density = message.density.clone().unwrap();
    NodeInput::Feedback(FeedbackMessage {
        header: Header {
            source: "fuse".into(),
            epoch: 9,
            sequence: 0,
            time_ns: 0,
        },
        node_epoch: message.header.epoch,
        answers: message.header.sequence,
        nodes: 1,
        mean: density.mean.iter().map(|mean| mean + 0.01).collect(),
        covariance: density.covariance,
        motion: None,
        responses: Vec::new(),
    })
}

#[test]
fn live_samples_are_processed_without_waiting_for_replies() {
    let mut worker = worker();
    let sent = run(
        &mut worker,
        [NodeInput::Samples(samples(0, 100, Pace::Live))],
    );
    let indices: Vec<u64> = sent.iter().map(|message| message.header.sequence).collect();
    assert_eq!(indices, [1, 2, 3, 4]);
    assert_eq!(sent[1].header.time_ns, 49 * 40_000_000);
    assert_eq!(
        sent[1].density.as_ref().unwrap().lineage,
        Some(NodeLineage {
            own: 0,
            answers: Vec::new()
        })
    );
    for message in &sent {
        assert!(spandrel_bus::Message::check(message).is_ok());
    }
}

#[test]
fn replayed_samples_wait_for_each_reply_for_any_block_size() {
    let means = |cuts: &[u64]| {
        let mut worker = worker();
        let mut inputs: VecDeque<NodeInput> = cuts
            .windows(2)
            .map(|cut| NodeInput::Samples(samples(cut[0], cut[1], Pace::Replayed)))
            .collect();
        let mut sent = Vec::new();
        while let Some(input) = inputs.pop_front() {
            let mut new = run(&mut worker, [input]);
            while let Some(last) = new.pop() {
                assert!(new.is_empty(), "one estimate, then the answer");
                assert_eq!(worker.awaits(), Some(last.header.sequence));
                new = run(&mut worker, [answer(&last)]);
                sent.push(last.density.unwrap().mean);
            }
        }
        sent
    };
    let whole = means(&[0, 100]);
    assert_eq!(whole.len(), 4);
    assert_eq!(whole, means(&[0, 10, 25, 26, 60, 99, 100]));
    assert!(
        (whole[1][0] - whole[0][0] - 0.01).abs() < 0.02,
        "the answer has been taken"
    );
}

fn frames(
    worker: &mut NodeIdentification,
    inputs: impl IntoIterator<Item = NodeInput>,
) -> Vec<FrameBlock> {
    let mut outputs = Vec::new();
    inputs
        .into_iter()
        .for_each(|input| worker.handle(input, &mut outputs));
    let frames = outputs.into_iter().filter_map(|output| match output {
        NodeOutput::Frames(block) => Some(block),
        NodeOutput::Local(_) | NodeOutput::Event(_) => None,
    });
    frames.collect()
}

#[test]
fn frames_for_waveforms_contain_all_samples_and_the_missing_ones() {
    let mut worker = worker_with("waveforms = true");
    let blocks = [samples(50, 110, Pace::Live), samples(120, 150, Pace::Live)];
    let found = frames(&mut worker, blocks.clone().map(NodeInput::Samples));
    let spans: Vec<_> = found
        .iter()
        .map(|block| (block.header.sequence, spandrel_bus::Block::end(block)))
        .collect();
    // The numbers count from 1970, when the samples would have begun.
    assert_eq!(spans, [(50, 110), (110, 150)]);
    for block in &found {
        spandrel_bus::Message::check(block).unwrap();
        assert_eq!((block.t0_ns, block.sampling_rate_hz), (0, 25.0));
    }
    assert_eq!(found[0].values, blocks[0].samples);
    let (missing, rest) = found[1].values.split_at(20);
    assert!(missing.iter().all(|value| value.is_nan()), "{missing:?}");
    assert_eq!(rest, blocks[1].samples);
}

#[test]
fn frames_are_of_this_run_and_on_request_only() {
    let inputs = || {
        [
            NodeInput::Past(samples(0, 50, Pace::Live)),
            NodeInput::Samples(samples(50, 75, Pace::Live)),
        ]
    };
    let found = frames(&mut worker_with("waveforms = true"), inputs());
    let starts: Vec<u64> = found.iter().map(|block| block.header.sequence).collect();
    assert_eq!(starts, [50]);
    assert_eq!(frames(&mut worker(), inputs()), []);
}

#[test]
fn late_reply_gives_the_same_result_as_a_timely_one() {
    let late = |samples_late: u64| {
        let mut worker = worker();
        let first = run(
            &mut worker,
            [NodeInput::Samples(samples(0, 25, Pace::Live))],
        );
        let middle = 25 + samples_late;
        run(
            &mut worker,
            [
                NodeInput::Samples(samples(25, middle, Pace::Live)),
                answer(&first[0]),
            ],
        );
        let second = run(
            &mut worker,
            [NodeInput::Samples(samples(middle, 50, Pace::Live))],
        );
        second[0].density.clone().unwrap()
    };
    let in_time = late(0);
    for samples_late in [1, 5, 24] {
        assert_eq!(late(samples_late), in_time, "{samples_late} samples late");
    }
}

#[test]
fn gaps_are_bridged_and_invalid_samples_are_dropped() {
    let mut worker = worker();
    let mut wild = samples(25, 50, Pace::Live);
    wild.samples[4] = 1e30;
    wild.samples[7] = f64::INFINITY;
    let foreign = SampleBlock {
        channels: 3,
        samples: vec![0.0; 6],
        ..samples(50, 60, Pace::Live)
    };
    let inputs = [
        samples(0, 25, Pace::Live),
        wild,
        foreign,
        samples(10, 20, Pace::Live),  // out of order
        samples(60, 100, Pace::Live), // ten samples missing
    ];
    let sent = run(&mut worker, inputs.into_iter().map(NodeInput::Samples));
    assert_eq!(sent.len(), 4);
    let dropped = worker.dropped();
    assert_eq!(dropped["absurd-samples"], 2);
    assert_eq!(dropped["samples-of-another-node"], 1);
    assert_eq!(dropped["samples-out-of-order"], 1);
    assert_eq!(dropped["missing-samples"], 10);
    assert!(
        sent.iter()
            .flat_map(|message| &message.density.as_ref().unwrap().mean)
            .all(|mean| mean.is_finite())
    );
}

#[test]
fn invalid_and_stale_replies_change_nothing() {
    let mut worker = worker();
    let first = run(
        &mut worker,
        [NodeInput::Samples(samples(0, 25, Pace::Live))],
    );
    let NodeInput::Feedback(good) = answer(&first[0]) else {
        unreachable!()
    };
    let before = worker.filter().filter().parameters();
    let nan = FeedbackMessage {
        mean: vec![f64::NAN; 10],
        ..good.clone()
    };
    let other_life = FeedbackMessage {
        node_epoch: 4,
        ..good.clone()
    };
    let never_sent = FeedbackMessage {
        answers: 2,
        ..good.clone()
    };
    let short = FeedbackMessage {
        mean: vec![1.0; 3],
        covariance: vec![1.0; 3],
        ..good.clone()
    };
    run(
        &mut worker,
        [nan, other_life, never_sent, short].map(NodeInput::Feedback),
    );
    assert_eq!(worker.filter().filter().parameters(), before);
    assert_eq!(
        (
            worker.dropped()["useless-feedback"],
            worker.dropped()["stale-feedback"]
        ),
        (2, 2)
    );
    run(&mut worker, [NodeInput::Feedback(good.clone())]);
    assert_ne!(worker.filter().filter().parameters(), before);
    run(&mut worker, [NodeInput::Feedback(good)]);
    assert_eq!(worker.dropped()["stale-feedback"], 3, "a repeat");
}

/// Regression: each worker counted its periods from its first sample, so periods of different nodes
/// did not end together.
#[test]
fn periods_end_at_whole_seconds_for_any_first_sample() {
    for (from, phase_ns) in [(10, 0), (10, 15_000_000), (24, -15_000_000), (25, 0)] {
        let mut worker = worker();
        let mut block = samples(from, 125, Pace::Live);
        block.header.time_ns += phase_ns;
        let sent = run(&mut worker, [NodeInput::Samples(block)]);
        let first = if from == 25 { 49 } else { 24 };
        let expected = (first..125)
            .step_by(25)
            .map(|number| number * 40_000_000 + phase_ns);
        assert_eq!(
            sent.iter()
                .map(|message| message.header.time_ns)
                .collect::<Vec<_>>(),
            expected.collect::<Vec<_>>()
        );
        // Information from a partial period also counts, relative to the prior that all nodes
        // share.
        let prior = NodeLineage {
            own: 0,
            answers: Vec::new(),
        };
        assert!(
            sent.iter()
                .all(|message| message.density.as_ref().unwrap().lineage.as_ref() == Some(&prior))
        );
    }
}

#[test]
fn periods_stay_in_step_while_the_clock_of_the_samples_drifts() {
    for (drift_ns, reason) in [
        (4_000_000, "missing-samples"),
        (-4_000_000, "samples-out-of-step"),
    ] {
        let mut worker = worker();
        let mut sent = Vec::new();
        for block in 0..40 {
            let mut part = samples(block * 5, block * 5 + 5, Pace::Live);
            part.header.time_ns += block as i64 * drift_ns;
            sent.extend(run(&mut worker, [NodeInput::Samples(part)]));
        }
        // 160 ms in all, which is four samples.
        assert!(
            (3..=4).contains(&worker.dropped()[reason]),
            "{:?}",
            worker.dropped()
        );
        for message in &sent {
            let off_ns = (message.header.time_ns - 960_000_000).rem_euclid(1_000_000_000);
            assert!(
                off_ns.min(1_000_000_000 - off_ns) <= 32_000_000,
                "{}",
                message.header.time_ns
            );
        }
        assert!(sent.len() >= 7);
    }
}

#[test]
fn restarted_sensor_keeps_the_same_periods() {
    let mut worker = worker();
    let mut again = samples(73, 150, Pace::Live);
    again.header.epoch = 2;
    let inputs = [samples(0, 60, Pace::Live), again].map(NodeInput::Samples);
    let sent = run(&mut worker, inputs);
    let ends: Vec<i64> = sent
        .iter()
        .map(|message| message.header.time_ns / 40_000_000)
        .collect();
    assert_eq!(ends, [24, 49, 74, 99, 124, 149]);
    let indices: Vec<u64> = sent.iter().map(|message| message.header.sequence).collect();
    assert_eq!(indices, [1, 2, 3, 4, 5, 6]);
    let named: Vec<bool> = sent
        .iter()
        .map(|message| message.density.as_ref().unwrap().lineage.is_some())
        .collect();
    assert_eq!(
        named,
        [true, true, false, false, false, false],
        "nothing faded while the sensor was away"
    );
    run(&mut worker, [answer(&sent[5])]);
    let next = run(
        &mut worker,
        [{
            let mut next = samples(150, 175, Pace::Live);
            next.header.epoch = 2;
            NodeInput::Samples(next)
        }],
    );
    let lineage = next[0].density.as_ref().unwrap().lineage.clone();
    assert_eq!(
        lineage,
        Some(NodeLineage {
            own: 6,
            answers: vec![6]
        })
    );
}

/// Returns the samples of [`samples`] by a clock that is `ahead_s` ahead.
fn ahead(from: u64, to: u64, ahead_s: i64) -> SampleBlock {
    let mut block = samples(from, to, Pace::Live);
    block.header.time_ns += ahead_s * 1_000_000_000;
    block
}

/// Regression: after one block an hour ahead, the worker dropped all samples for an hour.
#[test]
fn one_block_of_a_wrong_time_is_dropped() {
    let mut worker = worker();
    let blocks = [
        ahead(0, 50, 0),
        ahead(50, 60, 3600),
        ahead(60, 100, 0),
        ahead(100, 110, -600),
        ahead(110, 150, 0),
    ];
    let sent = run(&mut worker, blocks.map(NodeInput::Samples));
    let times = sent
        .iter()
        .map(|message| message.header.time_ns / 40_000_000);
    assert_eq!(times.collect::<Vec<_>>(), [24, 49, 74, 99, 124, 149]);
    let dropped = BTreeMap::from([("samples-of-a-wrong-time", 20), ("missing-samples", 20)]);
    assert_eq!(*worker.dropped(), dropped);
}

/// Regression: after the clock was set back, the worker dropped all samples until it had caught up.
#[test]
fn samples_after_a_step_of_the_clock_are_used() {
    for step_s in [-600, 600] {
        let mut worker = worker();
        let blocks = [
            ahead(0, 50, 0),
            ahead(50, 75, step_s),
            ahead(75, 100, step_s),
        ];
        let mut outputs = Vec::new();
        for block in blocks {
            worker.handle(NodeInput::Samples(block), &mut outputs);
        }
        let mut sent = Vec::new();
        let mut events = Vec::new();
        for output in outputs {
            match output {
                NodeOutput::Local(message) => sent.push(message.header.time_ns / 40_000_000),
                NodeOutput::Event(event) => events.push(event.kind),
                NodeOutput::Frames(_) => panic!("the structure file requests no waveforms"),
            }
        }
        assert_eq!(sent, [24, 49, 74 + 25 * step_s, 99 + 25 * step_s]);
        let expected = if step_s < 0 {
            EventKind::Restart
        } else {
            EventKind::Gap
        };
        assert_eq!(events, [expected], "{step_s} s");
    }
}

#[test]
fn last_block_after_a_long_gap_is_used() {
    let mut worker = worker();
    let mut last = ahead(50, 75, 3600);
    last.state = StreamState::Ended;
    let blocks = [ahead(0, 50, 0), last];
    let sent = run(&mut worker, blocks.map(NodeInput::Samples));
    assert_eq!(sent.len(), 4, "three estimates and the end");
    assert_eq!(sent[3].state, StreamState::Ended);
}

/// Regression: the filter of a node took the mean of a force field as 0. It then explained the
/// static deflection by a loss of stiffness, or restarted each second.
#[test]
fn static_deflection_under_a_mean_force_is_no_loss_of_stiffness() {
    let text = r#"
        [structure]
        name = "wind"
        sampling-rate-hz = 50
        identification = "distributed"

        [model]
        kind = "shear-building"
        storeys = 1
        mass-kg = 1e5
        stiffness-n-per-m = 4e7

        [damping]
        kind = "rayleigh"
        alpha-per-s = 0.1
        beta-s = 0.001
        known = true

        [[parameter]]
        name = "storey-1"
        scales = "stiffness"
        of = ["storey-1"]
        std = 0.2

        [[excitation]]
        name = "wind"
        kind = "force-field"
        dofs = "all"
        mean = [20000]
        std = [400]
        correlation-length = 2

        [[node]]
        name = "n1"
        [[node.channel]]
        name = "d1"
        quantity = "displacement"
        dof = "floor-1"
        unit = "m"
        noise-std = 2e-5

        [filter]
        displacement-std-m = 1e-3
        velocity-std-m-per-s = 1e-2
    "#;
    let structure = Structure::parse(text, Path::new("wind.toml")).unwrap();
    let mut worker = NodeIdentification::new(&structure, 0, 5).unwrap();
    let deflection_m = 20_000.0 / 4e7;
    let block = SampleBlock {
        sampling_rate_hz: 50.0,
        channels: 1,
        samples: vec![deflection_m; 500],
        ..samples(0, 0, Pace::Live)
    };
    run(&mut worker, [NodeInput::Samples(block)]);
    let stiffness = worker.filter().filter().parameters().mean[0];
    assert_eq!(worker.restarts(), 0, "stiffness {stiffness}");
    assert!((stiffness - 1.0).abs() < 0.01, "{stiffness}");
}

/// Regression: the full triangle was sent although the file specified variances alone.
#[test]
fn message_contains_only_variances_if_the_file_requests_it() {
    let asks = "[fusion]\ncovariance = \"variances\"";
    assert_eq!(FILE.matches("[fusion]").count(), 1);
    let structure =
        Structure::parse(&FILE.replace("[fusion]", asks), Path::new("building.toml")).unwrap();
    let mut worker = NodeIdentification::new(&structure, 3, 5).unwrap();
    let block = SampleBlock {
        sampling_rate_hz: 250.0,
        samples: vec![0.0; 500],
        ..samples(0, 0, Pace::Live)
    };
    let sent = run(&mut worker, [NodeInput::Samples(block)]);
    assert_eq!(sent[0].density.as_ref().unwrap().covariance.len(), 10);
    assert!(spandrel_bus::Message::check(&sent[0]).is_ok());
}

/// Returns a worker of the fourth node at 25 Hz, which screens its samples after two seconds of
/// training.
fn screening_worker() -> NodeIdentification {
    let text = FILE
        .replace("sampling-rate-hz = 250", "sampling-rate-hz = 25")
        .replace("motion = \"samples\"", "motion = \"none\"")
        .replace("samples-per-period = 50", "")
        .replace(
            "[fusion]",
            "[outliers]\ntraining-s = 2\nwindow-s = 40\n\n[fusion]",
        );
    let structure = Structure::parse(&text, Path::new("building.toml")).unwrap();
    NodeIdentification::new(&structure, 3, 5).unwrap()
}

/// Regression: samples that the filter of a node rejected were not reported.
#[test]
fn rejected_samples_of_a_node_are_reported_by_channel_in_its_messages() {
    let mut worker = screening_worker();
    let mut block = samples(0, 1000, Pace::Live);
    // Sample 500 of the second channel is a spike.
    block.samples[2 * 500 + 1] = 100.0;
    let sent = run(&mut worker, [NodeInput::Samples(block)]);
    assert!(
        sent.iter()
            .all(|message| message.screening.len() == 2 && message.samples == 25)
    );
    let rejected = |period: usize, channel: usize| sent[period].screening[channel].rejected;
    assert_eq!(
        rejected(20, 1),
        rejected(19, 1) + 1,
        "the spike is in the period from 500 on"
    );
    assert_eq!(rejected(20, 0), rejected(19, 0));
    let at_ns = 500 * 40_000_000;
    let span = MaskedSpan {
        from_ns: at_ns,
        to_ns: at_ns,
        samples: 1,
    };
    assert_eq!(sent[20].screening[1].masked, Some(span));
    assert_eq!(sent[21].screening[1].masked, None, "it is told once");
    assert!(
        sent.iter()
            .all(|message| spandrel_bus::Message::check(message).is_ok())
    );
    let trained = |period: usize| sent[period].screening[1].state == ChannelState::Screening;
    assert!(!trained(0) && trained(20));
}

#[test]
fn message_states_its_number_of_samples() {
    let mut worker = screening_worker();
    let mut block = samples(0, 100, Pace::Live);
    block.samples[2 * 25..2 * 75].fill(f64::NAN);
    let sent = run(&mut worker, [NodeInput::Samples(block)]);
    assert_eq!(
        sent.iter()
            .map(|message| message.samples)
            .collect::<Vec<_>>(),
        [25, 0, 0, 25]
    );
    // The same applies to a gap between blocks.
    let sent = run(
        &mut worker,
        [NodeInput::Samples(samples(150, 175, Pace::Live))],
    );
    assert_eq!(
        sent.iter()
            .map(|message| message.samples)
            .collect::<Vec<_>>(),
        [0, 0, 25]
    );
}

/// Restores a new run of a worker from the checkpoint of an earlier run.
fn next_life(before: &NodeIdentification, mut worker: NodeIdentification) -> NodeIdentification {
    let bytes = postcard::to_stdvec(&before.state()).unwrap();
    worker
        .restore(postcard::from_bytes(&bytes).unwrap())
        .unwrap();
    worker
}

#[test]
fn rereading_missed_samples_restores_the_uninterrupted_state() {
    let mut undisturbed = worker();
    let first = run(
        &mut undisturbed,
        [NodeInput::Samples(samples(0, 40, Pace::Live))],
    );
    run(
        &mut undisturbed,
        [
            answer(&first[0]),
            NodeInput::Samples(samples(40, 60, Pace::Live)),
        ],
    );
    assert_eq!(undisturbed.position(), Some(at(60)));
    let mut again = next_life(&undisturbed, worker());
    assert_eq!((again.position(), again.epoch()), (Some(at(60)), 6));
    let past = run(
        &mut again,
        [
            NodeInput::Past(samples(60, 80, Pace::Live)),
            NodeInput::Past(samples(80, 110, Pace::Live)),
        ],
    );
    assert_eq!(
        past,
        [],
        "the station may have heard of it by the life before"
    );
    let expected = run(
        &mut undisturbed,
        [NodeInput::Samples(samples(60, 150, Pace::Live))],
    );
    let told = run(
        &mut again,
        [NodeInput::Samples(samples(110, 150, Pace::Live))],
    );
    let of = |message: &LocalMessage| {
        (
            message.header.sequence,
            message.header.time_ns,
            message.density.clone().unwrap(),
        )
    };
    for (expected, told) in expected[2..].iter().zip(&told) {
        let ((sequence, time_ns, expected), (told_sequence, told_ns, told)) =
            (of(expected), of(told));
        assert_eq!((told_sequence, told_ns), (sequence, time_ns));
        assert_eq!(
            (told.mean, told.covariance),
            (expected.mean, expected.covariance),
            "message {sequence}, to the bit"
        );
        // The station knows this estimate only from the earlier run.
        assert_eq!(
            told.lineage,
            Some(NodeLineage {
                own: 1,
                answers: Vec::new()
            })
        );
    }
    assert_eq!(
        told.iter()
            .map(|message| message.header.sequence)
            .collect::<Vec<_>>(),
        [5, 6]
    );
    // After feedback, the messages contain newly learnt information.
    run(&mut again, [answer(&told[1])]);
    let next = run(
        &mut again,
        [NodeInput::Samples(samples(150, 175, Pace::Live))],
    );
    assert_eq!(
        next[0].density.as_ref().unwrap().lineage,
        Some(NodeLineage {
            own: 6,
            answers: vec![6]
        })
    );
}

#[test]
fn permanently_missed_samples_are_a_gap() {
    let mut first = worker();
    run(&mut first, [NodeInput::Samples(samples(0, 60, Pace::Live))]);
    let mut second = next_life(&first, worker());
    let told = run(
        &mut second,
        [NodeInput::Samples(samples(80, 100, Pace::Live))],
    );
    assert_eq!(second.dropped()["missing-samples"], 20);
    let ends: Vec<i64> = told
        .iter()
        .map(|message| message.header.time_ns / 40_000_000)
        .collect();
    assert_eq!(ends, [74, 99], "its periods end where they did");
    assert!(
        told.iter()
            .all(|message| message.density.as_ref().unwrap().lineage.is_none()),
        "it was never answered"
    );
}

#[test]
fn reread_samples_wait_for_no_reply() {
    let mut first = worker();
    run(
        &mut first,
        [NodeInput::Samples(samples(0, 20, Pace::Replayed))],
    );
    let mut second = next_life(&first, worker());
    assert_eq!(
        run(
            &mut second,
            [NodeInput::Past(samples(20, 110, Pace::Replayed))]
        ),
        []
    );
    assert_eq!((second.awaits(), second.position()), (None, Some(at(110))));
    let told = run(
        &mut second,
        [NodeInput::Samples(samples(110, 130, Pace::Replayed))],
    );
    assert_eq!(told.len(), 1);
    assert_eq!(second.awaits(), Some(5));
}

#[test]
fn reply_to_the_previous_run_is_stale() {
    let mut first = worker();
    let sent = run(&mut first, [NodeInput::Samples(samples(0, 25, Pace::Live))]);
    let mut second = next_life(&first, worker());
    run(&mut second, [answer(&sent[0])]);
    assert_eq!(second.dropped()["stale-feedback"], 1);
}

#[test]
fn a_state_of_other_channels_is_refused() {
    let error = worker()
        .restore(screening_worker().state())
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("screened channels of a checkpoint"),
        "{error}"
    );
}
