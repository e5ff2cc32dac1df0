//! Other modes as thermometers, where no temperature is measured.

use crate::support::{coverage, describe, judge, noise, settings};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use spandrel_judge::{
    Absence, Condition, ConditionKind, Epoch, Judge, Judgement, NewReference, Settings, State,
};

const DAY_S: f64 = 86_400.0;
const PER_DAY: u32 = 4;
const COMMISSIONING_DAYS: u32 = 365;
const MODES: [&str; 4] = ["f1", "f2", "f3", "f4"];
/// Fall of ln(frequency) of each mode per degree.
const SLOPES: [f64; 4] = [0.0030, 0.0022, 0.0026, 0.0034];
/// Day of the changes.
const CHANGE: f64 = 430.0;

/// Returns the epochs of four modes under a temperature that is not measured. Each mode also has a
/// deviation of its own. `stiffness` is the share of the sound stiffness of a mode on a day.
fn epochs(seed: u64, days: u32, warmth: f64, stiffness: impl Fn(usize, f64) -> f64) -> Vec<Epoch> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let (mut weather, mut deviations) = (0.0, [0.0_f64; 4]);
    let epoch = |index: u32| {
        let day = f64::from(index) / f64::from(PER_DAY);
        weather = 0.95 * weather + 1.2 * noise(&mut random);
        let season = 12.0 - 10.0 * (day * std::f64::consts::TAU / 365.25).cos();
        let celsius = warmth * (season + weather);
        let frequency = |mode: usize| {
            deviations[mode] = 0.98 * deviations[mode] + 0.0002 * noise(&mut random);
            let error = deviations[mode] + 0.0015 * noise(&mut random);
            let sound = (mode + 2) as f64 * (error - SLOPES[mode] * celsius).exp();
            Some(sound * stiffness(mode, day).sqrt())
        };
        Epoch {
            time_s: day * DAY_S,
            quantities: (0..MODES.len()).map(frequency).collect(),
            conditions: Vec::new(),
        }
    };
    (0..PER_DAY * days).map(epoch).collect()
}

/// Settings in which other modes are the thermometers of the first mode.
fn with(thermometers: &[&str]) -> Settings {
    let mut settings = settings(&MODES, &[], COMMISSIONING_DAYS);
    let names = thermometers.iter().map(|name| (*name).to_owned());
    settings.quantities[0].thermometers = names.collect();
    settings
}

/// Judges epochs, and returns the judgements of the first mode.
fn first_mode(thermometers: &[&str], epochs: &[Epoch]) -> Vec<Judgement> {
    let (state, judgements) = judge(with(thermometers), epochs);
    println!("thermometers {thermometers:?}");
    describe(&state, &judgements);
    of_first(judgements)
}

fn of_first(mut judgements: Vec<Judgement>) -> Vec<Judgement> {
    judgements.retain(|judgement| judgement.quantity == "f1");
    judgements
}

fn alarm_day(judgements: &[Judgement]) -> Option<i64> {
    let mut alarms = judgements
        .iter()
        .filter(|one| one.finding.is_some_and(|f| f.is_alarm()));
    alarms.next().map(|alarm| alarm.day)
}

const TWO: [&str; 2] = ["f2", "f3"];
const THREE: [&str; 3] = ["f2", "f3", "f4"];

#[test]
fn a_sound_mode_is_predicted_and_raises_nothing() {
    for seed in 1..=3 {
        let epochs = epochs(seed, 800, 1.0, |_, _| 1.0);
        for thermometers in [&TWO[..], &THREE] {
            let judgements = first_mode(thermometers, &epochs);
            let finding = judgements.iter().find(|one| one.finding.is_some());
            assert!(finding.is_none(), "seed {seed}: {finding:?}");
            let judged = judgements.iter().filter(|one| one.state == State::Judged);
            assert!(judged.count() > 400, "seed {seed}");
            let inside = coverage(judgements.iter());
            assert!((0.9..=1.0).contains(&inside), "seed {seed}: {inside}");
            let has_no_condition =
                |one: &Judgement| one.means.as_ref().is_none_or(|of| of.conditions.is_empty());
            assert!(judgements.iter().all(has_no_condition));
        }
    }
}

