//! Losses that are injected into the sound days of a real bridge: how fast each size is found.

use crate::support::{first_alarm, settings, table_or_skip};
use spandrel_judge::{Epoch, Judge, Judgement};

const MODES: [&str; 4] = ["f1_hz", "f2_hz", "f3_hz", "f4_hz"];
const PAVEMENT: [&str; 1] = ["t_tp_degc"];
const DAY_S: f64 = 86_400.0;
/// Last day before the damage of the series itself.
const SOUND_DAYS: f64 = 200.0;
/// First date of a loss, after the commissioning of 130 days.
const FIRST_DATE: i64 = 135;
/// Last date of a loss.
const LAST_DATE: i64 = 173;

/// Returns the days to the first alarm of `mode`, which loses a share of its frequency on a date.
fn delay(judge: &Judge, rest: &[Epoch], mode: usize, share: f64, date: i64) -> Option<i64> {
    let mut judge = judge.clone();
    let mut judgements: Vec<Judgement> = Vec::new();
    for epoch in rest {
        let mut epoch = epoch.clone();
        if epoch.time_s >= date as f64 * DAY_S {
            epoch.quantities[mode] = epoch.quantities[mode].map(|value| value * (1.0 - share));
        }
        judge.handle(&epoch, &mut judgements).unwrap();
    }
    let alarm = first_alarm(&judgements)?;
    assert_eq!(alarm.quantity, MODES[mode], "{}", alarm.sentence());
    assert!(alarm.day >= date, "false alarm: {}", alarm.sentence());
    Some(alarm.day - date + 1)
}

/// Losses of frequency, and their dates: the first one, and the number of days between two.
struct Injection<'a> {
    shares: &'a [f64],
    first_date: i64,
    between_dates: usize,
}

/// The bridge is warmer than ever before on days 149 to 153 and 163 to 169. A loss on such a day is
/// not mistaken for the effect of the warmth.
#[test]
fn a_loss_of_five_percent_of_frequency_of_the_bridge_is_found() {
    inject(&Injection {
        shares: &[0.05],
        first_date: 137,
        between_dates: 15,
    });
}

#[test]
#[ignore = "320 series take minutes; the figures of docs/theory/judgement.md"]
fn losses_of_frequency_of_the_bridge_are_found_by_size() {
    inject(&Injection {
        shares: &[0.01, 0.02, 0.03, 0.05],
        first_date: FIRST_DATE,
        between_dates: 2,
    });
}

fn inject(injection: &Injection<'_>) {
    let Some(table) = table_or_skip("z24-monitoring/z24_year.csv") else {
        return;
    };
    let times: Vec<f64> = table
        .numbers("record")
        .iter()
        .map(|hour| hour * 3600.0)
        .collect();
    let epochs = table.epochs(&times, &MODES, &PAVEMENT);
    let sound = epochs.partition_point(|epoch| epoch.time_s < SOUND_DAYS * DAY_S);
    let start = epochs.partition_point(|epoch| epoch.time_s < 134.0 * DAY_S);
    let mut judge = Judge::new(settings(&MODES, &PAVEMENT, 130)).unwrap();
    let mut judgements = Vec::new();
    for epoch in &epochs[..start] {
        judge.handle(epoch, &mut judgements).unwrap();
    }
    for (mode, name) in MODES.iter().enumerate() {
        for &share in injection.shares {
            let dates = (injection.first_date..=LAST_DATE).step_by(injection.between_dates);
            let mut delays: Vec<Option<i64>> = dates
                .map(|date| delay(&judge, &epochs[start..sound], mode, share, date))
                .collect();
            let found = delays.iter().flatten().count();
            let missed: Vec<i64> = (injection.first_date..=LAST_DATE)
                .step_by(injection.between_dates)
                .zip(&delays)
                .filter_map(|(date, delay)| delay.is_none().then_some(date))
                .collect();
            delays.sort_by_key(|delay| delay.unwrap_or(i64::MAX));
            let median = delays[delays.len() / 2];
            println!(
                "{name}, loss of {:.0} %: found {found} of {}, median {median:?} days; missed: \
                 {missed:?}",
                100.0 * share,
                delays.len()
            );
            // The reference of mode 2 is ready after the first date.
            let enough = 10 * found >= 9 * delays.len();
            assert!(share < 0.05 || enough, "{name}, {share}: {found}");
        }
    }
}
