//! The state of a judge: its size, its restart, and its reaction to bad input.

use crate::support::{describe, first_alarm, judge, settings};
use proptest::prelude::*;
use spandrel_judge::{
    Absence, Condition, ConditionKind, Epoch, Judge, JudgeError, Judgement, NewReference, State,
};

const EPOCH_S: f64 = 6.0 * 3600.0;

/// A structure whose frequency follows the temperature of a deck, without noise that matters.
fn epoch(index: u32) -> Epoch {
    let days = f64::from(index) / 4.0;
    let deck = 10.0 + 12.0 * (days / 58.0).sin() + 3.0 * (days * 1.7).sin();
    let noise = 0.001 * (f64::from(index) * 12.9898).sin();
    Epoch {
        time_s: f64::from(index) * EPOCH_S,
        quantities: vec![Some(4.0 * (1.0 - 0.001 * deck + noise))],
        conditions: vec![Some(deck)],
    }
}

fn epochs(days: u32) -> Vec<Epoch> {
    (0..4 * days).map(epoch).collect()
}

fn restored(judge: &Judge) -> Judge {
    postcard::from_bytes(&postcard::to_allocvec(judge).unwrap()).unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(6))]

    #[test]
    fn a_restart_anywhere_gives_the_same_judgements(places in prop::collection::vec(0_usize..600, 1..4)) {
        let mut series = epochs(150);
        for epoch in series.iter_mut().skip(500) {
            epoch.quantities[0] = epoch.quantities[0].map(|value| 0.97 * value);
        }
        let (whole, expected) = judge(settings(&["f1"], &["deck"], 95), &series);
        let mut state = Judge::new(settings(&["f1"], &["deck"], 95)).unwrap();
        let mut found = Vec::new();
        for (index, epoch) in series.iter().enumerate() {
            if places.contains(&index) {
                state = restored(&state);
            }
            state.handle(epoch, &mut found).unwrap();
        }
        state.finish(&mut found);
        prop_assert_eq!(
            postcard::to_allocvec(&found).unwrap(),
            postcard::to_allocvec(&expected).unwrap()
        );
        prop_assert_eq!(
            postcard::to_allocvec(&state).unwrap(),
            postcard::to_allocvec(&whole).unwrap()
        );
    }
}

#[test]
fn the_state_of_a_quantity_stays_below_64_kilobytes() {
    let mut state = Judge::new(settings(&["f1"], &["deck"], 400)).unwrap();
    let mut judgements = Vec::new();
    let mut largest = 0;
    for epoch in epochs(560) {
        state.handle(&epoch, &mut judgements).unwrap();
        if epoch.time_s % (20.0 * 86_400.0) == 0.0 {
            largest = largest.max(postcard::to_allocvec(&state).unwrap().len());
        }
    }
    println!("largest state: {largest} bytes");
    assert!(judgements.last().unwrap().state == State::Judged);
    assert!(largest < 64 * 1024, "{largest} bytes");
}

#[test]
fn a_loss_is_found_and_measured() {
    let mut series = epochs(200);
    for epoch in series
        .iter_mut()
        .filter(|epoch| epoch.time_s >= 130.0 * 86_400.0)
    {
        epoch.quantities[0] = epoch.quantities[0].map(|value| 0.95_f64.sqrt() * value);
    }
    let (state, judgements) = judge(settings(&["f1"], &["deck"], 100), &series);
    describe(&state, &judgements);
    let alarm = first_alarm(&judgements).expect("an alarm");
    assert!((130..150).contains(&alarm.day), "{}", alarm.sentence());
    let [low, high] = judgements
        .last()
        .unwrap()
        .finding
        .unwrap()
        .change()
        .interval;
    assert!(
        low < 0.05 && 0.05 < high,
        "95 % interval {low} to {high} of a loss of 0.05"
    );
}

#[test]
fn an_epoch_out_of_order_is_an_error_and_changes_nothing() {
    let series = epochs(3);
    let (expected, _) = judge(settings(&["f1"], &["deck"], 100), &series[..4]);
    let mut state = Judge::new(settings(&["f1"], &["deck"], 100)).unwrap();
    let mut judgements = Vec::new();
    for epoch in &series[..4] {
        state.handle(epoch, &mut judgements).unwrap();
    }
    for wrong in [&series[3], &series[0]] {
        let error = state.handle(wrong, &mut judgements).unwrap_err();
        assert!(matches!(error, JudgeError::OutOfOrder { .. }), "{error}");
    }
    state.finish(&mut judgements);
    assert_eq!(state, expected);
}

