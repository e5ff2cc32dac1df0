use super::*;
use crate::testing::{demo, hear, name};
use spandrel_bus::{ChannelWaveform, WaveformDisplay};
use spandrel_listener::Input;

const SECOND: i64 = 1_000_000_000;

fn heard() -> Store {
    let mut store = demo();
    for second in 0..100 {
        hear(&mut store, "storey-1", second * SECOND, 1.0, 0.25);
        hear(&mut store, "storey-2", second * SECOND + 1, 0.5, 0.75);
    }
    store
}

fn refused(asked: Asked) -> Refused {
    Request::new(&asked, &heard()).unwrap_err()
}

#[test]
fn span_contains_the_requested_number_of_points() {
    let store = heard();
    let asked = Asked {
        series: Some("parameter/storey-1".into()),
        from: Some("10.0".into()),
        to: Some("49.0".into()),
        points: Some(20),
        ..Asked::default()
    };
    let (span, _) = read(&store, &Request::new(&asked, &store).unwrap());
    let [series] = &span.series[..] else {
        panic!("{} series", span.series.len())
    };
    assert_eq!(series.columns, ["time_s", "mean", "std"]);
    assert_eq!(
        (series.data[0].len(), series.data[0][0], series.data[0][19]),
        (20, 11.0, 49.0)
    );
    assert_eq!(span.kept_from_s, Some(0.0));
}

#[test]
fn csv_rows_have_one_time_and_empty_fields_for_missing_values() {
    let store = heard();
    let asked = Asked {
        series: Some("parameter/storey-1,loss/storey-2".into()),
        from: Some("0.0".into()),
        to: Some("0.5".into()),
        ..Asked::default()
    };
    let csv = read(&store, &Request::new(&asked, &store).unwrap()).0.csv();
    let lines: Vec<&str> = csv.lines().collect();
    assert_eq!(
        lines,
        [
            "time,parameter/storey-1.mean,parameter/storey-1.std,loss/storey-2.loss,loss/storey-2.low,\
             loss/storey-2.high,loss/storey-2.probability_of_loss",
            "0,1,0.01,,,,",
            "1e-9,,,0.5,0.48040036015459947,0.5195996398454006,0.75",
        ]
    );
}

#[test]
fn csv_times_are_dates_or_seconds_for_a_record_without_dates() {
    for (time_ns, text) in [
        (1_709_208_000_000_000_000, "2024-02-29T12:00:00Z"),
        (1_709_208_000_250_000_000, "2024-02-29T12:00:00.25Z"),
        (90 * SECOND + SECOND / 2, "90.5"),
        (-SECOND, "-1"),
    ] {
        assert_eq!(written(time_ns), text);
    }
}

#[test]
fn csv_numbers_are_short_and_parsed_back_bit_for_bit() {
    for (value, text) in [
        (1.0, "1"),
        (-0.25, "-0.25"),
        (0.1 + 0.2, "0.30000000000000004"),
        (1e-5, "0.00001"),
        (1.5e-300, "1.5e-300"),
        (-2e22, "-2e22"),
        (f64::MIN_POSITIVE, "2.2250738585072014e-308"),
        (0.0, "0"),
    ] {
        assert_eq!(shortest(value), text);
        assert_eq!(
            text.parse::<f64>().unwrap().to_bits(),
            value.to_bits(),
            "{text}"
        );
    }
}

#[test]
fn span_may_be_given_in_dates() {
    let store = heard();
    let of = |from: &str, to: &str| {
        let asked = Asked {
            from: Some(from.into()),
            to: Some(to.into()),
            ..Asked::default()
        };
        Request::new(&asked, &store).unwrap()
    };
    assert_eq!(of("1970-01-01T00:00:10Z", "1970-01-02"), of("10", "86400"));
}

#[test]
fn series_without_values_is_empty_and_no_error() {
    let store = demo();
    let asked = Asked {
        series: Some("parameter/storey-3,consistency/all,noise/floors".into()),
        ..Asked::default()
    };
    let (span, _) = read(&store, &Request::new(&asked, &store).unwrap());
    assert_eq!(span.kept_from_s, None);
    let widths: Vec<usize> = span.series.iter().map(|series| series.data.len()).collect();
    assert_eq!(widths, [3, 2, 3]);
    assert!(span.series.iter().all(|series| series.data[0].is_empty()));
    assert_eq!(span.csv().lines().count(), 1);
}

#[test]
fn error_lists_the_allowed_values_of_a_request() {
    let unknown = refused(Asked {
        series: Some("parameter/storey-9".into()),
        ..Asked::default()
    });
    assert_eq!(unknown.what, "series `parameter/storey-9` is not known");
    assert_eq!(
        unknown.allowed,
        "must be one of: parameter/storey-1, parameter/storey-2, loss/storey-1, loss/storey-2"
    );
    assert_eq!(
        refused(Asked {
            points: Some(0),
            ..Asked::default()
        })
        .what,
        "points is 0"
    );
    assert!(
        refused(Asked {
            from: Some("2.0".into()),
            to: Some("1.0".into()),
            ..Asked::default()
        })
        .what
        .contains("from 2 to 1")
    );
    let no_time = refused(Asked {
        from: Some("NaN".into()),
        ..Asked::default()
    });
    assert_eq!(no_time.what, "from is `NaN`");
    assert!(
        no_time
            .allowed
            .contains("ISO 8601 such as 2026-03-01T12:00:00Z"),
        "{}",
        no_time.allowed
    );
}

