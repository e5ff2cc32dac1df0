//! Simulated sequences of events whose truth is known.

use super::*;
use crate::course::{CoursePoint, Memory};
use crate::phase::Phase;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};

const SETTINGS: JudgeSettings = JudgeSettings {
    loss: 0.05,
    credibility: 0.99,
    level: 0.95,
    weak_amplitude: -0.5,
};
/// Standard deviation within a record (Δ ln k).
const WITHIN: f64 = 0.03;
/// True scatter between events (Δ ln k).
const BETWEEN: f64 = 0.05;

fn point(index: usize, phase: Phase, amplitude: f64, y: f64) -> CoursePoint {
    CoursePoint {
        start_s: 3.0 * index as f64,
        end_s: 3.0 * (index + 1) as f64,
        phase,
        amplitude,
        y,
        s: WITHIN,
        is_contradicted: false,
    }
}

fn motion(y: f64) -> WeakMotion {
    WeakMotion {
        y,
        s: WITHIN,
        windows: 4,
    }
}

/// A weak event with this y.
fn weak(y: f64) -> EventCourse {
    EventCourse {
        memory: Memory::Shared,
        points: (0..4).map(|i| point(i, Phase::Weak, -1.0, y)).collect(),
        has_shaking: false,
        before: None,
        after: Some(motion(y)),
    }
}

/// A strong event whose softest window has the first y, with this number of weak windows of the
/// second y after it.
fn strong(softest: f64, after: f64, windows: usize) -> EventCourse {
    let mut points = vec![point(0, Phase::Shaking, 0.5, softest)];
    points.extend((1..=windows).map(|i| point(i, Phase::Weak, -1.0, after)));
    let after = motion(after);
    EventCourse {
        memory: Memory::Shared,
        points,
        has_shaking: true,
        before: None,
        after: (windows > 0).then_some(WeakMotion { windows, ..after }),
    }
}

fn scattered(random: &mut ChaCha8Rng, mean: f64) -> f64 {
    let std = f64::hypot(BETWEEN, WITHIN);
    mean + Normal::new(0.0, std).unwrap().sample(random)
}

fn judged(events: impl IntoIterator<Item = EventCourse>) -> Vec<EventJudgement> {
    let mut sequence = Sequence::new(SETTINGS).unwrap();
    events
        .into_iter()
        .map(|event| sequence.push(event, None))
        .collect()
}

#[test]
fn softening_is_raised_and_weak_events_raise_nothing() {
    let sound = [0.02, -0.03, 0.05, 0.0, -0.04];
    let events = sound.map(weak).into_iter().chain([strong(-0.9, 0.01, 4)]);
    let judgements = judged(events);
    assert!(judgements[..5].iter().all(|one| one.softening.is_none()));
    let last = &judgements[5];
    let softening = last.softening.unwrap();
    assert!(softening.is_raised && softening.expected.is_none());
    assert!((softening.change - (-0.9_f64).exp_m1()).abs() < 0.03);
    assert_eq!(last.raised(), None);
    assert!(last.own().unwrap().loss.unwrap().probability < 0.5);
}

#[test]
fn second_shaking_of_the_same_size_is_as_expected() {
    let events = [0.02, -0.03, 0.05].map(weak);
    let events = events.into_iter().chain([
        strong(-0.8, 0.0, 4),
        strong(-0.75, 0.0, 4),
        strong(-2.5, 0.0, 4),
    ]);
    let judgements = judged(events);
    let expected = |index: usize| judgements[index].softening.unwrap().expected;
    assert_eq!(expected(3), None);
    assert!(expected(4).unwrap().is_as_expected);
    assert!(!expected(5).unwrap().is_as_expected);
}

