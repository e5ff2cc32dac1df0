use proptest::prelude::*;
use spandrel_bus::{EstimateFlags, FitVerdict, Header, Message, Name, Phase, StreamState};

use super::*;
use crate::{BetweenRecords, RecordSummary};
use spandrel_bus::Excluded;

/// Returns a watch for two parameters. The second one has two rules: 5 % and 20 %.
fn watch() -> Watch {
    let decision = |number, loss, parameter, name: &str| {
        let rule = Rule::new(loss, 0.95, 0.5, 0.05).unwrap();
        let subject = Subject {
            parameter,
            name: name.into(),
            quantity: "stiffness".into(),
            prior_std: 0.3,
            bounds: (0.1, 2.0),
        };
        Decision::new(number, rule, subject)
    };
    Watch::from_decisions(
        2,
        vec![
            decision(0, 0.05, 0, "storey-1"),
            decision(0, 0.05, 1, "storey-2"),
            decision(1, 0.2, 1, "storey-2"),
        ],
    )
}

fn estimate(means: [f64; 2], std: f64, phase: Phase) -> Estimate {
    Estimate {
        mean: means.to_vec(),
        covariance: vec![std * std, 0.0, std * std],
        noise_mean: vec![],
        noise_covariance: vec![],
        innovations: vec![0.0],
        normalised_innovation_squared: 0.0,
        log_evidence: 0.0,
        used_channels: 1,
        flags: EstimateFlags {
            phase,
            ..EstimateFlags::working()
        },
        excluded: Excluded::None,
        sustained_information: Vec::new(),
    }
}

fn block(epoch: u64, sequence: u64, estimates: Vec<Estimate>) -> EstimateBlock {
    EstimateBlock {
        header: Header {
            source: "identify-1".into(),
            epoch,
            sequence,
            time_ns: sequence as i64 * 10_000_000,
        },
        term: 0,
        t0_ns: 0,
        sampling_rate_hz: 100.0,
        parameters: 2,
        noise_parameters: 0,
        channels: 1,
        estimates,
        state: StreamState::Running,
    }
}

fn alerts_of(watch: &mut Watch, block: &EstimateBlock) -> Vec<Alert> {
    let mut alerts = Vec::new();
    watch.handle_block(block, &mut alerts).unwrap();
    alerts
}

#[test]
fn the_least_vigilant_rule_of_a_parameter_counts() {
    let mut watch = watch();
    watch.decisions.swap(1, 2);
    let estimates = vec![estimate([1.0, 1.0], 0.08, Phase::Working); 300];
    alerts_of(&mut watch, &block(1, 0, estimates));
    assert_eq!(watch.decisions[1].vigilance(), Some(Vigilance::Watching));
    assert_eq!(
        watch.vigilance(1),
        Some(Vigilance::Undecided(UndecidedBecause::NothingLearnt))
    );
}

#[test]
fn displayed_losses_equal_those_of_the_decisions() {
    // A reference of 0.9 as from a baseline: 0.82 has lost 8.9 % of it, but 18 % of the design.
    let rule = Rule::new(0.10, 0.95, 0.5, 0.05).unwrap();
    let rule = rule.with_reference(Reference::new(0.9, 0.01).unwrap());
    let mut watch = watch();
    let subject = watch.decisions[0].subject().clone();
    watch.decisions[0] = Decision::new(0, rule, subject);
    let estimates = vec![estimate([0.82, 1.0], 0.01, Phase::Working); 25];
    let (mut alerts, mut losses) = (Vec::new(), Vec::new());
    for (sequence, part) in [(0, &estimates[..7]), (7, &estimates[7..])] {
        let block = block(1, sequence, part.to_vec());
        watch
            .handle_block_with_display(&block, 10.0, &mut alerts, &mut losses)
            .unwrap();
    }
    let shown: Vec<(usize, i64)> = losses
        .iter()
        .map(|loss| (loss.parameter, loss.time_ns / 10_000_000))
        .collect();
    assert_eq!(
        shown,
        [(0, 0), (1, 0), (0, 10), (1, 10), (0, 20), (1, 20)],
        "one loss per parameter, from its first rule, for the frames 0, 10 and 20"
    );
    let last = losses[4];
    let decided = ParameterEstimate {
        time_ns: 0,
        mean: 0.82,
        std: 0.01,
    };
    let reference = Reference::new(0.9, 0.01).unwrap();
    let expected = crate::probability_of_loss(&decided, &reference, 0.10);
    assert_eq!((last.probability, last.rule_loss), (expected, 0.10));
    assert!(expected < 0.5, "the design would give above 0.999");
    assert!((last.loss.loss - (1.0 - 0.82 / 0.9)).abs() < 1e-15);
    assert!(
        alerts.iter().all(|alert| alert.parameter != 0),
        "{alerts:?}"
    );
}

