//! What remains of a loss: an alarm stays, and a gain counts from the commissioning.

use crate::support::{coverage, describe, first_alarm, judge, noise, settings};
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

/// Judges hourly values of a quiet bridge, whose daily means scatter by 0.08 % of frequency.
/// `scatter` and `stiffness` are those of a day.
fn quiet(
    seed: u64,
    days: u32,
    scatter: impl Fn(f64) -> f64,
    stiffness: impl Fn(f64) -> f64,
) -> Vec<Judgement> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut weather = 0.0;
    let epoch = |index: u32| {
        let day = f64::from(index) / 24.0;
        weather = 0.985 * weather + 0.5 * noise(&mut random);
        let season = 12.0 - 8.0 * (day * std::f64::consts::TAU / 365.25).cos();
        let deck = season + weather;
        let error = scatter(day) * noise(&mut random);
        Epoch {
            time_s: day * DAY_S,
            quantities: vec![Some(
                3.0 * (-0.0013 * deck + error).exp() * stiffness(day).sqrt(),
            )],
            conditions: vec![Some(deck)],
        }
    };
    let epochs: Vec<Epoch> = (0..24 * days).map(epoch).collect();
    let settings = settings(&["f1"], &["deck"], COMMISSIONING_DAYS);
    let (state, judgements) = judge(settings, &epochs);
    println!("seed {seed}");
    describe(&state, &judgements);
    judgements
}

/// Regression test: the deviation u followed the ramp, and no step explained it for months.
#[test]
fn a_loss_that_grows_within_a_month_is_raised_within_two_months() {
    for seed in 1..=3 {
        let loss = |day: f64| 0.05 * ((day - 430.0) / 30.0).clamp(0.0, 1.0);
        let judgements = quiet(seed, 520, |_| 0.004, |day| 1.0 - loss(day));
        let alarm = first_alarm(&judgements).expect("an alarm");
        assert!((430..490).contains(&alarm.day), "{}", alarm.sentence());
        let [low, high] = judgements
            .last()
            .unwrap()
            .finding
            .unwrap()
            .change()
            .interval;
        assert!(low < 0.05 && 0.05 < high, "{low} to {high}");
    }
}

/// Regression test: the guard and the evidence read the scatter as a loss.
#[test]
fn more_scatter_is_no_loss_and_hides_none() {
    for seed in 1..=3 {
        let scatter = |day: f64| if day < 430.0 { 0.004 } else { 0.02 };
        let sound = quiet(seed, 800, scatter, |_| 1.0);
        assert_eq!(first_alarm(&sound), None);
        let late = sound.iter().filter(|judgement| judgement.day >= 460);
        let coverage = coverage(late);
        assert!(coverage > 0.85, "{coverage}");
        let lost = quiet(
            seed,
            620,
            scatter,
            |day| {
                if day < 580.0 { 1.0 } else { 0.93 }
            },
        );
        let alarm = first_alarm(&lost).expect("an alarm");
        assert!((580..620).contains(&alarm.day), "{}", alarm.sentence());
    }
}

/// Regression test: the drop was stated as a loss of less than nothing, and never in its size.
#[test]
fn a_drop_from_a_level_that_had_risen_is_stated_in_its_size() {
    for seed in 1..=3 {
        let judgements = quiet(
            seed,
            620,
            |_| 0.004,
            |day| match day {
                ..430.0 => 1.0,
                ..560.0 => 1.1,
                _ => 1.1 * 0.92,
            },
        );
        let last = judgements.last().unwrap();
        let sentence = last.sentence();
        assert!(sentence.contains("has dropped by"), "{sentence}");
        assert!(
            sentence.contains("from a level that had risen"),
            "{sentence}"
        );
        let change = *last.finding.expect("a finding").change();
        assert!((change.drop - 0.08).abs() < 0.015, "{change:?}");
        let raised = judgements.iter().filter(|one| one.raised);
        let alarms = raised.filter(|one| one.finding.is_some_and(|f| f.is_alarm()));
        assert_eq!(alarms.count(), 1);
    }
}

/// Regression test: a second loss was raised only if it was larger than the first one.
#[test]
fn a_second_smaller_loss_is_raised_with_its_date() {
    for seed in 1..=3 {
        let judgements = quiet(
            seed,
            640,
            |_| 0.004,
            |day| match day {
                ..430.0 => 1.0,
                ..560.0 => 0.9,
                _ => 0.83,
            },
        );
        let raised: Vec<&Judgement> = judgements.iter().filter(|one| one.raised).collect();
        assert_eq!(raised.len(), 2, "{raised:?}");
        assert!((560..575).contains(&raised[1].day), "{raised:?}");
        let change = *judgements.last().unwrap().finding.unwrap().change();
        let further = change.further.expect("a further loss");
        assert!((558..563).contains(&further.since_day), "{further:?}");
        assert!((further.loss - 0.07).abs() < 0.02, "{further:?}");
        assert!((428..433).contains(&change.since_day), "{change:?}");
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
