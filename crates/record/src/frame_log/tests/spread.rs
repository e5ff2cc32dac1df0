//! Segments of structures that start together do not end together.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use super::*;

const STRUCTURES: usize = 100;
/// Appends of a live structure per second.
const APPENDS_PER_S: u64 = 20;

#[test]
fn at_most_five_of_a_hundred_structures_end_a_segment_in_the_same_second() {
    let names: [fn(usize) -> String; 3] = [
        |number| format!("structure-{number}"),
        |number| format!("bridge-{number:03}"),
        |number| format!("{number}"),
    ];
    for name in names {
        let mut ends = BTreeMap::<u64, usize>::new();
        for number in 0..STRUCTURES {
            let limits = Limits::new(&LogSettings::default());
            let first = limits.first_of(&name(number));
            assert!((1..=limits.chunks).contains(&first.chunks), "{first:?}");
            *ends.entry(first.chunks / APPENDS_PER_S).or_default() += 1;
        }
        let most = ends.values().max();
        assert!(most <= Some(&5), "{}: {ends:?}", name(0));
    }
}

#[test]
fn first_segment_ends_at_a_share_of_its_limits_and_later_ones_at_the_limits() {
    let folder = quick_folder();
    let settings = LogSettings {
        segment_s: 100,
        ..LogSettings::default()
    };
    let share = f64::from(crc32fast::hash(b"tower")) / 2_f64.powi(32);
    assert!(
        (0.05..0.95).contains(&share),
        "the test needs a usual share"
    );
    let mut log = open_with(folder.path(), settings);
    for second in 0..200 {
        log.append(&[frames(1, 100 * second, 100)]).unwrap();
    }
    let starts: Vec<u64> = segments(folder.path())
        .iter()
        .map(|path| path.file_stem().unwrap().to_str().unwrap())
        .map(|name| name.rsplit_once('-').unwrap().1.parse().unwrap())
        .collect();
    let first = 100 * (100.0 * share).ceil() as u64;
    assert_eq!(starts, [0, first, first + 10_000]);
}

/// Appends blocks of 50 ms to a hundred logs in turn, as the thread of `ingest` does. Prints the
/// longest time that one turn takes, with first segments of full length and with spread ends.
///
/// To run it, use `cargo test -p spandrel-record --release --lib longest_turn -- --ignored
/// --nocapture`.
#[test]
#[ignore = "measures, and writes 600 MB"]
#[expect(clippy::disallowed_methods, reason = "measures the time of a turn")]
fn longest_turn_of_a_hundred_logs() {
    for is_spread in [false, true] {
        let folder = tempfile::tempdir().unwrap();
        let open = |number: usize| {
            let layout = LogLayout {
                structure: format!("structure-{number}"),
                ..layout()
            };
            let folder = folder.path().join(&layout.structure);
            let settings = LogSettings::default();
            let (mut log, _) = FrameLog::open(&folder, layout, settings).unwrap();
            if !is_spread {
                log.limits = Limits::new(&settings);
            }
            log
        };
        let mut logs: Vec<FrameLog> = (0..STRUCTURES).map(open).collect();
        let mut turns: Vec<Duration> = Vec::new();
        for turn in 0..u64::from(MOST_CHUNKS) + 100 {
            let block = frames(1, 5 * turn, 5);
            let started = Instant::now();
            for log in &mut logs {
                log.append(std::slice::from_ref(&block)).unwrap();
            }
            turns.push(started.elapsed());
        }
        turns.sort_unstable();
        let [median, longest] = [turns.len() / 2, turns.len() - 1].map(|at| turns[at]);
        println!("spread {is_spread}: a turn takes {median:?}, and {longest:?} at most");
    }
}