/// Without a thermometer, the seasons leave the mode without a reference.
#[test]
fn a_loss_of_four_percent_is_found_with_thermometers_only() {
    for seed in 1..=3 {
        let loss = |mode: usize, day: f64| {
            if mode == 0 && day >= CHANGE {
                0.96
            } else {
                1.0
            }
        };
        let epochs = epochs(seed, 446, 1.0, loss);
        assert_eq!(alarm_day(&first_mode(&[], &epochs)), None, "seed {seed}");
        for thermometers in [&TWO[..], &THREE] {
            let judgements = first_mode(thermometers, &epochs);
            let day = alarm_day(&judgements).expect("an alarm");
            assert!((430..445).contains(&day), "seed {seed}: day {day}");
            let raised = judgements.iter().filter(|one| one.raised).count();
            assert_eq!(raised, 1, "seed {seed}");
            let finding = judgements.last().unwrap().finding.unwrap();
            let [low, high] = finding.change().interval;
            assert!(low < 0.04 && 0.04 < high, "seed {seed}: {finding:?}");
        }
    }
}

/// Relative to the second mode alone, the first one seems to have lost or gained stiffness.
#[test]
fn a_thermometer_that_changes_causes_no_finding() {
    for (seed, share) in [(1, 1.04), (2, 1.04), (3, 0.96)] {
        let change = |mode: usize, day: f64| {
            if mode == 1 && day >= CHANGE {
                share
            } else {
                1.0
            }
        };
        let epochs = epochs(seed, 520, 1.0, change);
        for thermometers in [&TWO[..], &THREE] {
            let judgements = first_mode(thermometers, &epochs);
            let finding = judgements.iter().find(|one| one.finding.is_some());
            assert!(finding.is_none(), "seed {seed}: {finding:?}");
        }
    }
}

#[test]
fn one_of_three_thermometers_that_loses_as_much_hides_no_loss() {
    for seed in 1..=3 {
        let loss = |mode: usize, day: f64| if mode < 2 && day >= CHANGE { 0.96 } else { 1.0 };
        let judgements = first_mode(&THREE, &epochs(seed, 446, 1.0, loss));
        let day = alarm_day(&judgements).expect("an alarm");
        assert!((430..445).contains(&day), "seed {seed}: day {day}");
    }
}

/// This cannot be distinguished from warmth.
#[test]
fn a_loss_of_all_modes_raises_no_alarm() {
    let loss = |_: usize, day: f64| if day >= CHANGE { 0.96 } else { 1.0 };
    let judgements = first_mode(&THREE, &epochs(1, 520, 1.0, loss));
    assert_eq!(alarm_day(&judgements), None);
}

/// The seasons are weak, so that the thermometers are judged, too.
#[test]
fn a_thermometer_with_a_finding_stops_serving() {
    let change = |mode: usize, day: f64| match mode {
        1 if day >= CHANGE => 0.88,
        2 if day >= CHANGE + 30.0 => 0.88,
        _ => 1.0,
    };
    let (state, judgements) = judge(with(&TWO), &epochs(1, 500, 0.1, change));
    describe(&state, &judgements);
    let alarms = |name: &str| {
        let of = judgements.iter().filter(|one| one.quantity == name);
        of.filter(|one| one.raised)
            .map(|one| one.day)
            .collect::<Vec<_>>()
    };
    let (second, third) = (alarms("f2")[0], alarms("f3")[0]);
    assert!((430..450).contains(&second) && (460..480).contains(&third));
    assert!(alarms("f1").is_empty());
    let first = of_first(judgements);
    let on = |day: i64| first.iter().find(|one| one.day == day).unwrap();
    assert_eq!(on(459).state, State::Judged, "with the third mode alone");
    let why = Absence::Changed("f2, f3".to_owned());
    assert_eq!(on(third).state, State::NoStatement { why });
    assert_eq!(
        on(499).sentence(),
        "f1 is not judged, because its thermometers f2, f3 have changed or have a new reference. \
         It needs a new reference."
    );
}

