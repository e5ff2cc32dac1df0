use proptest::prelude::*;

use super::*;
use crate::Quantity;

fn reader(text: &str, mapping: &ColumnMapping) -> Result<CsvReader<'static>, RecordError> {
    CsvReader::new(
        Box::new(std::io::Cursor::new(text.to_owned())),
        Path::new("hall.csv"),
        mapping,
    )
}

fn rows(text: &str, mapping: &ColumnMapping) -> Result<Vec<(i64, Vec<f64>)>, RecordError> {
    let mut reader = reader(text, mapping)?;
    let mut rows = Vec::new();
    while let Some(row) = reader.next_row()? {
        rows.push((row.time_ns, row.values.to_vec()));
    }
    Ok(rows)
}

fn message(text: &str) -> String {
    rows(text, &ColumnMapping::by_name(["a", "b"]))
        .unwrap_err()
        .to_string()
}

#[test]
fn values_come_in_the_order_of_the_mapping_and_other_columns_are_ignored() {
    let mapping = ColumnMapping::by_name(["b", "a"]);
    let found = rows("time,a,note,b\n0,1,calm,2\n0.5,3,windy,4\n", &mapping).unwrap();
    assert_eq!(found, [(0, vec![2.0, 1.0]), (500_000_000, vec![4.0, 3.0])]);
}

#[test]
fn units_become_si() {
    let mapping = ColumnMapping::new(vec![
        ChannelColumn::new("acceleration")
            .with_unit("g", Quantity::Acceleration)
            .unwrap(),
        ChannelColumn::new("displacement")
            .with_unit("mm", Quantity::Displacement)
            .unwrap(),
    ]);
    let found = rows("time,acceleration,displacement\n0,1,250\n", &mapping).unwrap();
    assert_eq!(found, [(0, vec![9.80665, 0.25])]);
}

#[test]
fn declared_unit_precedes_the_unit_in_the_header() {
    let column = |column: &str| ChannelColumn::new("roof").with_column(column);
    let read = |text: &str, column: ChannelColumn| rows(text, &ColumnMapping::new(vec![column]));
    let by_file = |name: &str| column(name).in_unit_of_file(Quantity::Acceleration);
    let found = read(
        "time,roof [g]\n0,2\n",
        by_file("roof [g]").with_calibration(-1.0, 0.5).unwrap(),
    )
    .unwrap();
    assert_eq!(
        found,
        [(0, vec![0.5 - 2.0 * 9.80665])],
        "the calibration acts after it, as with other formats"
    );
    let declared = column("roof (g)")
        .with_unit("gal", Quantity::Acceleration)
        .unwrap();
    assert_eq!(
        read("time,roof (g)\n0,2\n", declared).unwrap(),
        [(0, vec![0.02])]
    );
    assert_eq!(
        read("time,roof [south]\n0,2\n", by_file("roof [south]")).unwrap(),
        [(0, vec![2.0])]
    );
    assert_eq!(
        read("time,roof [g]\n0,2\n", column("roof [g]")).unwrap(),
        [(0, vec![2.0])]
    );
    let error = read("time,roof [mm]\n0,2\n", by_file("roof [mm]"))
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("roof") && error.contains("mm") && error.contains("acceleration"),
        "{error}"
    );
}

#[test]
fn empty_and_nan_fields_are_missing_samples() {
    let found = rows(
        "time,a,b\n0,,1\n1,NaN, \n",
        &ColumnMapping::by_name(["a", "b"]),
    )
    .unwrap();
    assert!(found[0].1[0].is_nan() && found[0].1[1] == 1.0);
    assert!(found[1].1.iter().all(|value| value.is_nan()));
}

#[test]
fn gap_in_time_remains_a_gap() {
    let found = rows(
        "time,a\n0,1\n0.01,2\n7.5,3\n",
        &ColumnMapping::by_name(["a"]),
    )
    .unwrap();
    let times: Vec<i64> = found.iter().map(|(time_ns, _)| *time_ns).collect();
    assert_eq!(times, [0, 10_000_000, 7_500_000_000]);
}

#[test]
fn windows_lines_byte_order_mark_and_white_space_are_read() {
    let found = rows(
        "\u{feff}time , a\r\n 0 , 1\r\n1, 2 \r\n",
        &ColumnMapping::by_name(["a"]),
    )
    .unwrap();
    assert_eq!(found, [(0, vec![1.0]), (1_000_000_000, vec![2.0])]);
}

