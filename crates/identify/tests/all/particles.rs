//! Tests of the service's core with particles: its output, and its behaviour when they lose the
//! state.

use spandrel_bus::{Event, EventKind, FrameBlock, Header, Phase, StreamState};
use spandrel_identify::{Identification, IdentificationInput, Output};
use spandrel_structure::Structure;
use std::path::Path;

const RATE_HZ: usize = 50;

fn structure() -> Structure {
    let path =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/hysteretic-particles.toml");
    Structure::read(&path).unwrap()
}

/// Returns simulated seconds of force and acceleration. `fault` changes the acceleration at a time
/// (s).
fn frames(seconds: usize, fault: impl Fn(f64, f64) -> f64) -> FrameBlock {
    let rows = structure().simulator(3).take(seconds * RATE_HZ).enumerate();
    let values = rows.flat_map(|(frame, row)| {
        let [force, acceleration] = row.values[..] else {
            panic!("the example has two channels")
        };
        [force, fault(frame as f64 / RATE_HZ as f64, acceleration)]
    });
    FrameBlock {
        header: Header {
            source: "ingest".into(),
            epoch: 7,
            sequence: 0,
            time_ns: 0,
        },
        t0_ns: 0,
        sampling_rate_hz: RATE_HZ as f64,
        channels: 2,
        values: values.collect(),
        state: StreamState::Running,
    }
}

fn run(block: FrameBlock) -> Vec<Output> {
    let mut outputs = Vec::new();
    Identification::new(&structure(), "identify")
        .unwrap()
        .handle(IdentificationInput::Frames(block), &mut outputs);
    outputs
}

/// Returns kind and time (s) of each event.
fn events(outputs: &[Output]) -> Vec<(EventKind, f64)> {
    let event = |output: &Output| match output {
        Output::Event(Event { kind, time_ns, .. }) => Some((*kind, *time_ns as f64 / 1e9)),
        _ => None,
    };
    outputs.iter().filter_map(event).collect()
}

fn phase_at(outputs: &[Output], second: usize) -> Phase {
    let blocks = outputs.iter().filter_map(|output| {
        if let Output::Estimates(block) = output {
            Some(block)
        } else {
            None
        }
    });
    blocks
        .flat_map(|block| &block.estimates)
        .nth(second * RATE_HZ)
        .unwrap()
        .flags
        .phase
}

#[test]
fn particles_that_follow_the_data_publish_their_effective_number_and_no_event() {
    let outputs = run(frames(20, |_, acceleration| acceleration));
    let effective: Vec<f64> = outputs
        .iter()
        .filter_map(|output| match output {
            Output::Noise(display) if display.name.as_str() == "effective-particles" => {
                Some(display.mean)
            }
            _ => None,
        })
        .collect();
    assert_eq!(
        effective.len(),
        18 * 10,
        "ten times a second once the Kalman filter has warmed up"
    );
    assert!(
        effective
            .iter()
            .all(|number| (50.0..=500.0).contains(number)),
        "{effective:?}"
    );
    assert_eq!(events(&outputs), []);
    assert_eq!(phase_at(&outputs, 19), Phase::Working);
}

#[test]
fn a_lost_state_is_an_event_and_suspends_alert_decisions() {
    let jumps = |time_s: f64, acceleration: f64| {
        if (10.0..14.0).contains(&time_s) {
            -4.0 * acceleration
        } else {
            acceleration
        }
    };
    let outputs = run(frames(40, jumps));
    let events = events(&outputs);
    let [
        (EventKind::Unidentified, lost_s),
        (EventKind::Calibration, found_s),
    ] = events[..]
    else {
        panic!("{events:?}")
    };
    assert!(
        (10.0..12.0).contains(&lost_s) && (14.0..35.0).contains(&found_s),
        "lost at {lost_s} s, back at {found_s} s"
    );
    assert_eq!(
        [9, 13, 39].map(|second| phase_at(&outputs, second)),
        [Phase::Working, Phase::Training, Phase::Working]
    );
}

#[test]
fn particles_that_stay_lost_are_redrawn_from_the_prior() {
    let outputs = run(frames(50, |time_s, acceleration| {
        if time_s < 10.0 {
            acceleration
        } else {
            -4.0 * acceleration
        }
    }));
    let events = events(&outputs);
    assert_eq!(events[0].0, EventKind::Unidentified, "{events:?}");
    let restart = events
        .iter()
        .find(|(kind, _)| *kind == EventKind::Restart)
        .unwrap();
    let after_s = restart.1 - events[0].1;
    assert!((30.0..31.0).contains(&after_s), "after {after_s} s");
}

/// The demo with particles and identified noise levels.
fn with_adapted_noise() -> Structure {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo.toml");
    let text = std::fs::read_to_string(&path).unwrap();
    let particles = "[filter]\nkind = \"particle\"\nparticles = 100\nwarm-up-s = 0.5\n";
    let text = text.replace("[filter]\n", particles);
    Structure::parse(&text, &path).unwrap()
}

/// Regression: the particles took over before the noise levels were trained, and no alert was ever
/// decided. A restart then lost the levels.
#[test]
fn particles_start_after_the_training_of_the_noise_and_keep_the_levels() {
    let structure = with_adapted_noise();
    let rows = structure.simulator(5).take(3_000);
    let values: Vec<f64> = rows.flat_map(|row| row.values).collect();
    let block = |from: usize, to: usize| FrameBlock {
        header: Header {
            source: "ingest".into(),
            epoch: 7,
            sequence: from as u64,
            time_ns: from as i64 * 10_000_000,
        },
        t0_ns: 0,
        sampling_rate_hz: 100.0,
        channels: 6,
        values: values[from * 6..to * 6].to_vec(),
        state: StreamState::Running,
    };
    let estimates = |core: &mut Identification, block: FrameBlock| {
        let mut outputs = Vec::new();
        core.handle(IdentificationInput::Frames(block), &mut outputs);
        let blocks = outputs.into_iter().filter_map(|output| match output {
            Output::Estimates(block) => Some(block.estimates),
            _ => None,
        });
        blocks.flatten().collect::<Vec<_>>()
    };
    let mut core = Identification::new(&structure, "identify").unwrap();
    let head = estimates(&mut core, block(0, 2_500));
    assert_eq!(head[100].flags.phase, Phase::Training);
    assert_eq!(head[2_499].flags.phase, Phase::Working);
    let bytes = postcard::to_stdvec(&core.state()).unwrap();
    let tail = estimates(&mut core, block(2_500, 3_000));
    let mut core = Identification::new(&structure, "identify").unwrap();
    core.restore(postcard::from_bytes(&bytes).unwrap()).unwrap();
    let resumed = estimates(&mut core, block(2_500, 3_000));
    assert_eq!(resumed, tail);
    assert_ne!(
        tail[0].noise_mean,
        vec![0.005_f64.powi(2)],
        "the level is trained"
    );
}
