use super::frames::MOST_BRIDGED;
use super::messages::MOST_BYTES;
use super::*;
use proptest::prelude::*;
use spandrel_bus::{Block, Estimate, EventKind, Excluded, Header, Phase, StreamState};
use std::path::Path;

fn structure() -> Structure {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo.toml");
    Structure::read(&path).unwrap()
}

/// Returns simulated frames of the demo building in one block.
fn frames(count: usize) -> FrameBlock {
    let values = structure()
        .simulator(5)
        .take(count)
        .flat_map(|frame| frame.values)
        .collect();
    FrameBlock {
        header: Header {
            source: "ingest".into(),
            epoch: 7,
            sequence: 0,
            time_ns: 0,
        },
        t0_ns: 0,
        sampling_rate_hz: 100.0,
        channels: 6,
        values,
        state: StreamState::Running,
    }
}

fn run(blocks: Vec<FrameBlock>) -> Vec<Output> {
    let mut core = Identification::new(&structure(), "identify").unwrap();
    let mut outputs = Vec::new();
    blocks
        .into_iter()
        .for_each(|block| core.handle(IdentificationInput::Frames(block), &mut outputs));
    outputs
}

fn estimates(outputs: &[Output]) -> Vec<&Estimate> {
    let blocks = outputs.iter().filter_map(|output| match output {
        Output::Estimates(block) => Some(block),
        _ => None,
    });
    blocks.flat_map(|block| &block.estimates).collect()
}

fn events(outputs: &[Output]) -> Vec<&Event> {
    outputs
        .iter()
        .filter_map(|output| {
            if let Output::Event(event) = output {
                Some(event)
            } else {
                None
            }
        })
        .collect()
}

/// Cuts a block into the given lengths and a rest.
fn cut(mut block: FrameBlock, lengths: &[u64]) -> Vec<FrameBlock> {
    let mut blocks = Vec::new();
    for &length in lengths {
        let mut head = block.clone();
        head.truncate(length);
        block.skip(length);
        blocks.push(head);
    }
    blocks.push(block);
    blocks
}

#[test]
fn each_frame_gives_one_numbered_estimate() {
    let outputs = run(cut(frames(300), &[1, 99]));
    let numbers: Vec<_> = outputs
        .iter()
        .filter_map(|output| match output {
            Output::Estimates(block) => Some((
                block.header.sequence,
                block.estimates.len(),
                block.header.epoch,
            )),
            _ => None,
        })
        .collect();
    assert_eq!(numbers, [(0, 1, 7), (1, 99, 7), (100, 200, 7)]);
    let last = estimates(&outputs)[299];
    assert_eq!(
        (
            last.mean.len(),
            last.covariance.len(),
            last.innovations.len()
        ),
        (6, 21, 5)
    );
    assert!(last.variance(4).unwrap() > 0.0);
}

#[test]
fn parameters_are_displayed_ten_times_a_second_of_measurement() {
    let outputs = run(vec![frames(300)]);
    let displayed = outputs
        .iter()
        .filter(|output| matches!(output, Output::Parameter(_)))
        .count();
    let noise = outputs
        .iter()
        .filter(|output| matches!(output, Output::Noise(_)))
        .count();
    assert_eq!((displayed, noise), (30 * 6, 30));
}

#[test]
fn restart_of_a_diverged_filter_is_reported() {
    let mut block = frames(300);
    // The value is finite, but makes every filter diverge.
    block.values[200 * 6 + 3] = 1e300;
    let outputs = run(vec![block]);
    let estimates = estimates(&outputs);
    assert!(estimates[200].flags.restarted && !estimates[201].flags.restarted);
    assert!(
        estimates
            .iter()
            .all(|estimate| estimate.mean.iter().all(|mean| mean.is_finite()))
    );
    let restarts: Vec<_> = events(&outputs)
        .into_iter()
        .filter(|event| event.kind == EventKind::Restart)
        .collect();
    assert_eq!(restarts.len(), 1);
    assert_eq!(restarts[0].time_ns, 2_000_000_000);
    assert!(!restarts[0].why.is_empty());
}

