mod restarts;

use super::*;
use spandrel_bus::{
    ChannelState, LocalDensity, MaskedSpan, NodeHealth, NodeLineage, ScreenedChannel,
};
use std::path::Path;

const FILE: &str = include_str!("../../../../docs/examples/forty-storey-building.toml");
const SECOND_NS: i64 = 1_000_000_000;

fn structure() -> Structure {
    Structure::parse(FILE, Path::new("forty-storey-building.toml")).unwrap()
}

/// Returns the message of a node that has learnt a little about every parameter.
fn message(epoch: u64, index: u64, pace: Pace, mean: f64) -> LocalMessage {
    let covariance = (0..10)
        .flat_map(|j| (0..=j).map(move |i| if i == j { 0.008 } else { 0.0 }))
        .collect();
    LocalMessage {
        header: Header {
            source: "node".into(),
            epoch,
            sequence: index,
            time_ns: i64::try_from(index)
                .unwrap_or(i64::MAX)
                .saturating_mul(SECOND_NS),
        },
        pace,
        density: Some(LocalDensity {
            mean: vec![mean; 10],
            covariance,
            lineage: Some(NodeLineage {
                own: index - 1,
                answers: Vec::new(),
            }),
            motion: None,
        }),
        restarts: 0,
        samples: 250,
        screening: Vec::new(),
        state: StreamState::Running,
    }
}

fn local(node: usize, message: LocalMessage) -> FusionInput {
    let arrived_ns = message.header.time_ns;
    FusionInput::Local {
        node,
        message: Box::new(message),
        bytes: 500,
        arrived_ns,
    }
}

fn run(fusion: &mut Fusion, inputs: impl IntoIterator<Item = FusionInput>) -> Vec<Output> {
    let mut outputs = Vec::new();
    inputs
        .into_iter()
        .for_each(|input| fusion.handle(input, &mut outputs));
    outputs
}

fn estimates(outputs: &[Output]) -> Vec<&EstimateBlock> {
    let estimates = outputs.iter().filter_map(|output| match output {
        Output::Estimates(block) => Some(block),
        _ => None,
    });
    estimates.collect()
}

#[test]
fn station_reports_the_pace_of_its_nodes() {
    for pace in [Pace::Live, Pace::Replayed] {
        let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
        assert_eq!(fusion.pace(), None, "no node has spoken");
        run(
            &mut fusion,
            [
                FusionInput::Present(vec![true; 16]),
                local(0, message(3, 1, pace, 0.95)),
            ],
        );
        assert_eq!(fusion.pace(), Some(pace));
    }
}

#[test]
fn replayed_nodes_are_fused_after_all_messages_and_each_receives_a_reply() {
    let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
    let outputs = run(
        &mut fusion,
        (0..15).map(|node| local(node, message(3, 1, Pace::Replayed, 0.95))),
    );
    assert!(outputs.is_empty(), "node 15 has not spoken");
    let outputs = run(
        &mut fusion,
        [local(15, message(3, 1, Pace::Replayed, 0.95))],
    );
    let blocks = estimates(&outputs);
    assert_eq!(
        (
            blocks.len(),
            blocks[0].header.sequence,
            blocks[0].estimates.len()
        ),
        (1, 0, 1)
    );
    assert!(spandrel_bus::Message::check(blocks[0]).is_ok());
    let answers: Vec<_> = outputs
        .iter()
        .filter_map(|output| match output {
            Output::Feedback(node, feedback) => {
                Some((*node, feedback.answers, feedback.node_epoch, feedback.nodes))
            }
            _ => None,
        })
        .collect();
    assert_eq!(
        answers,
        (0..16).map(|node| (node, 1, 3, 16)).collect::<Vec<_>>()
    );
    assert_eq!(
        outputs
            .iter()
            .filter(|output| matches!(output, Output::Node(_)))
            .count(),
        16
    );
    assert_eq!(
        outputs
            .iter()
            .filter(|output| matches!(output, Output::Parameter(_)))
            .count(),
        10
    );
}

