//! Series of two real structures: a bridge over a year with frost and then damage, and a tower.
//!
//! The series are in `shared/data` beside the repository and not part of it. A page in each folder
//! states their source. The settings are the defaults, except the length of the commissioning.

use crate::support::{Table, coverage, describe, first_alarm, judge, settings, table_or_skip};
use spandrel_judge::{Epoch, Finding, Judgement, Missing, Season, State};

const Z24: &str = "z24-monitoring/z24_year.csv";
const MODES: [&str; 4] = ["f1_hz", "f2_hz", "f3_hz", "f4_hz"];
/// Temperature of the pavement, whose frost stiffens the bridge.
const PAVEMENT: [&str; 1] = ["t_tp_degc"];
/// Recorded hour and day on which the damage began.
const DAMAGE_H: f64 = 4804.0;
const DAMAGE_DAY: i64 = 200;
const HOUR_S: f64 = 3600.0;
const DAY_S: f64 = 86_400.0;

fn z24(table: &Table, conditions: &[&str]) -> Vec<Epoch> {
    let times: Vec<f64> = table
        .numbers("record")
        .iter()
        .map(|hour| hour * HOUR_S)
        .collect();
    table.epochs(&times, &MODES, conditions)
}

fn day(epoch: &Epoch) -> i64 {
    (epoch.time_s / DAY_S).floor() as i64
}

/// Joins two spans of days. The second follows the first after `gap` days.
fn joined(epochs: &[Epoch], spans: [std::ops::Range<i64>; 2], gap: i64) -> Vec<Epoch> {
    let [first, second] = spans;
    let shifted = |span: &std::ops::Range<i64>, by: i64| -> Vec<Epoch> {
        let inside = epochs.iter().filter(|epoch| span.contains(&day(epoch)));
        let moved = inside.cloned().map(|mut epoch| {
            epoch.time_s += by as f64 * DAY_S;
            epoch
        });
        moved.collect()
    };
    let mut all = shifted(&first, -first.start);
    all.extend(shifted(
        &second,
        first.end - first.start + gap - second.start,
    ));
    all
}

#[test]
fn damage_of_the_bridge_is_found_within_days_and_nothing_before() {
    let Some(table) = table_or_skip(Z24) else {
        return;
    };
    let (state, judgements) = judge(settings(&MODES, &PAVEMENT, 130), &z24(&table, &PAVEMENT));
    describe(&state, &judgements);
    let alarm = first_alarm(&judgements).expect("an alarm");
    assert!(alarm.day >= DAMAGE_DAY, "false alarm: {}", alarm.sentence());
    // The decision of a day falls at its end.
    let delay = (alarm.day + 1) as f64 - DAMAGE_H / 24.0;
    println!("delay {delay:.1} days, {}", alarm.sentence());
    assert!(delay <= 7.0, "{delay}");
    for mode in MODES {
        let sound = judgements
            .iter()
            .filter(|j| j.quantity == mode && j.day < DAMAGE_DAY);
        let found = coverage(sound);
        println!("{mode}: coverage {found:.3}");
        assert!((0.9..=1.0).contains(&found), "{mode}: {found}");
    }
}

/// Regression test: mode 2 wanders by 2 %, and raised a wrong loss of up to 2 % before the damage.
/// It depended on the thermometer and on the hour at which a day begins.
#[test]
fn no_thermometer_in_the_bridge_and_no_beginning_of_the_day_raises_a_wrong_loss() {
    let Some(table) = table_or_skip(Z24) else {
        return;
    };
    let thermometers = [
        "t_tp_degc",
        "t_twn_degc",
        "t_tds_degc",
        "t_ts_degc",
        "t_twc_degc",
        "t_mean_degc",
    ];
    for (thermometer, hour, days) in thermometers
        .into_iter()
        .flat_map(|of| [(of, 0.0, 130), (of, 8.0, 110), (of, 12.0, 170)])
    {
        let mut epochs = z24(&table, &[thermometer]);
        epochs
            .iter_mut()
            .for_each(|epoch| epoch.time_s += hour * HOUR_S);
        let (_, judgements) = judge(settings(&MODES, &[thermometer], days), &epochs);
        let alarm = first_alarm(&judgements).expect("an alarm");
        let delay = (alarm.day + 1) as f64 - (DAMAGE_H + hour) / 24.0;
        println!("{thermometer} from {hour} h, {days} days: {delay:.1} days");
        assert!(
            (0.0..=8.0).contains(&delay),
            "{thermometer} from {hour} h, {days} days: {}",
            alarm.sentence()
        );
    }
}