#[test]
fn a_frozen_or_missing_thermometer_gives_no_statement_and_no_alarm() {
    for (value, expected) in [
        (Some(4.0), Absence::Frozen("deck".to_owned())),
        (None, Absence::Condition("deck".to_owned())),
        // Kelvin that arrive as °C are not plausible.
        (Some(281.0), Absence::Condition("deck".to_owned())),
    ] {
        let mut series = epochs(160);
        for epoch in series
            .iter_mut()
            .filter(|epoch| epoch.time_s >= 120.0 * 86_400.0)
        {
            epoch.conditions[0] = value;
        }
        let (_, judgements) = judge(settings(&["f1"], &["deck"], 100), &series);
        assert!(first_alarm(&judgements).is_none(), "{value:?}");
        let last = judgements.last().unwrap();
        assert_eq!(
            last.state,
            State::NoStatement { why: expected },
            "{value:?}"
        );
    }
}

/// The program that determines the frequency repeats its last value, or its last day, while the
/// structure loses a tenth of its stiffness.
#[test]
fn a_frozen_quantity_gives_no_statement_and_no_alarm() {
    for from_last in [1, 4] {
        let mut series = epochs(200);
        let late = 130 * 4;
        for index in late..series.len() {
            series[index].quantities = series[index - from_last].quantities.clone();
        }
        let (state, judgements) = judge(settings(&["f1"], &["deck"], 100), &series);
        describe(&state, &judgements);
        assert!(
            judgements
                .iter()
                .all(|judgement| judgement.finding.is_none())
        );
        let why = Absence::FrozenQuantity;
        for judgement in judgements.iter().filter(|judgement| judgement.day >= 132) {
            let why = why.clone();
            assert_eq!(judgement.state, State::NoStatement { why }, "{judgement:?}");
        }
        assert_eq!(
            judgements.last().unwrap().sentence(),
            "f1 is not judged, because it has repeated its values for a day or longer. Check the \
             program that determines them."
        );
    }
}

#[test]
fn a_quantity_in_another_unit_gives_no_statement_and_no_change() {
    let mut series = epochs(160);
    let late = |epoch: &&mut Epoch| epoch.time_s >= 120.0 * 86_400.0;
    for epoch in series.iter_mut().filter(late) {
        epoch.quantities[0] = epoch.quantities[0].map(|hertz| 1000.0 * hertz);
    }
    let (_, judgements) = judge(settings(&["f1"], &["deck"], 100), &series);
    assert!(
        judgements
            .iter()
            .all(|judgement| judgement.finding.is_none())
    );
    let last = judgements.last().unwrap();
    let why = Absence::OtherUnit;
    assert_eq!(last.state, State::NoStatement { why });
    assert_eq!(
        last.sentence(),
        "f1 is not judged, because its values have jumped by a factor of 10 or more. Check their \
         unit."
    );
}

#[test]
fn a_temperature_in_a_wrong_unit_is_not_ready_and_names_it() {
    let declared = |kind, unit: fn(f64) -> f64| {
        let mut settings = settings(&["f1"], &["deck"], 290);
        settings.conditions[0].kind = kind;
        let mut series = epochs(420);
        for epoch in &mut series {
            epoch.conditions[0] = epoch.conditions[0].map(unit);
        }
        let (_, judgements) = judge(settings, &series);
        assert!(
            judgements
                .iter()
                .all(|judgement| judgement.finding.is_none())
        );
        let last = judgements.last().unwrap();
        assert!(matches!(last.state, State::NotReady { .. }), "{last:?}");
        last.sentence()
    };
    let told = declared(ConditionKind::Fahrenheit, |celsius| celsius);
    assert!(
        told.contains("nine of ten days of the commissioning have deck below -"),
        "{told}"
    );
    assert!(told.contains("its unit is probably wrong"), "{told}");
    let told = declared(ConditionKind::Celsius, |celsius| 1.8 * celsius + 32.0);
    assert!(
        told.contains("the median of deck in the commissioning is "),
        "{told}"
    );
    assert!(told.contains("its unit is probably wrong"), "{told}");
}

#[test]
fn a_spike_of_the_thermometer_does_not_change_its_day() {
    let series = epochs(130);
    let (_, expected) = judge(settings(&["f1"], &["deck"], 100), &series);
    let mut spiked = series.clone();
    for epoch in spiked.iter_mut().skip(7).step_by(19) {
        epoch.conditions[0] = Some(79.0);
    }
    let (_, found) = judge(settings(&["f1"], &["deck"], 100), &spiked);
    let last = |judgements: &[Judgement]| judgements.last().unwrap().expectation.unwrap();
    let (found, expected) = (last(&found), last(&expected));
    assert!((found.expected / expected.expected - 1.0).abs() < 0.002);
}

