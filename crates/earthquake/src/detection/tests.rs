use super::*;

const RATE_HZ: f64 = 50.0;

fn settings() -> DetectionSettings {
    DetectionSettings {
        rate_hz: RATE_HZ,
        fundamental_hz: 5.0,
        channels: 2,
        trigger: 1.0,
        strong: 2.0,
        again_after_s: vec![3600.0, 86_400.0],
        most_frames: 1_000_000,
    }
}

fn ns(seconds: f64) -> i64 {
    (seconds * 1e9) as i64
}

/// Pushes frames of these seconds, and schedules as a service does.
fn run(
    detection: &mut Detection,
    seconds: std::ops::Range<f64>,
    motion: impl Fn(f64) -> [f64; 2],
) -> Vec<Detected> {
    let mut all = Vec::new();
    let frame = |s: f64| (s * RATE_HZ).round() as u64;
    for number in frame(seconds.start)..frame(seconds.end) {
        let time_s = number as f64 / RATE_HZ;
        let mut found = Vec::new();
        detection.push(number, ns(time_s), &motion(time_s), &mut found);
        for one in &found {
            if let Detected::Complete(Cut {
                first,
                end,
                kind:
                    CutKind::Earthquake {
                        is_strong: true, ..
                    },
            }) = one
            {
                detection.schedule(ns(*first as f64 / RATE_HZ), ns(*end as f64 / RATE_HZ));
            }
        }
        all.extend(found);
    }
    all
}

/// A building under gravity that shakes with this amplitude from 100 to 110 s.
fn quake(amplitude: f64) -> impl Fn(f64) -> [f64; 2] {
    move |time_s| {
        let level = if (100.0..110.0).contains(&time_s) {
            amplitude
        } else {
            0.01
        };
        let wave = level * (31.0 * time_s).sin();
        [9.81 + wave, -wave]
    }
}

fn cuts(found: &[Detected]) -> Vec<&Cut> {
    let each = found.iter().filter_map(|one| match one {
        Detected::Complete(cut) => Some(cut),
        Detected::Began { .. } => None,
    });
    each.collect()
}

#[test]
fn earthquake_is_recorded_from_30_s_before_until_20_s_after_its_strong_motion() {
    let mut detection = Detection::new(settings()).unwrap();
    let found = run(&mut detection, 0.0..200.0, quake(3.0));
    let [Detected::Began { first }, Detected::Complete(cut)] = &found[..] else {
        panic!("{found:?}")
    };
    assert_eq!(*first, cut.first);
    let (from_s, to_s) = (cut.first as f64 / RATE_HZ, cut.end as f64 / RATE_HZ);
    assert!((70.0..70.3).contains(&from_s), "{from_s}");
    // The last sample above the trigger counts for one window.
    assert!((129.0..134.0).contains(&to_s), "{to_s}");
    let expected = CutKind::Earthquake {
        ending: Ending::Calm,
        is_strong: true,
    };
    assert_eq!(cut.kind, expected);
    assert_eq!(detection.due().len(), 2);
}

#[test]
fn weak_earthquake_is_recorded_but_not_judged_again() {
    let mut detection = Detection::new(settings()).unwrap();
    let found = run(&mut detection, 0.0..200.0, quake(1.5));
    assert_eq!(cuts(&found).len(), 1);
    assert!(detection.due().is_empty());
    assert!(
        run(
            &mut Detection::new(settings()).unwrap(),
            0.0..200.0,
            quake(0.9)
        )
        .is_empty()
    );
}

#[test]
fn weak_motion_is_recorded_an_hour_later_and_a_new_earthquake_postpones_it() {
    let mut detection = Detection::new(settings()).unwrap();
    run(&mut detection, 0.0..200.0, quake(3.0));
    let again_s = 3731.0;
    let aftershock = |time_s: f64| {
        let level = if (3800.0..3805.0).contains(&time_s) {
            1.5
        } else {
            0.01
        };
        let wave = level * (31.0 * time_s).sin();
        [9.81 + wave, -wave]
    };
    let found = run(&mut detection, 200.0..4200.0, aftershock);
    let cuts = cuts(&found);
    assert_eq!(cuts.len(), 2, "{cuts:?}");
    assert!(matches!(
        cuts[0].kind,
        CutKind::Earthquake {
            is_strong: false,
            ..
        }
    ));
    let CutKind::Later { due } = &cuts[1].kind else {
        panic!("{:?}", cuts[1])
    };
    assert_eq!(due.len(), 1);
    assert!((ns(again_s) - due[0].at_ns).abs() < ns(4.0), "{due:?}");
    assert!(cuts[1].first >= cuts[0].end);
    assert_eq!(cuts[1].end - cuts[1].first, 120 * 50);
    assert_eq!(detection.due()[0].after_s, 86_400.0);
}

#[test]
fn spike_in_one_channel_is_no_earthquake() {
    let mut detection = Detection::new(settings()).unwrap();
    let spike = |time_s: f64| {
        [
            if (50.0..50.1).contains(&time_s) {
                80.0
            } else {
                0.0
            },
            0.0,
        ]
    };
    assert!(run(&mut detection, 0.0..100.0, spike).is_empty());
    let alone = DetectionSettings {
        channels: 1,
        ..settings()
    };
    let mut detection = Detection::new(alone).unwrap();
    assert!(!run(&mut detection, 0.0..100.0, spike).is_empty());
}

#[test]
fn steps_of_the_sensors_are_recorded_once_and_become_the_offset() {
    let mut detection = Detection::new(settings()).unwrap();
    let step = |time_s: f64| {
        let level = if time_s < 100.0 { 0.0 } else { 5.0 };
        [level, level]
    };
    let found = run(&mut detection, 0.0..2000.0, step);
    let cuts = cuts(&found);
    let expected = CutKind::Earthquake {
        ending: Ending::Longest,
        is_strong: true,
    };
    assert_eq!(cuts[0].kind, expected);
    assert_eq!(cuts[0].end - cuts[0].first, 600 * 50);
    assert_eq!(cuts.len(), 1);
    assert!(detection.is_watching());
}

#[test]
fn interrupted_earthquake_is_recorded_and_what_is_due_survives_a_new_run() {
    let mut detection = Detection::new(settings()).unwrap();
    run(&mut detection, 0.0..105.0, quake(3.0));
    let mut found = Vec::new();
    detection.restart(&mut found);
    let [Detected::Complete(cut)] = &found[..] else {
        panic!("{found:?}")
    };
    assert_eq!(cut.end, 105 * 50);
    detection.schedule(0, ns(105.0));
    detection.push(0, ns(9000.0), &[0.0, 0.0], &mut Vec::new());
    assert!(!detection.is_watching(), "weak motion is recorded at once");
}

#[test]
fn a_detection_that_is_restored_while_it_watches_finds_the_same() {
    let mut whole = Detection::new(settings()).unwrap();
    let expected = run(&mut whole, 0.0..4500.0, quake(3.0));
    let mut first = Detection::new(settings()).unwrap();
    let mut found = run(&mut first, 0.0..90.0, quake(3.0));
    let mut second = Detection::new(settings()).unwrap();
    assert!(second.restore(first.state().clone()));
    found.extend(run(&mut second, 90.0..4500.0, quake(3.0)));
    assert_eq!(found, expected);
    assert_eq!(expected.len(), 3);
    assert_eq!(second.state(), whole.state());
}