#[test]
fn lost_frames_are_bridged_and_numbering_continues() {
    let mut core = Identification::new(&structure(), "identify").unwrap();
    let mut outputs = Vec::new();
    let mut blocks = cut(frames(400), &[200, 50]);
    let after = blocks.pop().unwrap();
    core.handle(IdentificationInput::Frames(blocks.remove(0)), &mut outputs);
    core.handle(IdentificationInput::gap(200, 250), &mut outputs);
    core.handle(IdentificationInput::Frames(after), &mut outputs);
    let estimates = estimates(&outputs);
    assert_eq!((estimates.len(), core.done()), (400, 400));
    assert!(
        estimates[200..250]
            .iter()
            .all(|estimate| estimate.flags.prediction_only)
    );
    assert!(!estimates[250].flags.prediction_only);
    assert_eq!(
        estimates[199].mean, estimates[249].mean,
        "parameters stand still in predictions"
    );
    assert_eq!(events(&outputs)[0].kind, EventKind::Gap);
}

#[test]
fn motion_returns_to_its_prior_after_a_gap_too_long_to_bridge() {
    let mut core = Identification::new(&structure(), "identify").unwrap();
    let mut outputs = Vec::new();
    core.handle(IdentificationInput::Frames(frames(3000)), &mut outputs);
    let mean = |core: &Identification| match core.estimator() {
        Estimator::Filter(filter) => filter.mean().clone(),
        Estimator::Classes(_) | Estimator::Particles(_) => panic!("the demo has one filter"),
    };
    let before = mean(&core);
    core.handle(IdentificationInput::gap(3000, 9000), &mut outputs);
    assert_eq!(estimates(&outputs).len(), 9000);
    let after = mean(&core);
    assert!(
        after.rows(0, 10).iter().all(|entry| *entry == 0.0),
        "the motion is back at its prior"
    );
    assert_eq!(
        after.rows(10, 5),
        before.rows(10, 5),
        "the parameters are kept"
    );
}

/// Regression: with some dozens of parameters, the estimates of a long gap exceeded the size limit
/// of a message, which ended the service.
#[test]
fn estimates_of_a_long_gap_fit_into_messages() {
    let mut core = Identification::new(&structure(), "identify").unwrap();
    let mut outputs = Vec::new();
    core.handle(IdentificationInput::Frames(frames(200)), &mut outputs);
    core.handle(IdentificationInput::gap(200, 9000), &mut outputs);
    let (mut next, mut grid) = (0, None);
    let blocks = outputs.iter().filter_map(|output| match output {
        Output::Estimates(block) => Some(block),
        _ => None,
    });
    for block in blocks {
        assert_eq!(block.header.sequence, next, "one follows the other");
        grid = grid.or(block.grid());
        assert_eq!(block.header.time_ns, grid.unwrap().time_ns(next));
        assert!(
            block.estimates.len() * block.item_bytes() <= MOST_BYTES,
            "{} estimates",
            block.estimates.len()
        );
        next = block.end();
    }
    assert_eq!(next, 9000);
}

/// Regression: all responses of a block preceded its first estimates, so a file contained them in
/// the wrong rows.
#[test]
fn responses_are_published_with_the_estimates_of_their_frames() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo.toml");
    let response =
        "\n[[response]]\nname = \"roof\"\nquantity = \"displacement\"\ndof = \"floor-5\"\n";
    let text = std::fs::read_to_string(&path).unwrap() + response;
    let mut core =
        Identification::new(&Structure::parse(&text, &path).unwrap(), "identify").unwrap();
    let mut outputs = Vec::new();
    core.handle(IdentificationInput::Frames(frames(8000)), &mut outputs);
    let lengths: Vec<usize> = outputs
        .iter()
        .filter_map(|output| match output {
            Output::Responses(rows) => Some(rows.len()),
            Output::Estimates(block) => Some(block.estimates.len()),
            _ => None,
        })
        .collect();
    assert!(lengths.len() > 2, "one block: {lengths:?}");
    assert!(
        lengths.chunks(2).all(|pair| pair[0] == pair[1]),
        "{lengths:?}"
    );
    assert_eq!(lengths.iter().sum::<usize>(), 2 * 8000);
}

