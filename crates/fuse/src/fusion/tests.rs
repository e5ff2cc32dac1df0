use super::*;
use spandrel_bus::{LocalDensity, NodeLineage};
use std::path::Path;

const FILE: &str = include_str!("../../../../docs/examples/forty-storey-building.toml");
const SECOND_NS: i64 = 1_000_000_000;

fn structure() -> Structure {
    Structure::parse(FILE, Path::new("forty-storey-building.toml")).unwrap()
}

/// What a node sends that has learnt a little of everything.
fn message(epoch: u64, index: u64, pace: Pace, mean: f64) -> LocalMessage {
    let covariance = (0..10).flat_map(|j| (0..=j).map(move |i| if i == j { 0.008 } else { 0.0 })).collect();
    LocalMessage {
        header: Header {
            source: "node".into(),
            epoch,
            sequence: index,
            time_ns: (index as i64).saturating_mul(SECOND_NS),
        },
        pace,
        density: Some(LocalDensity {
            mean: vec![mean; 10],
            covariance,
            lineage: Some(NodeLineage { own: index - 1, answers: Vec::new() }),
            motion: None,
        }),
        restarts: 0,
        state: StreamState::Running,
    }
}

fn local(node: usize, message: LocalMessage) -> Input {
    let arrived_ns = message.header.time_ns;
    Input::Local { node, message, bytes: 500, arrived_ns }
}