#[test]
fn each_parameter_and_rule_decides_on_its_own() {
    let found = alerts_of(
        &mut watch(),
        &block(1, 0, vec![estimate([1.0, 0.86], 0.01, Phase::Working); 20]),
    );
    let raised: Vec<(usize, usize)> = found
        .iter()
        .filter(|alert| alert.state == AlertState::Raised)
        .map(|alert| (alert.rule, alert.parameter))
        .collect();
    assert_eq!(raised, [(0, 1)]); // not storey 1, and not the loss of 20 %
}

#[test]
fn most_severe_rule_gives_the_state_of_its_parameter() {
    let mut watch = watch();
    alerts_of(
        &mut watch,
        &block(1, 0, vec![estimate([1.0, 0.7], 0.01, Phase::Working); 20]),
    );
    assert_eq!(
        watch
            .standing(1)
            .map(|alert| (alert.state, alert.rule_loss)),
        Some((AlertState::Raised, 0.2))
    );
    // Half of the loss is repaired: the rule for 20 % is cleared, the rule for 5 % remains raised.
    alerts_of(
        &mut watch,
        &block(1, 20, vec![estimate([1.0, 0.86], 0.01, Phase::Working); 20]),
    );
    assert_eq!(
        watch
            .standing(1)
            .map(|alert| (alert.state, alert.rule_loss)),
        Some((AlertState::Raised, 0.05))
    );
    assert_eq!(watch.standing(0), None);
}

#[test]
fn unannounced_state_is_that_of_the_first_rule_of_the_parameter() {
    let stands = |watch: &Watch, parameter| {
        watch
            .unannounced(parameter)
            .map(|alert| (alert.state, alert.rule_loss))
    };
    let mut watch = watch();
    assert_eq!(
        (stands(&watch, 0), stands(&watch, 1)),
        (None, None),
        "nothing is known before the first estimate"
    );
    alerts_of(
        &mut watch,
        &block(1, 0, vec![estimate([1.0, 1.0], 0.01, Phase::Working)]),
    );
    let normal = Some((AlertState::Normal, 0.05));
    assert_eq!((stands(&watch, 0), stands(&watch, 1)), (normal, normal));
    alerts_of(
        &mut watch,
        &block(1, 1, vec![estimate([1.0, 0.86], 0.01, Phase::Working)]),
    );
    assert_eq!(
        (stands(&watch, 0), stands(&watch, 1)),
        (normal, None),
        "storey 2 is announced as pending"
    );
}

#[test]
fn no_alert_is_decided_during_training() {
    let mut watch = watch();
    let found = alerts_of(
        &mut watch,
        &block(1, 0, vec![estimate([0.5, 0.5], 0.01, Phase::Training); 50]),
    );
    assert_eq!(found, []);
    // A training period that lasts causes an alert after a second.
    let found = alerts_of(
        &mut watch,
        &block(
            1,
            50,
            vec![estimate([0.5, 0.5], 0.01, Phase::Training); 100],
        ),
    );
    let states: Vec<_> = found
        .iter()
        .map(|alert| (alert.parameter, alert.state, alert.undecided_because))
        .collect();
    let told = |parameter| {
        (
            parameter,
            AlertState::Undecided,
            Some(UndecidedBecause::NoiseTraining),
        )
    };
    assert_eq!(states, [told(0), told(1), told(1)]);
    assert_eq!(
        watch.undecided(),
        [(UndecidedBecause::NoiseTraining, 3)].into()
    );
}