/// The deck has been cold when its input opens. Without its warming, the frequency seems to fall.
#[test]
fn an_open_input_with_slight_noise_is_frozen_and_hides_no_season() {
    let mut series = epochs(470);
    let open = series
        .iter_mut()
        .filter(|epoch| epoch.time_s >= 300.0 * 86_400.0);
    for (index, epoch) in open.enumerate() {
        epoch.conditions[0] = Some(0.01 + 0.01 * (index as f64 * 7.1).sin());
    }
    let (state, judgements) = judge(settings(&["f1"], &["deck"], 290), &series);
    describe(&state, &judgements);
    assert_eq!(first_alarm(&judgements), None);
    let why = Absence::Frozen("deck".to_owned());
    let late = judgements.iter().filter(|judgement| judgement.day >= 302);
    for judgement in late {
        let why = why.clone();
        assert_eq!(judgement.state, State::NoStatement { why }, "{judgement:?}");
    }
}

/// In its second summer, the thermometer is 20 °C too cold from one epoch to the next.
#[test]
fn a_thermometer_that_jumps_and_stays_there_is_not_believed() {
    let mut series = epochs(520);
    let late = |epoch: &&mut Epoch| epoch.time_s >= 456.0 * 86_400.0;
    for epoch in series.iter_mut().filter(late) {
        epoch.conditions[0] = epoch.conditions[0].map(|celsius| celsius - 20.0);
    }
    let (state, judgements) = judge(settings(&["f1"], &["deck"], 365), &series);
    describe(&state, &judgements);
    assert!(
        judgements
            .iter()
            .all(|judgement| judgement.finding.is_none())
    );
    let last = judgements.last().unwrap();
    let why = Absence::Jumped("deck".to_owned());
    assert_eq!(last.state, State::NoStatement { why });
    assert_eq!(
        last.sentence(),
        "f1 is not judged, because deck has jumped from one epoch to the next and has not gone \
         back. Check the thermometer."
    );
}

#[test]
fn the_units_of_a_temperature_give_the_same_judgements() {
    let series = epochs(130);
    let (_, expected) = judge(settings(&["f1"], &["deck"], 100), &series);
    type Convert = fn(f64) -> f64;
    let units: [(ConditionKind, Convert); 2] = [
        (ConditionKind::Kelvin, |celsius| celsius + 273.15),
        (ConditionKind::Fahrenheit, |celsius| 1.8 * celsius + 32.0),
    ];
    for (kind, convert) in units {
        let mut settings = settings(&["f1"], &["deck"], 100);
        settings.conditions[0] = Condition {
            name: "deck".to_owned(),
            kind,
        };
        let mut series = series.clone();
        for epoch in &mut series {
            epoch.conditions[0] = epoch.conditions[0].map(convert);
        }
        let (_, found) = judge(settings, &series);
        for (found, expected) in found.iter().zip(&expected) {
            assert_eq!(found.state, expected.state, "{kind:?}");
            let difference = found.expectation.zip(expected.expectation);
            let difference = difference.map_or(0.0, |(a, b)| (a.expected / b.expected - 1.0).abs());
            assert!(difference < 1e-9, "{kind:?}: {difference}");
        }
    }
}

#[test]
fn an_input_that_is_wrong_after_the_commissioning_gives_no_alarm() {
    type Change = fn(&mut Epoch);
    let mistakes: [(&str, Change); 4] = [
        ("°F that arrive as °C", |epoch| {
            epoch.conditions[0] = epoch.conditions[0].map(|celsius| 1.8 * celsius + 32.0);
        }),
        ("a thermometer of another place", |epoch| {
            epoch.conditions[0] = epoch.conditions[0].map(|celsius| celsius + 25.0);
        }),
        ("a clock that jumps by 200 days", |epoch| {
            epoch.time_s += 200.0 * 86_400.0;
        }),
        ("a program that finds no frequency", |epoch| {
            epoch.quantities[0] = Some(f64::NAN);
        }),
    ];
    for (name, change) in mistakes {
        let mut series = epochs(160);
        let is_late = |epoch: &&mut Epoch| epoch.time_s >= 120.0 * 86_400.0;
        series.iter_mut().filter(is_late).for_each(change);
        let (state, judgements) = judge(settings(&["f1"], &["deck"], 100), &series);
        describe(&state, &judgements);
        assert!(first_alarm(&judgements).is_none(), "{name}");
    }
}