fn run(fusion: &mut Fusion, inputs: impl IntoIterator<Item = Input>) -> Vec<Output> {
    let mut outputs = Vec::new();
    inputs.into_iter().for_each(|input| fusion.handle(input, &mut outputs));
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
fn replayed_nodes_are_fused_when_all_have_spoken_and_answered_by_name() {
    let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
    let outputs = run(&mut fusion, (0..15).map(|node| local(node, message(3, 1, Pace::Replayed, 0.95))));
    assert!(outputs.is_empty(), "node 15 has not spoken");
    let outputs = run(&mut fusion, [local(15, message(3, 1, Pace::Replayed, 0.95))]);
    let blocks = estimates(&outputs);
    assert_eq!((blocks.len(), blocks[0].header.sequence, blocks[0].estimates.len()), (1, 0, 1));
    assert!(spandrel_bus::Message::check(blocks[0]).is_ok());
    let answers: Vec<_> = outputs
        .iter()
        .filter_map(|output| match output {
            Output::Feedback(node, feedback) => Some((*node, feedback.answers, feedback.node_epoch, feedback.nodes)),
            _ => None,
        })
        .collect();
    assert_eq!(answers, (0..16).map(|node| (node, 1, 3, 16)).collect::<Vec<_>>());
    assert_eq!(outputs.iter().filter(|output| matches!(output, Output::Node(_))).count(), 16);
    assert_eq!(outputs.iter().filter(|output| matches!(output, Output::Parameter(_))).count(), 10);
}

#[test]
fn a_replaying_node_that_is_gone_is_not_waited_for() {
    let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
    let mut present = vec![true; 16];
    run(&mut fusion, [Input::Present(present.clone())]);
    run(&mut fusion, (0..16).map(|node| local(node, message(3, 1, Pace::Replayed, 0.95))));
    let outputs = run(&mut fusion, (0..15).map(|node| local(node, message(3, 2, Pace::Replayed, 0.95))));
    assert!(estimates(&outputs).is_empty());
    present[15] = false;
    let outputs = run(&mut fusion, [Input::Present(present)]);
    assert_eq!(estimates(&outputs).len(), 1);
    let states: Vec<NodeHealth> = outputs
        .iter()
        .filter_map(|output| match output {
            Output::Node(node) => Some(node.state),
            _ => None,
        })
        .collect();
    assert_eq!((states[0], states[15]), (NodeHealth::Used, NodeHealth::Silent));
}

#[test]
fn a_station_that_comes_late_begins_where_the_nodes_are() {
    let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
    run(&mut fusion, [Input::Present(vec![true; 16])]);
    for index in [5000, 5001, u64::MAX] {
        let outputs = run(&mut fusion, (0..16).map(|node| local(node, message(3, index, Pace::Replayed, 0.95))));
        assert_eq!(estimates(&outputs).len(), 1, "one fusion, however far the count has gone");
    }
    assert_eq!(fusion.done(), 3);
}

#[test]
fn live_nodes_are_fused_at_the_ticks_with_what_has_come() {
    let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
    let outputs = run(&mut fusion, (0..9).map(|node| local(node, message(3, 1, Pace::Live, 0.95))));
    assert!(outputs.is_empty());
    let outputs = run(&mut fusion, [Input::Tick(SECOND_NS + SECOND_NS / 2), Input::Tick(2 * SECOND_NS)]);
    assert_eq!(estimates(&outputs).len(), 1);
    // nothing more has come: what is known fades, and an event says so once
    let outputs = run(&mut fusion, [Input::Tick(3 * SECOND_NS), Input::Tick(4 * SECOND_NS)]);
    let blocks = estimates(&outputs);
    assert_eq!(blocks.len(), 2);
    assert!(blocks.iter().all(|block| block.estimates[0].flags.prediction_only));
    assert_eq!(outputs.iter().filter(|output| matches!(output, Output::Event(_))).count(), 1);
}

#[test]
fn old_messages_and_old_lives_are_refused_and_a_new_life_is_taken() {
    let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
    run(&mut fusion, [local(0, message(3, 1, Pace::Live, 0.95)), local(0, message(3, 2, Pace::Live, 0.95))]);
    run(&mut fusion, [local(0, message(3, 1, Pace::Live, 0.95)), local(0, message(2, 9, Pace::Live, 0.95))]);
    assert_eq!(fusion.refused(), BTreeMap::from([("refused-old".into(), 1), ("refused-stale-epoch".into(), 1)]));
    run(&mut fusion, [local(0, message(4, 1, Pace::Live, 0.95))]);
    assert_eq!(fusion.refused().values().sum::<u64>(), 2);
    let outputs = run(&mut fusion, [Input::Tick(2 * SECOND_NS)]);
    assert!(outputs.iter().any(|output| matches!(output, Output::Feedback(0, feedback) if feedback.node_epoch == 4)));
}

#[test]
fn a_node_that_disagrees_is_left_out_and_told_of_once() {
    let file = FILE.replace("detector = \"none\"", "detector = \"one-at-a-time\"");
    let structure = Structure::parse(&file, Path::new("building.toml")).unwrap();
    let mut fusion = Fusion::new(&structure, "fuse", 7).unwrap();
    run(&mut fusion, [Input::Present(vec![true; 16])]);
    let mut events = 0;
    for index in 1..40 {
        let mean = |node| if node == 4 { 1.9 } else { 0.95 };
        let outputs = run(&mut fusion, (0..16).map(|node| local(node, message(3, index, Pace::Replayed, mean(node)))));
        for output in &outputs {
            match output {
                Output::Event(event) => {
                    events += 1;
                    assert_eq!((event.kind, event.subject.as_str()), (EventKind::NodeExcluded, "floor-5"));
                }
                Output::Node(node) => {
                    assert_eq!(node.state == NodeHealth::Excluded, node.node.as_str() == "floor-5");
                    assert!(spandrel_bus::Message::check(node).is_ok());
                }
                Output::Estimates(block) => assert!((block.estimates[0].mean[0] - 0.95).abs() < 0.06),
                Output::Parameter(_) | Output::Feedback(..) => {}
            }
        }
    }
    assert_eq!(events, 1);
}

#[test]
fn the_last_block_says_that_it_is_the_last() {
    let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
    run(&mut fusion, (0..16).map(|node| local(node, message(3, 1, Pace::Replayed, 0.95))));
    let ended = |node| {
        let mut last = message(3, 1, Pace::Replayed, 0.95);
        (last.density, last.state, last.header.time_ns) = (None, StreamState::Ended, 1_400_000_000);
        local(node, last)
    };
    let outputs = run(&mut fusion, (0..16).map(ended));
    let blocks = estimates(&outputs);
    assert_eq!((blocks.len(), blocks[0].state, blocks[0].header.sequence), (1, StreamState::Ended, 1));
    assert_eq!(fusion.done_ns(), Some(1_400_000_000));
}

/// Broke: one message that claims to replay made the station wait for periods that live nodes never complete.
#[test]
fn a_message_that_claims_to_replay_does_not_stop_the_fusions_of_live_nodes() {
    let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
    run(&mut fusion, [Input::Present(vec![true; 16])]);
    run(&mut fusion, (0..16).map(|node| local(node, message(3, 1, Pace::Live, 0.95))));
    assert_eq!(estimates(&run(&mut fusion, [Input::Tick(2 * SECOND_NS)])).len(), 1);
    // of a later life, so that what node 5 sends from now on is refused
    run(&mut fusion, [local(5, message(4, 1000, Pace::Replayed, 0.95))]);
    for second in 3..6 {
        let index = second as u64 - 1;
        run(&mut fusion, (0..16).map(|node| local(node, message(3, index, Pace::Live, 0.95))));
        assert_eq!(estimates(&run(&mut fusion, [Input::Tick(second * SECOND_NS)])).len(), 1, "second {second}");
    }
}

/// Broke: fusions were due when the messages of nodes that had begun together came, and missed some of them every few seconds.
#[test]
fn messages_that_come_a_third_of_a_period_early_or_late_are_heard_in_each_fusion() {
    let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
    let jitter_ns = [0, -330_000_000, 330_000_000, 50_000_000, -50_000_000];
    let mut outputs = Vec::new();
    for (index, jitter_ns) in (1..).zip(jitter_ns) {
        let arrived_ns = index as i64 * SECOND_NS + jitter_ns;
        let message = message(3, index, Pace::Live, 0.95);
        fusion.handle(Input::Local { node: 0, message, bytes: 500, arrived_ns }, &mut outputs);
        fusion.handle(Input::Tick(index as i64 * SECOND_NS + SECOND_NS / 2), &mut outputs);
    }
    let heard: Vec<bool> = estimates(&outputs).iter().map(|block| !block.estimates[0].flags.prediction_only).collect();
    assert_eq!(heard, [true; 5]);
}

/// Broke: no fusion until the clock had come to where it had been.
#[test]
fn a_clock_that_is_set_back_does_not_stop_the_fusions() {
    let mut fusion = Fusion::new(&structure(), "fuse", 7).unwrap();
    let mut outputs = Vec::new();
    for index in 1..=6 {
        let hour_ns = if index > 3 { 3600 * SECOND_NS } else { 0 };
        let arrived_ns = 10_000 * SECOND_NS + index * SECOND_NS - hour_ns;
        let message = message(3, index as u64, Pace::Live, 0.95);
        fusion.handle(Input::Local { node: 0, message, bytes: 500, arrived_ns }, &mut outputs);
        for tick in 0..20 {
            fusion.handle(Input::Tick(arrived_ns + tick * SECOND_NS / 20), &mut outputs);
        }
    }
    // half a second after the messages; at once when the clock has gone back, and then a period later
    let half_ns = SECOND_NS / 2;
    let blocks = estimates(&outputs);
    let between = blocks.windows(2).map(|pair| (pair[1].header.time_ns - pair[0].header.time_ns) / half_ns);
    assert_eq!(between.collect::<Vec<_>>(), [2, 2, 1 - 2 * 3600, 2, 2]);
}
