use super::*;
use spandrel_bus::{Gap, Header, StreamState};
use spandrel_earthquake::DetectionSettings;

const RATE_HZ: f64 = 50.0;
const T0_NS: i64 = 1_600_000_000_000_000_000;

fn cutting() -> Cutting {
    let detection = Detection::new(DetectionSettings {
        rate_hz: RATE_HZ,
        fundamental_hz: 5.0,
        channels: 2,
        trigger: 1.0,
        strong: 1.0,
        again_after_s: vec![600.0],
        most_frames: 100_000,
    });
    // Channel 1 is not watched.
    Cutting::new(detection.unwrap(), vec![0, 2], RATE_HZ)
}

/// Shakes from 100 to 110 s.
fn block(epoch: u64, seconds: std::ops::Range<u32>) -> Delivery<FrameBlock> {
    let frames = seconds.start * 50..seconds.end * 50;
    let values = frames.clone().flat_map(|frame| {
        let time_s = f64::from(frame) / RATE_HZ;
        let level = if (100.0..110.0).contains(&time_s) {
            4.0
        } else {
            0.01
        };
        let wave = level * (31.0 * time_s).sin();
        [wave, 77.0, -wave]
    });
    Delivery::Block(FrameBlock {
        header: Header {
            source: "ingest".into(),
            epoch,
            sequence: frames.start.into(),
            time_ns: T0_NS,
        },
        t0_ns: T0_NS,
        sampling_rate_hz: RATE_HZ,
        channels: 3,
        values: values.collect(),
        state: StreamState::Running,
    })
}

fn run(cutting: &mut Cutting, epoch: u64, seconds: std::ops::Range<u32>) -> Vec<CutOutput> {
    let mut outputs = Vec::new();
    for from in seconds.clone().step_by(5) {
        let block = block(epoch, from..(from + 5).min(seconds.end));
        cutting.handle(&block, &mut outputs);
    }
    outputs
}

#[test]
fn recording_has_all_channels_and_the_times_of_its_frames() {
    let mut cutting = cutting();
    let outputs = run(&mut cutting, 1, 0..900);
    let [
        CutOutput::Began { start_ns, .. },
        CutOutput::Record(shaking),
        CutOutput::Record(later),
    ] = &outputs[..]
    else {
        panic!("{outputs:?}")
    };
    assert_eq!(*start_ns, shaking.about.start_ns);
    let start_s = (start_ns - T0_NS) as f64 / 1e9;
    assert!((70.0..71.0).contains(&start_s), "{start_s}");
    let (first, values) = &shaking.rows[0];
    assert_eq!(first, start_ns);
    assert_eq!(values[1], 77.0);
    assert!(matches!(&later.about.kind, CutKind::Later { due } if due[0].of_ns == *start_ns));
    assert!(
        cutting.frames.len() <= 30 * 50 + 1,
        "{}",
        cutting.frames.len()
    );
}

/// A checkpoint while nothing shakes, and the frames since [`Cutting::needed_from`], give the same
/// recording as without a crash.
#[test]
fn crash_in_the_middle_of_an_earthquake_changes_no_recording() {
    let expected = run(&mut cutting(), 1, 0..900);
    let mut first = cutting();
    run(&mut first, 1, 0..95);
    let (state, needed) = (first.state(), first.needed_from().unwrap());
    let lost = run(&mut first, 1, 95..105);
    assert_eq!(lost.len(), 1, "strong motion has begun");
    let mut second = cutting();
    second.restore(state).unwrap();
    assert_eq!(
        second.start(),
        Start::At {
            epoch: 1,
            sequence: needed.sequence
        }
    );
    let from = (needed.sequence / 250) * 5;
    let outputs = run(&mut second, 1, from as u32..900);
    assert_eq!(outputs, expected);
}

#[test]
fn weak_motion_without_samples_is_tried_again() {
    let mut cutting = cutting();
    run(&mut cutting, 1, 0..720);
    let mut outputs = Vec::new();
    let gap = Gap {
        epoch: 1,
        from: 745 * 50,
        to: 4000 * 50,
    };
    run(&mut cutting, 1, 720..745);
    cutting.handle(&Delivery::Gap(gap), &mut outputs);
    let outputs = run(&mut cutting, 1, 4000..4300);
    let [CutOutput::TooFew { due, .. }, CutOutput::Record(later)] = &outputs[..] else {
        panic!("{outputs:?}")
    };
    assert!(matches!(&later.about.kind, CutKind::Later { due: made } if made == due));
    assert!(later.about.start_ns >= T0_NS + 4_000_000_000_000);
}

#[test]
fn earthquake_is_recorded_although_a_new_run_of_frames_begins() {
    let mut cutting = cutting();
    run(&mut cutting, 1, 0..105);
    let outputs = run(&mut cutting, 2, 0..5);
    let [CutOutput::Record(recorded)] = &outputs[..] else {
        panic!("{outputs:?}")
    };
    assert_eq!(recorded.rows.last().unwrap().0, T0_NS + 104_980_000_000);
}
