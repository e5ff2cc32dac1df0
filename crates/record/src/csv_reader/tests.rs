use proptest::prelude::*;

use super::*;
use crate::Quantity;

fn reader(text: &str, mapping: &ColumnMapping) -> Result<CsvReader, RecordError> {
    CsvReader::new(Box::new(std::io::Cursor::new(text.to_owned())), Path::new("hall.csv"), mapping)
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
    rows(text, &ColumnMapping::by_name(["a", "b"])).unwrap_err().to_string()
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
        ChannelColumn::new("acceleration").with_unit("g", Quantity::Acceleration).unwrap(),
        ChannelColumn::new("displacement").with_unit("mm", Quantity::Displacement).unwrap(),
    ]);
    let found = rows("time,acceleration,displacement\n0,1,250\n", &mapping).unwrap();
    assert_eq!(found, [(0, vec![9.80665, 0.25])]);
}

#[test]
fn empty_and_nan_fields_are_missing_samples() {
    let found = rows("time,a,b\n0,,1\n1,NaN, \n", &ColumnMapping::by_name(["a", "b"])).unwrap();
    assert!(found[0].1[0].is_nan() && found[0].1[1] == 1.0);
    assert!(found[1].1.iter().all(|value| value.is_nan()));
}

#[test]
fn gap_in_time_stays_a_gap() {
    let found = rows("time,a\n0,1\n0.01,2\n7.5,3\n", &ColumnMapping::by_name(["a"])).unwrap();
    let times: Vec<i64> = found.iter().map(|(time_ns, _)| *time_ns).collect();
    assert_eq!(times, [0, 10_000_000, 7_500_000_000]);
}

#[test]
fn windows_lines_byte_order_mark_and_white_space_are_read() {
    let found = rows("\u{feff}time , a\r\n 0 , 1\r\n1, 2 \r\n", &ColumnMapping::by_name(["a"])).unwrap();
    assert_eq!(found, [(0, vec![1.0]), (1_000_000_000, vec![2.0])]);
}

#[test]
fn iso_8601_times_are_read() {
    let found = rows("time,a\n2024-02-29T12:00:00Z,1\n2024-02-29T12:00:00.005Z,2\n", &ColumnMapping::by_name(["a"]));
    let times: Vec<i64> = found.unwrap().iter().map(|(time_ns, _)| *time_ns).collect();
    assert_eq!(times, [1_709_208_000_000_000_000, 1_709_208_000_005_000_000]);
}

#[test]
fn missing_columns_are_all_named_beside_those_that_are_there() {
    let error = reader("time_s,c\n", &ColumnMapping::by_name(["a", "b"])).err().unwrap();
    assert_eq!(error.to_string(), "hall.csv:1: has no column `time`, `a`, `b`; its columns are `time_s`, `c`");
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
    assert_eq!(message("time,a,b\n0,1\n"), "hall.csv:2: row has 2 fields, must have 3 as the header");
    assert_eq!(message("time,a,b\nnoon,1,2\n"), "hall.csv:2: time is `noon`, must be seconds or ISO 8601");
    assert_eq!(
        message("time,a,b\n0,1,2\n2024-02-29T12:00:00Z,1,2\n"),
        "hall.csv:3: time is `2024-02-29T12:00:00Z`, must be in seconds as the first time of the file"
    );
    assert_eq!(
        message("time,a,b\n0,1,2\n0.5,1,2\n0.5,1,2\n"),
        "hall.csv:4: time 0.5 s is not later than 0.5 s of the row before, must increase"
    );
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