/// Regression: all estimates of a gap were in memory at once, 417 MB for 4096 frames of a structure
/// with 160 parameters.
#[test]
fn long_gap_is_bridged_in_parts_with_the_same_bits() {
    let begun = || {
        let mut core = Identification::new(&structure(), "identify").unwrap();
        core.handle(IdentificationInput::Frames(frames(200)), &mut Vec::new());
        core
    };
    let said = |outputs: &[Output]| {
        outputs
            .iter()
            .map(|output| format!("{output:?}"))
            .collect::<Vec<_>>()
    };
    let (mut whole, mut outputs) = (begun(), Vec::new());
    whole.handle(IdentificationInput::gap(200, 9000), &mut outputs);
    let (mut core, mut together, mut left) = (
        begun(),
        Vec::new(),
        Some(IdentificationInput::gap(200, 9000)),
    );
    let mut dones = Vec::new();
    while let Some(input) = left {
        let mut part = Vec::new();
        left = core.handle_part(input, &mut part);
        assert!(
            estimates(&part).len() as u64 <= MOST_BRIDGED,
            "{} at once",
            estimates(&part).len()
        );
        together.extend(said(&part));
        dones.push(core.done());
    }
    assert_eq!(together, said(&outputs));
    assert_eq!(
        events(&outputs)
            .iter()
            .filter(|event| event.kind == EventKind::Gap)
            .count(),
        1,
        "it is told once"
    );
    assert_eq!(core.state(), whole.state());
    assert!(dones.len() > 60 && dones.last() == Some(&9000), "{dones:?}");
}

#[test]
fn new_epoch_of_frames_keeps_the_parameters() {
    let mut again = frames(200);
    again.header.epoch = 8;
    let outputs = run(vec![frames(2000), again]);
    let estimates = estimates(&outputs);
    assert_eq!(estimates.len(), 2200);
    let moved = (estimates[2000].mean[0] - estimates[1999].mean[0]).abs();
    assert!(
        moved < 3.0 * estimates[1999].variance(0).unwrap().sqrt(),
        "moved by {moved}"
    );
    assert!(
        events(&outputs)
            .iter()
            .any(|event| event.kind == EventKind::Restart && event.why.contains("epoch"))
    );
}

#[test]
fn restart_of_the_source_during_motion_keeps_noise_levels_and_parameters() {
    let all = frames(3000);
    let mut parts = cut(all, &[2000]);
    let mut again = parts.remove(1);
    again.header = Header {
        source: "ingest".into(),
        epoch: 8,
        sequence: 0,
        time_ns: 0,
    };
    let outputs = run(vec![parts.remove(0), again]);
    let estimates = estimates(&outputs);
    let (before, after) = (estimates[1999].noise_mean[0], estimates[2999].noise_mean[0]);
    assert!(
        (0.5..1.5).contains(&(after / before)),
        "noise level from {before:e} to {after:e}"
    );
    let worst = estimates[2000..]
        .iter()
        .map(|e| (e.mean[0] - 1.0).abs())
        .fold(0.0, f64::max);
    assert!(worst < 0.05, "storey 1 moved to {worst} from the truth");
}

#[test]
fn missing_ground_motion_increases_the_variance_of_its_step() {
    let mut block = frames(1000);
    for frame in 500..520 {
        block.values[frame * 6] = f64::NAN; // the ground
    }
    let outputs = run(vec![block]);
    let estimates = estimates(&outputs);
    assert!(
        estimates
            .iter()
            .all(|estimate| !estimate.flags.restarted && estimate.used_channels == 5)
    );
    // The filter includes the unknown excitation in its uncertainty, so no innovation of that
    // interval is implausible.
    let worst = estimates[500..530]
        .iter()
        .map(|e| e.normalised_innovation_squared)
        .fold(0.0, f64::max);
    assert!(worst < 30.0, "normalised innovation squared of {worst}");
}

#[test]
fn training_ends_although_the_level_of_an_unmeasured_excitation_stays_uncertain() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/output-only.toml");
    let structure = Structure::read(&path).unwrap();
    let mut core = Identification::new(&structure, "identify").unwrap();
    let mut block = frames(1);
    block.channels = structure.channel_count() as u16;
    block.values = structure
        .simulator(1)
        .take(9000)
        .flat_map(|frame| frame.values)
        .collect();
    let mut outputs = Vec::new();
    core.handle(IdentificationInput::Frames(block), &mut outputs);
    assert!(
        events(&outputs)
            .iter()
            .all(|event| event.kind != EventKind::Unidentified)
    );
    assert_eq!(estimates(&outputs)[8999].flags.phase, Phase::Working);
}