#[test]
fn station_does_not_wait_for_an_absent_replayed_node() {
    let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
    let mut present = vec![true; 16];
    run(&mut fusion, [FusionInput::Present(present.clone())]);
    run(
        &mut fusion,
        (0..16).map(|node| local(node, message(3, 1, Pace::Replayed, 0.95))),
    );
    let outputs = run(
        &mut fusion,
        (0..15).map(|node| local(node, message(3, 2, Pace::Replayed, 0.95))),
    );
    assert!(estimates(&outputs).is_empty());
    present[15] = false;
    let outputs = run(&mut fusion, [FusionInput::Present(present)]);
    assert_eq!(estimates(&outputs).len(), 1);
    let states: Vec<NodeHealth> = outputs
        .iter()
        .filter_map(|output| match output {
            Output::Node(node) => Some(node.state),
            _ => None,
        })
        .collect();
    assert_eq!(
        (states[0], states[15]),
        (NodeHealth::Used, NodeHealth::Silent)
    );
}

#[test]
fn late_station_starts_at_the_present_period_of_the_nodes() {
    let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
    run(&mut fusion, [FusionInput::Present(vec![true; 16])]);
    for index in [5000, 5001, u64::MAX] {
        let outputs = run(
            &mut fusion,
            (0..16).map(|node| local(node, message(3, index, Pace::Replayed, 0.95))),
        );
        assert_eq!(
            estimates(&outputs).len(),
            1,
            "one fusion, however far the count has gone"
        );
    }
    assert_eq!(fusion.done(), 3);
}

#[test]
fn live_nodes_are_fused_at_each_tick_with_the_received_messages() {
    let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
    let outputs = run(
        &mut fusion,
        (0..9).map(|node| local(node, message(3, 1, Pace::Live, 0.95))),
    );
    assert!(outputs.is_empty());
    let outputs = run(
        &mut fusion,
        [
            FusionInput::Tick(SECOND_NS + SECOND_NS / 2),
            FusionInput::Tick(2 * SECOND_NS),
        ],
    );
    assert_eq!(estimates(&outputs).len(), 1);
    // Without further messages the information fades. A single delay by one period is no event.
    let told = |outputs: &[Output]| -> Vec<EventKind> {
        let of_station = |output: &Output| match output {
            Output::Event(event) if event.subject == "fuse" => Some(event.kind),
            _ => None,
        };
        outputs.iter().filter_map(of_station).collect()
    };
    let outputs = run(
        &mut fusion,
        [
            FusionInput::Tick(3 * SECOND_NS),
            FusionInput::Tick(4 * SECOND_NS),
        ],
    );
    let blocks = estimates(&outputs);
    assert_eq!(blocks.len(), 2);
    assert!(
        blocks
            .iter()
            .all(|block| block.estimates[0].flags.prediction_only)
    );
    assert_eq!(told(&outputs), []);
    // Three consecutive fusions without data cause one event, and so does their end.
    let outputs = run(
        &mut fusion,
        (5..9).map(|second| FusionInput::Tick(second * SECOND_NS)),
    );
    assert_eq!(told(&outputs), [EventKind::Gap]);
    let again = (0..9).map(|node| local(node, message(3, 9, Pace::Live, 0.95)));
    let outputs = run(
        &mut fusion,
        again.chain([
            FusionInput::Tick(9 * SECOND_NS + SECOND_NS / 2),
            FusionInput::Tick(10 * SECOND_NS),
        ]),
    );
    // These nodes have received no feedback, so the station adopts their estimates.
    assert_eq!(told(&outputs), [EventKind::Restart, EventKind::NodeBack]);
}

#[test]
fn stale_messages_and_epochs_are_rejected_and_a_new_epoch_is_accepted() {
    let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
    run(
        &mut fusion,
        [
            local(0, message(3, 1, Pace::Live, 0.95)),
            local(0, message(3, 2, Pace::Live, 0.95)),
        ],
    );
    run(
        &mut fusion,
        [
            local(0, message(3, 1, Pace::Live, 0.95)),
            local(0, message(2, 9, Pace::Live, 0.95)),
        ],
    );
    assert_eq!(
        fusion.refused(),
        BTreeMap::from([("refused-old".into(), 1), ("refused-stale-epoch".into(), 1)])
    );
    run(&mut fusion, [local(0, message(4, 1, Pace::Live, 0.95))]);
    assert_eq!(fusion.refused().values().sum::<u64>(), 2);
    let outputs = run(&mut fusion, [FusionInput::Tick(2 * SECOND_NS)]);
    assert!(
        outputs.iter().any(
            |output| matches!(output, Output::Feedback(0, feedback) if feedback.node_epoch == 4)
        )
    );
}