#[test]
fn earlier_values_are_queried_from_the_history_and_prepended() {
    let mut store = demo();
    for second in 1_000..1_100 {
        hear(&mut store, "storey-1", second * SECOND, 1.0, 0.25);
    }
    let asked = |from: f64| Asked {
        series: Some("parameter/storey-1".into()),
        from: Some(from.to_string()),
        to: Some("1100".into()),
        points: Some(100),
        ..Asked::default()
    };
    let read = |store: &Store, from| read(store, &Request::new(&asked(from), store).unwrap());
    assert_eq!(read(&store, 0.0).1, [], "nobody to ask");
    store.handle(crate::testing::present(&[(Service::History, "history")]));
    assert_eq!(read(&store, 1_000.0).1, [], "all of it is here");

    let (mut span, earlier) = read(&store, 0.0);
    let [earlier] = &earlier[..] else {
        panic!("{earlier:?}")
    };
    assert_eq!(
        (earlier.name.as_str(), earlier.query.kind.as_str()),
        ("storey-1", "parameter")
    );
    assert_eq!(
        (earlier.query.from_ns, earlier.query.to_ns),
        (0, 1_000 * SECOND - 1)
    );
    assert_eq!(
        earlier.query.points + span.series[0].data[0].len(),
        100,
        "as many points as asked for, in all"
    );
    let column = |value: f64| vec![value; 2];
    let answer = HistorySpan {
        structure: name("demo"),
        kind: "parameter".to_owned(),
        name: "storey-1".to_owned(),
        resolution_s: Some(60),
        kept_from_s: Some(10.0),
        rows: spandrel_bus::HistoryRows {
            time_s: vec![59.0, 1_000.0],
            count: vec![600; 2],
            mean: column(0.9),
            std: column(0.02),
            spread: column(0.0),
            least: column(0.8),
            largest: column(1.0),
            low: column(0.7),
            high: column(1.1),
            probability_of_loss: column(0.5),
        },
    };
    span.put_before(earlier, &answer);
    let data = &span.series[0].data;
    assert_eq!((data[0][0], data[1][0], data[2][0]), (59.0, 0.9, 0.02));
    assert!(data[0].is_sorted(), "{:?}", data[0]);
    assert_eq!(span.kept_from_s, Some(10.0));
}

#[test]
fn the_history_is_not_queried_for_series_that_it_does_not_store() {
    let mut store = demo();
    store.handle(crate::testing::present(&[(Service::History, "history")]));
    let asked = Asked {
        series: Some("innovation/floor-1,waveform/floor-1,consistency/all,loss/storey-1".into()),
        from: Some("0".into()),
        to: Some("1100".into()),
        ..Asked::default()
    };
    let (span, earlier) = read(&store, &Request::new(&asked, &store).unwrap());
    assert_eq!(span.series.len(), 4);
    let kinds: Vec<&str> = earlier.iter().map(|one| one.query.kind.as_str()).collect();
    assert_eq!(kinds, ["loss"]);
}

#[test]
fn waveforms_from_before_the_stored_ones_are_read_from_the_recording() {
    let mut store = demo();
    let unkept = |store: &Store, from: Option<&str>, recorded| {
        let asked = Asked {
            series: Some("waveform/floor-1".into()),
            from: from.map(str::to_owned),
            to: Some("200".into()),
            recorded,
            ..Asked::default()
        };
        read(store, &Request::new(&asked, store).unwrap()).0.unkept
    };
    let all = Unkept::new(1, 0, 200 * SECOND, POINTS);
    assert_eq!(unkept(&store, Some("0"), None), [all]);
    store.handle(Input::Waveform(WaveformDisplay {
        structure: name("demo"),
        node: name("floor-1"),
        time_ns: 100 * SECOND,
        frames: 100,
        bucket_s: 0.1,
        channels: vec![ChannelWaveform {
            channel: name("floor-1"),
            missing: 0,
            level: None,
            extremes: vec![Some([-1.0, 1.0]); 10],
        }],
    }));
    // The middle of the first bucket is at 100.05 s, so that half of the points are for the rest.
    let before = Unkept::new(1, 0, 100 * SECOND + SECOND / 20 - 1, 501);
    assert_eq!(unkept(&store, Some("0"), None), [before]);
    assert_eq!(unkept(&store, Some("150"), None), [], "all of it is here");
    assert_eq!(unkept(&store, Some("0"), Some(false)), []);
    assert_eq!(unkept(&store, None, None), [], "a range without a start");
}

/// Regression test: a range without an end was refused as too long.
#[test]
fn waveforms_are_read_from_the_recording_up_to_the_newest_data() {
    let mut store = demo();
    hear(&mut store, "storey-1", 120 * SECOND, 1.0, 0.0);
    let unkept = |from: &str, to: Option<&str>| {
        let asked = Asked {
            series: Some("waveform/floor-1".into()),
            from: Some(from.to_owned()),
            to: to.map(str::to_owned),
            ..Asked::default()
        };
        read(&store, &Request::new(&asked, &store).unwrap())
            .0
            .unkept
    };
    let up_to = |second: i64| [Unkept::new(1, 0, second * SECOND, POINTS)];
    assert_eq!(unkept("0", None), up_to(120));
    assert_eq!(unkept("0", Some("200")), up_to(120));
    assert_eq!(unkept("0", Some("60")), up_to(60));
    assert_eq!(unkept("120", None), [], "nothing is newer");
}

/// Regression test: the loss begins after the reference was learnt, and hid the estimates before
/// it.
#[test]
fn a_series_that_begins_later_does_not_hide_the_others() {
    let mut store = demo();
    hear(&mut store, "storey-1", 7 * SECOND, 1.0, 0.0);
    hear(&mut store, "storey-2", 3 * SECOND, 1.0, 0.0);
    let asked = Asked {
        series: Some("loss/storey-1,parameter/storey-2".into()),
        ..Asked::default()
    };
    let (span, _) = read(&store, &Request::new(&asked, &store).unwrap());
    assert_eq!(span.kept_from_s, Some(3.0));
}