#[test]
fn lasting_loss_names_what_it_waits_for() {
    let few = judged([weak(0.0), weak(0.01), strong(-0.5, -0.2, 4)]);
    assert_eq!(
        few[2].own().unwrap().waiting,
        Some(Waiting::EarlierEvents {
            found: 2,
            required: 4
        })
    );
    let sound = [0.0, 0.02, -0.02, 0.01];
    let short = judged(sound.map(weak).into_iter().chain([strong(-0.5, -0.5, 2)]));
    assert_eq!(
        short[4].own().unwrap().waiting,
        Some(Waiting::WeakMotion {
            found: 2,
            required: 3
        })
    );
    let aftershock = sound.map(weak).into_iter();
    let aftershock = judged(aftershock.chain([strong(-0.5, -0.5, 2), weak(-0.5)]));
    let candidate = aftershock[5].lasting[0];
    assert_eq!((candidate.since, candidate.waiting), (4, None));
    assert_eq!(candidate.loss.unwrap().later, 1);
}

#[test]
fn first_event_is_compared_with_its_own_recovery() {
    let mut event = strong(-1.0, 0.0, 0);
    let settling = [-0.3, -0.2, -0.1, -0.1, -0.1, -0.1];
    let settling = (1..).zip(settling);
    event
        .points
        .extend(settling.map(|(i, y)| point(i, Phase::Settling, -1.0, y)));
    let judgement = &judged([event])[0];
    let reference = judgement.reference.unwrap();
    assert_eq!(reference.kind, ReferenceKind::OwnRecovery);
    assert!((reference.y + 0.1).abs() < 1e-12, "{reference:?}");
    assert!(judgement.softening.unwrap().is_raised);
}

#[test]
fn loss_without_recorded_shaking_is_found() {
    let sound = [0.0, 0.02, -0.02, 0.01, 0.03, -0.01].map(weak);
    let judgements = judged(sound.into_iter().chain([-0.7, -0.72].map(weak)));
    assert!(judgements[5].lasting.is_empty());
    let (since, loss) = judgements[7].raised().unwrap();
    assert!(since == 6 && (loss.loss - 0.5).abs() < 0.05, "{loss:?}");
}

#[test]
fn strong_motion_never_counts_as_lasting() {
    let sound = [0.0, 0.02, -0.02, 0.01, 0.03];
    let judgements = judged(sound.map(weak).into_iter().chain([strong(-2.0, 0.0, 5)]));
    let loss = judgements[5].own().unwrap().loss.unwrap();
    assert!(loss.loss.abs() < 0.05 && !loss.is_raised, "{loss:?}");
}

#[test]
fn a_raised_loss_starts_a_new_reference() {
    let sound = [0.0, 0.02, -0.02, 0.01, 0.03, -0.01];
    let damaged = [-0.5, -0.52, -0.49, -0.51];
    let events = sound.map(weak).into_iter().chain([strong(-1.0, -0.5, 4)]);
    let judgements = judged(events.chain(damaged.map(weak)));
    assert_eq!(judgements[10].raised().unwrap().0, 6);
    let reference = judgements[10].reference.unwrap();
    assert!((reference.y + 0.5).abs() < 0.03, "{reference:?}");
}

