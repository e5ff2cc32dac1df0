use super::*;
use crate::testing::{CHANNELS, EPOCH_S, RATE_HZ, block, frames, frames_of, name, plan, t0_ns};
use spandrel_bus::{ModeDisplay, ModeState};

/// Number of frames that contain two epochs.
const TWO_EPOCHS: usize = 6_700;

fn following() -> Following {
    let plan = plan(&[("first", 1.0), ("second", 2.5)]);
    Following::new(&name("tower"), &plan, None).unwrap()
}

fn deliver(core: &mut Following, delivery: &Delivery<FrameBlock>) -> Vec<ModesOutput> {
    let mut outputs = Vec::new();
    core.handle(delivery, &mut outputs);
    outputs
}

/// Delivers frames of a run in blocks.
fn run(
    core: &mut Following,
    epoch: u64,
    all: &[[f64; CHANNELS]],
    from: usize,
    of: usize,
) -> Vec<ModesOutput> {
    let mut outputs = Vec::new();
    for (number, frames) in all[from..].chunks(of).enumerate() {
        let block = block(epoch, from + number * of, frames);
        outputs.extend(deliver(core, &Delivery::Block(block)));
    }
    outputs
}

fn displays(outputs: &[ModesOutput]) -> Vec<&ModeDisplay> {
    let mut displays = Vec::new();
    for output in outputs {
        if let ModesOutput::Mode(display) = output {
            displays.push(display.as_ref());
        }
    }
    displays
}

#[test]
fn each_epoch_gives_one_message_per_declared_mode_with_its_time() {
    let mut core = following();
    let outputs = run(&mut core, 1, &frames(TWO_EPOCHS), 0, 128);
    let displays = displays(&outputs);
    assert_eq!(displays.len(), 4);
    for (display, (mode, hz)) in displays.iter().zip([("first", 1.0), ("second", 2.5)]) {
        assert_eq!(
            (display.mode.as_str(), display.state),
            (mode, ModeState::Tracked)
        );
        let estimate = display.estimate.as_ref().unwrap();
        assert!((estimate.frequency_hz - hz).abs() < 0.03, "{display:?}");
        let channels: Vec<&str> = estimate
            .shape
            .iter()
            .map(|at| at.channel.as_str())
            .collect();
        assert_eq!(
            channels,
            ["floor-1", "floor-2"],
            "the first channel is not used"
        );
        assert!(estimate.amplitude > 0.0);
    }
    let [first, second] = [displays[0], displays[2]].map(|display| display.time_ns - t0_ns(1));
    assert_eq!((second - first) as f64, EPOCH_S * 1e9);
    assert_eq!(displays[2].epochs, 2);
    let reached = core.position().unwrap();
    assert_eq!((reached.epoch, reached.sequence), (1, TWO_EPOCHS as u64));
    let last_ns = t0_ns(1) + ((TWO_EPOCHS - 1) as f64 / RATE_HZ * 1e9) as i64;
    assert_eq!(core.last_time_ns(), Some(last_ns));
}

#[test]
fn blocks_and_a_restart_change_no_bit() {
    let all = frames(TWO_EPOCHS);
    let whole = run(&mut following(), 1, &all, 0, 128);
    assert!(!whole.is_empty());
    for stop in [10, 3_000, 3_400, 5_001] {
        let mut before = following();
        let mut outputs = run(&mut before, 1, &all[..stop], 0, 37);
        let saved = postcard::to_stdvec(&before.state()).unwrap();
        let mut after = following();
        after
            .restore(postcard::from_bytes(&saved).unwrap())
            .unwrap();
        let Start::At { sequence, .. } = after.start() else {
            panic!("the state has a position");
        };
        assert_eq!(after.declared().displays(), before.declared().displays());
        outputs.extend(run(&mut after, 1, &all, sequence as usize, 500));
        assert_eq!(outputs, whole, "stopped at frame {stop}");
    }
}

#[test]
fn a_state_of_other_modes_or_bands_is_refused() {
    let state = following().state();
    let mut other = Following::new(&name("tower"), &plan(&[("first", 1.0)]), None).unwrap();
    assert!(other.restore(state.clone()).is_err());
    let mut plan = plan(&[("first", 1.0), ("second", 2.5)]);
    plan.settings.epoch_s *= 2.0;
    let mut other = Following::new(&name("tower"), &plan, None).unwrap();
    assert!(other.restore(state).is_err());
}