/// Returns frames of a changed demo in one block.
fn of_text(change: impl Fn(String) -> String, count: usize) -> (Structure, FrameBlock) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo.toml");
    let text = change(std::fs::read_to_string(&path).unwrap());
    let structure = Structure::parse(&text, &path).unwrap();
    let mut block = frames(1);
    block.values = structure
        .simulator(5)
        .take(count)
        .flat_map(|frame| frame.values)
        .collect();
    (structure, block)
}

fn identified(structure: &Structure, block: FrameBlock) -> Vec<Output> {
    let mut core = Identification::new(structure, "identify").unwrap();
    let mut outputs = Vec::new();
    core.handle(IdentificationInput::Frames(block), &mut outputs);
    outputs
}

#[test]
fn lasting_noise_misfit_restarts_training_and_is_reported() {
    // The floors become a hundred times noisier at 40 s. The published rule cannot follow by
    // itself.
    let (structure, mut block) = of_text(
        |text| text.replace("[filter]", "[filter]\nnoise-rule = \"published\""),
        12_000,
    );
    for (k, frame) in block.values.chunks_exact_mut(6).enumerate().skip(4000) {
        for (c, value) in frame.iter_mut().enumerate().skip(1) {
            *value += 0.5 * f64::sin((k * (7 * c + 3)) as f64 * 1.7);
        }
    }
    let outputs = identified(&structure, block);
    let told = events(&outputs);
    let back = told
        .iter()
        .find(|event| event.what == "noise levels back in training")
        .expect("the event");
    assert!(back.time_ns > 40_000_000_000 && back.kind == EventKind::Calibration);
}

#[test]
fn parameters_at_their_bounds_are_reported_a_few_times_at_most() {
    let (structure, block) = of_text(
        |text| {
            text.replace("std = 0.2", "std = 0.2\nbounds = [0.9, 1.2]")
                .replace("at-s = 60", "at-s = 20")
        },
        4000,
    );
    let outputs = identified(&structure, block);
    let told: Vec<_> = events(&outputs)
        .into_iter()
        .filter(|e| e.what == "parameters kept at their bounds")
        .collect();
    assert!(
        told.iter()
            .any(|event| event.why.contains("storey-2") && event.time_ns > 20_000_000_000),
        "{told:?}"
    );
    assert!(told.len() <= 3, "{} times", told.len()); // in 40 s, with 10 s off the bounds
}

#[test]
fn event_names_the_parameters_that_a_class_keeps_at_their_bounds() {
    let (structure, block) = of_text(
        |text| {
            text.replace("std = 0.2", "std = 0.2\nbounds = [0.9, 1.2]")
                .replace("at-s = 60", "at-s = 20")
                + "\n[classes]\nkind = \"self-calibrating\"\n"
        },
        4000,
    );
    let outputs = identified(&structure, block);
    let told: Vec<_> = events(&outputs)
        .into_iter()
        .filter(|e| e.what == "parameters kept at their bounds")
        .collect();
    assert!(
        told.iter().any(|event| event.why.contains("storey-2")),
        "{told:?}"
    );
    assert!(
        told.iter().all(|event| event.why.contains("storey-")),
        "{told:?}"
    );
}

#[test]
fn stuck_ground_channel_is_reported_within_seconds_and_suspends_decisions() {
    let (structure, mut block) = of_text(
        |text| text.replace("adapt-noise = true", "adapt-noise = false"),
        6000,
    );
    let stuck_at = block.values[2000 * 6];
    for frame in block.values.chunks_exact_mut(6).skip(2000) {
        frame[0] = stuck_at;
    }
    let outputs = identified(&structure, block);
    let told: Vec<_> = events(&outputs)
        .into_iter()
        .filter(|e| e.kind == EventKind::ChannelExcluded)
        .collect();
    assert_eq!(told.len(), 1, "{told:?}");
    assert!(
        told[0].subject == "ground" && told[0].time_ns == 22_000_000_000,
        "{told:?}"
    );
    let estimates = estimates(&outputs);
    let phases: Vec<Phase> = estimates
        .iter()
        .map(|estimate| estimate.flags.phase)
        .collect();
    let turns: Vec<usize> = (1..phases.len())
        .filter(|at| phases[*at] != phases[at - 1])
        .collect();
    assert_eq!((phases[0], &turns[..]), (Phase::Working, &[2200][..]));
    // The ground motion counts as unknown, but the building is still identified.
    let storeys = &estimates[5999].mean[..5];
    let worst = storeys
        .iter()
        .map(|mean| (mean - 1.0).abs())
        .fold(0.0, f64::max);
    assert!(worst < 0.1, "off by {worst}");
}