#[test]
fn iso_8601_times_are_read() {
    let found = rows(
        "time,a\n2024-02-29T12:00:00Z,1\n2024-02-29T12:00:00.005Z,2\n",
        &ColumnMapping::by_name(["a"]),
    );
    let times: Vec<i64> = found.unwrap().iter().map(|(time_ns, _)| *time_ns).collect();
    assert_eq!(
        times,
        [1_709_208_000_000_000_000, 1_709_208_000_005_000_000]
    );
}

#[test]
fn error_names_all_missing_and_present_columns() {
    let error = reader("time_s,c\n", &ColumnMapping::by_name(["a", "b"]))
        .err()
        .unwrap();
    assert_eq!(
        error.to_string(),
        "hall.csv:1: has no column `time`, `a`, `b`; its columns are `time_s`, `c`"
    );
}

#[test]
fn empty_file_lacks_its_columns() {
    assert!(matches!(
        reader("", &ColumnMapping::by_name(["a"])),
        Err(RecordError::MissingColumns { ref found, .. }) if found.is_empty()
    ));
}

#[test]
fn repeated_column_is_refused_only_if_it_is_needed() {
    let text = "time,a,x,x\n0,1,2,3\n";
    assert!(rows(text, &ColumnMapping::by_name(["a"])).is_ok());
    assert!(matches!(
        reader(text, &ColumnMapping::by_name(["x"])),
        Err(RecordError::RepeatedColumn { ref column, .. }) if column == "x"
    ));
}

#[test]
fn errors_name_file_line_found_and_allowed() {
    assert_eq!(
        message("time,a,b\n0,1,2\n1,1.x,2\n"),
        "hall.csv:3: column `a` is `1.x`, must be a finite number, or empty for a missing sample"
    );
    assert_eq!(
        message("time,a,b\n0,inf,2\n"),
        "hall.csv:2: column `a` is `inf`, must be a finite number, or empty for a missing sample"
    );
    assert_eq!(
        message("time,a,b\n0,1\n"),
        "hall.csv:2: row has 2 fields, must have 3 like the header"
    );
    assert_eq!(
        message("time,a,b\nnoon,1,2\n"),
        "hall.csv:2: time is `noon`, must be seconds, ISO 8601, DD.MM.YYYY HH:MM or \
         YYYY/MM/DD HH:MM"
    );
    assert_eq!(
        message("time,a,b\n0,1,2\n2024-02-29T12:00:00Z,1,2\n"),
        "hall.csv:3: time is `2024-02-29T12:00:00Z`, must be a number as the first time of the file"
    );
    assert_eq!(
        message("time,a,b\n0,1,2\n0.5,1,2\n0.5,1,2\n"),
        "hall.csv:4: time 0.5 s is not later than 0.5 s of the previous row, must increase"
    );
    assert_eq!(
        message("time,a,b\n2019-03-07T08:39:06Z,1,2\n2019-03-07T08:09:02Z,1,2\n"),
        "hall.csv:3: time 2019-03-07T08:09:02Z is not later than 2019-03-07T08:39:06Z of the \
         previous row, must increase"
    );
}

/// Regression test: the error named the row after a wrong one, which is right.
#[test]
fn a_row_far_ahead_of_both_neighbours_is_named_itself() {
    let wrong_year = "2025-01-01T00:00:00Z,1,2\n2026-01-02T00:00:00Z,1,2\n2025-01-03T00:00:00Z,1,2";
    assert_eq!(
        message(&format!("time,a,b\n{wrong_year}\n")),
        "hall.csv:3: time 2026-01-02T00:00:00Z is far ahead of both neighbours, must be between \
         2025-01-01T00:00:00Z and 2025-01-03T00:00:00Z"
    );
    // Two rows in a wrong order, and a clock that was set back.
    for text in ["0,1,2\n3,1,2\n1,1,2", "5,1,2\n900,1,2\n2,1,2"] {
        let told = message(&format!("time,a,b\n{text}\n"));
        assert!(told.starts_with("hall.csv:4: time "), "{told}");
    }
}

#[test]
fn line_numbers_count_windows_lines_and_blank_lines() {
    assert!(message("time,a,b\r\n0,1,2\r\n1,1,2\r\n2,?,2\r\n").starts_with("hall.csv:4: "));
    assert!(message("time,a,b\r\n0,1,2\r\n\r\n2,?,2").starts_with("hall.csv:4: "));
    assert!(message("time,a,b\n0,1,2\n1,1").starts_with("hall.csv:3: "));
    assert!(message("time,a,b\n0,1,2\n\n\n2,?,2\n").starts_with("hall.csv:5: "));
}

