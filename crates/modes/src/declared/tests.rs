use super::*;
use crate::testing::{RATE_HZ, frames, name, plan};
use nalgebra::{Complex, DVector};
use spandrel_modal::LadderEpoch;
use std::sync::LazyLock;

/// An epoch whose modes the tests replace.
static EPOCH: LazyLock<LadderEpoch> = LazyLock::new(|| {
    let plan = plan(&[]);
    let mut stream = plan.stream().unwrap();
    let mut epochs = frames(4_000)
        .into_iter()
        .filter_map(|frame| stream.push(&frame[1..]).unwrap());
    epochs.next().unwrap()
});

/// Returns a mode whose second channel moves by `second` of the first.
fn mode(frequency_hz: f64, second: f64) -> Mode {
    Mode {
        source: Source::Mode,
        frequency_hz,
        frequency_std_hz: 0.002 * frequency_hz,
        damping: 0.02,
        damping_std: 0.002,
        channels: vec![0, 1],
        shape: DVector::from_vec(vec![Complex::from(1.0), Complex::from(second)]),
        shape_std: vec![0.0, 0.01],
        collinearity: 1.0,
        band_hz: EPOCH.bands[0].band_hz,
        orders: 1.0,
        kurtosis: None,
    }
}

fn machine(frequency_hz: f64) -> Mode {
    Mode {
        source: Source::Machine,
        ..mode(frequency_hz, 0.5)
    }
}

fn declared(modes: &[(&str, f64)]) -> DeclaredModes {
    DeclaredModes::new(&name("tower"), &plan(modes)).unwrap()
}

/// Processes an epoch, and returns the events as `kind subject`.
fn pass(declared: &mut DeclaredModes, modes: &[Mode]) -> Vec<String> {
    let found = LadderModes {
        modes: modes.to_vec(),
        bands: Vec::new(),
    };
    let mut outputs = Vec::new();
    let over = EpochOver {
        time_ns: 1_000_000_000 * declared.epochs() as i64,
        epoch: &EPOCH,
        found: &found,
    };
    declared.handle(over, &mut outputs);
    let events = outputs.into_iter().filter_map(|output| match output {
        ModesOutput::Mode(_) | ModesOutput::Parameter(_) => None,
        ModesOutput::Event(event) => Some(format!("{:?} {}", event.kind, event.subject)),
    });
    events.collect()
}

fn states(declared: &DeclaredModes) -> Vec<ModeState> {
    declared
        .displays()
        .iter()
        .map(|display| display.state)
        .collect()
}

fn frequencies(declared: &DeclaredModes) -> Vec<Option<f64>> {
    let displays = declared.displays().iter();
    let frequency = |display: &ModeDisplay| Some(display.estimate.as_ref()?.frequency_hz);
    displays.map(frequency).collect()
}

#[test]
fn close_declared_modes_take_the_nearest_mode_each() {
    let mut two = declared(&[("first", 1.00), ("second", 1.03)]);
    let events = pass(&mut two, &[mode(1.025, -1.0)]);
    assert_eq!(events, ["ModeFound second"]);
    assert_eq!(frequencies(&two), [None, Some(1.025)]);
    assert_eq!(states(&two), [ModeState::Missing, ModeState::Tracked]);
    let events = pass(&mut two, &[mode(1.01, 1.0), mode(1.026, -1.0)]);
    assert_eq!(events, ["ModeFound first"]);
    assert_eq!(frequencies(&two), [Some(1.01), Some(1.026)]);
    assert_eq!(two.displays()[0].presence, 0.5);
}

/// A declared mode that does not exist must not take another one.
#[test]
fn a_declared_mode_far_from_all_modes_is_missing_and_then_lost() {
    let mut far = declared(&[("far", 5.0)]);
    let mut events = Vec::new();
    for _ in 1..LOST_AFTER {
        events.extend(pass(&mut far, &[mode(1.0, 1.0)]));
        assert_eq!(states(&far), [ModeState::Missing]);
    }
    events.extend(pass(&mut far, &[mode(1.0, 1.0)]));
    assert_eq!(states(&far), [ModeState::Lost]);
    assert_eq!(frequencies(&far), [None]);
    assert_eq!(events, ["ModeProposed 1.0000 Hz", "ModeLost far"]);
}

#[test]
fn a_mode_moves_away_from_its_declared_frequency() {
    let mut one = declared(&[("first", 1.0)]);
    for epoch in 0..40 {
        pass(&mut one, &[mode(1.0 - 0.004 * f64::from(epoch), 0.6)]);
        assert_eq!(states(&one), [ModeState::Tracked], "epoch {epoch}");
    }
    assert_eq!(frequencies(&one), [Some(0.844)]);
}

#[test]
fn a_lost_mode_is_found_again_and_nothing_is_stated_in_between() {
    let mut one = declared(&[("first", 1.0)]);
    for _ in 0..2 {
        pass(&mut one, &[mode(1.0, 0.6)]);
    }
    let mut events = Vec::new();
    for _ in 0..8 {
        events.extend(pass(&mut one, &[]));
    }
    assert_eq!(events, ["ModeLost first"]); // 2 of 7 epochs
    assert!(pass(&mut one, &[mode(1.001, 0.6)]).is_empty()); // 3 of 11
    assert_eq!(states(&one), [ModeState::Lost]);
    assert_eq!(frequencies(&one), [None]);
    let events = pass(&mut one, &[mode(1.001, 0.6)]); // 4 of 12
    assert_eq!(events, ["ModeFound first"]);
    assert_eq!(frequencies(&one), [Some(1.001)]);
}