#[test]
fn disagreeing_node_is_excluded_and_reported_once() {
    let file = FILE.replace("detector = \"none\"", "detector = \"one-at-a-time\"");
    let structure = Structure::parse(&file, Path::new("building.toml")).unwrap();
    let mut fusion = Fusion::new(&structure, "fuse", 7).unwrap();
    run(&mut fusion, [FusionInput::Present(vec![true; 16])]);
    let mut events = 0;
    for index in 1..40 {
        let mean = |node| if node == 4 { 1.9 } else { 0.95 };
        let outputs = run(
            &mut fusion,
            (0..16).map(|node| local(node, message(3, index, Pace::Replayed, mean(node)))),
        );
        for output in &outputs {
            match output {
                Output::Event(event) => {
                    events += 1;
                    assert_eq!(
                        (event.kind, event.subject.as_str()),
                        (EventKind::NodeExcluded, "floor-5")
                    );
                }
                Output::Node(node) => {
                    assert_eq!(
                        node.state == NodeHealth::Excluded,
                        node.node.as_str() == "floor-5"
                    );
                    assert!(spandrel_bus::Message::check(node).is_ok());
                }
                Output::Estimates(block) => {
                    assert!((block.estimates[0].mean[0] - 0.95).abs() < 0.06)
                }
                Output::Parameter(_) | Output::Feedback(..) | Output::Outliers(..) => {}
            }
        }
    }
    assert_eq!(events, 1);
}

#[test]
fn weights_are_published_and_a_permanently_discounted_node_is_excluded() {
    let file = FILE.replace(
        "detector = \"none\"",
        "detector = \"one-at-a-time\"\nweighting = \"graded\"",
    );
    let structure = Structure::parse(&file, Path::new("building.toml")).unwrap();
    let mut fusion = Fusion::new(&structure, "fuse", 7).unwrap();
    run(&mut fusion, [FusionInput::Present(vec![true; 16])]);
    let mut weights = Vec::new();
    for index in 1..20 {
        // Ten parameters differ by 0.3, with variances of 0.008 on both sides: d² = 56 exceeds the
        // limit of 29.6.
        let mean = |node| if node == 4 { 1.25 } else { 0.95 };
        let outputs = run(
            &mut fusion,
            (0..16).map(|node| local(node, message(3, index, Pace::Replayed, mean(node)))),
        );
        for output in &outputs {
            let Output::Node(node) = output else { continue };
            assert!(spandrel_bus::Message::check(node).is_ok());
            if node.node.as_str() == "floor-5" {
                assert_eq!(node.state == NodeHealth::Excluded, node.weight == Some(0.0));
                weights.push(node.weight.unwrap());
            } else {
                assert_eq!(node.weight, Some(1.0));
            }
        }
    }
    assert!(
        weights[..3]
            .iter()
            .all(|weight| (weight - 29.588 / 56.25).abs() < 1e-3),
        "{weights:?}"
    );
    assert!(
        weights[3..].iter().all(|weight| *weight == 0.0),
        "{weights:?}"
    );
}

#[test]
fn last_block_ends_the_stream() {
    let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
    run(
        &mut fusion,
        (0..16).map(|node| local(node, message(3, 1, Pace::Replayed, 0.95))),
    );
    let ended = |node| {
        let mut last = message(3, 1, Pace::Replayed, 0.95);
        (last.density, last.state, last.header.time_ns) = (None, StreamState::Ended, 1_400_000_000);
        local(node, last)
    };
    let outputs = run(&mut fusion, (0..16).map(ended));
    let blocks = estimates(&outputs);
    assert_eq!(
        (blocks.len(), blocks[0].state, blocks[0].header.sequence),
        (1, StreamState::Ended, 1)
    );
    assert_eq!(fusion.done_ns(), Some(1_400_000_000));
}

/// Regression: one message that claimed to be replayed made the station wait for periods that live
/// nodes never complete.
#[test]
fn message_with_the_wrong_pace_does_not_stop_fusions_of_live_nodes() {
    let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
    run(&mut fusion, [FusionInput::Present(vec![true; 16])]);
    run(
        &mut fusion,
        (0..16).map(|node| local(node, message(3, 1, Pace::Live, 0.95))),
    );
    assert_eq!(
        estimates(&run(&mut fusion, [FusionInput::Tick(2 * SECOND_NS)])).len(),
        1
    );
    // This message has a later epoch, so the station rejects the next messages of node 5.
    run(
        &mut fusion,
        [local(5, message(4, 1000, Pace::Replayed, 0.95))],
    );
    for second in 3..6 {
        let index = second as u64 - 1;
        run(
            &mut fusion,
            (0..16).map(|node| local(node, message(3, index, Pace::Live, 0.95))),
        );
        assert_eq!(
            estimates(&run(&mut fusion, [FusionInput::Tick(second * SECOND_NS)])).len(),
            1,
            "second {second}"
        );
    }
}