#[test]
fn frames_are_counted_as_decided_or_not() {
    let mut watch = watch();
    assert_eq!(watch.decided_share(1), None);
    let mut contradicted = estimate([1.0, 1.0], 0.01, Phase::Working);
    contradicted.flags.fit = Some(FitVerdict::Contradicted);
    alerts_of(
        &mut watch,
        &block(1, 0, vec![estimate([1.0, 1.0], 0.01, Phase::Working); 30]),
    );
    alerts_of(&mut watch, &block(1, 30, vec![contradicted; 10]));
    assert_eq!(
        (watch.decided_share(0), watch.decided_share(1)),
        (Some(0.75), Some(0.75))
    );
    let shares = watch.decided_shares();
    assert_eq!(shares[&1].frames(), 80, "two rules watch storey 2");
    assert_eq!(
        shares[&1].undecided().collect::<Vec<_>>(),
        [(UndecidedBecause::FitContradicted, 20)]
    );
}

#[test]
fn missing_estimates_and_another_epoch_reset_a_pending_alert() {
    for (epoch, sequence) in [(1, 5), (2, 1), (2, 4)] {
        let mut watch = watch();
        let soft = vec![estimate([0.86, 1.0], 0.01, Phase::Working); 4];
        assert_eq!(
            alerts_of(&mut watch, &block(1, 0, soft.clone()))[0].state,
            AlertState::Pending
        );
        let found = alerts_of(&mut watch, &block(epoch, sequence, soft));
        let states: Vec<AlertState> = found.iter().map(|alert| alert.state).collect();
        assert_eq!(
            states,
            [AlertState::Pending],
            "epoch {epoch}, from {sequence}"
        );
    }
}

#[test]
fn times_that_shift_by_a_gap_reset_a_pending_alert() {
    const FRAME_NS: i64 = 10_000_000;
    for (frames, expected) in [
        (3, AlertState::Raised),
        (-3, AlertState::Pending),
        (4, AlertState::Pending),
        (360_000, AlertState::Pending),
        (-360_000, AlertState::Pending),
    ] {
        let mut watch = watch();
        let soft = vec![estimate([0.86, 1.0], 0.01, Phase::Working); 3];
        alerts_of(&mut watch, &block(1, 0, soft.clone()));
        let mut next = block(1, 3, soft);
        next.t0_ns = frames * FRAME_NS;
        let last = alerts_of(&mut watch, &next).pop();
        let state = last.map_or(AlertState::Pending, |alert| alert.state);
        assert_eq!(state, expected, "{frames} frames");
    }
}

#[test]
fn block_of_another_structure_is_refused_and_changes_nothing() {
    let mut watch = watch();
    let before = watch.clone();
    let mut other = block(1, 0, vec![estimate([0.5, 0.5], 0.01, Phase::Working); 3]);
    other.parameters = 3;
    assert!(matches!(
        watch.handle_block(&other, &mut Vec::new()),
        Err(AlertError::ParameterCount {
            found: 3,
            expected: 2
        })
    ));
    assert_eq!(watch, before);
}