/// Without this, a mode that had started with a wrong pole would stay lost for ever.
#[test]
fn a_lost_mode_starts_anew_with_a_mode_that_persists() {
    let mut one = declared(&[("first", 1.0)]);
    pass(&mut one, &[mode(1.03, -1.0)]);
    let mut events = Vec::new();
    for _ in 0..12 {
        events.extend(pass(&mut one, &[mode(0.98, 1.0)]));
    }
    assert_eq!(frequencies(&one), [Some(0.98)]);
    assert_eq!(states(&one), [ModeState::Tracked]);
    let expected = [
        "ModeProposed 0.9800 Hz",
        "ModeLost first",
        "ModeFound first",
    ];
    assert_eq!(events, expected);
}

#[test]
fn a_mode_that_is_not_declared_is_proposed_once_and_never_adopted() {
    let mut one = declared(&[("first", 1.0)]);
    let mut events = Vec::new();
    for _ in 0..4 {
        events.extend(pass(&mut one, &[mode(1.0, 1.0), mode(2.5, -1.0)]));
    }
    for _ in 0..4 {
        events.extend(pass(&mut one, &[mode(1.0, 1.0)])); // the candidate is forgotten
    }
    for _ in 0..4 {
        events.extend(pass(&mut one, &[mode(1.0, 1.0), mode(2.51, -1.0)]));
    }
    assert_eq!(events, ["ModeFound first", "ModeProposed 2.5000 Hz"]);
    assert_eq!(one.displays().len(), 1);
}

/// Most modes with such a damping ratio are spurious.
#[test]
fn a_mode_with_an_uncertain_damping_ratio_is_neither_started_nor_proposed() {
    let uncertain = |frequency_hz| Mode {
        damping_std: 0.03,
        ..mode(frequency_hz, 1.0)
    };
    let mut one = declared(&[("first", 1.0)]);
    for _ in 0..4 {
        assert!(pass(&mut one, &[uncertain(1.0), uncertain(2.5)]).is_empty());
    }
    assert_eq!(states(&one), [ModeState::Missing]);
    // A tracked mode may be uncertain in one epoch.
    pass(&mut one, &[mode(1.0, 1.0)]);
    pass(&mut one, &[uncertain(1.0)]);
    assert_eq!(states(&one), [ModeState::Tracked]);
}

#[test]
fn a_machine_is_no_mode_and_marks_the_mode_at_its_frequency() {
    let mut two = declared(&[("first", 1.0), ("second", 2.5)]);
    pass(&mut two, &[machine(1.02), mode(2.5, -1.0)]);
    let machines = |declared: &DeclaredModes| -> Vec<bool> {
        declared
            .displays()
            .iter()
            .map(|display| display.machine)
            .collect()
    };
    assert_eq!(states(&two), [ModeState::Missing, ModeState::Tracked]);
    assert_eq!(machines(&two), [true, false]);
    pass(&mut two, &[mode(1.0, 1.0), mode(2.5, -1.0), machine(2.505)]);
    assert_eq!(machines(&two), [false, true]);
    pass(&mut two, &[mode(1.0, 1.0), mode(2.5, -1.0), machine(2.6)]);
    assert_eq!(machines(&two), [false, false], "4 % away");
}

#[test]
fn modes_that_cannot_be_told_apart_are_paired_with_each_other() {
    let mut two = declared(&[("first", 1.0), ("second", 1.1)]);
    let events = pass(&mut two, &[mode(1.0, 0.9), mode(1.1, 1.0)]);
    assert_eq!(events, ["ModeFound first", "ModeFound second"]);
    let mut events = Vec::new();
    for step in 1..=10 {
        let nearer = 0.005 * f64::from(step);
        events.extend(pass(
            &mut two,
            &[mode(1.0 + nearer, 0.9), mode(1.1 - nearer, 1.0)],
        ));
    }
    assert_eq!(events, ["ModePaired first"]);
    assert_eq!(states(&two), [ModeState::Paired; 2]);
    let partners: Vec<&str> = two
        .displays()
        .iter()
        .map(|display| display.partner.as_ref().unwrap().as_str())
        .collect();
    assert_eq!(partners, ["second", "first"]);
}

#[test]
fn impossible_numbers_are_not_published() {
    let mut one = declared(&[("first", 1.0)]);
    let infinite = Mode {
        shape_std: vec![0.0, f64::INFINITY],
        ..mode(1.0, 1.0)
    };
    pass(&mut one, &[infinite]);
    assert_eq!(states(&one), [ModeState::Missing]);
}

#[test]
fn the_amplitude_is_that_of_the_largest_channel_in_its_unit() {
    let mut one = declared(&[("first", 1.0)]);
    pass(&mut one, &[mode(1.0, 0.5)]);
    let all = frames(4_000);
    let values: Vec<f64> = all.iter().map(|frame| frame[1]).collect();
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let square: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    let std = (square / values.len() as f64).sqrt();
    let amplitude = one.displays()[0].estimate.as_ref().unwrap().amplitude;
    assert!(
        (amplitude / std - 1.0).abs() < 0.1,
        "{amplitude} {std} at {RATE_HZ} Hz"
    );
}