/// With known truth, the interval must contain the lasting loss with its level, and a sound
/// structure must rarely be called damaged.
#[test]
fn simulated_sequences_have_the_stated_coverage_and_rate_of_false_alarms() {
    const RUNS: u32 = 4000;
    let mut random = ChaCha8Rng::seed_from_u64(21);
    for (true_loss, before, after) in [(0.0, 8, 1), (0.0, 8, 6), (0.2, 8, 6), (0.2, 5, 2)] {
        let (mut inside, mut raised, mut any, mut unjudged) = (0_u32, 0_u32, 0_u32, 0_u32);
        let delta = f64::ln(1.0 - true_loss);
        for _ in 0..RUNS {
            let mut sequence = Sequence::new(SETTINGS).unwrap();
            for _ in 0..before {
                sequence.push(weak(scattered(&mut random, 0.0)), None);
            }
            let mut last = sequence.push(strong(-1.0, scattered(&mut random, delta), 4), None);
            for _ in 1..after {
                last = sequence.push(weak(scattered(&mut random, delta)), None);
            }
            // An earlier outlier may have started a new reference, rarely.
            let own = last.lasting.iter().find(|one| one.since == before);
            let Some(loss) = own.and_then(|one| one.loss) else {
                unjudged += 1;
                continue;
            };
            any += u32::from(last.raised().is_some());
            inside += u32::from(loss.interval.contains(true_loss));
            raised += u32::from(loss.is_raised);
        }
        println!("{true_loss} {before} {after}: {inside} {raised} {any} {unjudged}");
        assert!(unjudged < RUNS / 20, "{unjudged}");
        let coverage = f64::from(inside) / f64::from(RUNS - unjudged);
        // Three standard deviations of the share below 0.95; wider is on the safe side.
        assert!(
            coverage > 0.94,
            "loss {true_loss}, {before} + {after}: {coverage}"
        );
        if true_loss == 0.0 {
            let rate = f64::from(raised) / f64::from(RUNS);
            assert!(rate < 0.01, "{before} + {after}: {rate}");
        } else if after == 6 {
            let rate = f64::from(raised) / f64::from(RUNS);
            assert!(rate > 0.3, "{before} + {after}: {rate}");
        }
    }
}

#[test]
fn interval_for_the_structure_covers_further_events() {
    const RUNS: u32 = 4000;
    let mut random = ChaCha8Rng::seed_from_u64(22);
    let (mut wide, mut narrow) = (0_u32, 0_u32);
    for _ in 0..RUNS {
        let mut sequence = Sequence::new(SETTINGS).unwrap();
        for _ in 0..7 {
            sequence.push(weak(scattered(&mut random, 0.0)), None);
        }
        let y = scattered(&mut random, 0.0);
        let state = sequence.push(weak(y), None).weak.unwrap();
        // Without a prediction, a false loss has started a new reference.
        let predicted = state.predicted;
        wide += u32::from(predicted.is_some_and(|interval| interval.contains(y.exp())));
        narrow += u32::from(state.within.contains(1.0));
    }
    let share = |count: u32| f64::from(count) / f64::from(RUNS);
    assert!((0.93..0.985).contains(&share(wide)), "{}", share(wide));
    // The interval within the record ignores the scatter between events.
    assert!(share(narrow) < 0.8, "{}", share(narrow));
}

#[test]
fn settings_out_of_range_are_named() {
    let wrong = JudgeSettings {
        loss: 1.0,
        ..SETTINGS
    };
    let told = Sequence::new(wrong).unwrap_err().to_string();
    assert_eq!(told, "loss is 1, must be above 0 and below 1");
}

/// The recordings minutes and an hour after an earthquake share its temperature and moisture.
#[test]
fn recordings_of_the_same_hours_count_as_one_event() {
    const HOUR_NS: i64 = 3_600_000_000_000;
    let last = |hours: &[i64]| {
        let mut sequence = Sequence::new(SETTINGS).unwrap();
        for (index, y) in [0.0, 0.15, -0.12, 0.1, -0.1].into_iter().enumerate() {
            sequence.push(weak(y), Some(index as i64 * 1_000 * HOUR_NS));
        }
        let start_ns = 5_000 * HOUR_NS;
        let mut last = sequence.push(strong(-1.0, -0.1, 4), Some(start_ns));
        for hours in hours {
            last = sequence.push(weak(-0.1), Some(start_ns + hours * HOUR_NS));
        }
        last.own().or(last.lasting.last()).unwrap().loss.unwrap()
    };
    assert_eq!(last(&[0, 1, 11]).later, 1);
    assert_eq!(last(&[0, 1, 24, 168]).later, 3);
    // The recordings are more precise together, but the scatter between events remains.
    let width = |hours: &[i64]| {
        let interval = last(hours).interval;
        interval.high - interval.low
    };
    let (alone, repeated, days) = (width(&[]), width(&[0, 1, 11]), width(&[24, 48, 168]));
    assert!(repeated > 0.95 * alone, "{repeated} {alone}");
    assert!(days < 0.85 * alone, "{days} {alone}");
}
