use super::*;
use crate::testing::{EPOCH_S, S, deck, estimate, frequency, monitoring, name, sources};
use spandrel_bus::ParameterMonitoring;

const EPOCH: i64 = EPOCH_S as i64;

fn sighted() -> Epochs {
    let mut epochs = Epochs::new(sources(), None);
    let watching = monitoring(MonitoringState::Watching, &[]);
    handle(&mut epochs, EpochInput::Monitoring(watching));
    handle(&mut epochs, EpochInput::Measured(Some(true)));
    epochs
}

fn handle(epochs: &mut Epochs, input: EpochInput) -> Vec<ClosedEpoch> {
    let mut closed = Vec::new();
    epochs.handle(input, &mut closed);
    closed
}

fn take(epochs: &mut Epochs, second: i64, mean: f64) -> Vec<ClosedEpoch> {
    handle(epochs, EpochInput::Parameter(estimate(second, mean)))
}

fn refused(epochs: &Epochs, reason: &str) -> u64 {
    epochs.refused().get(reason).copied().unwrap_or(0)
}

/// Closes the first epoch and returns it.
fn first(epochs: &mut Epochs) -> ClosedEpoch {
    take(epochs, 2 * EPOCH, 1.0).remove(0)
}

#[test]
fn an_epoch_is_the_geometric_mean_and_closes_when_the_second_next_begins() {
    let mut epochs = sighted();
    assert_eq!(take(&mut epochs, 10, 0.5), []);
    assert_eq!(take(&mut epochs, EPOCH - 1, 2.0), []);
    assert_eq!(take(&mut epochs, 2 * EPOCH - 1, 3.0), []);
    let closed = first(&mut epochs);
    assert_eq!(closed.middle_ns, EPOCH / 2 * S);
    let value = closed.epoch.quantities[0].unwrap();
    assert!((value - 1.0).abs() < 1e-15, "{value}"); // √(0.5 · 2)
    assert_eq!(closed.epoch.quantities[1], None);
    // ln(value) is ± ln 2, and the mean of (std / mean)² is (0.02² + 0.005²) / 2.
    let expected = (2_f64.ln().powi(2) + (4e-4 + 2.5e-5) / 2.0).sqrt();
    let deviation = closed.deviations[0].unwrap();
    assert!((deviation - expected).abs() < 1e-12, "{deviation}");
}

/// An epoch of the future would exclude the epochs of the present until then, also after a restart.
#[test]
fn values_of_the_future_exclude_no_values_of_the_present() {
    let mut epochs = sighted();
    handle(&mut epochs, EpochInput::Clock(10 * S));
    for ahead in [71, 3 * EPOCH, 1_000 * EPOCH] {
        assert_eq!(take(&mut epochs, ahead, 1.0), []);
        handle(&mut epochs, EpochInput::Condition(deck(ahead, 20.0)));
    }
    for reason in ["ahead-of-clock-estimates", "ahead-of-clock-conditions"] {
        assert_eq!(refused(&epochs, reason), 3, "{reason}");
    }
    take(&mut epochs, 10, 2.0);
    handle(&mut epochs, EpochInput::Condition(deck(11, 15.0)));
    handle(&mut epochs, EpochInput::Clock(2 * EPOCH * S));
    let closed = first(&mut epochs);
    assert_eq!(closed.epoch.quantities[0], Some(2.0));
    assert_eq!(closed.epoch.conditions[0], Some(15.0));
}