/// Regression: fusions coincided with the arrival of messages from nodes that had started together.
/// Every few seconds, a fusion missed some of them.
#[test]
fn messages_a_third_of_a_period_early_or_late_are_used_in_each_fusion() {
    let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
    let jitter_ns = [0, -330_000_000, 330_000_000, 50_000_000, -50_000_000];
    let mut outputs = Vec::new();
    for (index, jitter_ns) in (1..).zip(jitter_ns) {
        let arrived_ns = index as i64 * SECOND_NS + jitter_ns;
        let message = message(3, index, Pace::Live, 0.95);
        fusion.handle(
            FusionInput::Local {
                node: 0,
                message: Box::new(message),
                bytes: 500,
                arrived_ns,
            },
            &mut outputs,
        );
        fusion.handle(
            FusionInput::Tick(index as i64 * SECOND_NS + SECOND_NS / 2),
            &mut outputs,
        );
    }
    let heard: Vec<bool> = estimates(&outputs)
        .iter()
        .map(|block| !block.estimates[0].flags.prediction_only)
        .collect();
    assert_eq!(heard, [true; 5]);
}

/// Regression: there was no fusion until the clock had reached its former time again.
#[test]
fn clock_set_back_does_not_stop_the_fusions() {
    let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
    let mut outputs = Vec::new();
    for index in 1..=6 {
        let hour_ns = if index > 3 { 3600 * SECOND_NS } else { 0 };
        let arrived_ns = 10_000 * SECOND_NS + index * SECOND_NS - hour_ns;
        let message = message(3, index as u64, Pace::Live, 0.95);
        fusion.handle(
            FusionInput::Local {
                node: 0,
                message: Box::new(message),
                bytes: 500,
                arrived_ns,
            },
            &mut outputs,
        );
        for tick in 0..20 {
            fusion.handle(
                FusionInput::Tick(arrived_ns + tick * SECOND_NS / 20),
                &mut outputs,
            );
        }
    }
    // Fusions follow the messages by half a second. When the clock is set back, one follows at
    // once, and the next a period later.
    let half_ns = SECOND_NS / 2;
    let blocks = estimates(&outputs);
    let between = blocks
        .windows(2)
        .map(|pair| (pair[1].header.time_ns - pair[0].header.time_ns) / half_ns);
    assert_eq!(between.collect::<Vec<_>>(), [2, 2, 1 - 2 * 3600, 2, 2]);
}

/// Regression: the station lost all information when its clock was set forward.
#[test]
fn clock_set_forward_does_not_age_the_information() {
    let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
    let mut outputs = Vec::new();
    for index in 1..=6 {
        let hour_ns = if index > 3 { 3600 * SECOND_NS } else { 0 };
        let arrived_ns = 10_000 * SECOND_NS + index * SECOND_NS + hour_ns;
        let message = message(3, index as u64, Pace::Live, 0.95);
        fusion.handle(
            FusionInput::Local {
                node: 0,
                message: Box::new(message),
                bytes: 500,
                arrived_ns,
            },
            &mut outputs,
        );
        for tick in 0..20 {
            fusion.handle(
                FusionInput::Tick(arrived_ns + tick * SECOND_NS / 20),
                &mut outputs,
            );
        }
    }
    let blocks = estimates(&outputs);
    assert!((5..=7).contains(&blocks.len()), "{}", blocks.len());
    let variances: Vec<f64> = blocks
        .iter()
        .map(|block| block.estimates[0].covariance[0])
        .collect();
    assert!(
        variances.iter().all(|variance| *variance < 0.012),
        "{variances:?}"
    );
    let growth = variances.windows(2).map(|pair| pair[1] / pair[0]);
    assert!(growth.fold(0.0, f64::max) < 1.5, "{variances:?}");
}

