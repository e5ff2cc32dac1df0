//! Sudden faults of a sensor, which must not look like damage.

use super::*;

/// Frame in which the fault begins. The demo building is undamaged until 60 s.
const BEGIN: usize = 4_000;

/// Returns the frames of the demo, in which `change` has changed the values of a floor from 40 s
/// on. It receives the number of the frame and the former values of the floor.
fn with_fault(floor: usize, count: usize, change: impl Fn(usize, &[f64]) -> f64) -> FrameBlock {
    let sound = of_text(without_damage, count).1.values;
    let of_floor: Vec<f64> = sound.chunks(6).map(|values| values[floor]).collect();
    let mut block = frames(1);
    block.values = sound;
    for (number, values) in block.values.chunks_mut(6).enumerate().skip(BEGIN) {
        values[floor] = change(number, &of_floor[..=number]);
    }
    block
}

fn without_damage(text: String) -> String {
    let (text, _) = text.split_once("[[simulation.damage]]").unwrap();
    text.to_owned()
}

/// Returns the text of the demo with twice the damping of the simulation, which is not identified.
fn with_wrong_damping(text: String) -> String {
    let text = without_damage(text).replace("ratio = 0.02", "ratio = 0.04");
    let (head, rest) = text
        .split_once("[[parameter]]\nname = \"damping\"")
        .unwrap();
    let (_, tail) = rest.split_once("[[excitation]]").unwrap();
    format!("{head}[[excitation]]{tail}")
}

fn wrong_structure() -> Structure {
    of_text(with_wrong_damping, 1).0
}

/// Changes the values of a sensor: receives the number of the frame and the former values.
type Change<'a> = &'a dyn Fn(usize, &[f64]) -> f64;

fn of_kind(outputs: &[Output], kind: EventKind) -> Vec<&Event> {
    let mut events = events(outputs);
    events.retain(|event| event.kind == kind);
    events
}

/// The structure file has wrong damping, so that the fit is doubtful before the fault as well.
#[test]
fn sudden_fault_is_named_within_seconds_and_the_parameters_stay() {
    let structure = wrong_structure();
    let faults: [(&str, Change<'_>); 5] = [
        ("does not follow the motion of the others", &|_, _| 0.0),
        ("does not follow the motion of the others", &|_, values| {
            values[BEGIN]
        }),
        ("measures with the opposite sign", &|number, values| {
            -values[number]
        }),
        ("measures 0.2", &|number, values| 0.2 * values[number]),
        // 0.15 s late
        (
            "measures something that the others do not",
            &|number, values| values[number - 15],
        ),
    ];
    for (words, change) in faults {
        for floor in [2, 5] {
            let outputs = identified(&structure, with_fault(floor, 6_000, change));
            let [event] = of_kind(&outputs, EventKind::ChannelExcluded)[..] else {
                panic!("{words}, floor {floor}: {:?}", events(&outputs))
            };
            assert_eq!(event.subject, format!("floor-{floor}"));
            assert!(
                event.what.starts_with(&format!("the sensor {words}")),
                "{event:?}"
            );
            let all = estimates(&outputs);
            let first = all
                .iter()
                .position(|estimate| estimate.excluded != Excluded::None)
                .unwrap();
            let after_s = (first - BEGIN) as f64 / 100.0;
            assert!(after_s < 8.0, "{words}, floor {floor}: after {after_s} s");
            let before = &all[BEGIN - 1];
            for estimate in &all[first + 1..] {
                assert!(!estimate.flags.restarted);
                assert_eq!(estimate.used_channels, 4);
                // A wrong model has slightly different best parameters without the channel.
                for (mean, before) in estimate.mean[..5].iter().zip(&before.mean) {
                    assert!(
                        (mean - before).abs() < 0.1,
                        "{words}, floor {floor}: {mean} {before}"
                    );
                }
            }
        }
    }
}

#[test]
fn sudden_loss_of_stiffness_is_no_fault_of_a_sensor() {
    for storey in 1..=5 {
        for loss in [0.15, 0.4, 0.7] {
            let damaged = |text: String| {
                let damage = format!(
                    "[[simulation.damage]]\nparameter = \"storey-{storey}\"\nat-s = 40\n\
                     loss = {loss}\n"
                );
                without_damage(text) + &damage
            };
            let (_, block) = of_text(damaged, 6_000);
            let outputs = identified(&wrong_structure(), block);
            let all = estimates(&outputs);
            let jumped = all.iter().any(|estimate| estimate.flags.follows_jump);
            assert!(jumped || loss < 0.2, "storey {storey} loses {loss}");
            let is_sound = |estimate: &&Estimate| {
                estimate.excluded == Excluded::None && estimate.flags.phase == Phase::Working
            };
            let settled = &all[2_000..];
            assert!(
                settled.iter().all(is_sound),
                "storey {storey} loses {loss}: {:?}",
                events(&outputs)
            );
        }
    }
}

#[test]
fn repaired_sensor_is_used_again() {
    let repaired = 5_500;
    let block = with_fault(3, 9_500, |number, values| match number {
        ..5_500 => 0.0,
        _ => values[number],
    });
    let outputs = identified(&wrong_structure(), block);
    let [event] = of_kind(&outputs, EventKind::ChannelBack)[..] else {
        panic!("{:?}", events(&outputs))
    };
    assert_eq!(event.subject, "floor-3");
    let after_s = event.time_ns as f64 / 1e9 - f64::from(repaired) / 100.0;
    assert!((20.0..35.0).contains(&after_s), "{after_s}");
    let all = estimates(&outputs);
    let last = all.last().unwrap();
    assert_eq!((last.excluded, last.used_channels), (Excluded::None, 5));
    for (mean, before) in last.mean[..5].iter().zip(&all[BEGIN - 1].mean) {
        assert!((mean - before).abs() < 0.04, "{mean} {before}");
    }
}

#[test]
fn restart_within_and_after_a_trial_changes_no_bit() {
    let structure = wrong_structure();
    let block = with_fault(2, 6_000, |_, _| 0.0);
    let whole = identified(&structure, block.clone());
    let all = estimates(&whole);
    let doubted = all
        .iter()
        .position(|estimate| estimate.flags.phase == Phase::SensorInDoubt);
    let excluded = all
        .iter()
        .position(|estimate| estimate.excluded != Excluded::None);
    let (doubted, excluded) = (doubted.unwrap() as u64, excluded.unwrap() as u64);
    assert!(doubted + 50 < excluded, "{doubted}, {excluded}");
    for at in [doubted + 50, excluded + 50] {
        let [head, tail] = &cut(block.clone(), &[at])[..] else {
            panic!("two parts")
        };
        let mut core = Identification::new(&structure, "identify").unwrap();
        core.handle(IdentificationInput::Frames(head.clone()), &mut Vec::new());
        let bytes = postcard::to_stdvec(&core.state()).unwrap();
        let mut core = Identification::new(&structure, "identify").unwrap();
        core.restore(postcard::from_bytes(&bytes).unwrap()).unwrap();
        let mut outputs = Vec::new();
        core.handle(IdentificationInput::Frames(tail.clone()), &mut outputs);
        let resumed = estimates(&outputs);
        // A missing innovation is not equal to itself.
        assert_eq!(format!("{resumed:?}"), format!("{:?}", &all[at as usize..]));
    }
}
