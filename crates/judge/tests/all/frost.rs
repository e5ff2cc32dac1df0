//! A commissioning without frost, and the winters after it.

use crate::support::{describe, first_alarm, judge, noise, settings};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use spandrel_judge::{Epoch, Judgement, State};
use std::ops::Range;

const DAY_S: f64 = 86_400.0;
const PER_DAY: u32 = 4;

/// Deck temperature (°C) of a day. The winter of each year has two cold spells of ten days. The
/// second one is no colder than the first.
fn deck(day: f64) -> f64 {
    match day % 365.0 {
        300.0..310.0 => -3.0,
        320.0..330.0 => -2.0,
        day => 12.0 + 9.0 * (std::f64::consts::TAU * (day - 120.0) / 365.0).cos(),
    }
}

/// Judges a structure that stiffens in frost, after a commissioning of 200 days without frost.
/// `deck` is `None` on days without data.
fn judged(
    seed: u64,
    days: u32,
    deck: impl Fn(f64) -> Option<f64>,
) -> (Option<bool>, Vec<Judgement>) {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let epoch = |index: u32| {
        let day = f64::from(index) / f64::from(PER_DAY);
        let deck = deck(day.floor())? + 0.3 * noise(&mut random);
        let error = 0.002 * noise(&mut random);
        Some(Epoch {
            time_s: day * DAY_S,
            quantities: vec![Some(
                4.0 * (-0.001 * deck - 0.01 * deck.min(0.0) + error).exp(),
            )],
            conditions: vec![Some(deck)],
        })
    };
    let epochs: Vec<Epoch> = (0..PER_DAY * days).filter_map(epoch).collect();
    let (state, judgements) = judge(settings(&["f1"], &["deck"], 200), &epochs);
    println!("seed {seed}");
    describe(&state, &judgements);
    let report = state.report().remove(0);
    (
        report.reference.expect("a reference").knows_frost,
        judgements,
    )
}

/// Returns the number of days of frost, and how many of them are outside experience.
fn frost(judgements: &[Judgement], days: Range<i64>) -> (usize, usize) {
    let of_frost = judgements.iter().filter(|judgement| {
        let means = judgement.means.as_ref();
        days.contains(&judgement.day) && means.is_some_and(|means| means.conditions[0] < 0.0)
    });
    let is_outside = |one: &&Judgement| matches!(one.state, State::OutsideExperience { .. });
    let outside = of_frost.clone().filter(is_outside).count();
    (of_frost.count(), outside)
}

/// Regression test: after five days of frost, a day that was not colder was judged.
#[test]
fn all_frost_of_a_first_winter_is_outside_experience_and_known_in_the_next_one() {
    for seed in 1..=3 {
        let (knows_frost, judgements) = judged(seed, 365, |day| Some(deck(day)));
        assert_eq!(frost(&judgements, 0..365), (20, 20), "seed {seed}");
        assert_eq!(knows_frost, Some(false), "seed {seed}");
        let (knows_frost, judgements) = judged(seed, 730, |day| Some(deck(day)));
        let (days, outside) = frost(&judgements, 365..730);
        // Half of the first spell can be colder than five days of the winter before.
        assert!(days == 20 && outside < 10, "seed {seed}: {outside}");
        assert_eq!(knows_frost, Some(true), "seed {seed}");
        assert_eq!(first_alarm(&judgements), None);
    }
}

/// Regression test: three months without data ended the winter, so that its frost became known.
#[test]
fn days_without_data_do_not_end_a_winter() {
    let interrupted = |day: f64| match day {
        300.0..310.0 => Some(-3.0),
        310.0..405.0 => None,
        405.0..415.0 => Some(-2.0),
        _ => Some(deck(day)),
    };
    let (_, judgements) = judged(1, 420, interrupted);
    assert_eq!(frost(&judgements, 0..420), (20, 20));
}

/// Where no summer is long enough, the frost of a winter is known in the next one.
#[test]
fn a_winter_is_over_after_a_year_even_if_the_summer_is_short() {
    let alpine = |day: f64| match day {
        // Each month from the first winter on has three days of frost.
        300.0.. if day % 30.0 < 3.0 => Some(-3.0),
        _ => Some(deck(day).max(3.0)),
    };
    let (_, judgements) = judged(1, 720, alpine);
    let (days, outside) = frost(&judgements, 300..630);
    assert_eq!(days, outside);
    let (days, outside) = frost(&judgements, 631..720);
    assert!(days == 8 && outside < 5, "{outside} of {days}");
}