/// The epochs of the future would otherwise exclude those of the present.
#[test]
fn a_clock_that_is_set_back_leaves_no_epoch_and_no_condition_of_the_future() {
    let mut epochs = sighted();
    handle(&mut epochs, EpochInput::Clock(1000 * EPOCH * S));
    take(&mut epochs, 10, 1.0);
    handle(&mut epochs, EpochInput::Condition(deck(11, 10.0)));
    assert_eq!(take(&mut epochs, 999 * EPOCH, 9.0), []);
    assert_eq!(take(&mut epochs, 1000 * EPOCH, 9.0), []);
    handle(&mut epochs, EpochInput::Condition(deck(999 * EPOCH, 40.0)));
    handle(&mut epochs, EpochInput::Clock(20 * S));
    assert_eq!(refused(&epochs, "ahead-of-clock-epochs"), 2);
    take(&mut epochs, 20, 4.0);
    handle(&mut epochs, EpochInput::Condition(deck(21, 20.0)));
    handle(&mut epochs, EpochInput::Clock(2 * EPOCH * S));
    let closed = first(&mut epochs);
    let value = closed.epoch.quantities[0].unwrap();
    assert!((value - 2.0).abs() < 1e-15, "{value}"); // √(1 · 4)
    assert_eq!(closed.epoch.conditions[0], Some(15.0));
    assert_eq!(refused(&epochs, "late-estimates"), 0);
    assert_eq!(refused(&epochs, "repeated-conditions"), 0);
}

#[test]
fn a_jump_ahead_without_confirmation_closes_nothing_and_is_dropped() {
    let mut epochs = sighted();
    take(&mut epochs, 10, 1.0);
    assert_eq!(take(&mut epochs, 500 * EPOCH, 9.0), []);
    assert_eq!(take(&mut epochs, 501 * EPOCH, 9.0), []);
    take(&mut epochs, 20, 4.0);
    assert_eq!(refused(&epochs, "unconfirmed-epochs"), 2);
    let value = first(&mut epochs).epoch.quantities[0].unwrap();
    assert!((value - 2.0).abs() < 1e-15, "{value}"); // √(1 · 4)
}

#[test]
fn a_jump_ahead_is_confirmed_by_the_second_next_epoch() {
    let mut epochs = sighted();
    take(&mut epochs, 10, 1.0);
    assert_eq!(take(&mut epochs, 500 * EPOCH, 2.0), []);
    assert_eq!(take(&mut epochs, 501 * EPOCH, 4.0), []);
    let closed = take(&mut epochs, 502 * EPOCH, 1.0);
    let found: Vec<_> = closed
        .iter()
        .map(|closed| (closed.middle_ns / S / EPOCH, closed.epoch.quantities[0]))
        .collect();
    assert_eq!(found, [(0, Some(1.0)), (500, Some(2.0))]);
    // The present is after the jump now.
    let closed = take(&mut epochs, 503 * EPOCH, 1.0);
    assert_eq!(closed[0].epoch.quantities[0], Some(4.0));
    assert_eq!(refused(&epochs, "unconfirmed-epochs"), 0);
}

#[test]
fn replayed_samples_and_the_next_day_are_no_jump() {
    let day = 86_400;
    for (is_measured, second) in [(Some(false), 500 * EPOCH), (Some(true), day)] {
        let mut epochs = sighted();
        handle(&mut epochs, EpochInput::Measured(is_measured));
        take(&mut epochs, 10, 1.0);
        assert_eq!(take(&mut epochs, second, 9.0).len(), 1, "{second}");
    }
}

#[test]
fn values_and_epochs_ahead_of_the_clock_are_reported() {
    let mut epochs = Epochs::new(sources(), Some(1000 * EPOCH * S + 1));
    handle(&mut epochs, EpochInput::Measured(Some(true)));
    handle(&mut epochs, EpochInput::Clock(10 * S));
    assert_eq!(epochs.take_ahead(), []);
    take(&mut epochs, 71, 1.0);
    handle(&mut epochs, EpochInput::Condition(deck(72, 20.0)));
    take(&mut epochs, 10, 1.0);
    assert_eq!(refused(&epochs, "late-estimates"), 1);
    let values = |source, second| Ahead::Values {
        of: name(source),
        time_ns: second * S,
    };
    let end_ns = 1001 * EPOCH * S;
    assert_eq!(
        epochs.take_ahead(),
        [
            values("pier", 71),
            values("deck", 72),
            Ahead::Epoch { end_ns }
        ]
    );
    // Late values after an epoch of the past are no mistake of a clock.
    handle(&mut epochs, EpochInput::Now(Duration::from_secs(7200)));
    handle(&mut epochs, EpochInput::Clock(1002 * EPOCH * S));
    take(&mut epochs, 10, 1.0);
    assert_eq!(refused(&epochs, "late-estimates"), 2);
    assert_eq!(epochs.take_ahead(), []);
}

