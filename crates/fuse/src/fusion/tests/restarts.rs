//! Tests of a station that resumes from its checkpoint.

use super::*;

/// Half-life in the structure file, in s.
const HALF_LIFE_S: f64 = 8.0;

/// Returns a new run of a station, restored from the checkpoint of an earlier run.
fn next_life(before: &Fusion, structure: &Structure, epoch: u64) -> Fusion {
    let bytes = postcard::to_stdvec(&before.state()).unwrap();
    let mut next = Fusion::new(structure, "fuse", epoch).unwrap();
    next.restore(postcard::from_bytes(&bytes).unwrap()).unwrap();
    next
}

fn estimated(outputs: &[Output]) -> Vec<Estimate> {
    estimates(outputs)
        .into_iter()
        .flat_map(|block| block.estimates.clone())
        .collect()
}

/// Returns the message of a live node that uses each feedback message at once.
fn sends(_: usize, second: u64) -> Option<LocalMessage> {
    let mut message = message(3, second, Pace::Live, 0.9);
    let density = message.density.as_mut().unwrap();
    // The variances decrease with time.
    density
        .covariance
        .iter_mut()
        .for_each(|entry| *entry /= second as f64);
    density.lineage = Some(NodeLineage {
        own: second - 1,
        answers: vec![second - 1]
            .into_iter()
            .filter(|own| *own > 0)
            .collect(),
    });
    Some(message)
}

#[test]
fn restarted_station_continues_as_if_uninterrupted() {
    let mut undisturbed = Fusion::new(&structure(), "fuse", 7).unwrap();
    run(&mut undisturbed, [FusionInput::Present(vec![true; 16])]);
    live(&mut undisturbed, 1..7, sends);
    let mut again = next_life(&undisturbed, &structure(), 8);
    let expected = estimated(&live(&mut undisturbed, 7..12, sends));
    let told = run(
        &mut again,
        [
            FusionInput::Present(vec![true; 16]),
            FusionInput::Tick(6 * SECOND_NS + 600_000_000),
        ],
    );
    assert!(
        told.is_empty(),
        "nothing is said before something is heard: {told:?}"
    );
    let outputs = live(&mut again, 7..12, sends);
    let found = estimated(&outputs);
    assert_eq!(found.len(), expected.len());
    for (found, expected) in found.iter().zip(&expected) {
        let numbers =
            |estimate: &Estimate| [estimate.mean.clone(), estimate.covariance.clone()].concat();
        for (found, expected) in numbers(found).iter().zip(numbers(expected)) {
            // The clock starts at another time, so its periods are rounded differently.
            assert!(
                (found - expected).abs() <= 1e-12,
                "{found} in place of {expected}"
            );
        }
    }
    let places: Vec<(u64, u64)> = estimates(&outputs)
        .iter()
        .map(|block| (block.header.epoch, block.header.sequence))
        .collect();
    assert_eq!(places, [(8, 0), (8, 1), (8, 2), (8, 3), (8, 4)]);
    assert!(events(&outputs).is_empty(), "{:?}", events(&outputs));
}

#[test]
fn epoch_rises_at_a_restart_although_the_clock_was_set_back() {
    let mut first = Fusion::new(&structure(), "fuse", 1000).unwrap();
    live(&mut first, 1..3, sends);
    let second = next_life(&first, &structure(), 5);
    assert_eq!(second.epoch(), 1001);
    assert_eq!(next_life(&second, &structure(), 2000).epoch(), 2000);
}

/// Covers a power failure of the machine that runs all services: no node can report its lineage
/// before its first feedback message.
#[test]
fn station_keeps_its_estimates_after_a_restart_with_all_nodes() {
    let mut first = Fusion::new(&structure(), "fuse", 7).unwrap();
    run(&mut first, [FusionInput::Present(vec![true; 16])]);
    let last = estimated(&live(&mut first, 1..30, sends)).pop().unwrap();
    let mut second = next_life(&first, &structure(), 8);
    run(&mut second, [FusionInput::Present(vec![true; 16])]);
    let nameless = |node, second| {
        let mut message = sends(node, second)?;
        message.header.epoch = 4;
        message.density.as_mut()?.lineage = None;
        Some(message)
    };
    let outputs = live(&mut second, 100..102, nameless);
    let next = &estimated(&outputs)[0];
    // The information halves in half of the half-life, and a period is one second.
    let one_period = 2_f64.powf(1.0 / (HALF_LIFE_S / 2.0));
    for parameter in 0..10 {
        let std = last.variance(parameter).unwrap().sqrt();
        assert!(
            (next.mean[parameter] - last.mean[parameter]).abs() < 1e-6 * std,
            "{} {}",
            next.mean[parameter],
            std
        );
        let growth = next.variance(parameter).unwrap() / (std * std);
        assert!(
            (growth / one_period - 1.0).abs() < 1e-6,
            "it fades by one period, {one_period}, and not by {growth}"
        );
    }
    // The feedback to the nodes contains these estimates.
    let answers = outputs.iter().filter(|output| {
        matches!(output, Output::Feedback(_, answer) if answer.node_epoch == 4 && (answer.mean[0] - next.mean[0]).abs() < 1e-3)
    });
    assert_eq!(answers.count(), 2 * 16);
}

#[test]
fn rejected_samples_are_not_reported_again_after_a_restart() {
    let file = FILE.replace("[fusion]", "[outliers]\n\n[fusion]");
    let structure = Structure::parse(&file, Path::new("building.toml")).unwrap();
    let screened = |rejected| ScreenedChannel {
        state: ChannelState::Screening,
        rejected,
        screened: 500,
        recent_share: 0.25,
        scale: 0.5,
        masked: None,
    };
    let told = |fusion: &mut Fusion, index, rejected| {
        let screening = vec![screened(0), screened(rejected)];
        let outputs = run(
            fusion,
            [local(
                0,
                LocalMessage {
                    screening,
                    ..message(3, index, Pace::Live, 0.95)
                },
            )],
        );
        let flagged = outputs.iter().filter_map(|output| match output {
            Output::Outliers(0, display) if display.channel.as_str() == "acceleration-1" => {
                Some(display.flagged)
            }
            _ => None,
        });
        flagged.sum::<u64>()
    };
    let mut first = Fusion::new(&structure, "fuse", 7).unwrap();
    assert_eq!(told(&mut first, 1, 3), 3);
    let mut second = next_life(&first, &structure, 8);
    assert_eq!(told(&mut second, 2, 5), 2);
}

#[test]
fn a_state_of_other_nodes_is_refused() {
    let state = Fusion::new(&structure(), "fuse", 7).unwrap().state();
    let own = "[[node]]\nname = \"floor-1\"\n";
    assert_eq!(FILE.matches(own).count(), 1);
    let text = FILE.replace(own, "[[node]]\nname = \"cellar\"\n");
    let renamed = Structure::parse(&text, Path::new("building.toml")).unwrap();
    let mut other = Fusion::new(&renamed, "fuse", 8).unwrap();
    let error = other.restore(state).unwrap_err().to_string();
    assert!(
        error.contains("nodes of a checkpoint") && error.contains("15") && error.contains("16"),
        "{error}"
    );
}