#[test]
fn excitation_without_samples_is_reported_once() {
    let (structure, mut block) = of_text(|text| text, 3000);
    for frame in block.values.chunks_exact_mut(6) {
        frame[0] = f64::NAN;
    }
    let outputs = identified(&structure, block);
    let told: Vec<_> = events(&outputs)
        .into_iter()
        .filter(|e| e.what.contains("has no samples"))
        .collect();
    assert_eq!(told.len(), 1);
    assert!(
        told[0].what.contains("ground") && told[0].time_ns < 11_000_000_000,
        "{told:?}"
    );
    assert!(
        estimates(&outputs)
            .iter()
            .all(|estimate| estimate.flags.phase != Phase::Working),
        "nothing is decided"
    );
    assert_eq!(
        estimates(&outputs)[2999].flags.phase,
        Phase::ExcitationSilent
    );
}

/// All floors are silent for a minute, while the ground is measured.
#[test]
fn prediction_without_response_is_flagged_and_does_not_become_more_certain() {
    let mut block = frames(12_000);
    for frame in block.values.chunks_exact_mut(6).skip(6000) {
        frame[1..].fill(f64::NAN);
    }
    let outputs = run(vec![block]);
    let estimates = estimates(&outputs);
    let variances = |frame: usize| -> Vec<f64> {
        let estimate: &Estimate = estimates[frame];
        let of_parameter = |j| estimate.variance(j).unwrap();
        (0..estimate.mean.len()).map(of_parameter).collect()
    };
    let (first, last) = (variances(6000), variances(11_999));
    for (j, (first, last)) in first.iter().zip(&last).enumerate() {
        assert!(
            *last >= first * (1.0 - 1e-9),
            "parameter {j}: {first} to {last}"
        );
    }
    let is_silent = |estimate: &&Estimate| estimate.flags.phase == Phase::ResponseSilent;
    assert_eq!(estimates.iter().position(is_silent), Some(6099));
    assert!(estimates[6099..].iter().all(is_silent));
}

#[test]
fn silent_excitation_is_trusted_only_after_an_equally_long_return() {
    let (structure, mut block) = of_text(
        |text| text.replace("adapt-noise = true", "adapt-noise = false"),
        6000,
    );
    for frame in block.values.chunks_exact_mut(6).skip(1000).take(2000) {
        frame[0] = f64::NAN;
    }
    let outputs = identified(&structure, block);
    let phases: Vec<Phase> = estimates(&outputs)
        .iter()
        .map(|estimate| estimate.flags.phase)
        .collect();
    let turns: Vec<usize> = (1..phases.len())
        .filter(|at| phases[*at] != phases[at - 1])
        .collect();
    assert_eq!((phases[0], &turns[..]), (Phase::Working, &[1999, 3999][..]));
    assert!(
        events(&outputs)
            .iter()
            .any(|event| event.what == "ground is measured again"
                && event.kind == EventKind::ChannelBack
                && event.subject == "ground")
    );
}

#[test]
fn long_interval_without_samples_neither_diverges_nor_changes_the_parameters() {
    let (structure, mut block) = of_text(
        |text| text.replace("half-life-s = 10", "half-life-s = 2"),
        12_000,
    );
    for value in &mut block.values[3000 * 6..10_000 * 6] {
        *value = f64::NAN;
    }
    let outputs = identified(&structure, block);
    let estimates = estimates(&outputs);
    assert!(estimates.iter().all(|estimate| !estimate.flags.restarted));
    let truth = [1.0, 0.85, 1.0, 1.0, 1.0];
    for (mean, truth) in estimates[11_999].mean.iter().zip(truth) {
        assert!((mean - truth).abs() < 0.03, "{:?}", estimates[11_999].mean);
    }
}