#[test]
fn a_reference_learnt_while_damaged_finds_no_loss_and_a_gain() {
    let Some(table) = table_or_skip(Z24) else {
        return;
    };
    let epochs = joined(&z24(&table, &PAVEMENT), [201..236, 0..200], 30);
    let mut settings = settings(&MODES, &PAVEMENT, 35);
    settings.season = Season::Waived;
    let (state, judgements) = judge(settings, &epochs);
    describe(&state, &judgements);
    let alarm = first_alarm(&judgements);
    assert!(alarm.is_none(), "{:?}", alarm.map(Judgement::sentence));
    let stiffer = |judgement: &Judgement| matches!(judgement.finding, Some(Finding::Stiffer(_)));
    assert!(judgements.iter().any(stiffer));
}

#[test]
fn the_first_frost_is_outside_experience_and_raises_nothing() {
    let Some(table) = table_or_skip(Z24) else {
        return;
    };
    // Days 91 to 199 have no day of frost in the pavement; the winter before them follows a month
    // later.
    let epochs = joined(&z24(&table, &PAVEMENT), [91..200, 0..91], 30);
    let (state, judgements) = judge(settings(&MODES, &PAVEMENT, 109), &epochs);
    describe(&state, &judgements);
    let alarm = first_alarm(&judgements);
    assert!(alarm.is_none(), "{:?}", alarm.map(Judgement::sentence));
    let notice = judgements.iter().find(|judgement| judgement.raised);
    assert!(notice.is_none(), "{:?}", notice.map(Judgement::sentence));
    let frost: Vec<i64> = epochs
        .iter()
        .filter(|epoch| epoch.conditions[0].is_some_and(|celsius| celsius < -1.0))
        .map(day)
        .collect();
    let first = frost.iter().copied().min().unwrap();
    for judgement in judgements.iter().filter(|judgement| judgement.day == first) {
        assert!(
            matches!(judgement.state, State::OutsideExperience { .. }),
            "day {first}: {judgement:?}"
        );
    }
}

#[test]
fn without_a_temperature_the_bridge_raises_no_false_alarm() {
    let Some(table) = table_or_skip(Z24) else {
        return;
    };
    let (state, judgements) = judge(settings(&MODES, &[], 130), &z24(&table, &[]));
    describe(&state, &judgements);
    let false_alarm = first_alarm(&judgements).filter(|alarm| alarm.day < DAMAGE_DAY);
    assert!(
        false_alarm.is_none(),
        "{:?}",
        false_alarm.map(Judgement::sentence)
    );
}

#[test]
fn fourteen_days_of_the_tower_are_not_ready() {
    let Some(table) = table_or_skip("sciri-tower/tower_frequencies_temperatures.csv") else {
        return;
    };
    // A row every half hour. The times of the file are not needed to the second.
    let rows = table.0["time_utc"].len();
    let times: Vec<f64> = (0..rows).map(|row| row as f64 * 1800.0).collect();
    let modes = [
        "f1_hz", "f2_hz", "f3_hz", "f4_hz", "f5_hz", "f6_hz", "f7_hz",
    ];
    let conditions = ["t1_degc", "t2_degc"];
    let mut settings = settings(&modes, &conditions, 20);
    settings.loss = 0.02;
    let (_, judgements) = judge(settings, &table.epochs(&times, &modes, &conditions));
    assert!(first_alarm(&judgements).is_none());
    let last = judgements.last().unwrap();
    let State::NotReady { missing } = &last.state else {
        panic!("{last:?}");
    };
    assert!(matches!(missing, Missing::Season { .. }), "{missing}");
}