#[test]
fn restarted_station_replies_with_the_estimates_of_the_nodes() {
    let mut fusion = Fusion::new(&structure(), "fuse", 8).unwrap();
    run(&mut fusion, [FusionInput::Present(vec![true; 16])]);
    let known = |index| {
        let mut known = message(3, index, Pace::Live, 0.8);
        let density = known.density.as_mut().unwrap();
        density
            .covariance
            .iter_mut()
            .for_each(|entry| *entry *= 0.01);
        density.lineage = Some(NodeLineage {
            own: index - 1,
            answers: vec![index - 1],
        });
        known
    };
    run(&mut fusion, (0..16).map(|node| local(node, known(500))));
    let outputs = run(&mut fusion, [FusionInput::Tick(501 * SECOND_NS)]);
    let answers = outputs.iter().filter_map(|output| match output {
        Output::Feedback(_, feedback) => Some(feedback),
        _ => None,
    });
    let answers: Vec<_> = answers.collect();
    assert_eq!(answers.len(), 16);
    for answer in answers {
        assert!(
            (answer.mean[0] - 0.8).abs() < 1e-9 && answer.covariance[0] < 1e-4,
            "{answer:?}"
        );
    }
    let events = outputs
        .iter()
        .filter(|output| matches!(output, Output::Event(event) if event.subject == "fuse"));
    assert_eq!(events.count(), 1);
}

#[test]
fn replayed_nodes_are_fused_by_sample_times_and_not_by_message_numbers() {
    let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
    run(&mut fusion, [FusionInput::Present(vec![true; 16])]);
    // Node 15 started five periods after the others.
    for index in 1..=10_u64 {
        let outputs = run(
            &mut fusion,
            (0..15).map(|node| local(node, message(3, index, Pace::Replayed, 0.95))),
        );
        assert!(estimates(&outputs).is_empty(), "{index}");
        if index < 6 {
            continue;
        }
        let mut late = message(3, index - 5, Pace::Replayed, 0.95);
        late.header.time_ns = index as i64 * SECOND_NS;
        let outputs = run(&mut fusion, [local(15, late)]);
        assert_eq!(
            estimates(&outputs).last().map(|block| block.header.time_ns),
            Some(index as i64 * SECOND_NS)
        );
    }
}

#[test]
fn reply_contains_only_variances_if_the_file_requests_it() {
    let file = FILE.replace("[fusion]", "[fusion]\ncovariance = \"variances\"");
    let structure = Structure::parse(&file, Path::new("building.toml")).unwrap();
    let mut fusion = Fusion::new(&structure, "fuse", 7).unwrap();
    let outputs = run(
        &mut fusion,
        (0..16).map(|node| local(node, message(3, 1, Pace::Replayed, 0.95))),
    );
    let answered = |output: &Output| matches!(output, Output::Feedback(_, feedback) if feedback.covariance.len() == 10);
    assert_eq!(outputs.iter().filter(|output| answered(output)).count(), 16);
}

fn events(outputs: &[Output]) -> Vec<(EventKind, &str, i64)> {
    let events = outputs.iter().filter_map(|output| match output {
        Output::Event(event) => Some((
            event.kind,
            event.subject.as_str(),
            event.time_ns / SECOND_NS,
        )),
        _ => None,
    });
    events.collect()
}

fn health(outputs: &[Output], node: usize) -> Vec<NodeHealth> {
    let name = structure().nodes()[node].name().to_owned();
    let states = outputs.iter().filter_map(|output| match output {
        Output::Node(display) if display.node.as_str() == name => Some(display.state),
        _ => None,
    });
    states.collect()
}

/// Sends the messages of live nodes in each of these seconds. The station fuses half a second
/// later.
fn live(
    fusion: &mut Fusion,
    seconds: std::ops::Range<u64>,
    sends: impl Fn(usize, u64) -> Option<LocalMessage>,
) -> Vec<Output> {
    let mut outputs = Vec::new();
    for second in seconds {
        for node in 0..16 {
            outputs.extend(
                sends(node, second)
                    .map(|message| local(node, message))
                    .into_iter()
                    .flat_map(|input| run(fusion, [input])),
            );
        }
        outputs.extend(run(
            fusion,
            [FusionInput::Tick(second as i64 * SECOND_NS + SECOND_NS / 2)],
        ));
    }
    outputs
}