#[test]
fn diverged_filter_recovers_the_parameters_during_motion() {
    let (structure, mut block) = of_text(|text| text.replace("at-s = 60", "at-s = 600"), 9000);
    for value in &mut block.values[4000 * 6 + 1..4000 * 6 + 6] {
        *value = 1e200;
    }
    let outputs = identified(&structure, block);
    let estimates = estimates(&outputs);
    assert!(estimates[4000].flags.restarted);
    assert_eq!(
        estimates
            .iter()
            .filter(|estimate| estimate.flags.restarted)
            .count(),
        1
    );
    for mean in &estimates[8999].mean {
        assert!((mean - 1.0).abs() < 0.02, "{:?}", estimates[8999].mean);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn block_sizes_change_no_bit_of_the_estimates(lengths in prop::collection::vec(1_u64..120, 0..5)) {
        let whole = run(vec![frames(500)]);
        let parts = run(cut(frames(500), &lengths));
        prop_assert_eq!(estimates(&whole), estimates(&parts));
    }
}

#[test]
fn verdict_on_the_fit_is_published_with_the_parameters_and_in_the_flags() {
    let (structure, block) = of_text(|text| text, 3000);
    let outputs = identified(&structure, block);
    let shown: Vec<_> = outputs
        .iter()
        .filter_map(|output| {
            if let Output::Fit(fit) = output {
                Some(fit)
            } else {
                None
            }
        })
        .collect();
    let flags: Vec<_> = estimates(&outputs)
        .iter()
        .map(|estimate| estimate.flags)
        .collect();
    let first = flags.iter().position(|flags| flags.fit.is_some()).unwrap();
    let ten_periods = (10.0 * 100.0 / structure.natural_frequencies_hz()[0]) as usize;
    assert!(
        (ten_periods..ten_periods + 200).contains(&first),
        "{first}, ten periods are {ten_periods} frames"
    );
    assert!(flags[first..].iter().all(|flags| flags.fit.is_some()));
    // ten times a second
    let least = (3000 - first) / 10;
    assert!(shown.len() >= least, "{} of {least}", shown.len());
    let last = estimates(&outputs)[2999].flags;
    assert_eq!(last.fit, shown.last().map(|fit| fit.verdict));
    assert!(shown.iter().all(|fit| {
        fit.channels.len() <= 5
            && fit
                .channels
                .iter()
                .all(|channel| channel.channel.as_str() != "ground")
    }));
}

/// The samples of a storey that loses stiffness at once look like outliers.
#[test]
fn a_sudden_loss_pauses_the_screening_and_is_reported_once() {
    let (structure, block) = of_text(
        |text| {
            text.replace("[filter]", "[outliers]\n\n[filter]")
                .replace("loss = 0.15", "loss = 0.6")
        },
        8_000,
    );
    let outputs = identified(&structure, block);
    let paused: Vec<&Event> = events(&outputs)
        .into_iter()
        .filter(|event| event.what.starts_with("outlier screening paused"))
        .collect();
    let [event] = paused[..] else {
        panic!("{paused:?}")
    };
    assert_eq!(
        (event.kind, event.subject.as_str()),
        (EventKind::Calibration, "identify")
    );
    let after_s = event.time_ns as f64 / 1e9 - 60.0;
    assert!((0.2..1.5).contains(&after_s), "{after_s} s after the loss");
    assert!(
        events(&outputs)
            .iter()
            .all(|event| event.kind != EventKind::ChannelExcluded)
    );
}

#[test]
fn faulty_sensor_is_named_and_excluded_and_identification_restarts() {
    let structure = structure();
    let mut block = frames(12_000);
    for values in block.values.chunks_mut(6) {
        values[3] *= -1.0;
    }
    let outputs = identified(&structure, block);
    let name = structure.channels().nth(3).unwrap().name();
    let excluded: Vec<&Event> = events(&outputs)
        .into_iter()
        .filter(|event| event.kind == EventKind::ChannelExcluded)
        .collect();
    let [event] = &excluded[..] else {
        panic!("{excluded:?}")
    };
    assert_eq!(event.subject, name);
    assert!(event.what.contains("opposite sign"), "{}", event.what);
    let all = estimates(&outputs);
    let first = all
        .iter()
        .position(|estimate| estimate.excluded != Excluded::None)
        .unwrap();
    assert!(all[first].flags.restarted && all[first - 1].used_channels == 5);
    // The filter has learnt from the frames before without this sensor.
    let prior = structure.parameters()[0].std().powi(2);
    assert!(all[first].variance(0) < Some(0.01 * prior));
    assert!(
        (all[first].mean[0] - 1.0).abs() < 0.1,
        "{:?}",
        all[first].mean
    );
    assert_eq!(all[first + 1].flags.phase, Phase::Working);
    let last = all.last().unwrap();
    assert_eq!((last.excluded, last.used_channels), (Excluded::One(2), 4));
    assert_eq!(last.flags.phase, Phase::Working);
    assert!((last.mean[0] - 1.0).abs() < 0.1, "{:?}", last.mean);
}

/// The screening rejects the samples of a sensor before the comparison names its fault.
#[test]
fn filter_continues_if_the_screening_has_already_rejected_a_faulty_sensor() {
    let (structure, mut block) = of_text(
        |text| text.replace("[filter]", "[outliers]\n\n[filter]"),
        12_000,
    );
    for values in block.values.chunks_mut(6).skip(5_000) {
        values[3] *= -1.0;
    }
    let outputs = identified(&structure, block);
    let excluded: Vec<&Event> = events(&outputs)
        .into_iter()
        .filter(|event| event.kind == EventKind::ChannelExcluded)
        .collect();
    let [screened, compared] = excluded[..] else {
        panic!("{excluded:?}")
    };
    assert_eq!(screened.subject, compared.subject);
    let found_by = "below the first natural frequency";
    assert!(compared.why.starts_with(found_by), "{compared:?}");
    let all = estimates(&outputs);
    assert!(all.iter().all(|estimate| !estimate.flags.restarted));
    let last = all.last().unwrap();
    assert_eq!((last.excluded, last.used_channels), (Excluded::One(2), 4));
}

#[test]
fn restart_beside_an_exclusion_changes_no_bit() {
    let structure = structure();
    let mut block = frames(8_000);
    for values in block.values.chunks_mut(6) {
        values[3] *= -1.0;
    }
    let whole = identified(&structure, block.clone());
    let all = estimates(&whole);
    let first = all
        .iter()
        .position(|estimate| estimate.excluded != Excluded::None)
        .unwrap() as u64;
    // A sensor in doubt is excluded later. From then on, the checkpoint contains the recent frames.
    for at in [first - 100, first + 100] {
        let [head, tail] = &cut(block.clone(), &[at])[..] else {
            panic!("two parts")
        };
        let mut core = Identification::new(&structure, "identify").unwrap();
        core.handle(IdentificationInput::Frames(head.clone()), &mut Vec::new());
        let state = core.state();
        let mut core = Identification::new(&structure, "identify").unwrap();
        core.restore(state).unwrap();
        let mut outputs = Vec::new();
        core.handle(IdentificationInput::Frames(tail.clone()), &mut outputs);
        let resumed = estimates(&outputs);
        // A missing innovation is not equal to itself.
        assert_eq!(format!("{:?}", resumed.last()), format!("{:?}", all.last()));
    }
}

/// Without frames to repeat, the parameters are held until the motion has settled.
#[test]
fn parameters_are_held_while_the_motion_settles() {
    let structure = structure();
    let mut core = Identification::new(&structure, "identify").unwrap();
    core.handle(IdentificationInput::Frames(frames(500)), &mut Vec::new());
    core.forget_sensors();
    core.restart_without_faulty().unwrap();
    let settling = core.settling;
    assert_eq!(settling, (100.0 * core.check.window_s()) as u64);
    let state = core.state();
    let mut core = Identification::new(&structure, "identify").unwrap();
    core.restore(state).unwrap();
    assert!(core.has_sensor_in_doubt(), "the motion settles");
    let mut block = frames(500 + settling as usize);
    block.values.drain(..500 * 6);
    block.header.sequence = 500;
    let mut outputs = Vec::new();
    core.handle(IdentificationInput::Frames(block), &mut outputs);
    let all = estimates(&outputs);
    let released = all.iter().position(|estimate| estimate.flags.restarted);
    assert_eq!(released, Some(settling as usize - 1));
    let last = all.last().unwrap();
    assert!(last.variance(0) > all[0].variance(0));
    assert!(!core.has_sensor_in_doubt());
}

#[test]
fn held_parameters_are_released_with_the_variance_of_their_prior() {
    // The filter forgets while the parameters are held, so that their deviation does not stay.
    let structure = structure();
    let mut core = Identification::new(&structure, "identify").unwrap();
    core.estimator.set_parameter_std(0.01).unwrap();
    core.handle(IdentificationInput::Frames(frames(3000)), &mut Vec::new());
    let held = core.estimator.parameter_mean().to_vec();
    core.estimator.set_parameter_std(1.0).unwrap();
    assert_eq!(core.estimator.parameter_mean(), held);
    let Estimator::Filter(filter) = &core.estimator else {
        panic!("the demo has one filter")
    };
    let released = filter.parameters().covariance;
    for (j, parameter) in structure.parameters().iter().enumerate() {
        assert!(
            (released[(j, j)] - parameter.std().powi(2)).abs() < 1e-12,
            "{released}"
        );
    }
}

#[test]
fn divergence_ends_the_hold_while_the_motion_settles() {
    let mut core = Identification::new(&structure(), "identify").unwrap();
    core.handle(IdentificationInput::Frames(frames(100)), &mut Vec::new());
    core.settling = 50;
    assert!(core.has_sensor_in_doubt(), "the motion settles");
    core.restart(0, "it diverged");
    assert_eq!(core.settling, 0);
    assert!(!core.has_sensor_in_doubt());
}

#[test]
fn sensor_check_restarts_after_a_gap_too_long_to_bridge() {
    let structure = structure();
    let mut core = Identification::new(&structure, "identify").unwrap();
    core.handle(IdentificationInput::Frames(frames(500)), &mut Vec::new());
    let new = SensorCheck::new(&structure);
    assert_ne!(core.sensor_check().state(), new.state());
    core.handle(
        IdentificationInput::gap(500, 500 + 20 * 100),
        &mut Vec::new(),
    );
    assert_eq!(core.sensor_check().state(), new.state());
}

/// Between 15 and 17 s, all motion is forty times as large.
#[test]
fn flags_state_strong_motion_also_after_a_restart_within_it() {
    let with_shock = |limit: &str| {
        let (structure, mut block) = of_text(|text| format!("{text}\n{limit}"), 6000);
        let shock = 1500 * 6..1700 * 6;
        block.values[shock]
            .iter_mut()
            .for_each(|value| *value *= 40.0);
        (structure, block)
    };
    let peaks = |outputs: &[Output]| -> Vec<Option<f32>> {
        let all = estimates(outputs).into_iter();
        all.map(|estimate| estimate.flags.strong_motion).collect()
    };
    let (structure, block) = with_shock("");
    let without = identified(&structure, block);
    assert!(peaks(&without).iter().all(Option::is_none));

    let (structure, block) = with_shock("[earthquakes]\nstrong-m-per-s2 = 5.0\n");
    let whole = identified(&structure, block.clone());
    let found = peaks(&whole);
    let strong: Vec<usize> = (0..6000).filter(|frame| found[*frame].is_some()).collect();
    let (first, last) = (strong[0], strong[strong.len() - 1]);
    assert!((1500..1600).contains(&first), "{first}");
    // The last large values lie in the window of 10 s until 27 s. The motion ends when no window
    // has been strong for three windows.
    assert!((5600..5700).contains(&last), "{last}");
    assert_eq!(strong.len(), last + 1 - first);
    assert!(found[first] > Some(5.0) && found[last] > found[first]);

    let mut outputs = Vec::new();
    let mut core = Identification::new(&structure, "identify").unwrap();
    let mut parts = cut(block, &[1650])
        .into_iter()
        .map(IdentificationInput::Frames);
    core.handle(parts.next().unwrap(), &mut outputs);
    let bytes = postcard::to_stdvec(&core.state()).unwrap();
    let mut core = Identification::new(&structure, "identify").unwrap();
    core.restore(postcard::from_bytes(&bytes).unwrap()).unwrap();
    core.handle(parts.next().unwrap(), &mut outputs);
    assert_eq!(peaks(&outputs), found);
}

mod sudden_faults;