/// An epoch over a hole would contain steps and false lags.
#[test]
fn no_epoch_contains_both_sides_of_a_hole() {
    let all = frames(2 * TWO_EPOCHS);
    let whole = run(&mut following(), 1, &all, 0, 128);
    let first_ns = displays(&whole)[0].time_ns;
    let hole = 1_000;
    let mut core = following();
    let mut outputs = run(&mut core, 1, &all[..3_000], 0, 128);
    let gap = Gap {
        epoch: 1,
        from: 3_000,
        to: 3_000 + hole,
    };
    outputs.extend(deliver(&mut core, &Delivery::Gap(gap)));
    assert_eq!(outputs, []);
    let rest = run(&mut core, 1, &all, 4_000, 128);
    let moved_ns = displays(&rest)[0].time_ns - first_ns;
    assert_eq!(moved_ns as f64, 4_000.0 / RATE_HZ * 1e9);
    // The epoch is that of a stream that begins after the hole, except for the offset of each
    // channel, which the filter keeps.
    let anew = run(&mut following(), 1, &all[4_000..], 0, 128);
    let frequency = |outputs: &[ModesOutput]| {
        let estimate = displays(outputs)[0].estimate.clone().unwrap();
        estimate.frequency_hz
    };
    assert!((frequency(&rest) - frequency(&anew)).abs() < 1e-6);
}

/// A recording and a stream have the same rule: a hole of less than a second repeats the last
/// values.
#[test]
fn a_short_hole_is_bridged() {
    let mut all = frames(TWO_EPOCHS);
    let whole = run(&mut following(), 1, &all, 0, 128);
    let mut core = following();
    let mut outputs = run(&mut core, 1, &all[..3_000], 0, 128);
    let gap = Gap {
        epoch: 1,
        from: 3_000,
        to: 3_010,
    };
    outputs.extend(deliver(&mut core, &Delivery::Gap(gap)));
    outputs.extend(run(&mut core, 1, &all, 3_010, 128));
    let times = |outputs: &[ModesOutput]| -> Vec<i64> {
        displays(outputs)
            .iter()
            .map(|display| display.time_ns)
            .collect()
    };
    assert_eq!(times(&outputs), times(&whole));
    assert_ne!(outputs, whole);
    // The same frames with missing samples.
    all[3_000..3_010].fill([f64::NAN; CHANNELS]);
    assert_eq!(outputs, run(&mut following(), 1, &all, 0, 128));
}

#[test]
fn a_new_run_begins_anew() {
    let all = frames(TWO_EPOCHS);
    let mut core = following();
    run(&mut core, 1, &all[..5_000], 0, 128);
    assert_eq!(core.declared().epochs(), 1);
    let again = run(&mut core, 2, &all, 0, 128);
    let fresh = run(&mut following(), 2, &all, 0, 128);
    assert_eq!(again, fresh);
    assert_eq!(core.declared().epochs(), 2);
}

/// Regression: the mode was then looked for near its declared frequency only, and lost.
#[test]
fn mode_that_has_drifted_is_found_in_a_new_run() {
    let plan = plan(&[("first", 1.0), ("second", 2.5)]);
    let mut core = Following::new(&name("tower"), &plan, None).unwrap();
    // The mode moves by 2 % with each epoch, and is declared within 5 %.
    let epochs: Vec<f64> = (0..6).map(|epoch| 1.0 - 0.02 * f64::from(epoch)).collect();
    let last_hz = epochs[epochs.len() - 1];
    let drifting: Vec<[f64; CHANNELS]> = epochs
        .iter()
        .flat_map(|hz| frames_of([*hz, 2.5], 3_400))
        .collect();
    let outputs = run(&mut core, 1, &drifting, 0, 128);
    let tracked_hz = displays(&outputs).iter().rev().find_map(|display| {
        let estimate = display.estimate.as_ref()?;
        (display.mode.as_str() == "first").then_some(estimate.frequency_hz)
    });
    assert!(
        (tracked_hz.unwrap() - last_hz).abs() < 0.03,
        "{tracked_hz:?}"
    );
    let again = run(&mut core, 2, &frames_of([last_hz, 2.5], TWO_EPOCHS), 0, 128);
    let first = displays(&again)[0];
    assert_eq!(
        (first.mode.as_str(), first.state),
        ("first", ModeState::Tracked)
    );
}

#[test]
fn frames_that_no_longer_exist_delay_the_first_epoch() {
    let all = frames(TWO_EPOCHS);
    let mut core = following();
    let gap = Gap {
        epoch: 1,
        from: 0,
        to: 2_000,
    };
    assert_eq!(deliver(&mut core, &Delivery::Gap(gap)), []);
    let reached = Position {
        epoch: 1,
        sequence: 2_000,
    };
    assert_eq!(core.position(), Some(reached));
    let rest = run(&mut core, 1, &all, 2_000, 128);
    let whole = run(&mut following(), 1, &all, 0, 128);
    let moved_ns = displays(&rest)[0].time_ns - displays(&whole)[0].time_ns;
    assert_eq!(moved_ns as f64, 2_000.0 / RATE_HZ * 1e9);
}

#[test]
fn an_epoch_with_one_channel_is_counted_and_gives_no_message() {
    let mut all = frames(TWO_EPOCHS);
    for frame in &mut all {
        frame[2] = f64::NAN;
    }
    let mut core = following();
    assert_eq!(run(&mut core, 1, &all, 0, 128), []);
    assert_eq!(core.unidentified(), 2);
}