/// Regression: there was no event when a node became silent.
#[test]
fn silence_and_return_of_a_node_are_reported_once_each() {
    let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
    run(&mut fusion, [FusionInput::Present(vec![true; 16])]);
    let silent = |second| (10..20).contains(&second);
    let sends =
        |node, second| (node != 5 || !silent(second)).then(|| message(3, second, Pace::Live, 0.95));
    let outputs = live(&mut fusion, 1..30, sends);
    // The event follows the third fusion without the node, so that a single lost message causes
    // none.
    assert_eq!(
        events(&outputs),
        [
            (EventKind::NodeSilent, "floor-8", 12),
            (EventKind::NodeBack, "floor-8", 20)
        ]
    );
    let displays = outputs.iter().filter_map(|output| match output {
        Output::Node(display) if display.node.as_str() == "floor-8" => Some(display),
        _ => None,
    });
    for display in displays {
        let is_silent = silent((display.time_ns / SECOND_NS) as u64);
        let (since_s, heard_s) = (
            display.silent_since_ns.map(|ns| ns / SECOND_NS),
            display.heard_ns.unwrap() / SECOND_NS,
        );
        assert_eq!(
            display.state,
            if is_silent {
                NodeHealth::Silent
            } else {
                NodeHealth::Used
            }
        );
        assert_eq!(since_s, is_silent.then_some(10));
        assert_eq!(
            heard_s,
            if is_silent {
                9
            } else {
                display.time_ns / SECOND_NS
            }
        );
    }
}

#[test]
fn node_without_samples_is_silent_although_its_worker_sends() {
    let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
    run(&mut fusion, [FusionInput::Present(vec![true; 16])]);
    let sends = |node, second| {
        let samples = if node == 5 && second >= 10 { 0 } else { 250 };
        Some(LocalMessage {
            samples,
            ..message(3, second, Pace::Live, 0.95)
        })
    };
    let outputs = live(&mut fusion, 1..15, sends);
    assert_eq!(events(&outputs), [(EventKind::NodeSilent, "floor-8", 12)]);
    assert_eq!(health(&outputs, 5).last(), Some(&NodeHealth::Silent));
}

/// Regression: predictions of nodes whose sensors had all failed counted as measured, and alerts
/// were decided by them.
#[test]
fn estimates_without_samples_of_any_node_are_predictions() {
    let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
    run(&mut fusion, [FusionInput::Present(vec![true; 16])]);
    let sends = |_, second| {
        let samples = if (5..10).contains(&second) { 0 } else { 250 };
        Some(LocalMessage {
            samples,
            ..message(3, second, Pace::Live, 0.95)
        })
    };
    let outputs = live(&mut fusion, 1..12, sends);
    let flags = estimates(&outputs)
        .into_iter()
        .map(|block| block.estimates[0].flags);
    let found: Vec<_> = flags
        .map(|flags| (flags.prediction_only, flags.phase))
        .collect();
    let mut expected = [(false, Phase::Working); 11];
    expected[4..6].fill((true, Phase::Working));
    expected[6..9].fill((true, Phase::ResponseSilent));
    assert_eq!(found, expected);
    let told: Vec<_> = events(&outputs)
        .into_iter()
        .filter(|(_, subject, _)| *subject == "fuse")
        .collect();
    assert_eq!(
        told,
        [
            (EventKind::Gap, "fuse", 7),
            (EventKind::NodeBack, "fuse", 10)
        ]
    );
}

/// Regression: the flag was never set, so that the prior cleared alerts.
#[test]
fn estimate_of_a_station_that_restarts_from_its_prior_is_marked() {
    let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
    run(&mut fusion, [FusionInput::Present(vec![true; 16])]);
    let implausible = |node, second| {
        let mut message = sends_certain(node, second);
        if second == 3 {
            message.density.as_mut().unwrap().mean.fill(50.0);
        }
        Some(message)
    };
    let outputs = live(&mut fusion, 1..5, implausible);
    let restarted = estimates(&outputs)
        .into_iter()
        .map(|block| block.estimates[0].flags.restarted);
    assert_eq!(restarted.collect::<Vec<_>>(), [false, false, true, false]);
}

/// Returns the message of a node that is certain of its parameters and uses each reply at once.
fn sends_certain(_: usize, second: u64) -> LocalMessage {
    let mut message = message(3, second, Pace::Live, 0.95);
    let density = message.density.as_mut().unwrap();
    density
        .covariance
        .iter_mut()
        .for_each(|entry| *entry *= 1e-3);
    let lineage = density.lineage.as_mut().unwrap();
    lineage.answers.extend((1..second).next_back());
    message
}

/// Returns the times of the fusions (s) that the blocks state, and those that the numbers of their
/// estimates state.
fn times(outputs: &[Output]) -> Vec<(i64, i64)> {
    let blocks = estimates(outputs).into_iter();
    let with_estimate = blocks.filter(|block| !block.estimates.is_empty());
    let times = with_estimate.map(|block| {
        let of_number = block.grid().unwrap().time_ns(block.header.sequence);
        (block.header.time_ns / SECOND_NS, of_number / SECOND_NS)
    });
    times.collect()
}