#[test]
fn message_contains_the_numbers_and_the_bus_accepts_it() {
    let mut watch = watch();
    let found = alerts_of(
        &mut watch,
        &block(1, 0, vec![estimate([0.86, 1.0], 0.01, Phase::Working); 20]),
    );
    let message = found[1].to_message(
        &Name::new("tower").unwrap(),
        &Name::new("storey-1").unwrap(),
    );
    let read =
        spandrel_bus::AlertMessage::decode("application/json", &message.encode().unwrap()).unwrap();
    assert_eq!(
        (
            read.state,
            read.since_ns,
            read.rule_loss,
            read.rule_credibility
        ),
        (AlertState::Raised, Some(0), 0.05, 0.95)
    );
    assert_eq!(
        (read.mean, read.reference, read.reference_std),
        (0.86, Some(1.0), Some(0.0))
    );
    let interval = read.loss_interval.unwrap();
    assert!(
        (read.loss.unwrap() - 0.14).abs() < 1e-12 && interval.low < 0.14 && interval.high > 0.14
    );
    assert_eq!(read.time_ns, 50_000_000);
}

#[test]
fn acknowledgement_with_the_longest_texts_is_accepted_by_the_bus() {
    let mut watch = watch();
    alerts_of(
        &mut watch,
        &block(1, 0, vec![estimate([0.86, 1.0], 0.01, Phase::Working); 20]),
    );
    let by = Acknowledged {
        who: "é".repeat(2048),
        note: "n".repeat(4096),
    };
    let mut alerts = Vec::new();
    assert!(watch.acknowledge(0, &by, &mut alerts));
    assert!(!watch.acknowledge(1, &by, &mut alerts));
    let message = alerts[0].to_message(
        &Name::new("tower").unwrap(),
        &Name::new("storey-1").unwrap(),
    );
    assert!(message.encode().is_ok());
}

fn tower(reference: &str) -> Structure {
    let text =
        include_str!("../../tests/tower.toml").replace("reference.design-std = 1e-9", reference);
    Structure::parse(&text, "tower.toml".as_ref()).unwrap()
}

/// Returns the reference of the first alert on a large loss.
fn reference_used(structure: &Structure, baseline: Option<&Baseline>) -> Option<(f64, f64)> {
    let mut watch = Watch::new(structure, baseline).unwrap();
    let soft = Estimate {
        mean: vec![0.3],
        covariance: vec![1e-4],
        ..estimate([0.0; 2], 0.0, Phase::Working)
    };
    let block = EstimateBlock {
        parameters: 1,
        ..block(1, 0, vec![soft])
    };
    let reference = alerts_of(&mut watch, &block)[0].reference;
    reference.map(|reference| (reference.mean(), reference.std()))
}

fn tower_baseline(structure: &str) -> Baseline {
    let record = RecordSummary::from_estimates([[(0.8, 0.05)]]).unwrap();
    Baseline::from_records(
        structure,
        &["storey-1"],
        &[record],
        BetweenRecords::Stated(0.0),
    )
    .unwrap()
}

#[test]
fn rules_of_the_structure_file_give_the_reference() {
    assert_eq!(
        reference_used(&tower("reference = { design-std = 0.05 }"), None),
        Some((1.0, 0.05))
    );
    assert_eq!(
        reference_used(&tower("reference = { mean = 0.9, std = 0.1 }"), None),
        Some((0.9, 0.1))
    );
    assert_eq!(
        reference_used(&tower("reference = { learn-s = 60 }"), None),
        None
    ); // still learning
}

#[test]
fn baseline_replaces_only_a_learnt_reference() {
    let baseline = tower_baseline("tower");
    let (mean, std) =
        reference_used(&tower("reference = { learn-s = 60 }"), Some(&baseline)).unwrap();
    assert!((mean - 0.8).abs() < 1e-12 && (std - 0.05).abs() < 1e-12);
    assert_eq!(
        reference_used(&tower("reference = { design-std = 0.05 }"), Some(&baseline)),
        Some((1.0, 0.05))
    );
    assert_eq!(
        reference_used(
            &tower("reference = { mean = 0.9, std = 0.1 }"),
            Some(&baseline)
        ),
        Some((0.9, 0.1))
    );
}

#[test]
fn baseline_of_another_structure_is_refused() {
    let error = Watch::new(&tower(""), Some(&tower_baseline("bridge"))).unwrap_err();
    assert_eq!(
        error.to_string(),
        "baseline is for structure `bridge`, must be for `tower`"
    );
}

