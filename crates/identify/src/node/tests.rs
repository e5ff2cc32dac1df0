use super::*;
use std::path::Path;

const FILE: &str = include_str!("../../../../docs/examples/forty-storey-building.toml");

/// The fourth node at 25 Hz, which tells no motion.
fn worker() -> NodeIdentification {
    let mut text = FILE.to_owned();
    for (line, other) in
        [("sampling-rate-hz = 250", "sampling-rate-hz = 25"), ("motion = \"samples\"", "motion = \"none\"")]
    {
        assert_eq!(text.matches(line).count(), 1, "{line}");
        text = text.replace(line, other);
    }
    let structure = Structure::parse(&text, Path::new("building.toml")).unwrap();
    NodeIdentification::new(&structure, 3, 5).unwrap()
}

/// Samples from number `from` to before `to` of a slow swing, from time 0 on.
fn samples(from: u64, to: u64, pace: Pace) -> SampleBlock {
    let value = |number: u64| [0.001 * (number as f64 * 0.06).sin(), -0.01 * (number as f64 * 0.06).sin()];
    SampleBlock {
        header: Header { source: "floor-4".into(), epoch: 1, sequence: from, time_ns: (from * 40_000_000) as i64 },
        sampling_rate_hz: 25.0,
        pace,
        channels: 2,
        samples: (from..to).flat_map(value).collect(),
        state: StreamState::Running,
    }
}

fn run(worker: &mut NodeIdentification, inputs: impl IntoIterator<Item = NodeInput>) -> Vec<LocalMessage> {
    let mut outputs = Vec::new();
    inputs.into_iter().for_each(|input| worker.handle(input, &mut outputs));
    let local = outputs.into_iter().filter_map(|output| match output {
        NodeOutput::Local(message) => Some(message),
        NodeOutput::Event(_) => None,
    });
    local.collect()
}

fn answer(message: &LocalMessage) -> NodeInput {
    let density = message.density.clone().unwrap();
    NodeInput::Feedback(FeedbackMessage {
        header: Header { source: "fuse".into(), epoch: 9, sequence: 0, time_ns: 0 },
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
fn live_samples_wait_for_nothing() {
    let mut worker = worker();
    let sent = run(&mut worker, [NodeInput::Samples(samples(0, 100, Pace::Live))]);
    let indices: Vec<u64> = sent.iter().map(|message| message.header.sequence).collect();
    assert_eq!(indices, [1, 2, 3, 4]);
    assert_eq!(sent[1].header.time_ns, 49 * 40_000_000);
    assert_eq!(sent[1].density.as_ref().unwrap().lineage, Some(NodeLineage { own: 1, answers: Vec::new() }));
    for message in &sent {
        assert!(spandrel_bus::Message::check(message).is_ok());
    }
}

#[test]
fn replayed_samples_wait_for_each_answer_whatever_the_blocks() {
    let means = |cuts: &[u64]| {
        let mut worker = worker();
        let mut inputs: VecDeque<NodeInput> =
            cuts.windows(2).map(|cut| NodeInput::Samples(samples(cut[0], cut[1], Pace::Replayed))).collect();
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
    assert!((whole[1][0] - whole[0][0] - 0.01).abs() < 0.02, "the answer has been taken");
}

#[test]
fn a_late_answer_gives_the_same_as_one_in_time() {
    let late = |samples_late: u64| {
        let mut worker = worker();
        let first = run(&mut worker, [NodeInput::Samples(samples(0, 25, Pace::Live))]);
        let middle = 25 + samples_late;
        run(&mut worker, [NodeInput::Samples(samples(25, middle, Pace::Live)), answer(&first[0])]);
        let second = run(&mut worker, [NodeInput::Samples(samples(middle, 50, Pace::Live))]);
        second[0].density.clone().unwrap()
    };
    let in_time = late(0);
    for samples_late in [1, 5, 24] {
        assert_eq!(late(samples_late), in_time, "{samples_late} samples late");
    }
}

#[test]
fn gaps_are_bridged_and_nonsense_is_dropped() {
    let mut worker = worker();
    let mut wild = samples(25, 50, Pace::Live);
    wild.samples[4] = 1e30;
    wild.samples[7] = f64::INFINITY;
    let foreign = SampleBlock { channels: 3, samples: vec![0.0; 6], ..samples(50, 60, Pace::Live) };
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
    assert!(sent.iter().flat_map(|message| &message.density.as_ref().unwrap().mean).all(|mean| mean.is_finite()));
}

#[test]
fn answers_of_no_use_change_nothing() {
    let mut worker = worker();
    let first = run(&mut worker, [NodeInput::Samples(samples(0, 25, Pace::Live))]);
    let NodeInput::Feedback(good) = answer(&first[0]) else { unreachable!() };
    let before = worker.filter().filter().parameters();
    let nan = FeedbackMessage { mean: vec![f64::NAN; 10], ..good.clone() };
    let other_life = FeedbackMessage { node_epoch: 4, ..good.clone() };
    let never_sent = FeedbackMessage { answers: 2, ..good.clone() };
    let short = FeedbackMessage { mean: vec![1.0; 3], covariance: vec![1.0; 3], ..good.clone() };
    run(&mut worker, [nan, other_life, never_sent, short].map(NodeInput::Feedback));
    assert_eq!(worker.filter().filter().parameters(), before);
    assert_eq!((worker.dropped()["useless-feedback"], worker.dropped()["stale-feedback"]), (2, 2));
    run(&mut worker, [NodeInput::Feedback(good.clone())]);
    assert_ne!(worker.filter().filter().parameters(), before);
    run(&mut worker, [NodeInput::Feedback(good)]);
    assert_eq!(worker.dropped()["stale-feedback"], 3, "a repeat");
}
