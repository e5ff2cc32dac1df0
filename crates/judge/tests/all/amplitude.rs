//! A structure that softens in strong motion: its amplitude explains storms, and hides no loss.

use crate::support::{coverage, describe, first_alarm, judge, noise, settings};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use spandrel_judge::{Condition, ConditionKind, Epoch, Judge, Judgement, State};

const DAY_S: f64 = 86_400.0;
const PER_DAY: u32 = 4;
const COMMISSIONING_DAYS: u32 = 365;
/// log10 of the amplitude above which the frequency falls, and its fall per decade.
const HINGE: f64 = -1.4;
const FALL: f64 = 0.04;
/// Days of the storms that follow the commissioning.
const STORMS: std::ops::Range<f64> = 450.0..490.0;

/// Returns the epochs of a frequency that depends on an amplitude only. One of 20 days has a storm,
/// and every day of `STORMS`. `stiffness` is the share of the sound stiffness on a day.
fn epochs(seed: u64, days: u32, stiffness: impl Fn(f64) -> f64) -> Vec<Epoch> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let (mut deviation, mut storm) = (0.0_f64, None);
    let epoch = |index: u32| {
        let day = f64::from(index) / f64::from(PER_DAY);
        if index.is_multiple_of(PER_DAY) {
            let is_storm = noise(&mut random) > 1.65 || STORMS.contains(&day);
            storm = is_storm.then(|| 1.2 + 0.2 * noise(&mut random));
        }
        deviation = 0.98 * deviation + 0.0002 * noise(&mut random);
        let decades = -2.0 + 0.25 * noise(&mut random) + storm.unwrap_or(0.0);
        let softening = FALL * (decades - HINGE).max(0.0);
        let ln = deviation - softening + 0.001 * noise(&mut random);
        Epoch {
            time_s: day * DAY_S,
            quantities: vec![Some(4.0 * ln.exp() * stiffness(day).sqrt())],
            conditions: vec![Some(10_f64.powf(decades))],
        }
    };
    (0..PER_DAY * days).map(epoch).collect()
}

/// Judges epochs with the amplitude as a condition.
fn with_amplitude(epochs: &[Epoch]) -> (Judge, Vec<Judgement>) {
    let mut settings = settings(&["f1"], &[], COMMISSIONING_DAYS);
    settings.conditions.push(Condition {
        name: "rms".to_owned(),
        kind: ConditionKind::Amplitude,
    });
    let (state, judgements) = judge(settings, epochs);
    describe(&state, &judgements);
    (state, judgements)
}

/// Judges the same epochs without it.
fn without_amplitude(epochs: &[Epoch]) -> Vec<Judgement> {
    let mut epochs = epochs.to_vec();
    for epoch in &mut epochs {
        epoch.conditions.clear();
    }
    let (state, judgements) = judge(settings(&["f1"], &[], COMMISSIONING_DAYS), &epochs);
    describe(&state, &judgements);
    judgements
}

#[test]
fn storms_are_explained_by_the_amplitude_above_its_hinge() {
    for seed in 1..=4 {
        println!("seed {seed}");
        let (state, judgements) = with_amplitude(&epochs(seed, 730, |_| 1.0));
        let finding = judgements.iter().find(|one| one.finding.is_some());
        assert!(finding.is_none(), "seed {seed}: {finding:?}");
        let inside = coverage(judgements.iter());
        assert!((0.9..=1.0).contains(&inside), "seed {seed}: {inside}");
        let reference = state.report().remove(0).reference.expect("a reference");
        let hinge = reference.amplitude_hinges[0].log10();
        assert!((hinge - HINGE).abs() < 0.35, "seed {seed}: {hinge}");
        let in_storms = judgements
            .iter()
            .filter(|one| STORMS.contains(&(one.day as f64)));
        let judged = in_storms.filter(|one| one.state == State::Judged);
        let errors: Vec<f64> = judged
            .filter_map(|one| one.expectation)
            .map(|expectation| (expectation.measured / expectation.expected).ln())
            .collect();
        assert!(errors.len() >= 25, "seed {seed}: {} judged", errors.len());
        // A storm lowers the frequency by some 2.4 %.
        let mean = errors.iter().sum::<f64>() / errors.len() as f64;
        assert!(mean.abs() < 0.002, "seed {seed}: {mean}");
    }
}

#[test]
fn forty_days_of_storms_look_like_a_loss_without_the_amplitude() {
    for seed in 1..=4 {
        println!("seed {seed}");
        let judgements = without_amplitude(&epochs(seed, 520, |_| 1.0));
        let alarm = first_alarm(&judgements).expect("an alarm");
        assert!(STORMS.contains(&(alarm.day as f64)), "{alarm:?}");
    }
}

#[test]
fn the_amplitude_hides_no_loss() {
    for seed in 1..=4 {
        println!("seed {seed}");
        let loss = |day: f64| if day < 400.0 { 1.0 } else { 0.96 };
        let (_, judgements) = with_amplitude(&epochs(seed, 450, loss));
        let alarm = first_alarm(&judgements).expect("an alarm");
        assert!((400..430).contains(&alarm.day), "{alarm:?}");
    }
}

/// A commissioning without storms does not show their effect.
#[test]
fn motion_that_was_never_as_strong_is_outside_experience() {
    let mut series = epochs(1, 490, |_| 1.0);
    let is_weak = |epoch: &Epoch| epoch.conditions[0].is_some_and(|rms| rms.log10() < HINGE);
    let is_early = |epoch: &Epoch| epoch.time_s < STORMS.start * DAY_S;
    series.retain(|epoch| is_weak(epoch) || !is_early(epoch));
    let (_, judgements) = with_amplitude(&series);
    let outside = |one: &&Judgement| matches!(one.state, State::OutsideExperience { .. });
    let late = |one: &&Judgement| STORMS.contains(&(one.day as f64));
    let first = judgements.iter().filter(late).take(5).filter(outside);
    assert_eq!(first.count(), 5);
}