proptest! {
    #[test]
    fn other_block_sizes_give_the_same_alerts(
        means in prop::collection::vec((0.7_f64..1.1, 0.7_f64..1.1, prop::bool::weighted(0.05)), 1..80),
        hold in 1_usize..8,
        cuts in prop::collection::vec(1_usize..20, 1..80),
    ) {
        // Each mean lasts for a while, so that pending and raised states occur.
        let estimates: Vec<Estimate> = means
            .iter()
            .flat_map(|(a, b, restarted)| {
                let mut held = vec![estimate([*a, *b], 0.01, Phase::Working); hold];
                held[0].flags.restarted = *restarted;
                held
            })
            .collect();
        let whole = alerts_of(&mut watch(), &block(1, 0, estimates.clone()));

        let mut cut_watch = watch();
        let mut cut_alerts = Vec::new();
        let mut start = 0;
        for length in cuts.iter().cycle() {
            if start >= estimates.len() {
                break;
            }
            let end = (start + length).min(estimates.len());
            cut_watch.handle_block(&block(1, start as u64, estimates[start..end].to_vec()), &mut cut_alerts).unwrap();
            start = end;
        }
        prop_assert_eq!(cut_alerts, whole);
    }
}

#[test]
fn change_without_a_sensor_in_the_baseline_adds_to_the_deviation() {
    // The change without row 1 is known, and that without row 0 is 15 % of the estimate.
    let mut watch = watch();
    let decision = watch.decisions.remove(0);
    let mut decision = decision.with_changes_without(vec![None, Some(0.04)]);
    let flags = EstimateFlags::working();
    let mut std = |excluded| {
        let estimate = ParameterEstimate {
            time_ns: 0,
            mean: 0.8,
            std: 0.03,
        };
        decision.with_missing_sensor(estimate, excluded, &flags).std
    };
    assert_eq!(std(Excluded::None), 0.03);
    assert!((std(Excluded::One(1)) - 0.05).abs() < 1e-12);
    let unknown = 0.03_f64.hypot(0.15 * 0.8);
    for excluded in [Excluded::One(0), Excluded::One(9), Excluded::Several] {
        assert!((std(excluded) - unknown).abs() < 1e-12, "{excluded:?}");
    }
}

#[test]
fn loss_that_a_missing_sensor_could_explain_raises_no_alert() {
    let raised = |excluded| {
        let mut watch = watch();
        let soft = Estimate {
            excluded,
            ..estimate([0.87, 1.0], 0.01, Phase::Working)
        };
        let alerts = alerts_of(&mut watch, &block(1, 0, vec![soft; 500]));
        alerts.iter().any(|alert| alert.state == AlertState::Raised)
    };
    assert!(raised(Excluded::None));
    assert!(!raised(Excluded::One(0)));
}

#[test]
fn nothing_is_decided_while_a_sensor_is_in_doubt() {
    let mut watch = watch();
    let in_doubt = estimate([0.5, 1.0], 0.01, Phase::SensorInDoubt);
    let alerts = alerts_of(&mut watch, &block(1, 0, vec![in_doubt; 500]));
    assert!(
        alerts
            .iter()
            .all(|alert| alert.state == AlertState::Undecided),
        "{alerts:?}"
    );
    let because = alerts.first().and_then(|alert| alert.undecided_because);
    assert_eq!(because, Some(UndecidedBecause::SensorInDoubt));
}