#[test]
fn an_epoch_of_another_mode_does_not_change_its_day() {
    let series = epochs(130);
    let (_, expected) = judge(settings(&["f1"], &["deck"], 100), &series);
    let mut confused = series.clone();
    for epoch in confused.iter_mut().step_by(16) {
        epoch.quantities[0] = epoch.quantities[0].map(|value| 0.9 * value);
    }
    let (_, found) = judge(settings(&["f1"], &["deck"], 100), &confused);
    let measured =
        |judgements: &[Judgement]| judgements.last().unwrap().expectation.unwrap().measured;
    assert!((measured(&found) / measured(&expected) - 1.0).abs() < 0.002);
    assert!(first_alarm(&found).is_none());
}

#[test]
fn the_state_of_three_thermometers_stays_below_64_kilobytes() {
    let conditions = ["deck", "girder", "air"];
    let mut state = Judge::new(settings(&["f1"], &conditions, 400)).unwrap();
    let mut judgements = Vec::new();
    let mut largest = 0;
    for mut epoch in epochs(560) {
        let deck = epoch.conditions[0].unwrap();
        epoch.conditions = vec![
            Some(deck),
            Some(0.8 * deck + 1.0),
            Some(deck - 0.5 * deck.sin()),
        ];
        state.handle(&epoch, &mut judgements).unwrap();
        if epoch.time_s % (20.0 * 86_400.0) == 0.0 {
            largest = largest.max(postcard::to_allocvec(&state).unwrap().len());
        }
    }
    println!("largest state: {largest} bytes");
    assert!(largest < 64 * 1024, "{largest} bytes");
}

#[test]
fn a_new_reference_is_that_of_a_judge_that_starts_at_its_moment() {
    let settings = || settings(&["f1", "f2"], &["deck"], 95);
    let mut series = epochs(200);
    for epoch in &mut series {
        let value = epoch.quantities[0];
        epoch.quantities.push(value);
    }
    let moment_s = 60.5 * 86_400.0;
    let (_, unchanged) = judge(settings(), &series);
    let later: Vec<Epoch> = series
        .iter()
        .filter(|epoch| epoch.time_s >= moment_s)
        .cloned()
        .collect();
    let (_, fresh) = judge(settings(), &later);
    let mut state = Judge::new(settings()).unwrap();
    state.start_anew(NewReference {
        time_s: moment_s,
        quantity: Some(1),
    });
    assert!(!state.awaits_reference(0) && state.awaits_reference(1));
    let mut judgements = Vec::new();
    for epoch in &series {
        state.handle(epoch, &mut judgements).unwrap();
    }
    state.finish(&mut judgements);
    assert!(!state.awaits_reference(1));
    let of = |all: &[Judgement], name: &str, from: i64| -> Vec<Judgement> {
        let days = all.iter().filter(|day| day.quantity == name);
        days.filter(|day| day.day >= from).cloned().collect()
    };
    assert_eq!(of(&judgements, "f1", 0), of(&unchanged, "f1", 0));
    assert_eq!(of(&judgements, "f2", 60), of(&fresh, "f2", 60));
    let before = of(&judgements, "f2", 0);
    assert_eq!(before[..60], of(&unchanged, "f2", 0)[..60]);
    // The morning of the day of the moment does not count.
    assert_eq!(before[60].means.as_ref().unwrap().epochs, 2);
}

#[test]
fn a_new_reference_clears_the_change() {
    let mut series = epochs(200);
    for epoch in series
        .iter_mut()
        .filter(|epoch| epoch.time_s >= 130.0 * 86_400.0)
    {
        epoch.quantities[0] = epoch.quantities[0].map(|value| 0.95_f64.sqrt() * value);
    }
    let mut state = Judge::new(settings(&["f1"], &["deck"], 100)).unwrap();
    state.start_anew(NewReference {
        time_s: 160.0 * 86_400.0,
        quantity: None,
    });
    let mut judgements = Vec::new();
    for epoch in &series {
        state.handle(epoch, &mut judgements).unwrap();
    }
    let on = |day: usize| &judgements[day];
    assert!(on(159).finding.is_some());
    assert_eq!(on(160).finding, None);
    assert_eq!(on(160).state, State::Learning { days_left: 99 });
}
