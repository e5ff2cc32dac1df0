//! Tests of the screening times: only those that fit into memory and have a scale are valid.

use crate::Structure;
use crate::file::tests::{DEMO, line_of, read};
use spandrel_filter::outlier::upper_bound;

fn with_outliers(keys: &str) -> String {
    format!("{DEMO}\n[outliers]\n{keys}\n")
}

#[test]
fn error_names_the_line_of_an_impossible_screening_time() {
    for (key, told) in [
        (
            "window-s = 1e12",
            "is 1e12, must be from 0.14 to 100000, which is 14 to 10000000 samples",
        ),
        (
            "window-s = 0.01",
            "is 0.01, 1 sample at 100 Hz, must be from 0.14 to 100000",
        ),
        (
            "training-s = 1e300",
            "is 1e300, must be from 0.03 to 10000, which is 3 to 1000000 samples",
        ),
        ("fault-window-s = 1e9", "is 1e9, must be from 0.03 to 10000"),
    ] {
        let text = with_outliers(key);
        let error = read(&text).expect_err(key);
        let [mistake] = error.diagnostics() else {
            panic!("{error}")
        };
        let name = key.split(' ').next().unwrap();
        assert_eq!(
            (mistake.line(), mistake.key()),
            (line_of(&text, key), format!("outliers.{name}").as_str())
        );
        let whole = format!("{}, {}", mistake.found(), mistake.allowed());
        assert!(whole.starts_with(told), "{whole}");
    }
}

#[test]
fn shortest_and_longest_times_give_a_valid_filter() {
    let makes_a_filter = |structure: &Structure| {
        let settings = structure.filter_settings().unwrap();
        spandrel_filter::ExtendedKalmanFilter::new(structure.model(), settings).is_ok()
    };
    let shortest = with_outliers("window-s = 0.14\ntraining-s = 0.03\nfault-window-s = 0.03");
    assert!(makes_a_filter(&read(&shortest).unwrap()));
    // Settings that follow from a period of days are limited by memory.
    let slow =
        with_outliers("").replacen("first-frequency-hz = 1.0", "first-frequency-hz = 3e-6", 1);
    let settings = read(&slow)
        .unwrap()
        .filter_settings()
        .unwrap()
        .outliers
        .unwrap();
    assert_eq!(
        (
            settings.window,
            settings.training_steps,
            settings.fault_window
        ),
        (10_000_000, 1_000_000, 1_000_000)
    );
}

#[test]
fn shortest_window_is_the_first_whose_upper_bound_is_above_the_lower_one() {
    assert!(upper_bound(13) < 2.0 && upper_bound(14) >= 2.0);
}