#[test]
fn a_thermometer_with_a_new_reference_stops_serving_until_the_mode_has_one() {
    let series = epochs(1, 900, 1.0, |_, _| 1.0);
    let anew = |day: f64, quantity: usize| NewReference {
        time_s: day * DAY_S,
        quantity: Some(quantity),
    };
    let mut state = Judge::new(with(&TWO)).unwrap();
    for new in [anew(400.0, 1), anew(410.0, 2), anew(420.0, 0)] {
        state.start_anew(new);
    }
    let mut judgements = Vec::new();
    for epoch in &series {
        state.handle(epoch, &mut judgements).unwrap();
    }
    state.finish(&mut judgements);
    let first = of_first(judgements);
    let states = |days: std::ops::Range<i64>| {
        let of = first.iter().filter(move |one| days.contains(&one.day));
        of.map(|one| one.state.clone()).collect::<Vec<_>>()
    };
    let judged = |days| {
        states(days)
            .iter()
            .filter(|one| **one == State::Judged)
            .count()
    };
    assert!(judged(401..410) > 5, "{:?}", states(401..410));
    let is_without = |state: &State| matches!(state, State::NoStatement { .. });
    assert!(
        states(411..420).iter().all(is_without),
        "{:?}",
        states(411..420)
    );
    assert_eq!(states(425..426), [State::Learning { days_left: 359 }]);
    assert!(judged(800..890) > 60, "{:?}", states(800..890));
}

/// Only the second mode has changed. The course of the third one is present on each of these days,
/// although it was just learnt, or has just come back.
#[test]
fn a_single_course_decides_neither_after_its_commissioning_nor_after_an_outage() {
    let gain = |day_of_change: f64| {
        move |mode: usize, day: f64| {
            if mode == 1 && day >= day_of_change {
                1.04
            } else {
                1.0
            }
        }
    };
    let mut late = epochs(1, 446, 1.0, gain(372.0));
    for epoch in late.iter_mut().filter(|one| one.time_s < 25.0 * DAY_S) {
        epoch.quantities[2] = None;
    }
    let mut outage = epochs(1, 500, 1.0, gain(CHANGE));
    outage.retain(|one| !(440.0 * DAY_S..475.0 * DAY_S).contains(&one.time_s));
    let missing = 475.0 * DAY_S..476.0 * DAY_S;
    for epoch in outage
        .iter_mut()
        .filter(|one| missing.contains(&one.time_s))
    {
        epoch.quantities[2] = None;
    }
    for series in [late, outage] {
        let judgements = first_mode(&TWO, &series);
        let finding = judgements.iter().find(|one| one.finding.is_some());
        assert!(finding.is_none(), "{finding:?}");
    }
}

#[test]
fn a_third_thermometer_that_is_never_measured_hides_no_loss() {
    let loss = |mode: usize, day: f64| {
        if mode == 0 && day >= CHANGE {
            0.96
        } else {
            1.0
        }
    };
    let mut series = epochs(1, 446, 1.0, loss);
    series
        .iter_mut()
        .for_each(|epoch| epoch.quantities[3] = None);
    let day = alarm_day(&first_mode(&THREE, &series)).expect("an alarm");
    assert!((430..445).contains(&day), "{day}");
}

#[test]
fn the_order_of_new_references_on_one_day_has_no_effect() {
    let series = epochs(1, 800, 1.0, |_, _| 1.0);
    let of_order = |order: [usize; 3]| {
        let mut state = Judge::new(with(&TWO)).unwrap();
        for quantity in order {
            state.start_anew(NewReference {
                time_s: 400.0 * DAY_S,
                quantity: Some(quantity),
            });
        }
        let mut judgements = Vec::new();
        for epoch in &series {
            state.handle(epoch, &mut judgements).unwrap();
        }
        state.finish(&mut judgements);
        of_first(judgements)
    };
    let first = of_order([0, 1, 2]);
    assert_eq!(first, of_order([1, 2, 0]));
    assert_eq!(first.last().unwrap().state, State::Judged);
}

#[test]
fn epochs_without_a_thermometer_do_not_count() {
    let mut series = epochs(1, 446, 1.0, |mode, day| {
        if mode == 0 && day >= CHANGE {
            0.96
        } else {
            1.0
        }
    });
    let both = {
        let mut series = series.clone();
        for epoch in series.iter_mut().filter(|one| one.time_s >= 425.0 * DAY_S) {
            (epoch.quantities[1], epoch.quantities[2]) = (None, None);
        }
        first_mode(&TWO, &series)
    };
    let last = both.last().unwrap();
    let is_missing = matches!(
        &last.state,
        State::NoStatement {
            why: Absence::Condition(_)
        }
    );
    assert!(is_missing, "{last:?}");
    assert_eq!(alarm_day(&both), None);
    // A thermometer that is missing for a month is no longer awaited.
    for epoch in series.iter_mut().filter(|one| one.time_s >= 395.0 * DAY_S) {
        epoch.quantities[1] = None;
    }
    let day = alarm_day(&first_mode(&TWO, &series)).expect("an alarm");
    assert!((430..445).contains(&day), "{day}");
}

