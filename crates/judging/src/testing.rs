//! Messages and settings for tests.

use crate::epochs::{ClosedEpoch, ConditionSource, QuantitySource, Sources};
use spandrel_bus::{
    ConditionDisplay, ModeDisplay, ModeEstimate, ModeState, MonitoringDisplay, MonitoringState,
    Name, ParameterDisplay,
};
use spandrel_judge::{Condition, ConditionKind, Epoch, Quantity, QuantityKind, Season, Settings};
use spandrel_structure::JudgePlan;

pub(crate) const S: i64 = 1_000_000_000;
/// Length of the epochs (s).
pub(crate) const EPOCH_S: u32 = 900;

pub(crate) fn name(text: &str) -> Name {
    Name::new(text).unwrap()
}

/// Returns one parameter, one quantity without live values, and one temperature of the deck.
pub(crate) fn sources() -> Sources {
    Sources {
        is_updated: false,
        length_ns: i64::from(EPOCH_S) * S,
        quantities: vec![Some(QuantitySource::Parameter(name("pier"))), None],
        conditions: vec![ConditionSource {
            name: name("deck"),
            kind: ConditionKind::Celsius,
            declared: None,
        }],
    }
}

pub(crate) fn plan() -> JudgePlan {
    let quantity = |name: &str| Quantity {
        name: name.to_owned(),
        kind: QuantityKind::Stiffness,
        thermometers: Vec::new(),
    };
    JudgePlan {
        settings: Settings {
            false_alarms_per_year: 0.1,
            loss: 0.02,
            commissioning_days: 30,
            season: Season::Waived,
            quantities: vec![quantity("pier"), quantity("girder")],
            conditions: vec![Condition {
                name: "deck".to_owned(),
                kind: ConditionKind::Celsius,
            }],
        },
        epoch_s: EPOCH_S,
        time_column: "time".to_owned(),
        quantity_columns: vec!["pier".to_owned(), "girder, \"old\"".to_owned()],
        condition_columns: vec!["deck".to_owned()],
    }
}

pub(crate) fn estimate(second: i64, mean: f64) -> ParameterDisplay {
    ParameterDisplay::of_normal(&name("bridge"), &name("pier"), second * S, mean, 1e-4)
}

pub(crate) fn deck(second: i64, value: f64) -> ConditionDisplay {
    ConditionDisplay {
        structure: name("bridge"),
        name: name("deck"),
        time_ns: second * S,
        value,
        unit: "degC".to_owned(),
        interval_s: Some(600.0),
        instrument: None,
    }
}

pub(crate) fn monitoring(state: MonitoringState, reasons: &[&str]) -> MonitoringDisplay {
    MonitoringDisplay {
        structure: name("bridge"),
        time_ns: 0,
        measured_ns: None,
        state,
        since_ns: 0,
        reasons: reasons.iter().map(|reason| (*reason).to_owned()).collect(),
        parameters: Vec::new(),
        channels: Vec::new(),
    }
}

/// Returns the epoch of this number, with values that need all digits.
pub(crate) fn closed(number: i64) -> ClosedEpoch {
    let middle_ns = (number * i64::from(EPOCH_S) + i64::from(EPOCH_S) / 2) * S;
    let odd = number as f64;
    ClosedEpoch {
        middle_ns,
        epoch: Epoch {
            time_s: ClosedEpoch::time_s(middle_ns),
            quantities: vec![Some(1.0 + odd.sin() / 300.0), None],
            conditions: vec![(number % 7 != 0).then(|| 10.0 * (odd / 9.0).cos())],
        },
        deviations: vec![Some(0.01 / (odd + 3.0)), None],
        is_measured: true,
    }
}

/// Returns an epoch of a day (three of them), with a share of the stiffness.
pub(crate) fn of_day(day: i64, third: i64, stiffness: f64) -> ClosedEpoch {
    let middle_ns = (day * 86_400 + third * 28_800 + 14_400) * S;
    // Irregular and reproducible, without a trend.
    let scatter = 0.004 * ((day * 3 + third) as f64 * 2.399).sin();
    let deck = 10.0 + 8.0 * (day as f64 * 0.9).sin();
    ClosedEpoch {
        middle_ns,
        epoch: Epoch {
            time_s: ClosedEpoch::time_s(middle_ns),
            quantities: vec![Some(stiffness * (1.0 - 0.001 * deck + scatter)), None],
            conditions: vec![Some(deck)],
        },
        ..closed(0)
    }
}

/// Returns the mode `bending` after an epoch that ends at `second`.
pub(crate) fn frequency(second: i64, frequency_hz: f64) -> ModeDisplay {
    ModeDisplay {
        structure: name("bridge"),
        mode: name("bending"),
        time_ns: second * S,
        epoch_s: 300.0,
        epochs: 1,
        state: ModeState::Tracked,
        partner: None,
        estimate: Some(ModeEstimate {
            frequency_hz,
            frequency_std_hz: 0.001 * frequency_hz,
            damping: 0.02,
            damping_std: 0.002,
            shape: Vec::new(),
            amplitude: 0.1,
        }),
        presence: 1.0,
        machine: false,
        declared_hz: 2.0,
    }
}
