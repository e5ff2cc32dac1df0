use std::path::PathBuf;

use super::*;

fn recording(text: &str, offset: OffsetRemoval) -> Recording {
    let mapping = ColumnMapping::by_name(["a", "b"]);
    let input = Box::new(std::io::Cursor::new(text.to_owned()));
    let reader = CsvReader::new(input, &PathBuf::from("hall.csv"), &mapping).unwrap();
    Recording::new(Box::new(reader), offset).unwrap()
}

fn all_rows(recording: &mut Recording) -> Vec<(i64, Vec<f64>)> {
    let mut rows = Vec::new();
    while let Some(row) = recording.next_row().unwrap() {
        rows.push((row.time_ns, row.values.to_vec()));
    }
    rows
}

/// Returns `count` rows at `rate_hz` with times of `digits` digits. Channel `a` is the row number,
/// and `b` is 1.
fn regular_text(rate_hz: f64, count: usize, digits: usize) -> String {
    let rows = (0..count).map(|row| format!("{:.digits$},{row},1\n", row as f64 / rate_hz));
    std::iter::once("time,a,b\n".to_owned())
        .chain(rows)
        .collect()
}

#[test]
fn rounded_times_give_the_declared_rate() {
    // 120 Hz to µs as in the shake table records, and to ms as loggers print it. Two rows suffice
    // for µs.
    for (count, digits) in [(5000, 6), (5000, 3), (2, 6)] {
        let recording = recording(&regular_text(120.0, count, digits), OffsetRemoval::Keep);
        assert_eq!(
            recording.check_sampling_rate(120.0).unwrap(),
            120.0,
            "{count} rows, {digits} digits"
        );
    }
}

#[test]
fn another_rate_than_declared_is_refused() {
    let recording = recording(&regular_text(120.0, 2000, 6), OffsetRemoval::Keep);
    let error = recording.check_sampling_rate(100.0).unwrap_err();
    assert_eq!(
        error.to_string(),
        "hall.csv: is sampled at 120.0000 Hz, must be 100 Hz as declared"
    );
}

#[test]
fn gaps_do_not_change_the_rate() {
    let text = "time,a,b\n0,1,1\n0.01,1,1\n0.02,1,1\n5,1,1\n5.01,1,1\n9,1,1\n9.01,1,1\n";
    assert!(
        (recording(text, OffsetRemoval::Keep)
            .sampling_rate_hz()
            .unwrap()
            - 100.0)
            .abs()
            < 1e-9
    );
}

#[test]
fn one_row_has_no_rate() {
    let error = recording("time,a,b\n0,1,1\n", OffsetRemoval::Keep)
        .sampling_rate_hz()
        .unwrap_err();
    assert!(matches!(error, RecordError::TooShort { rows: 1, .. }));
}

#[test]
fn no_rows_are_lost_after_the_look_ahead() {
    let rows = all_rows(&mut recording(
        &regular_text(100.0, 3456, 2),
        OffsetRemoval::Keep,
    ));
    let numbers: Vec<f64> = rows.iter().map(|(_, values)| values[0]).collect();
    let expected: Vec<f64> = (0..3456).map(f64::from).collect();
    assert_eq!(numbers, expected);
}

#[test]
fn mean_of_the_first_seconds_is_removed_from_the_whole_channel() {
    let text = "time,a,b\n10,1,\n10.5,3,\n11,10,7\n11.5,20,8\n";
    let mut recording = recording(text, OffsetRemoval::MeanOfFirst { seconds: 1.0 });
    assert_eq!(recording.offsets(), [Some(2.0), None]);
    let rows = all_rows(&mut recording);
    let a: Vec<f64> = rows.iter().map(|(_, values)| values[0]).collect();
    assert_eq!(a, [-1.0, 1.0, 8.0, 18.0]);
    // The span contains no sample of `b`, so its values are unchanged.
    assert_eq!(rows[3].1[1], 8.0);
}

#[test]
fn span_of_the_offset_may_be_longer_than_the_look_ahead_and_than_the_record() {
    for seconds in [15.0, 1e9, 1e300] {
        let mut recording = recording(
            &regular_text(100.0, 3000, 2),
            OffsetRemoval::MeanOfFirst { seconds },
        );
        let averaged = if seconds < 30.0 { 1500.0 } else { 3000.0 };
        assert_eq!(recording.offsets()[0], Some((averaged - 1.0) / 2.0));
        assert_eq!(all_rows(&mut recording).len(), 3000);
    }
}

#[test]
fn span_of_the_offset_must_be_positive() {
    for seconds in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let reader = CsvReader::new(
            Box::new(&b"time\n"[..]),
            &PathBuf::from("x.csv"),
            &ColumnMapping::new(Vec::new()),
        );
        let error = Recording::new(
            Box::new(reader.unwrap()),
            OffsetRemoval::MeanOfFirst { seconds },
        );
        assert!(
            matches!(error, Err(RecordError::OffsetSpan { .. })),
            "{seconds}"
        );
    }
}

#[test]
fn unknown_format_names_the_known_ones() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.xlsx");
    std::fs::write(&path, [0, 1, 2, 3]).unwrap();
    let error = Recording::open(&path, &ColumnMapping::by_name(["a"]), OffsetRemoval::Keep)
        .err()
        .unwrap()
        .to_string();
    assert!(
        error.ends_with(
            "unknown format, must be one of text table (CSV), miniSEED, COSMOS, CSMIP volume 2, \
        MATLAB level 5, universal file (58), PEER AT2, SMC, TDMS, MCAP, gzip, zip archive, folder"
        ),
        "{error}"
    );
}
