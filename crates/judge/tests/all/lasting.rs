//! What remains of a loss: an alarm stays, and a gain counts from the commissioning.

use crate::support::{coverage, describe, judge, noise, settings};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use spandrel_judge::{Epoch, Finding, Judge, Judgement, State};

const DAY_S: f64 = 86_400.0;
const COMMISSIONING_DAYS: u32 = 365;
const PER_DAY: u32 = 4;

/// Judges a frequency under a deck with seasons, weather and a deviation without a measured cause.
/// `stiffness` is the share of the sound stiffness on a day.
fn judged(seed: u64, days: u32, stiffness: impl Fn(f64) -> f64) -> Vec<Judgement> {
    commissioned(seed, days, COMMISSIONING_DAYS, stiffness).1
}

/// The same after a commissioning of any length. Also returns the judge.
fn commissioned(
    seed: u64,
    days: u32,
    commissioning_days: u32,
    stiffness: impl Fn(f64) -> f64,
) -> (Judge, Vec<Judgement>) {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let (mut weather, mut deviation) = (0.0, 0.0);
    let epoch = |index: u32| {
        let day = f64::from(index) / f64::from(PER_DAY);
        weather = 0.95 * weather + 1.2 * noise(&mut random);
        deviation = 0.98 * deviation + 0.0004 * noise(&mut random);
        let season = 12.0 - 10.0 * (day * std::f64::consts::TAU / 365.25).cos();
        let deck = season + weather;
        let sound = 4.0 * (-0.0012 * deck + deviation + 0.0015 * noise(&mut random)).exp();
        Epoch {
            time_s: day * DAY_S,
            quantities: vec![Some(sound * stiffness(day).sqrt())],
            conditions: vec![Some(deck)],
        }
    };
    let epochs: Vec<Epoch> = (0..PER_DAY * days).map(epoch).collect();
    let (state, judgements) = judge(settings(&["f1"], &["deck"], commissioning_days), &epochs);
    println!("seed {seed}");
    describe(&state, &judgements);
    (state, judgements)
}

fn is_stiffer(judgement: &&Judgement) -> bool {
    matches!(judgement.finding, Some(Finding::Stiffer(_)))
}

#[test]
fn an_alarm_stays_when_most_of_the_loss_comes_back() {
    for seed in 1..=4 {
        let judgements = judged(seed, 800, |day| match day {
            ..430.0 => 1.0,
            ..450.0 => 0.97,
            _ => 0.997,
        });
        let has_alarm = |judgement: &Judgement| judgement.finding.is_some_and(|f| f.is_alarm());
        let first = judgements.iter().position(has_alarm).expect("an alarm");
        let lost = judgements[first..].iter().find(|one| !has_alarm(one));
        assert!(lost.is_none(), "seed {seed}: {lost:?}");
    }
}

/// Returns how many of the judgements with an alarm have an interval that contains the true loss,
/// and the number of alarms that were raised.
fn correct(judgements: &[Judgement], loss: impl Fn(f64) -> f64) -> (usize, usize, usize) {
    let alarms = judgements.iter().filter_map(|judgement| {
        let finding = judgement.finding.filter(Finding::is_alarm)?;
        Some((judgement, finding))
    });
    let (mut inside, mut all, mut raised) = (0, 0, 0);
    for (judgement, finding) in alarms {
        let [low, high] = finding.change().interval;
        all += 1;
        inside += usize::from((low..=high).contains(&loss(judgement.day as f64)));
        raised += usize::from(judgement.raised);
    }
    println!("{inside} of {all} intervals are correct, {raised} raised");
    (inside, all, raised)
}

/// The model learns most of a slow loss. Regression test: the stated loss did not contain this part.
#[test]
fn a_slow_loss_is_stated_in_its_present_size() {
    for seed in 1..=4 {
        let loss = |day: f64| 0.01 * (day - 420.0).max(0.0) / 30.0;
        let judgements = judged(seed, 1000, |day| 1.0 - loss(day));
        let (inside, all, raised) = correct(&judgements, loss);
        assert!(all > 300 && 10 * inside >= 9 * all, "{inside} of {all}");
        assert!((2..20).contains(&raised), "{raised}");
        let last = judgements.last().unwrap();
        assert_eq!(last.state, State::Judged, "no day is judged any longer");
    }
}