proptest! {
    #[test]
    fn arbitrary_bytes_are_read_or_refused(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        let mut file = b"time,a\n0,1\n".to_vec();
        file.extend(bytes);
        let mapping = ColumnMapping::by_name(["a"]);
        let mut reader = CsvReader::new(Box::new(std::io::Cursor::new(file)), Path::new("x.csv"), &mapping).unwrap();
        while let Ok(Some(row)) = reader.next_row() {
            prop_assert!(!row.values[0].is_infinite());
        }
    }
}

#[test]
fn other_separators_and_decimal_commas_are_read() {
    let mapping = ColumnMapping::by_name(["a", "b"]);
    let expected = [(0, vec![1.5, -2.0]), (10_000_000, vec![0.25, 3.0])];
    for text in [
        "time;a;b\n0,00;1,5;-2\n0,01;0,25;3\n",
        "time\ta\tb\n0.00\t1.5\t-2\n0.01\t0.25\t3\n",
        "time\ta\tb\n0,00\t1,5\t-2\n0,01\t0,25\t3\n",
        "  time   a  b\n  0.00  1.5  -2\n  0.01 0.25   3\n",
        "sep=;\r\ntime;a;b\r\n0.00;1.5;-2\r\n0.01;0.25;3\r\n",
    ] {
        assert_eq!(rows(text, &mapping).unwrap(), expected, "{text}");
    }
}

#[test]
fn spreadsheets_with_their_dates_and_words_for_missing_values_are_read() {
    let mapping = ColumnMapping::by_name(["a", "b"]);
    let text = "time;a;b\r\n29.02.2024 12:00;1,5;NA\r\n29.02.2024 13:00;-;2\r\n\
                29.02.2024 14:00;#N/A;n/a\r\n";
    let mut reader = reader(text, &mapping).unwrap();
    let mut found = Vec::new();
    while let Some(row) = reader.next_row().unwrap() {
        found.push((
            row.time_ns,
            row.values.iter().filter(|value| value.is_nan()).count(),
        ));
    }
    let noon = 1_709_208_000_000_000_000;
    let hour = 3_600_000_000_000;
    assert_eq!(found, [(noon, 1), (noon + hour, 1), (noon + 2 * hour, 2)]);
    assert!(!reader.times_have_zone());
}

#[test]
fn rows_in_any_order_are_read_if_that_is_wanted() {
    let mapping = ColumnMapping::by_name(["a"]);
    let text = "time,a\n2,1\n1,2\n1,3\n";
    let mut reader = reader(text, &mapping).unwrap().in_any_order();
    let mut found = Vec::new();
    while let Some(row) = reader.next_row().unwrap() {
        found.push(row.time_ns);
    }
    assert_eq!(found, [2_000_000_000, 1_000_000_000, 1_000_000_000]);
    assert!(reader.times_have_zone());
}

#[test]
fn lines_before_the_header_count_in_line_numbers() {
    let mapping = ColumnMapping::by_name(["a"]);
    let text = "Recorder 7, hall\nStart: 2025-03-06\n\ntime,a\n0,1\n0.01,?\n";
    let error = rows(text, &mapping).unwrap_err();
    assert!(
        error
            .to_string()
            .starts_with("hall.csv:6: column `a` is `?`"),
        "{error}"
    );
}

#[test]
fn table_of_numbers_without_times_is_counted_at_the_declared_rate() {
    let columns = vec![
        ChannelColumn::new("roof").with_column("2"),
        ChannelColumn::new("base").with_column("1"),
    ];
    let mapping = ColumnMapping::new(columns).with_time(TimeSource::Counted { rate_hz: 100.0 });
    let found = rows("-3.359\t-0.052\t7\n-0.627\t-0.054\t8\n", &mapping).unwrap();
    assert_eq!(
        found,
        [
            (0, vec![-0.052, -3.359]),
            (10_000_000, vec![-0.054, -0.627])
        ]
    );
}

#[test]
fn times_in_microseconds_are_read() {
    let time = TimeSource::Column {
        name: "t".to_owned(),
        unit: TimeUnit::Microseconds,
    };
    let mapping = ColumnMapping::by_name(["a"]).with_time(time);
    let found = rows("n,t,a\n0,991011697,1\n1,991020030,2\n", &mapping).unwrap();
    assert_eq!(
        found,
        [(991_011_697_000, vec![1.0]), (991_020_030_000, vec![2.0])]
    );
}