fn replay(fusion: &mut Fusion, periods: impl IntoIterator<Item = (u64, i64)>) -> Vec<Output> {
    let mut outputs = Vec::new();
    for (index, second) in periods {
        for node in 0..16 {
            let mut message = message(3, index, Pace::Replayed, 0.95);
            message.header.time_ns = second * SECOND_NS;
            outputs.extend(run(fusion, [local(node, message)]));
        }
    }
    outputs
}

/// Regression: after a gap of a record, estimates and alerts stated times within the gap.
#[test]
fn numbers_state_the_times_of_their_fusions_after_a_gap() {
    let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
    run(&mut fusion, [FusionInput::Present(vec![true; 16])]);
    let outputs = replay(&mut fusion, [(1, 1), (2, 2), (7203, 7203), (7204, 7204)]);
    let expected = [1, 2, 7203, 7204].map(|second| (second, second));
    assert_eq!(times(&outputs), expected);
}

/// Regression: the station waited for later periods than those of the second replay.
#[test]
fn record_that_is_replayed_again_is_fused_again() {
    let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
    run(&mut fusion, [FusionInput::Present(vec![true; 16])]);
    let ended = |node, index| {
        let mut last = message(3, index, Pace::Replayed, 0.95);
        (last.density, last.state) = (None, StreamState::Ended);
        local(node, last)
    };
    replay(&mut fusion, (1..4).map(|index| (index, index as i64)));
    // Nodes 1 to 15 have ended and begin again before node 0 has ended.
    run(&mut fusion, (1..16).map(|node| ended(node, 3)));
    let again = |node| {
        let mut first = message(3, 4, Pace::Replayed, 0.95);
        first.header.time_ns = SECOND_NS;
        local(node, first)
    };
    let outputs = run(&mut fusion, (1..16).map(again));
    assert_eq!(times(&outputs), [], "node 0 is in the former replay");
    run(&mut fusion, [ended(0, 3)]);
    let outputs = run(&mut fusion, [again(0)]);
    assert_eq!(times(&outputs), [(1, 1)]);
    let used = outputs.iter().find_map(|output| match output {
        Output::Feedback(0, feedback) => Some(feedback.nodes),
        _ => None,
    });
    assert_eq!(used, Some(16));
    let outputs = replay(&mut fusion, [(5, 2), (6, 3), (7, 4)]);
    assert_eq!(times(&outputs), [2, 3, 4].map(|second| (second, second)));
}

#[test]
fn repeated_message_begins_no_new_replay() {
    let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
    run(&mut fusion, [FusionInput::Present(vec![true; 16])]);
    replay(&mut fusion, (1..4).map(|index| (index, index as i64)));
    run(&mut fusion, [local(0, message(3, 1, Pace::Replayed, 0.95))]);
    assert_eq!(fusion.refused()["refused-old"], 1);
    let outputs = replay(&mut fusion, [(4, 4)]);
    assert_eq!(times(&outputs), [(4, 4)]);
}

#[test]
fn return_of_an_excluded_node_is_reported() {
    let file = FILE.replace("detector = \"none\"", "detector = \"one-at-a-time\"");
    let structure = Structure::parse(&file, Path::new("building.toml")).unwrap();
    let mut fusion = Fusion::new(&structure, "fuse", 7).unwrap();
    run(&mut fusion, [FusionInput::Present(vec![true; 16])]);
    let mean = |node, second| if node == 4 && second < 40 { 1.9 } else { 0.95 };
    let outputs = live(&mut fusion, 1..90, |node, second| {
        Some(message(3, second, Pace::Live, mean(node, second)))
    });
    let told: Vec<_> = events(&outputs)
        .into_iter()
        .map(|(kind, subject, _)| (kind, subject))
        .collect();
    assert_eq!(
        told,
        [
            (EventKind::NodeExcluded, "floor-5"),
            (EventKind::NodeBack, "floor-5")
        ]
    );
}