#[test]
fn monitoring_that_is_blind_or_unknown_gives_an_epoch_without_a_value() {
    let mut unknown = Epochs::new(sources(), None);
    handle(&mut unknown, EpochInput::Measured(Some(true)));
    take(&mut unknown, 10, 1.0);
    let mut blind = sighted();
    let display = monitoring(MonitoringState::Blind, &["no samples"]);
    handle(&mut blind, EpochInput::Monitoring(display));
    take(&mut blind, 10, 1.0);
    let mut silent = sighted();
    handle(&mut silent, EpochInput::Now(Duration::from_secs(6)));
    take(&mut silent, 10, 1.0);
    let mut blind_here = sighted();
    let mut display = monitoring(MonitoringState::Degraded, &[]);
    display.parameters.push(ParameterMonitoring {
        parameter: name("pier"),
        state: MonitoringState::Blind,
        why: Some("the present data contain no information".to_owned()),
        sustained_std: None,
    });
    handle(&mut blind_here, EpochInput::Monitoring(display));
    take(&mut blind_here, 10, 1.0);
    for mut epochs in [unknown, blind, silent, blind_here] {
        assert_eq!(refused(&epochs, "blind-estimates"), 1);
        assert_eq!(first(&mut epochs).epoch.quantities, [None, None]);
    }
}

/// Strong shaking softens a structure for minutes, which is no lasting change.
#[test]
fn epochs_from_an_earthquake_until_the_structure_has_settled_have_no_value() {
    let mut epochs = sighted();
    // The epochs end at 900, 1800, … s. The earthquake at 1000 s is over at 1900 s.
    for number in 0..4 {
        take(&mut epochs, number * EPOCH + 10, 1.0);
        if number == 1 {
            handle(&mut epochs, EpochInput::Earthquake(1000 * S));
        }
    }
    let mut closed = Vec::new();
    epochs.close_before(5, &mut closed);
    let values: Vec<_> = closed.iter().map(|of| of.epoch.quantities[0]).collect();
    // The first epoch was closed by the third estimate, and the second by the fourth.
    assert_eq!(values, [None, Some(1.0)]);
    assert_eq!(refused(&epochs, "shaken-epochs"), 2);
}

#[test]
fn learning_the_reference_of_a_rule_is_not_blindness() {
    let mut epochs = sighted();
    let display = monitoring(MonitoringState::Blind, &[REFERENCE_IS_LEARNT]);
    handle(&mut epochs, EpochInput::Monitoring(display));
    take(&mut epochs, 10, 1.0);
    assert!(first(&mut epochs).is_measured);
}

#[test]
fn one_replayed_estimate_marks_its_epoch_and_an_unknown_origin_gives_no_value() {
    let mut epochs = sighted();
    take(&mut epochs, 10, 1.0);
    handle(&mut epochs, EpochInput::Measured(Some(false)));
    take(&mut epochs, 20, 1.0);
    handle(&mut epochs, EpochInput::Measured(None));
    take(&mut epochs, EPOCH, 1.0);
    assert_eq!(refused(&epochs, "estimates-of-unknown-origin"), 1);
    handle(&mut epochs, EpochInput::Measured(Some(true)));
    let closed = take(&mut epochs, 5 * EPOCH, 1.0);
    assert_eq!(closed.len(), 2);
    assert!(!closed[0].is_measured);
    assert_eq!(closed[1].epoch.quantities, [None, None]);
}