#[test]
fn modes_that_contradict_the_model_leave_alerts_undecided_and_are_named() {
    let mut watch = watch();
    let lossy = || vec![estimate([0.8, 1.0], 0.01, Phase::Working); 200];
    let modes = "mode sway-1 was measured at 1.2 Hz, and the model has it at 1 Hz";
    watch.set_contradicting_modes(Some(modes));
    let alerts = alerts_of(&mut watch, &block(1, 0, lossy()));
    assert!(!alerts.is_empty());
    for alert in &alerts {
        assert_eq!(alert.state, AlertState::Undecided);
        assert_eq!(
            alert.undecided_because,
            Some(UndecidedBecause::FitContradicted)
        );
        assert_eq!(alert.fit, Some(FitVerdict::Contradicted));
        let told = format!(
            "the data contradict the model: the natural frequencies of the model differ from the \
             measured ones ({modes})"
        );
        assert!(alert.why.ends_with(&told), "{}", alert.why);
    }
    assert!(watch.was_contradicted_by_modes());
    watch.set_contradicting_modes(None);
    let alerts = alerts_of(&mut watch, &block(1, 200, lossy()));
    assert!(
        alerts
            .iter()
            .any(|alert| alert.state == AlertState::Raised && alert.parameter == 0),
        "{alerts:?}"
    );
    assert!(!watch.was_contradicted_by_modes());
}

/// Returns the states that a decision announces. The reference is learnt for 3 s, and the parameter
/// has each mean of `course` for a number of seconds without the given channels.
fn states_without_sensor(course: &[(f64, u64, Excluded)]) -> Vec<AlertState> {
    let rule = Rule::new(0.05, 0.95, 0.5, 0.05).unwrap();
    let mut watch = watch();
    watch.decisions.truncate(1);
    let subject = watch.decisions[0].subject().clone();
    watch.decisions[0] = Decision::new(0, rule.with_learnt_reference(3.0).unwrap(), subject);
    let mut states = Vec::new();
    let mut sequence = 0;
    for (mean, seconds, excluded) in course {
        let one = Estimate {
            excluded: *excluded,
            ..estimate([*mean, 1.0], 0.005, Phase::Working)
        };
        let frames = vec![one; 100 * *seconds as usize];
        let alerts = alerts_of(&mut watch, &block(1, sequence, frames));
        sequence += 100 * seconds;
        let undecided =
            |alert: &&Alert| alert.state == AlertState::Undecided && alert.revision == 0;
        for alert in alerts.iter().filter(undecided) {
            let why = "because a sensor is left out";
            assert!(alert.why.contains(why), "{}", alert.why);
        }
        let changes = alerts.iter().filter(|alert| alert.revision == 0);
        states.extend(changes.map(|alert| alert.state));
    }
    states
}

/// Regression test: without a baseline, 15 % were added to the deviation for as long as a sensor
/// was left out, so that a rule of 5 % never decided again.
#[test]
fn loss_without_a_sensor_is_raised_once_the_change_without_it_is_measured() {
    use AlertState::{Cleared, Learning, Normal, Pending, Raised, Undecided};
    let one = Excluded::One(0);
    let mut course = vec![(1.0, 5, Excluded::None), (0.97, 10, one)];
    let sound = [Learning, Normal, Undecided, Normal];
    assert_eq!(states_without_sensor(&course), sound);
    course.push((0.97 * 0.85, 5, one));
    let lost = [&sound[..], &[Pending, Raised]].concat();
    assert_eq!(states_without_sensor(&course), lost);
    // The change of the estimate is no loss once the sensor is used again.
    course.push((1.0, 5, Excluded::None));
    let used_again = [&lost[..], &[Cleared]].concat();
    assert_eq!(states_without_sensor(&course), used_again);
    // Without another sensor, the change is unknown again.
    let other = [course[0], course[1], (0.85, 2, Excluded::One(1))];
    let unknown = [&sound[..], &[Undecided]].concat();
    assert_eq!(states_without_sensor(&other), unknown);
}

#[test]
fn change_without_a_sensor_that_may_be_a_loss_stays_undecided() {
    use AlertState::{Learning, Normal, Undecided};
    for mean in [0.94, 0.85, 1.35] {
        let course = [(1.0, 5, Excluded::None), (mean, 60, Excluded::One(0))];
        let states = states_without_sensor(&course);
        assert_eq!(states, [Learning, Normal, Undecided], "{mean}");
    }
}