/// Regression: no fusion followed the end of the last nodes, so their displayed state remained that
/// of the last fusion.
#[test]
fn last_nodes_are_displayed_as_ended() {
    for pace in [Pace::Replayed, Pace::Live] {
        let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
        run(&mut fusion, [FusionInput::Present(vec![true; 16])]);
        live(&mut fusion, 1..4, |_, second| {
            Some(message(3, second, pace, 0.95))
        });
        let ended = |_, _| {
            let last = message(3, 3, pace, 0.95);
            Some(LocalMessage {
                density: None,
                state: StreamState::Ended,
                ..last
            })
        };
        let outputs = live(&mut fusion, 4..8, ended);
        for node in 0..16 {
            assert_eq!(
                health(&outputs, node).last(),
                Some(&NodeHealth::Ended),
                "{pace:?} node {node}"
            );
        }
        assert_eq!(
            estimates(&outputs).last().map(|block| block.state),
            Some(StreamState::Ended),
            "{pace:?}"
        );
        // A sensor that restarts under the same worker is used again.
        let outputs = live(&mut fusion, 8..10, |_, second| {
            Some(message(3, second, pace, 0.95))
        });
        assert_eq!(
            health(&outputs, 0).last(),
            Some(&NodeHealth::Used),
            "{pace:?}"
        );
    }
}

/// Regression: the station did not notice that all nodes had disappeared.
#[test]
fn all_nodes_have_ended_without_their_tokens() {
    let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
    run(&mut fusion, [FusionInput::Present(vec![true; 16])]);
    live(&mut fusion, 1..4, |_, second| {
        Some(message(3, second, Pace::Live, 0.95))
    });
    let one = (0..16).map(|node| node == 3).collect();
    assert!(
        run(&mut fusion, [FusionInput::Present(one)]).is_empty(),
        "one is there"
    );
    let outputs = run(&mut fusion, [FusionInput::Present(vec![false; 16])]);
    assert_eq!(events(&outputs), [(EventKind::NodeSilent, "fuse", 3)]);
    assert!(
        (0..16).all(|node| health(&outputs, node) == [NodeHealth::Ended]),
        "{outputs:?}"
    );
    // The nodes remain ended in later fusions until a node is present again.
    let outputs = live(&mut fusion, 4..12, |_, _| None);
    assert_eq!(health(&outputs, 3), [NodeHealth::Ended; 8]);
    assert!(
        events(&outputs)
            .iter()
            .all(|(_, subject, _)| *subject == "fuse"),
        "{:?}",
        events(&outputs)
    );
    run(&mut fusion, [FusionInput::Present(vec![true; 16])]);
    let outputs = live(&mut fusion, 12..14, |_, second| {
        Some(message(3, second, Pace::Live, 0.95))
    });
    assert_eq!(health(&outputs, 3), [NodeHealth::Used; 2]);
}

#[test]
fn screening_results_of_nodes_are_published_by_channel_name() {
    let file = FILE.replace("[fusion]", "[outliers]\n\n[fusion]");
    let structure = Structure::parse(&file, Path::new("building.toml")).unwrap();
    let mut fusion = Fusion::new(&structure, "fuse", 7).unwrap();
    let names: Vec<String> = fusion
        .screened_channels()
        .flatten()
        .map(ToString::to_string)
        .collect();
    assert_eq!((names.len(), names[1].as_str()), (32, "acceleration-1"));
    let screened = |rejected, masked| ScreenedChannel {
        state: ChannelState::Screening,
        rejected,
        screened: 500,
        recent_share: 0.25,
        scale: 0.5,
        masked,
    };
    let span = MaskedSpan {
        from_ns: 5,
        to_ns: 9,
        samples: 3,
    };
    let mut told = Vec::new();
    for (index, rejected, masked) in [(1, 3, Some(span)), (2, 3, None), (3, 5, None), (4, 1, None)]
    {
        let screening = vec![screened(0, None), screened(rejected, masked)];
        told.extend(run(
            &mut fusion,
            [local(
                0,
                LocalMessage {
                    screening,
                    ..message(3, index, Pace::Live, 0.95)
                },
            )],
        ));
    }
    let of_second = told.iter().filter_map(|output| match output {
        Output::Outliers(0, display) if display.channel.as_str() == "acceleration-1" => {
            Some(display)
        }
        _ => None,
    });
    let found: Vec<_> = of_second
        .map(|display| (display.flagged, display.rejected, display.masked))
        .collect();
    // The last count is from a filter that has restarted.
    assert_eq!(
        found,
        [
            (3, 3, Some(span)),
            (0, 3, Some(span)),
            (2, 5, Some(span)),
            (1, 1, Some(span))
        ]
    );
    // The channels differ from the channels of the node.
    run(
        &mut fusion,
        [local(
            0,
            LocalMessage {
                screening: vec![screened(0, None)],
                ..message(3, 5, Pace::Live, 0.95)
            },
        )],
    );
    assert_eq!(
        fusion.refused(),
        BTreeMap::from([("refused-screening".into(), 1)])
    );
}