/// Regression test: the second loss was never raised, and its size was wrong for months.
#[test]
fn a_second_loss_is_raised_in_its_size() {
    for seed in 1..=4 {
        let loss = |day: f64| match day {
            ..430.0 => 0.0,
            ..560.0 => 0.05,
            _ => 0.15,
        };
        let judgements = judged(seed, 700, |day| 1.0 - loss(day));
        let raised: Vec<&Judgement> = judgements.iter().filter(|one| one.raised).collect();
        assert!((430..460).contains(&raised[0].day), "{raised:?}");
        assert!((560..570).contains(&raised[1].day), "{raised:?}");
        assert!(raised.len() <= 3, "{raised:?}");
        let soon = judgements.iter().find(|one| one.day == 570).unwrap();
        let [low, high] = soon.finding.unwrap().change().interval;
        assert!(low < 0.15 && 0.15 < high, "{soon:?}");
        let last = judgements.last().unwrap().finding.unwrap();
        let [low, high] = last.change().interval;
        assert!(low < 0.15 && 0.15 < high, "{last:?}");
        assert!((420..435).contains(&last.change().since_day), "{last:?}");
    }
}

#[test]
fn a_loss_that_came_back_may_have_recovered() {
    for seed in 1..=4 {
        let judgements = judged(seed, 560, |day| match day {
            430.0..445.0 => 0.95,
            _ => 1.0,
        });
        let sentence = judgements.last().unwrap().sentence();
        assert!(sentence.contains("may have recovered"), "{sentence}");
    }
}

/// The date of the first epoch is wrong, such as that of a clock without a battery.
#[test]
fn a_first_day_with_a_wrong_date_does_not_shorten_the_commissioning() {
    let epoch = |day: f64| Epoch {
        time_s: day * DAY_S,
        quantities: vec![Some(4.0 + 0.001 * (day % 5.0))],
        conditions: Vec::new(),
    };
    let days = (5000..5100).map(f64::from);
    let epochs: Vec<Epoch> = [0.0].into_iter().chain(days).map(epoch).collect();
    let (_, judgements) = judge(settings(&["f1"], &[], COMMISSIONING_DAYS), &epochs);
    let last = judgements.last().unwrap();
    assert_eq!(last.state, State::Learning { days_left: 265 });
}

/// A slow loss is learnt. It is partly repaired, and the bridge remains softer than it was.
#[test]
fn a_learnt_loss_that_partly_comes_back_is_no_gain() {
    for seed in 1..=4 {
        let judgements = judged(seed, 1000, |day| match day {
            ..660.0 => 1.0 - 0.05 * ((day - 400.0) / 200.0).clamp(0.0, 1.0),
            _ => 0.98,
        });
        let stiffer = judgements.iter().find(is_stiffer);
        assert!(stiffer.is_none(), "seed {seed}: {stiffer:?}");
    }
}

#[test]
fn a_gain_beyond_the_commissioning_is_told() {
    for seed in 1..=4 {
        let judgements = judged(seed, 560, |day| if day < 430.0 { 1.0 } else { 1.04 });
        let stiffer = judgements.iter().find(is_stiffer).expect("a gain");
        assert!(
            (430..500).contains(&stiffer.day),
            "seed {seed}: {stiffer:?}"
        );
    }
}

/// A commissioning of 120 days does not show the deviations of other seasons, so a loss of 2 % is
/// not raised. Regression test: the report stated a delay of some days for it.
#[test]
fn the_report_names_the_losses_that_a_short_commissioning_cannot_show() {
    let (state, _) = commissioned(1, 130, 120, |_| 1.0);
    let reference = state.report().remove(0).reference.expect("a reference");
    let delay = |loss: f64| {
        let of = |delay: &&spandrel_judge::Delay| delay.loss == loss;
        let delays = &reference.performance.delays;
        delays.iter().find(of).expect("the loss").median_days
    };
    assert_eq!(delay(0.02), None);
    assert!(delay(0.10).is_some());
}

/// A commissioning of 120 days does not show the errors of other seasons, so the interval is wide
/// at first. Regression test: it remained too wide, and held nearly all days.
#[test]
fn the_interval_holds_its_share_of_the_days_after_a_short_commissioning() {
    let mut share = 0.0;
    for seed in 1..=4 {
        let judgements = commissioned(seed, 485, 120, |_| 1.0).1;
        share += coverage(judgements.iter()) / 4.0;
    }
    assert!((0.93..0.97).contains(&share), "{share}");
}

/// The deviation from a lost stiffness says nothing about the errors of a sound day.
#[test]
fn a_loss_does_not_widen_the_interval() {
    let width = |loss: f64| {
        let judgements = judged(1, 560, |day| if day < 430.0 { 1.0 } else { 1.0 - loss });
        let [low, high] = judgements.last().unwrap().expectation.unwrap().interval;
        (high / low).ln()
    };
    let (sound, lost) = (width(0.0), width(0.05));
    assert!(lost < 1.3 * sound, "{sound}, {lost}");
}