#[test]
fn a_condition_is_the_mean_of_the_epoch_or_holds_for_two_intervals() {
    let mut epochs = sighted();
    for (second, value) in [(-2000, 1.0), (100, 10.0), (700, 12.0), (800, 14.0)] {
        handle(&mut epochs, EpochInput::Condition(deck(second, value)));
    }
    for second in [10, EPOCH, 2 * EPOCH, 3 * EPOCH] {
        take(&mut epochs, second, 1.0);
    }
    let closed = take(&mut epochs, 9 * EPOCH, 1.0);
    let told: Vec<_> = closed
        .iter()
        .map(|closed| closed.epoch.conditions[0])
        .collect();
    // The first two epochs are closed already. The value of second 800 holds until second 2000.
    assert_eq!(told, [Some(14.0), None]);
    let mut epochs = sighted();
    handle(&mut epochs, EpochInput::Condition(deck(100, 10.0)));
    handle(&mut epochs, EpochInput::Condition(deck(700, 12.0)));
    take(&mut epochs, 10, 1.0);
    assert_eq!(first(&mut epochs).epoch.conditions, [Some(11.0)]);
}

#[test]
fn a_condition_in_another_unit_is_converted_or_refused() {
    let mut epochs = sighted();
    let mut kelvin = deck(100, 283.15);
    kelvin.unit = "K".to_owned();
    handle(&mut epochs, EpochInput::Condition(kelvin));
    let mut wind = deck(200, 3.0);
    wind.unit = "m/s".to_owned();
    handle(&mut epochs, EpochInput::Condition(wind));
    handle(&mut epochs, EpochInput::Condition(deck(300, 95.0)));
    handle(&mut epochs, EpochInput::Condition(deck(100, 5.0)));
    take(&mut epochs, 10, 1.0);
    let value = first(&mut epochs).epoch.conditions[0].unwrap();
    assert!((value - 10.0).abs() < 1e-12, "{value}");
    for reason in [
        "wrong-unit-conditions",
        "out-of-range-conditions",
        "repeated-conditions",
    ] {
        assert_eq!(refused(&epochs, reason), 1, "{reason}");
    }
}

#[test]
fn estimates_of_epochs_that_are_closed_are_refused_also_after_a_restart() {
    let mut epochs = Epochs::new(sources(), Some(EPOCH / 2 * S));
    handle(&mut epochs, EpochInput::Measured(Some(true)));
    take(&mut epochs, EPOCH - 1, 1.0);
    assert_eq!(refused(&epochs, "late-estimates"), 1);
}

#[test]
fn conditions_without_estimates_take_no_memory_and_are_counted() {
    let mut epochs = sighted();
    for number in 0..1000 {
        handle(
            &mut epochs,
            EpochInput::Condition(deck(number * EPOCH, 10.0)),
        );
    }
    assert_eq!(epochs.conditions[0].by_epoch.len(), CONDITIONS_KEPT);
    let lost = 1000 - CONDITIONS_KEPT as u64;
    assert_eq!(refused(&epochs, "conditions-not-kept"), lost);
}

/// Returns epochs of a declared mode, which know that the samples are measured and nothing else.
fn of_mode() -> Epochs {
    let mut sources = sources();
    sources.quantities = vec![Some(QuantitySource::Mode(name("bending")))];
    let mut epochs = Epochs::new(sources, None);
    handle(&mut epochs, EpochInput::Measured(Some(true)));
    epochs
}

fn take_mode(epochs: &mut Epochs, display: &ModeDisplay) -> Vec<ClosedEpoch> {
    handle(epochs, EpochInput::Mode(Box::new(display.clone())))
}