/// A program confuses the second mode with another one, 3 % higher, in one of 25 epochs. The last
/// day has such an epoch.
#[test]
fn an_epoch_with_another_mode_as_thermometer_does_not_move_its_day() {
    let sound = epochs(1, 444, 1.0, |_, _| 1.0);
    let mut confused = sound.clone();
    for epoch in confused.iter_mut().step_by(25) {
        epoch.quantities[1] = epoch.quantities[1].map(|value| 1.03 * value);
    }
    let error = |epochs: &[Epoch]| {
        let expectation = first_mode(&TWO, epochs).last().unwrap().expectation;
        let expectation = expectation.expect("a day with data");
        (expectation.measured / expectation.expected).ln()
    };
    // A day that is moved has an error of 1 %.
    let (sound, confused) = (error(&sound), error(&confused));
    assert!((sound - confused).abs() < 0.004, "{sound}, {confused}");
}

#[test]
fn a_restart_gives_the_same_judgements_in_less_than_64_kilobytes() {
    let amplitude = |mut settings: Settings| {
        settings.conditions.push(Condition {
            name: "rms".to_owned(),
            kind: ConditionKind::Amplitude,
        });
        settings
    };
    let mut series = epochs(1, 450, 1.0, |mode, day| {
        if mode == 0 && day >= CHANGE {
            0.96
        } else {
            1.0
        }
    });
    for (index, epoch) in series.iter_mut().enumerate() {
        epoch
            .conditions
            .push(Some(0.01 + 0.001 * (index as f64).sin()));
    }
    let (_, expected) = judge(amplitude(with(&TWO)), &series);
    let size = |judge: &Judge| postcard::to_allocvec(judge).unwrap().len();
    let mut alone = Judge::new(amplitude(with(&[]))).unwrap();
    let mut state = Judge::new(amplitude(with(&TWO))).unwrap();
    let (mut found, mut largest) = (Vec::new(), 0);
    for (index, epoch) in series.iter().enumerate() {
        alone.handle(epoch, &mut Vec::new()).unwrap();
        state.handle(epoch, &mut found).unwrap();
        if index % 97 == 0 {
            let bytes = postcard::to_allocvec(&state).unwrap();
            state = postcard::from_bytes(&bytes).unwrap();
            // Without its thermometers, the first mode is one of four equal quantities.
            largest = largest.max(bytes.len().saturating_sub(size(&alone) * 3 / 4));
        }
    }
    state.finish(&mut found);
    assert_eq!(found, expected);
    assert!(largest < 64 * 1024, "{largest} bytes");
}

#[test]
fn a_wrong_list_of_thermometers_is_an_error() {
    let second = |mut settings: Settings, thermometers: &[&str]| {
        let names = thermometers.iter().map(|name| (*name).to_owned());
        settings.quantities[1].thermometers = names.collect();
        settings
    };
    let mut condition = with(&THREE);
    condition.conditions.push(Condition {
        name: "air".to_owned(),
        kind: ConditionKind::Celsius,
    });
    for (settings, said) in [
        (
            with(&["f2", "f5"]),
            "list of thermometers of f1 contains \"f5\", must contain other quantities: f2, f3, f4",
        ),
        (
            with(&["f1", "f2"]),
            "contains \"f1\", must contain other quantities",
        ),
        (with(&["f2", "f2"]), "repeats \"f2\", must be unique"),
        (with(&["f2"]), "has 1 name, must have at least 2"),
        (
            condition,
            "has 3 names beside 1 conditions, must be at most 3 together",
        ),
        (
            second(with(&["f2", "f3"]), &["f1", "f3"]),
            "contains \"f2\", which has thermometers itself",
        ),
        (
            second(with(&["f2", "f3"]), &["f3", "f4"]),
            "contains \"f2\", which has thermometers itself",
        ),
    ] {
        let error = Judge::new(settings).unwrap_err().to_string();
        assert!(error.contains(said), "{error}");
    }
}