#[test]
fn a_repeated_frequency_counts_once_in_the_epoch_in_which_its_own_epoch_ends() {
    let mut epochs = of_mode();
    for display in [frequency(300, 2.0), frequency(EPOCH - 1, 8.0)] {
        for _ in 0..5 {
            assert_eq!(take_mode(&mut epochs, &display), []);
        }
    }
    assert_eq!(take_mode(&mut epochs, &frequency(EPOCH, 3.0)), []);
    let closed = take_mode(&mut epochs, &frequency(2 * EPOCH, 3.0)).remove(0);
    assert_eq!(closed.middle_ns, EPOCH / 2 * S);
    let value = closed.epoch.quantities[0].unwrap();
    assert!((value - 4.0).abs() < 1e-14, "{value}"); // √(2 · 8)
    // ln(value) is ± ln 2, and std / mean is 0.001 in both.
    let expected = (2_f64.ln().powi(2) + 1e-6).sqrt();
    let deviation = closed.deviations[0].unwrap();
    assert!((deviation - expected).abs() < 1e-12, "{deviation}");
    assert!(closed.is_measured);
    assert_eq!(epochs.refused().len(), 0);
    take_mode(&mut epochs, &frequency(EPOCH / 2, 3.0));
    assert_eq!(refused(&epochs, "late-modes"), 1);
}

/// Blindness concerns the estimates of a model, on which a frequency does not depend.
#[test]
fn a_frequency_needs_no_monitoring_but_a_known_origin() {
    let mut epochs = of_mode();
    let blind = monitoring(MonitoringState::Blind, &["the filter restarts"]);
    handle(&mut epochs, EpochInput::Monitoring(blind));
    take_mode(&mut epochs, &frequency(10, 2.0));
    handle(&mut epochs, EpochInput::Measured(None));
    take_mode(&mut epochs, &frequency(20, 200.0));
    let closed = take_mode(&mut epochs, &frequency(2 * EPOCH, 3.0)).remove(0);
    assert_eq!(closed.epoch.quantities[0], Some(2.0));
    assert_eq!(refused(&epochs, "modes-of-unknown-origin"), 2);
}

#[test]
fn a_frequency_that_is_missing_paired_or_that_of_a_machine_does_not_count() {
    let mut epochs = of_mode();
    take_mode(&mut epochs, &frequency(10, 2.0));
    let missing = ModeDisplay {
        state: ModeState::Missing,
        estimate: None,
        ..frequency(20, 9.0)
    };
    let paired = ModeDisplay {
        state: ModeState::Paired,
        ..frequency(30, 9.0)
    };
    let machine = ModeDisplay {
        machine: true,
        ..frequency(40, 9.0)
    };
    let of_other = ModeDisplay {
        mode: name("torsion"),
        ..frequency(50, 9.0)
    };
    for display in [missing, paired, machine, of_other] {
        take_mode(&mut epochs, &display);
    }
    handle(&mut epochs, EpochInput::Clock(100 * S));
    take_mode(&mut epochs, &frequency(4 * EPOCH, 9.0));
    assert_eq!(refused(&epochs, "ahead-of-clock-modes"), 1);
    handle(&mut epochs, EpochInput::Clock(4 * EPOCH * S));
    let closed = take_mode(&mut epochs, &frequency(2 * EPOCH, 3.0)).remove(0);
    assert_eq!(closed.epoch.quantities[0], Some(2.0));
    assert_eq!(refused(&epochs, "paired-modes"), 1);
    assert_eq!(refused(&epochs, "machine-modes"), 1);
}

/// Regression: months without the mode left the last judgement in force.
#[test]
fn a_mode_that_is_missing_gives_epochs_without_a_value() {
    let mut epochs = of_mode();
    let missing = |second| ModeDisplay {
        state: ModeState::Missing,
        estimate: None,
        ..frequency(second, 9.0)
    };
    assert_eq!(take_mode(&mut epochs, &missing(10)), []);
    let closed = take_mode(&mut epochs, &missing(2 * EPOCH)).remove(0);
    assert_eq!(closed.epoch.quantities, [None]);
    assert!(closed.is_measured);
}
